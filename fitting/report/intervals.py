"""Intervals of parameters where something is left that the model does not know."""

from collections.abc import Mapping
from typing import Any

from fitting import formatting
from fitting.attribution.rules import RULES

NOT_COVERED = "not covered"
"""Flag of a parameter whose interval knows nothing of what is missing."""
_WITHHELD = "withheld"


def is_withheld(estimate: Mapping[str, Any]) -> bool:
    """Whether no interval is stated, because too much is left that has no name."""
    return estimate.get("interval") == _WITHHELD


def say_what_intervals_hold(report: dict[str, Any], times_noise: float) -> None:
    """Mark the intervals of the drive's own parameters, and of derived figures, where much is left; withhold them where
    it has no name.

    What is missing stands in part in the parameters, by more than any standard error tells.

    Args:
        report: its content so far, with finite numbers only.
        times_noise: what the final model leaves, over the measurement noise.
    """
    unexplained = report["decision"] == "unexplained"
    much = times_noise >= RULES.excess
    if not (unexplained or much):
        return
    names = formatting.words(list(report["before"]["parameters"]))
    left = (
        f"What the model leaves is {formatting.number(times_noise)} times the noise"
        if much
        else "What is missing has no name"
    )
    end = "their intervals are withheld" if unexplained and much else "their intervals know nothing of that"
    note = f"{left}: {names} may be off by more than their standard errors, and {end}."
    for account in (report["before"], report["after"]):
        for estimate in (*account["parameters"].values(), *account["derived"].values()):
            if unexplained and much:
                estimate["ci95"], estimate["interval"] = [None, None], _WITHHELD
            estimate["flag"] = estimate["flag"] or NOT_COVERED
            estimate["note"] = estimate.get("note") or note
