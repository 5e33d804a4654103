"""Print what changed between two characterisations, and exit 1 where it is more than numbers.

    python benchmarks/characterisation/compare.py before.json after.json

Decisions, names, exit codes and keys of the results are compared exactly. Numbers are compared in units of their
standard error where they have one, else relative to their size; processor and wall time are never compared.
"""

import argparse
import json
import math
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

Record = dict[str, Any]


@dataclass(frozen=True)
class Change:
    """One difference.

    Attributes:
        kind: what differs.
        text: from what to what.
        size: of a number's change, in units of what is tolerated.
        fails: whether it is one that must not be.
    """

    kind: str
    text: str
    size: float = 0.0
    fails: bool = False


@dataclass(frozen=True)
class Tolerance:
    """Largest changes of numbers that are not told.

    Attributes:
        sigmas: in standard errors.
        relative: of numbers without one.
    """

    sigmas: float = 0.1
    relative: float = 1e-3


def changes(before: Record, after: Record, tolerance: Tolerance) -> list[Change]:
    """All differences of one command's results."""
    if before["status"] != after["status"]:
        told = f"{_status(before)} -> {_status(after)}"
        return [Change("status", told, fails=before["status"] == "done")]
    if before["status"] != "done":
        return []
    found = []
    for key, name in (("exit_code", "exit code"), ("decision", "decision"), ("traceback", "traceback")):
        if before[key] != after[key]:
            found.append(Change(name, f"{before[key]} -> {after[key]}", fails=True))
    for key in sorted(before["names"].keys() | after["names"].keys()):
        one, other = before["names"].get(key), after["names"].get(key)
        if one != other:
            found.append(Change(f"names, {key}", f"{one} -> {other}", fails=True))
    found += _of_sets("keys", before["schema"], after["schema"], fails=True)
    found += _of_sets("files", before["files"], after["files"], fails=False)
    if before["stderr"] != after["stderr"]:
        found.append(Change("stderr", f"{before['stderr']}\n      -> {after['stderr']}"))
    for path in sorted(before["words"].keys() & after["words"].keys()):
        one, other = before["words"][path], after["words"][path]
        if one != other:
            found.append(Change("word", f"{path}: {_short(one)} -> {_short(other)}"))
    return found + sorted(_of_numbers(before, after, tolerance), key=lambda change: -change.size)


def _status(record: Record) -> str:
    return f"{record['status']}{': ' + record['reason'] if 'reason' in record else ''}"


def _short(word: Any) -> str:
    return str(word) if len(str(word)) <= 100 else f"{str(word)[:100]}..."


def _of_sets(kind: str, before: list[str], after: list[str], *, fails: bool) -> Iterator[Change]:
    for name, lost, gained in (("gone", before, after), ("new", after, before)):
        apart = sorted(set(lost) - set(gained))
        if apart:
            yield Change(f"{kind} {name}", ", ".join(apart), fails=fails)


def _of_numbers(before: Record, after: Record, tolerance: Tolerance) -> Iterator[Change]:
    for path in sorted(before["figures"].keys() & after["figures"].keys()):
        one, other = before["figures"][path], after["figures"][path]
        if one.get("identifiable") != other.get("identifiable"):
            told = f"{path}: identifiable {one.get('identifiable')} -> {other.get('identifiable')}"
            yield Change("number", told, math.inf)
        std = one.get("std")
        yield from _of_number(path, one["value"], other["value"], std, tolerance)
        if std is not None or other.get("std") is not None:
            yield from _of_number(f"{path}, standard error", std, other.get("std"), None, tolerance)


def _of_number(
    path: str, before: float | None, after: float | None, std: float | None, tolerance: Tolerance
) -> Iterator[Change]:
    if before == after:
        return
    if before is None or after is None:
        yield Change("number", f"{path}: {before} -> {after}", math.inf)
        return
    shift = abs(after - before)
    if std:
        size, told = shift / std / tolerance.sigmas, f"{shift / std:.3g} standard errors"
    else:
        relative = shift / max(abs(before), abs(after))
        size, told = relative / tolerance.relative, f"{100 * relative:.3g} %"
    # A comparison that fails on NaN as well.
    if not size <= 1.0:
        yield Change("number", f"{path}: {before:.8g} -> {after:.8g} ({told})", size)


def main() -> None:
    """Compare two files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--sigmas", type=float, default=0.1, help="change of an estimate in standard errors")
    parser.add_argument("--relative", type=float, default=1e-3, help="change of other numbers")
    parser.add_argument("--most", type=int, default=8, help="numbers and words told of each command")
    parser.add_argument("--new-keys", action="store_true", help="keys that were added are no failure")
    args = parser.parse_args()
    before, after = (json.loads(path.read_text(encoding="utf-8")) for path in (args.before, args.after))
    if before["inputs"] != after["inputs"]:
        print("The two ran on other inputs: numbers differ for that reason alone.")
    both = [name for name in before["results"] if name in after["results"]]
    failed = 0
    for name in both:
        found = changes(before["results"][name], after["results"][name], Tolerance(args.sigmas, args.relative))
        failing = [c for c in found if c.fails and not (args.new_keys and c.kind == "keys new")]
        failed += bool(failing)
        _show(name, found, failing, args.most)
    for told, one, other in (("after", before, after), ("before", after, before)):
        lost = [name for name in one["results"] if name not in other["results"]]
        if lost:
            print(f"Not run {told}: {', '.join(lost)}")
    print(f"{len(both)} commands compared; {failed} with changes of decision, name, exit code or keys")
    sys.exit(1 if failed else 0)


def _show(name: str, found: list[Change], failing: list[Change], most: int) -> None:
    if not found:
        return
    print(f"{'CHANGED' if failing else 'numbers'}  {name}")
    for kind in dict.fromkeys(change.kind for change in found):
        same = [change for change in found if change.kind == kind]
        shown = same[:most] if kind in ("number", "word") else same
        for change in shown:
            print(f"    {'! ' if change in failing else ''}{kind}: {change.text}")
        if len(same) > len(shown):
            print(f"    and {len(same) - len(shown)} more of kind {kind}")


if __name__ == "__main__":
    main()
