"""Content of a fit's report only: goodness, residual tests, frequency response, posterior, and their interpretation."""

from collections.abc import Mapping
from typing import Any

from fitting import formatting
from fitting.outcome import FitOnly
from fitting.report.outputs import in_words
from fitting.report.posterior import posterior_dict
from fitting.uncertainty.prediction_band import coverage
from fitting.validation.frequency_response import (
    FrequencyResponse,
    antiresonance_seen,
    coherent_band,
    excites_antiresonance,
    excites_resonance,
    is_blurred,
    resonance_seen,
    unexplained_band,
)

# Measured and modelled resonance agree if they differ by less than this, or the distance of the lines.
_AGREES = 0.03
# Test error over training error, and error over noise, above which they are mentioned.
_DRIFTED = 1.5
_NOTHING_BUT_NOISE = 1.1


def fit_dict(fitted: FitOnly, noise: float) -> dict[str, Any]:
    """The entries of a fit's report.

    Args:
        fitted: the fit.
        noise: rms measurement noise of the principal output.
    """
    g, account = fitted.goodness, fitted.account
    return {
        "assumed": dict(fitted.assumed),
        "goodness": {
            "fit_percent": dict(g.fit_percent),
            "rmse_over_noise": {part: rmse / noise for part, rmse in account.rmse.items()},
            "band_coverage": coverage(fitted.bands),
            "error_over_noise": dict(g.error_over_noise),
            "reduced_chi_square": g.reduced_chi_square,
            "log_likelihood": g.log_likelihood,
            "aic": g.aic,
            "bic": g.bic,
            "data": g.data,
            "left_out": g.left_out,
            "parameters": g.parameters,
            "initial_states": g.states,
            "iterations": g.iterations,
            "converged": g.converged,
            "substeps": g.substeps,
        },
        "residual_tests": [
            {
                "name": t.name,
                "statistic": t.statistic,
                "degrees": t.degrees,
                "p_value": t.p_value,
                "verdict": t.verdict,
                "says": t.says,
            }
            for t in fitted.tests.tests
        ],
        "frequency_response": _response_dict(fitted.frequency_response),
        "posterior": posterior_dict(fitted.posterior),
    }


def meaning(report: Mapping[str, Any]) -> list[str]:
    """Interpretation of a fit's report, most important first, in a sentence or two each."""
    verdicts = {t["name"].split(" of ")[0]: t["verdict"] for t in report["residual_tests"]}
    on = report["judged_on"]
    rmse, over_noise = report["before"]["rmse"], report["goodness"]["rmse_over_noise"][on]
    notes = []
    source = report["parameters_from"]
    if source == "torque beside friction":
        notes.append(
            "The motor does not move as the logged torque predicts: friction or another torque of that size acts on "
            "it. "
            "The parameters are therefore those of a fit with Coulomb and viscous friction on the motor. The errors "
            "below are those of free runs without friction. `hdjax close-loop` searches for what acts on the motor."
        )
    elif source != "torque":
        side, other = ("load", "motor") if source == "load equation" else ("motor", "load")
        notes.append(
            f"The {other} does not move as the logged torque predicts: friction or another torque of that size acts on "
            f"it. K, alpha and B_sp are therefore those of the {side}'s own equation, driven by the {other}'s motion "
            "as measured. The errors below are those of free runs under the torque. `hdjax close-loop` searches for "
            f"what acts on the {other}."
        )
    for path, value in report["assumed"].items():
        notes.append(
            f"{path} was unknown and estimated as {formatting.number(value)} kg m^2, from the torque with simple "
            "friction. K and B_sp are proportional to it, and their intervals don't include its error."
        )
    if not report["goodness"]["converged"]:
        notes.append("The iteration stopped before it met its tolerance: the values are provisional.")
    left = report["goodness"]["error_over_noise"]
    worst = max(left, key=lambda output: left[output])
    missing = [n for n in ("zero mean", "whiteness", "independence") if verdicts.get(n) == "failed"]
    if over_noise is None:
        notes.append(f"The free run diverges on {on} data: the model does not describe this drive.")
    elif missing and source == "torque":
        notes.append(
            "The residual is not white noise: the model lacks something, or the sensors' noise is coloured. The "
            "parameters absorb a part of what is missing, so that true values may lie outside the intervals. `hdjax "
            "close-loop` searches for it."
        )
        if over_noise < _DRIFTED:
            notes.append("The estimate of the measurement noise contains a part of what is missing: don't rely on it.")
    elif left[worst] >= _DRIFTED:
        if source == "torque":
            notes.append(
                f"The {worst} is not explained: its residual over short simulations is "
                f"{formatting.number(left[worst])} times its noise. `hdjax close-loop` searches for what acts on it."
            )
    elif over_noise < _NOTHING_BUT_NOISE:
        notes.append("The model explains these logs down to the measurement noise.")
    if rmse["training"] is not None and rmse["test"] is not None and rmse["test"] > _DRIFTED * rmse["training"]:
        notes.append(
            "The error is larger on test data than on the fitted data: the drive or its conditions changed along the "
            "log, or the initial state is poorly determined."
        )
    if verdicts.get("normality") == "failed" and not missing:
        notes.append("The errors are not Gaussian: look for outliers, clipping or coarse quantisation in the plot.")
    if report["goodness"]["left_out"]:
        notes.append(f"Omitted samples, missing or outliers: {report['goodness']['left_out']}.")
    response = report["frequency_response"]
    if response and not response["excited"]:
        notes.append("The log does not excite the resonance: the damping is poorly determined.")
    return notes


