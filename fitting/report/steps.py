"""Error on selection data after each step of the loop, over short segments where errors hardly accumulate."""

from collections.abc import Mapping, Sequence
from typing import Any

from fitting import formatting
from fitting.attribution.candidate_fit import Trial
from fitting.outcome import Loop
from fitting.report.outcome import Outcome
from fitting.report.outputs import principal

# In units of the measurement noise: largest error that counts as noise, and largest free-run error without a remark.
_NOISE, _OFF = 1.2, 3.0


def steps(outcome: Outcome) -> list[dict[str, Any]]:
    """The base model, then the model after each step, each with its error on segments of the selection data
    whose initial states are fitted; empty for a fit alone."""
    if not isinstance(outcome, Loop) or not outcome.rounds:
        return []
    seconds = outcome.setting.segmentation.horizon * outcome.stretches[0][0].experiment.time_step
    found = [_step(None, outcome.rounds[0].before, seconds)]
    for this in outcome.rounds:
        if this.accepted and this.winner.trial is not None:
            found.append(_step(this.winner.name, this.winner.trial, seconds))
    if outcome.unknown is not None:
        found.append(_step(outcome.unknown.chosen.form.name, outcome.unknown.trial, seconds, outcome.doubted))
    return found


def _step(added: str | None, trial: Trial, seconds: float, in_place_of: Sequence[str] = ()) -> dict[str, Any]:
    error = trial.held_out.principal_std
    known = {"added": added, "in_place_of": list(in_place_of)}
    return known | {"selection_segments_rmse": error, "segment_seconds": seconds}


def beyond_prediction(report: Mapping[str, Any], free: float | None) -> str | None:
    """A remark where only noise is left on short segments, and much more in long free runs.

    Args:
        report: the report's content so far.
        free: rms error of the final model's free runs on selection data; None where they diverged.
    """
    if not report["steps"]:
        return None
    last, (_, unit, noise) = report["steps"][-1], principal(report)
    short = last["selection_segments_rmse"]
    if short is None or short > _NOISE * noise or (free is not None and free < _OFF * noise):
        return None
    return (
        f"Over {formatting.quantity(last['segment_seconds'], 's')} at a time the model errs by "
        f"{formatting.quantity(short, unit)} rms ({formatting.number(short / noise)} times the noise) on selection "
        "data. Its longer free runs deviate nevertheless: along this motion small errors of initial state and "
        "parameters grow (as with a dead zone), or something slow acts that was not logged."
    )
