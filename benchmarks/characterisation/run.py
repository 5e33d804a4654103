"""Run the commands that have no result yet, and store what each gave. See README.md beside this file.

python benchmarks/characterisation/run.py --out before.json --shared ../shared
"""

import argparse
import json
import os
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parents[1]))

from characterisation.case import GROUPS, Case
from characterisation.execute import Ended, environment, execute
from characterisation.inputs import write_inputs
from characterisation.quick_cases import quick_cases
from characterisation.reading import Record, options_of, read_results
from characterisation.shared_cases import convergence_cases, practice_cases

SCHEMA = "characterisation/1"

_HERE = Path(__file__).parent
_WHERE = "import importlib.util as u; print(u.find_spec('fitting').origin)"
_MOST_LETTERS = 400


@dataclass(frozen=True)
class Places:
    """Folders of a run.

    Attributes:
        work: what the run writes but for its results.
        repo: the checkout that is characterised.
        shared: measured data and practice logs; None where not given.
        cache: kept programs.
    """

    work: Path
    repo: Path
    shared: Path | None
    cache: Path

    @property
    def outs(self) -> Path:
        """Folder of all cases' folders."""
        return self.work / "out"

    def filled(self, text: str, case: Case) -> str:
        """An argument with its placeholders filled in."""
        for mark, path in self._marks(case):
            text = text.replace(f"{{{mark}}}", str(path))
        return text

    def hidden(self, text: str, case: Case) -> str:
        """A text with marks in place of this machine's paths."""
        for mark, path in self._marks(case):
            text = text.replace(str(path), f"{{{mark}}}")
        return text

    def _marks(self, case: Case) -> Iterator[tuple[str, Path]]:
        yield "out", self.outs / case.name
        yield "outs", self.outs
        yield "inputs", self.work / "inputs"
        if self.shared is not None:
            yield "shared", self.shared
        yield "repo", self.repo
        yield "cache", self.cache
        yield "work", self.work


def main() -> None:
    """Run what is asked for, one command at a time."""
    args = _arguments()
    python = shlex.split(args.python)
    places = _places(args, python)
    stored = _stored(args.out, places)
    stored["inputs"] = write_inputs(places.work / "inputs")
    cases = _asked([*quick_cases(), *practice_cases(), *convergence_cases()], args)
    for number, case in enumerate(cases, start=1):
        known = stored["results"].get(case.name)
        if known is not None and known["status"] in ("done", "timeout") and not args.again:
            continue
        record = _run(case, places, python, args)
        stored["results"][case.name] = record
        _store(args.out, stored)
        print(f"{number:3d} of {len(cases)}  {case.name:<36} {_line(record)}", flush=True)


def _arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="JSON file; commands that it holds are not run again")
    parser.add_argument("--work", type=Path, help="folder for inputs and results; beside --out where not given")
    parser.add_argument("--group", nargs="+", choices=GROUPS, default=list(GROUPS))
    parser.add_argument("--only", nargs="+", help="commands of these names alone")
    parser.add_argument("--again", action="store_true", help="run commands that have a result as well")
    parser.add_argument("--shared", type=Path, help="folder with the practice logs and the measured data")
    parser.add_argument("--python", default=shlex.quote(sys.executable), help="interpreter and its options")
    parser.add_argument("--command", help="prefix in place of the entry point of the checkout that Python finds")
    parser.add_argument("--timeout", type=float, default=600.0, help="of commands without a limit of their own [s]")
    parser.add_argument("--cache-dir", type=Path, help="folder of kept programs; one below --work where not given")
    return parser.parse_args()


def _places(args: argparse.Namespace, python: list[str]) -> Places:
    work = (args.work or args.out.with_suffix("")).absolute()
    work.mkdir(parents=True, exist_ok=True)
    cache = (args.cache_dir or work / "cache").absolute()
    cache.mkdir(parents=True, exist_ok=True)
    own = environment(cache, script=False)
    command = [*python, "-P", "-c", _WHERE]
    found = subprocess.run(command, cwd=work, env=own, capture_output=True, text=True, check=True).stdout.strip()
    print(f"fitting is {found}", flush=True)
    return Places(work, Path(found).parents[1], args.shared.absolute() if args.shared else None, cache)