def _response_dict(found: FrequencyResponse | None) -> dict[str, Any] | None:
    if found is None:
        return None
    return {
        "resonance": found.resonance,
        "resonance_seen": resonance_seen(found),
        "antiresonance": found.antiresonance,
        "antiresonance_seen": antiresonance_seen(found),
        "excited": excites_resonance(found),
        "coherent_band": coherent_band(found),
        "unexplained_band": unexplained_band(found),
        "resolution": found.resolution,
        "averages": found.averages,
        "says": _response_sentences(found),
    }


def _response_sentences(found: FrequencyResponse) -> list[str]:
    """Sentences on the frequency response."""
    said, output = [], in_words(found.output)
    band = coherent_band(found)
    if band:
        said.append(f"The {output} responds linearly to the {found.source} from {_range(*band)} (coherence above 0.9).")
    else:
        said.append(f"The {output} nowhere responds linearly to the {found.source} (coherence above 0.9).")
    own, seen = found.antiresonance, antiresonance_seen(found)
    if own is not None:
        said.append(_compared("antiresonance", "dip", own, seen, excites_antiresonance(found), found.resolution))
    seen = resonance_seen(found)
    said.append(_compared("resonance", "peak", found.resonance, seen, excites_resonance(found), found.resolution))
    lacking = unexplained_band(found)
    if lacking:
        said.append(
            f"From {_range(*lacking)} the {found.source} is strong and noise is small, but the coherence is low: "
            "nonlinearity, a disturbance, or an effect that the model lacks."
        )
    if is_blurred(found, found.width):
        said.append(
            f"The lines lie {_hertz(found.resolution)} apart, too far for a resonance {_hertz(found.width)} wide: its "
            "peak looks lower than it is, and the coherence dips there."
        )
    return said


def _compared(name: str, form: str, own: float, seen: float | None, excited: bool, resolution: float) -> str:
    """A frequency of the model's beside what the log shows of it."""
    if not excited:
        return f"The log does not excite the model's {name} at {_hertz(own)}."
    if seen is None:
        return f"The log reaches the model's {name} at {_hertz(own)}, but shows no clear {form} there."
    if abs(seen - own) <= max(_AGREES * own, resolution):
        return f"The {name} is seen at {_hertz(seen)}, where the model has it ({_hertz(own)})."
    return f"The {name} is seen at {_hertz(seen)}, but the model has it at {_hertz(own)}."


def _range(low: float, high: float) -> str:
    return f"{formatting.number(low, 3)} to {_hertz(high)}"


def _hertz(value: float) -> str:
    return f"{formatting.number(value, 3)} Hz"
