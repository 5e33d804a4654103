"""Thresholds of all decisions, with meaning, unit and source."""

from dataclasses import dataclass, field, fields
from typing import Any


def _rule(default: float, unit: str, meaning: str, source: str) -> Any:
    return field(default=default, metadata={"unit": unit, "meaning": meaning, "source": source})


_UNDECLARED = "study of undeclared effects, `docs/evaluation_history.md`"


@dataclass(frozen=True)
class DecisionRules:
    """Thresholds of all decisions; `docs/rules.md` is generated from the fields."""

    significance: float = _rule(
        0.01,
        "1",
        "largest p-value of the best form's gain",
        "convention; at 0.01 at most one false alarm in a hundred searches",
    )
    least_gain: float = _rule(
        1e-3,
        "log of rms error",
        "smallest decrease of the error that counts where noise does not explain it, and between candidates",
        "solver errors may cause as much",
    )
    tie_level: float = _rule(
        0.05,
        "1",
        "p-value below which a candidate is worse than the best one, by a paired t test over blocks",
        "convention",
    )
    same_gain: float = _rule(
        0.02,
        "share of the best gain",
        "gains that differ by less are equal, over whole stretches and over short segments",
        _UNDECLARED,
    )
    strength_errors: float = _rule(
        3.9,
        "standard errors",
        "least distance of a strength from zero",
        "p-value of one percent over a hundred forms and shapes (Bonferroni)",
    )
    law_errors: float = _rule(
        2.0,
        "times the imperfection",
        "least error that a further effect removes, unless it leaves only noise: less, an inexact law may leave",
        "two standard deviations",
    )
    at_bounds: float = _rule(
        0.0,
        "parameters",
        "largest number of an effect's parameters at a bound: beyond its bounds a law is not physical",
        "bounds are in the code of each effect; after the final fit those that the logs determine count",
    )
    excess: float = _rule(
        1.5, "times the noise", "largest residual that counts as noise", "the noise is estimated to a few per cent"
    )
    explained: float = _rule(
        0.99,
        "share of variance",
        "of the error beyond noise that effects must remove to explain it",
        "a tenth of the error; 0.9986 on Silverbox, and 0.99 changes none of 40 cases of the study (seed 95)",
    )
    quasi_static_explained: float = _rule(
        0.9,
        "share of variance",
        "likewise of quasi-static logs, whose laws are less exact",
        "0.96 for the hysteresis of a measured joint (`docs/quasi_static.md`)",
    )
    little: float = _rule(
        0.05,
        "share of the gain",
        "below which a learned term's further gain, or the names' error beyond noise, is negligible",
        _UNDECLARED,
    )
    come_out: float = _rule(
        0.75,
        "share of mean square",
        "of a learned term that named effects must reproduce to count as equal to it",
        _UNDECLARED,
    )
    lasting: float = _rule(
        0.1,
        "log of rms error",
        "largest excess of a learned term's free-run error over that of the names that it replaces",
        "a lag in place of creep had 40 times the error (study, seed 95)",
    )
    noise_gain: float = _rule(
        5.0,
        "nats",
        "least log likelihood ratio, less the penalty for parameters, of an effect or of torque noise against none",
        "the best of fifty forms gains 4 by chance",
    )
    innovations: float = _rule(
        0.03,
        "share of variance",
        "largest predictable part of a Kalman filter's innovations where only noise is left",
        "below 0.01 under noise, above 0.06 where an effect is missing (`tests/uncertainty/test_noise_model.py`)",
    )
    free_run_explained: float = _rule(
        0.9,
        "share of variance",
        "of the free runs' error beyond noise: if effects remove more, bands matter only where noise explains the rest",
        "laws are not exact, and bands do not include their error",
    )
    surprise: float = _rule(
        1.25,
        "times the band",
        "largest error of free runs that agrees with the prediction band",
        "a right model stays within 1.2 (`tests/validation/test_free_run_check.py`)",
    )

    line_errors: float = _rule(
        5.0,
        "standard errors",
        "least amplitude of a spectral line that is present in a log",
        "p-value 5e-7, over some thousand lines",
    )
    line_share: float = _rule(
        0.25,
        "share of squares",
        "of the residual that a line must explain to align the clocks of several logs",
        "residual lines of a multisine explain less each (`tests/attribution/test_log_alignment.py`)",
    )
    line_in_phase: float = _rule(
        0.9,
        "share of amplitude",
        "amplitude of a line with one common phase over that with a phase per log, where clocks are aligned",
        "phases within 0.45 rad",
    )
    coefficient: float = _rule(
        0.005,
        "log of rms error",
        "least cross-validated gain of a further coefficient of a learned function",
        "assumed: half a percent of the error",
    )
    variable: float = _rule(
        0.03, "log of rms error", "least gain of a second variable of a learned function", "assumed: three percent"
    )
    quasi_static_imperfection: float = _rule(
        0.05,
        "share of rms",
        "error of quasi-static effects' laws, relative to what they have removed",
        "laws of hysteresis and stiffness are good to some hundredths (`docs/quasi_static.md`)",
    )
    wander: float = _rule(
        20.0,
        "times the noise",
        "largest low-frequency residual of quasi-static logs that counts as coloured noise",
        "encoder noise with a correlation of 0.98 from row to row gives nine times",
    )


RULES = DecisionRules()
"""The default rules."""


def rules_table() -> list[dict[str, Any]]:
    """The default rules as rows: name, threshold, unit, meaning, source."""
    return [
        {"name": f.name, "threshold": getattr(RULES, f.name)}
        | {k: f.metadata[k] for k in ("unit", "meaning", "source")}
        for f in fields(RULES)
    ]
