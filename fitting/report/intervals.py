"""Intervals of parameters where something is left that the model does not know."""

from typing import Any

from fitting import formatting
from fitting.attribution.decisions import RULES

NOT_COVERED = "not covered"
"""Flag of a parameter whose interval knows nothing of what is missing."""


def say_what_intervals_hold(report: dict[str, Any], times_noise: float) -> None:
    """Mark the intervals of the drive's own parameters where much is left, and withhold them where it has no name.

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
    for stage in ("before", "after"):
        for estimate in report[stage]["parameters"].values():
            if unexplained and much:
                estimate["ci95"], estimate["interval"] = [None, None], "withheld"
            estimate["flag"] = estimate["flag"] or NOT_COVERED
            estimate["note"] = estimate["note"] or note