def _stored(path: Path, places: Places) -> dict[str, Any]:
    """The results so far.

    Raises:
        SystemExit: where they are of another checkout.
    """
    if not path.exists():
        return {"schema": SCHEMA, "checkout": str(places.repo), "inputs": "", "results": {}}
    stored = json.loads(path.read_text(encoding="utf-8"))
    if stored["checkout"] != str(places.repo):
        raise SystemExit(f"{path}: its results are of {stored['checkout']}; give another --out, or set PYTHONPATH")
    return stored


def _store(path: Path, stored: dict[str, Any]) -> None:
    waiting = path.with_name(f".{path.name}")
    waiting.write_text(json.dumps(stored, indent=1) + "\n", encoding="utf-8")
    os.replace(waiting, path)


def _asked(cases: list[Case], args: argparse.Namespace) -> list[Case]:
    """The cases that are to run.

    Raises:
        SystemExit: where a name is none of theirs.
    """
    unknown = set(args.only or ()) - {case.name for case in cases}
    if unknown:
        raise SystemExit(f"no such commands: {', '.join(sorted(unknown))}")
    return [case for case in cases if (case.name in args.only if args.only else case.group in args.group)]


def _run(case: Case, places: Places, python: list[str], args: argparse.Namespace) -> Record:
    reason = _missing(case, places)
    if reason is not None:
        return {"status": "not available", "reason": reason}
    out = places.outs / case.name
    shutil.rmtree(out, ignore_errors=True)
    out.mkdir(parents=True)
    arguments = [places.filled(argument, case) for argument in case.arguments]
    own = environment(places.cache, script=case.runs != "command")
    limit = args.timeout if case.timeout is None else case.timeout
    ended = execute([*_prefix(case, python, args), *arguments], folder=places.work, environment=own, timeout=limit)
    measured = None if case.measured is None else Path(places.filled(case.measured, case))
    record = {
        "status": "done" if ended.exit_code is not None else "timeout",
        "group": case.group,
        "command": " ".join(case.arguments),
        "exit_code": ended.exit_code,
        "seconds": round(ended.seconds, 2),
        "processor_seconds": round(ended.processor_seconds, 2),
    } | _told(case, places, ended)
    found = read_results(
        out, stdout=places.hidden(ended.stdout, case), printed=case.printed, measured=measured, ratio=case.ratio
    )
    if "--help" in case.arguments:
        found["schema"] = options_of(ended.stdout)
    return record | found


def _prefix(case: Case, python: list[str], args: argparse.Namespace) -> list[str]:
    if case.runs == "script":
        return [*python, "-P"]
    if case.runs == "probe":
        return [*python, "-P", str(_HERE / "probe.py")]
    return shlex.split(args.command) if args.command else [*python, "-P", str(_HERE / "entry.py")]


def _missing(case: Case, places: Places) -> str | None:
    """Why a case can't be run."""
    absent = [module for module in case.modules if find_spec(module) is None]
    if absent:
        return f"{', '.join(absent)} is not installed"
    if any("{shared}" in argument for argument in case.arguments):
        if places.shared is None:
            return "needs --shared"
        files = [Path(places.filled(a, case)) for a in case.arguments if a.startswith("{shared}")]
        lost = [places.hidden(str(path), case) for path in files if not path.exists()]
        if lost:
            return f"{lost[0]} is absent"
    for name in case.after:
        if not (places.outs / name / "model.json").exists():
            return f"{name} left no model.json"
    return None


def _told(case: Case, places: Places, ended: Ended) -> Record:
    """What the command said on stderr: its first line, and whether a traceback was among it."""
    lines = [line for line in places.hidden(ended.stderr, case).splitlines() if line.strip()]
    traceback = any(line.startswith("Traceback") for line in lines)
    first = lines[-1 if traceback else 0][:_MOST_LETTERS] if lines else None
    return {"stderr": first, "traceback": traceback}


def _line(record: Record) -> str:
    if record["status"] == "not available":
        return f"not available: {record['reason']}"
    told = [
        f"exit {record['exit_code']}" if record["status"] == "done" else "out of time",
        f"{record['seconds']:.0f} s",
    ]
    if record["decision"]:
        told.append(f"{record['decision']}: {', '.join(record['names'].get('after.effects', [])) or 'nothing'}")
    if record["stderr"]:
        told.append(record["stderr"])
    return "; ".join(told)


if __name__ == "__main__":
    main()
