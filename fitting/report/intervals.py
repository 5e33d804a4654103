"""Intervals of parameters under model discrepancy."""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np

from fitting import formatting
from fitting.attribution.candidate_fit import Trial
from fitting.attribution.rules import RULES
from fitting.attribution.selection_round import Round
from fitting.outcome import Loop, kept_rounds
from fitting.uncertainty.standard_errors import uncertainty
from fitting.validation.derived_quantities import derived, drive_figures

NOT_COVERED = "not covered"
"""Flag of a parameter whose interval does not include model discrepancy."""
_WITHHELD = "withheld"
_TIED = (
    "Intervals of the drive's parameters include those of tied forms of the same family, which exceed them by more "
    "than a standard error."
)


def is_withheld(estimate: Mapping[str, Any]) -> bool:
    """Whether no interval is stated, because a large discrepancy is not explained."""
    return estimate.get("interval") == _WITHHELD


def widen_by_ties(after: dict[str, Any], outcome: Loop, x_max: float) -> None:
    """Extend the intervals of the drive's parameters and derived figures to those of tied forms of an effect's family.

    The data determine the family but not the law, and K depends on it by more than its standard error. Forms of other
    families may define K in another way; they are told as alternatives. Fits of the search are shorter than the final
    one, so a tied form's interval is taken relative to that of the chosen form in the same round.

    Args:
        after: the final model's content in the report.
        outcome: of the loop.
        x_max: the largest measured twist.
    """
    entries = after["parameters"] | after["derived"]
    stated = {path: entry["ci95"] for path, entry in entries.items()}
    for this in kept_rounds(outcome):
        for changes in _tied_of_the_family(this, x_max):
            for path in changes.keys() & entries.keys():
                entry, (move, wider) = entries[path], changes[path]
                (low, high), value, ends = stated[path], entry["value"], entry["ci95"]
                theirs = value + move + wider * (low - value), value + move + wider * (high - value)
                entry["ci95"] = [min(ends[0], theirs[0]), max(ends[1], theirs[1])]
                if max(low - theirs[0], theirs[1] - high) > entry["std"]:
                    entry["note"] = entry.get("note") or _TIED


class _Change(NamedTuple):
    """How much a tied form moves a figure, and how many times as uncertain it is."""

    move: float
    wider: float


def _tied_of_the_family(this: Round, x_max: float) -> Iterator[dict[str, _Change]]:
    """How each tied form of the chosen one's family changes the drive's figures."""
    chosen = this.winner
    others = [v for v in this.verdicts if v is not chosen and v.family == chosen.family and not v.separable]
    tied = [v.trial for v in others if v.trial is not None]
    if not tied:
        return
    assert chosen.trial is not None
    own = _figures(chosen.trial, x_max)
    for trial in tied:
        theirs = _figures(trial, x_max)
        yield {path: _change(own[path], theirs[path]) for path in own.keys() & theirs.keys()}


def _change(own: tuple[float, float], theirs: tuple[float, float]) -> _Change:
    wider = theirs[1] / own[1] if own[1] > 0.0 else 1.0
    return _Change(theirs[0] - own[0], wider if np.isfinite(wider) else 1.0)


def _figures(trial: Trial, x_max: float) -> dict[str, tuple[float, float]]:
    """Value and standard error of the drive's parameters and derived figures."""
    known = uncertainty(trial.training, torque_noise=False)
    figures = derived(trial.model, known, drive_figures, x_max)
    parameters = {path: e for path, e in known.estimates.items() if "." not in path}
    return {name: (figure.value, figure.std) for name, figure in (parameters | figures).items()}


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
