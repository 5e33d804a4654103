"""Decide stored cases anew under other rules: which rule changes anything. See benchmarks/README.md.

    python benchmarks/undeclared/replay.py study/results
    python benchmarks/undeclared/replay.py study/results --pairs
    python benchmarks/undeclared/replay.py study/results --set significance=0.02

The cases are results of `run.py`, or reports of `hdjax close-loop`, which store their evidence.
"""

import argparse
import itertools
import json
import sys
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from fitting.attribution.case_evidence import CaseEvidence, case_evidence
from fitting.attribution.decisions import Decision, decide
from fitting.attribution.rules import RULES, DecisionRules

# What each rule is where it is switched off: it then lets everything pass. The others decide what is evidence.
OFF: Mapping[str, float] = {
    "significance": 1.0,
    "least_gain": -np.inf,
    "tie_level": 0.0,
    "same_gain": 0.0,
    "strength_errors": -np.inf,
    "at_bounds": np.inf,
    "excess": np.inf,
    "explained": -np.inf,
    "little": 0.0,
    "come_out": 0.0,
    "lasting": -np.inf,
    "noise_gain": -np.inf,
    "innovations": np.inf,
    "surprise": np.inf,
    "free_run_explained": -np.inf,
}


def main() -> None:
    """Print how many cases each rule changes when it is switched off, or those that a change of thresholds changes."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, nargs="+", help="of results, or of reports")
    parser.add_argument("--pairs", action="store_true", help="which rules hide each other: two switched off at once")
    parser.add_argument("--set", nargs="+", default=[], metavar="RULE=VALUE", help="thresholds to decide with")
    args = parser.parse_args()
    cases = read_cases(args.folder)
    if args.set:
        changed = {name: float(value) for name, value in (pair.split("=") for pair in args.set)}
        for name, what in differing(cases, replace(RULES, **changed)).items():
            print(f"{name}: {what}")
        return
    print(f"{len(cases)} cases\n")
    if args.pairs:
        _print_hidden(cases)
        return
    print("| rule switched off | decisions that change | candidates or questions that change | cases |")
    print("|---|---|---|---|")
    for rule, value in OFF.items():
        found = differing(cases, replace(RULES, **{rule: value}))
        outcomes = [name for name, what in found.items() if "->" in what]
        shown = ", ".join(list(found)[:4]) + (", ..." if len(found) > 4 else "")
        print(f"| `{rule}` | {len(outcomes)} | {len(found) - len(outcomes)} | {shown} |")


def _print_hidden(cases: Mapping[str, CaseEvidence]) -> None:
    """Print the pairs of rules that together change cases that neither changes alone."""
    alone = {rule: set(differing(cases, replace(RULES, **{rule: value}))) for rule, value in OFF.items()}
    for (one, off), (other, also) in itertools.combinations(OFF.items(), 2):
        both = differing(cases, replace(RULES, **{one: off, other: also}))
        further = sorted(set(both) - alone[one] - alone[other])
        if further:
            print(f"{one} and {other}: {len(further)} further, {', '.join(further[:4])}")


def read_cases(folders: list[Path]) -> dict[str, CaseEvidence]:
    """The evidence of every case in some folders, by its file's name, or its folder's for a report."""
    found = {}
    for path in sorted(path for folder in folders for path in folder.rglob("*.json")):
        stored = json.loads(path.read_text(encoding="utf-8"))
        if stored.get("evidence"):
            found[path.parent.name if path.name == "report.json" else path.stem] = case_evidence(stored["evidence"])
    return found


def differing(cases: Mapping[str, CaseEvidence], rules: DecisionRules) -> dict[str, str]:
    """The cases on which other rules differ, with what they say.

    Args:
        cases: evidence by name.
        rules: the other rules.
    """
    pairs = {name: (decide(case), decide(case, rules)) for name, case in cases.items()}
    return {name: what for name, (now, then) in pairs.items() if (what := _difference(now, then)) is not None}


def _difference(now: Decision, then: Decision) -> str | None:
    if then.lacking is not None and then.lacking != now.lacking:
        return then.lacking
    return None if now.outcome == then.outcome else f"{now.outcome} -> {then.outcome}"


if __name__ == "__main__":
    main()
