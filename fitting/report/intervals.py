"""Intervals of parameters under model discrepancy."""

from collections.abc import Mapping
from typing import Any

from fitting import formatting
from fitting.attribution.rules import RULES

NOT_COVERED = "not covered"
"""Flag of a parameter whose interval does not include model discrepancy."""
_WITHHELD = "withheld"


def is_withheld(estimate: Mapping[str, Any]) -> bool:
    """Whether no interval is stated, because a large discrepancy is not explained."""
    return estimate.get("interval") == _WITHHELD


def say_what_intervals_hold(report: dict[str, Any], times_noise: float) -> None:
    """Mark the intervals of the drive's parameters and derived figures under a large discrepancy; withhold them where
    that is not explained, or where a learned torque acts in the mesh.

    The parameters absorb a part of what is missing, and this bias exceeds their standard errors. A learned torque in
    the mesh may hold a part of the spring's and the damper's torque, so that these are not unique.

    Args:
        report: its content so far, with finite numbers only.
        times_noise: residual of the final model over the measurement noise.
    """
    unexplained = report["decision"] == "unexplained"
    much = times_noise >= RULES.excess
    learned = report.get("unknown") or {}
    names = formatting.words(list(report["before"]["parameters"]))
    if (learned.get("place"), learned.get("quantity")) == ("mesh", "torque"):
        note = f"A learned torque acts beside {names} in the mesh: they are not unique, their intervals withheld."
        _mark(report["after"], note, withheld=True)
    if not (unexplained or much):
        return
    left = (
        f"The model's residual is {formatting.number(times_noise)} times the noise"
        if much
        else "The model discrepancy is not explained"
    )
    end = "their intervals are withheld" if unexplained and much else "their intervals do not include that"
    note = f"{left}: {names} may be off by more than their standard errors, and {end}."
    for account in (report["before"], report["after"]):
        _mark(account, note, withheld=unexplained and much)


def _mark(account: dict[str, Any], note: str, *, withheld: bool) -> None:
    for estimate in (*account["parameters"].values(), *account["derived"].values()):
        if withheld:
            estimate["ci95"], estimate["interval"] = [None, None], _WITHHELD
        estimate["flag"] = estimate["flag"] or NOT_COVERED
        estimate["note"] = estimate.get("note") or note
