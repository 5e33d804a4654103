"""Intervals of parameters under model discrepancy."""

from collections.abc import Iterator, Mapping
from typing import Any

from fitting import formatting
from fitting.attribution.rules import RULES
from fitting.attribution.selection_round import Round
from fitting.outcome import Loop, kept_rounds
from fitting.validation.derived_quantities import drive_figures
from hdjax import Model

NOT_COVERED = "not covered"
"""Flag of a parameter whose interval does not include model discrepancy."""
_WITHHELD = "withheld"
_TIED = (
    "Intervals of the drive's parameters include tied forms of the same family, which change them by more than a "
    "standard error."
)


def is_withheld(estimate: Mapping[str, Any]) -> bool:
    """Whether no interval is stated, because a large discrepancy is not explained."""
    return estimate.get("interval") == _WITHHELD


def widen_by_ties(after: dict[str, Any], outcome: Loop, x_max: float) -> None:
    """Extend the intervals of the drive's parameters and derived figures to all tied forms of an effect's family.

    The data determine the family but not the law, and K depends on it by more than its standard error. Forms of other
    families may define K in another way; they are told as alternatives.

    Args:
        after: the final model's content in the report.
        outcome: of the loop.
        x_max: the largest measured twist.
    """
    entries = after["parameters"] | after["derived"]
    for this in kept_rounds(outcome):
        for moves in _tied_of_the_family(this, x_max):
            for path in moves.keys() & entries.keys():
                entry, move = entries[path], moves[path]
                low, high = entry["ci95"]
                entry["ci95"] = [min(low, low + move), max(high, high + move)]
                if abs(move) > entry["std"]:
                    entry["note"] = entry.get("note") or _TIED


def _tied_of_the_family(this: Round, x_max: float) -> Iterator[dict[str, float]]:
    """By how much each tied form of the chosen one's family changes the drive's figures."""
    chosen = this.winner
    assert chosen.trial is not None
    own = _figures(chosen.trial.model, x_max)
    for verdict in this.verdicts:
        if verdict.trial is not None and verdict.family == chosen.family and not verdict.separable:
            theirs = _figures(verdict.trial.model, x_max)
            yield {path: theirs[path] - own[path] for path in own.keys() & theirs.keys()}


def _figures(model: Model, x_max: float) -> dict[str, float]:
    known = {path: float(value) for path, (value, _) in model.parameters().items() if "." not in path}
    return known | {name: float(value) for name, (value, _) in drive_figures(model, x_max).items()}


def say_what_intervals_hold(report: dict[str, Any]) -> None:
    """Mark the intervals of the drive's parameters and derived figures under a large discrepancy; withhold them where
    that is not explained, or where a learned torque acts in the mesh.

    The parameters absorb a part of what is missing, and this bias exceeds their standard errors. A learned torque in
    the mesh may hold a part of the spring's and the damper's torque, so that these are not unique.

    Args:
        report: its content so far, with finite numbers only.
    """
    unexplained = report["decision"] == "unexplained"
    final = report["evidence"]["final"]
    times_noise, beyond = report["times_noise"], None if final["replaced"] else final["surprise"]
    left = None
    if times_noise >= RULES.excess:
        left = f"The model's residual is {formatting.number(times_noise)} times the noise"
    elif beyond is not None and beyond > RULES.surprise:
        ratio = report["free_runs_times_expected"]
        # An infinite ratio is null in a report.
        left = "Free runs diverge"
        if ratio is not None:
            left = f"Free runs err by {formatting.number(ratio)} times what noise and uncertainty allow"
    learned = report.get("unknown") or {}
    names = formatting.words(list(report["before"]["parameters"]))
    if (learned.get("place"), learned.get("quantity"), report["parameters_from"]) == ("mesh", "torque", "torque"):
        note = f"A learned torque acts beside {names} in the mesh: they are not unique, their intervals withheld."
        _mark(report["after"], note, withheld=True)
    if not (unexplained or left):
        return
    withheld = unexplained and left is not None
    left = left or "The model discrepancy is not explained"
    end = "their intervals are withheld" if withheld else "their intervals do not include that"
    note = f"{left}: {names} may be off by more than their standard errors, and {end}."
    # One side's own equation leaves no more than noise.
    ends = ("before", "after") if report["parameters_from"] == "torque" else ("before",)
    for account in (report[end] for end in ends):
        _mark(account, note, withheld=withheld)


def _mark(account: dict[str, Any], note: str, *, withheld: bool) -> None:
    for estimate in (*account["parameters"].values(), *account["derived"].values()):
        if withheld:
            estimate["ci95"], estimate["interval"] = [None, None], _WITHHELD
        estimate["flag"] = estimate["flag"] or NOT_COVERED
        estimate["note"] = estimate.get("note") or note
