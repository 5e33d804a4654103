"""Every threshold that decides something, with its meaning, its unit and its source."""

from dataclasses import dataclass, field, fields
from typing import Any


def _rule(default: float, unit: str, meaning: str, source: str) -> Any:
    return field(default=default, metadata={"unit": unit, "meaning": meaning, "source": source})


_UNDECLARED = "study of undeclared effects, `docs/evaluation_history.md`"


@dataclass(frozen=True)
class DecisionRules:
    """Every threshold that decides something; `docs/rules.md` is made of the fields."""

    significance: float = _rule(
        0.01,
        "1",
        "largest chance that the best of the catalogue gains as much where nothing is missing",
        "convention; at 0.01 at most one false alarm in a hundred looks",
    )
    least_gain: float = _rule(
        1e-3,
        "log of rms error",
        "smallest decrease of the error that counts: a tenth of a percent",
        "an imperfection of the solver counts for as much",
    )
    tie_level: float = _rule(
        0.05,
        "1",
        "chance at which a candidate counts as worse than the best one, by a paired t test over blocks",
        "convention",
    )
    same_gain: float = _rule(
        0.02, "share of the best gain", "gains over whole stretches that differ by less are the same", _UNDECLARED
    )
    strength_errors: float = _rule(
        3.9,
        "standard errors",
        "by which a strength must differ from zero",
        "one percent of chance over a hundred forms and shapes (Bonferroni)",
    )
    at_bounds: float = _rule(
        0.0,
        "parameters",
        "of an effect that may have ended at a bound: beyond it the law makes no sense, so that it names nothing",
        "bounds are in the code of each effect",
    )
    excess: float = _rule(
        1.5, "times the noise", "a residual larger than this is not noise", "the noise is known to a few per cent"
    )
    explained: float = _rule(
        0.99,
        "share of variance",
        "of the error beyond noise that found effects must remove to be the explanation",
        "a tenth of the error; 0.9986 on Silverbox, and 0.99 changes none of 40 cases of the study (seed 95)",
    )
    quasi_static_explained: float = _rule(
        0.9,
        "share of variance",
        "likewise of quasi-static logs, whose laws err by more",
        "0.96 for the hysteresis of a measured joint (`docs/quasi_static.md`)",
    )
    little: float = _rule(
        0.05,
        "share of the gain",
        "what a learned term adds to names, or names leave beyond noise, is little below this share of their gain",
        _UNDECLARED,
    )
    come_out: float = _rule(
        0.75,
        "share of mean square",
        "of a learned term that named effects must make up for it to have come out as them",
        _UNDECLARED,
    )
    lasting: float = _rule(
        0.1,
        "log of rms error",
        "by which free runs of a learned term may be worse than those of the names that it would replace",
        "a lag in the place of creep left 40 times as much (study, seed 95)",
    )
    many: float = _rule(3.0, "names", "so many names may be the terms of one function", _UNDECLARED)
    noise_gain: float = _rule(
        5.0,
        "nats",
        "log likelihood by which an effect, or noise of the torque, must better noise that would explain as much",
        "the best of fifty forms gains 4 by chance",
    )
    innovations: float = _rule(
        0.03,
        "share of variance",
        "of a Kalman filter's innovations that earlier ones may predict where all that is left is noise",
        "below 0.01 under noise, above 0.06 where an effect is missing (`tests/uncertainty/test_noise_model.py`)",
    )
    free_run_explained: float = _rule(
        0.9,
        "share of variance",
        "of the free runs' error beyond noise that effects must remove for their bands not to be asked",
        "laws are not exact, and bands know nothing of that",
    )
    surprise: float = _rule(
        1.25,
        "times the band",
        "free runs that are farther off than this are not what the model promised",
        "a right model stays within 1.2 (`tests/validation/test_free_run_check.py`)",
    )

    line_errors: float = _rule(
        5.0, "standard errors", "by which a spectral line is in a log", "one in 2e6 by chance, over some thousand lines"
    )
    line_share: float = _rule(
        0.25,
        "share of squares",
        "of what is left that a line must explain for the clocks of several logs to be set by it",
        "lines that a multisine leaves behind explain less each (`tests/attribution/test_log_alignment.py`)",
    )
    line_in_phase: float = _rule(
        0.9,
        "share of amplitude",
        "that a line of one phase keeps of what it has with a phase of each log's own where clocks are right",
        "phases within 0.45 rad",
    )
    coefficient: float = _rule(
        0.005,
        "log of rms error",
        "that a further coefficient of a learned function must gain on parts of the training data left out",
        "assumed: half a percent of the error",
    )
    variable: float = _rule(
        0.03, "log of rms error", "that a second variable of a learned function must gain", "assumed: three percent"
    )
    quasi_static_imperfection: float = _rule(
        0.05,
        "share of rms",
        "of what effects of quasi-static logs have removed that their laws may get wrong",
        "laws of hysteresis and stiffness are good to some hundredths (`docs/quasi_static.md`)",
    )
    wander: float = _rule(
        20.0,
        "times the noise",
        "by which a residual of quasi-static logs may wander and still be coloured noise",
        "an encoder's noise correlated by 0.98 from row to row would be nine times",
    )


RULES = DecisionRules()
"""The rules as they are."""


def rules_table(rules: DecisionRules = RULES) -> list[dict[str, Any]]:
    """The rules as rows: name, threshold, unit, meaning, source."""
    return [
        {"name": f.name, "threshold": getattr(rules, f.name)}
        | {k: f.metadata[k] for k in ("unit", "meaning", "source")}
        for f in fields(rules)
    ]
