"""Limits of the data, one sentence each."""

from collections.abc import Mapping, Sequence
from typing import Any

from fitting import formatting
from fitting.report.outcome import Outcome
from fitting.report.outputs import final_account, in_words
from fitting.report.separating import plain_family
from fitting.report.steps import beyond_prediction
from fitting.uncertainty.identifiability import Identifiability
from fitting.uncertainty.standard_errors import Estimate
from hdjax.effects import BY_NAME
from hdjax.parameters import ParameterInfo

# Correlation above which the data determine a combination of two parameters.
_CORRELATED = 0.9
_MOST_CORRELATIONS = 5
_DAMPING = ("B_sp", "mu")
# Standard error over the prior's above which the data add nothing.
_NOTHING_NEW = 0.8

NOT_TOLD_FROM_ZERO = "not told from zero"
"""Flag of an effect's parameter whose interval contains zero."""


def parameter_note(estimate: Estimate, found: Identifiability, info: ParameterInfo | None = None) -> str | None:
    """A note on a parameter; None where none is needed.

    Args:
        estimate: of the parameter.
        found: identifiability.
        info: metadata of the parameter; None where its unit is arbitrary.
    """
    note = found.note(estimate.path)
    if note is None and estimate.path in _DAMPING and estimate.value < 0:
        return (
            f"{estimate.path} is negative: such a drive would feed energy; look for a delay or a wrong hold of the "
            "torque."
        )
    if note is None and info is not None and info.implausibly_large(estimate.value):
        most = formatting.quantity(info.plausible[1], estimate.unit)
        return (
            f"{estimate.path} is {formatting.quantity(estimate.value, estimate.unit)}, while real drives have at most "
            f"{most}: check the log's units, and other explanations."
        )
    return note


def identifiability_dict(found: Identifiability, units: Mapping[str, str]) -> dict[str, Any]:
    """Identifiability of a fitted model."""

    def told(sentence: str | None) -> str | None:
        return None if sentence is None else in_words_of_log(sentence, units)

    return {
        "reasons": {path: told(sentence) for path, sentence in found.reasons.items()},
        "bounds": {path: told(sentence) for path, sentence in found.bounds.items()},
        "directions": [dict(vars(d)) | {"sentence": told(d.sentence)} for d in found.directions],
        "held": [dict(vars(h)) for h in found.held],
    }


def in_words_of_log(sentence: str, units: Mapping[str, str]) -> str:
    """A sentence with the units of a reduced log."""
    return formatting.in_log_words(sentence, response=units["dynamic_error"], forcing=units["forcing"])


def limits(report: Mapping[str, Any]) -> list[str]:
    """Limits of the data, one sentence each."""
    final = final_account(report)
    found = report["identifiability"]
    # Single coefficients of a learned torque have no meaning.
    learned = tuple(f"{e['name']}." for e in report["after"]["effects"] if e["family"] == "unknown")
    effects = [e["parameters"] for e in report["after"]["effects"] if e["family"] != "unknown"]
    silent = frozenset(path for effect in effects for paths in _absent(effect).values() for path in paths)
    told = [e.get("note") for e in final["parameters"].values()]
    for effect in effects:
        told += [e.get("note") for path, e in effect.items() if path not in silent]
        told += [_absence(effect, unit, paths) for unit, paths in _absent(effect).items()]
    told += [d["sentence"] for d in found["directions"] if not silent.issuperset(d["members"])]
    notes = list(dict.fromkeys(n for n in told if n)) + _unseen(report)
    notes += [h["sentence"] for h in found["held"]]
    notes += [_of_prior(path, e) for path, e in final["parameters"].items() if (e.get("prior") or {}).get("tolerance")]
    notes += _of_one_side(report) + _of_scale(report)
    for other in report["alternatives"]:
        if not other["separable"]:
            notes.append(
                f"A tie: {other['name']} ({plain_family(other['family'])}) explains the selection data about as well "
                f"as {other['instead_of']}. {other['separating_experiment']}"
            )
    notes += _own_phases(report) + _own_zeros(report)
    if report["judged_on"] != "test":
        notes.append(
            "The logs are too short to reserve test data: no error on unused data is stated. Record longer logs, or "
            "name another one with --test."
            if report["decision"] != "fit_only"
            else "The logs are too short to reserve test data: the errors are those of the fitted data."
        )
    notes += _of_wide_bands(report)
    drifting = beyond_prediction(report, final["rmse"]["selection"])
    notes += [drifting] if drifting else []
    own = [c for c in final["correlations"] if not any(n.startswith(learned) for n in c["between"])]
    return notes + _correlated([c for c in own if not silent.intersection(c["between"])])


def _of_wide_bands(report: Mapping[str, Any]) -> list[str]:
    """A note where prediction bands say nothing of free runs."""
    final = ((report["evidence"] or {}).get("final")) or {}
    if not final.get("wide_bands") or final["replaced"]:
        return []
    output = in_words(report["output"])
    return [
        f"Whether free runs err by more than noise and uncertainty allow can't be told: their prediction bands are "
        f"wider than the measured {output} itself."
    ]


def _of_scale(report: Mapping[str, Any]) -> list[str]:
    """A note where two of three stated values are corrected: the third one fixes the scale of all."""
    corrected = [e["name"] for e in report["after"]["effects"] if getattr(BY_NAME.get(e["name"]), "corrects", None)]
    if len(corrected) < 2:
        return []
    return [
        "The logs determine J_m, J_l and the scale of the torque only relative to each other. Two of the three are "
        f"corrected ({formatting.words(corrected)}), and any other two would do as well: K and B_sp are in proportion "
        "to the one that is taken as stated."
    ]


def _unseen(report: Mapping[str, Any]) -> list[str]:
    """Limits due to missing sensors."""
    seen = set(report["before"]["rmse_of_outputs"])
    if "dynamic_error" in seen:
        return []
    notes = [
        "The twist was not measured: the model computes it from the measured signals. Effects in the mesh are "
        "visible only through these."
    ]
    if not seen & {"load_angle", "load_velocity", "joint_torque"}:
        notes.append(
            "Nothing was measured on the load side: only the motor's motion distinguishes friction and other torques "
            "on the load from those on the motor."
        )
    if not any(output.endswith("_angle") for output in seen):
        notes.append(
            "Angles were integrated from velocities, so that effects that depend on an angle are poorly determined."
        )
    return notes


def _of_one_side(report: Mapping[str, Any]) -> list[str]:
    """Source of the drive's parameters in a final model that leaves more than noise."""
    if report["decision"] == "fit_only" or report["parameters_from"] == "torque":
        return []
    side, other = ("load", "motor") if report["parameters_from"] == "load equation" else ("motor", "load")
    return [
        f"Named effects do not explain all that acts on the {other}. K, alpha and B_sp are therefore those of the "
        f"{side}'s own equation, driven by the {other}'s motion as measured: it leaves no more than noise."
    ]


def _of_prior(path: str, estimate: Mapping[str, Any]) -> str:
    """Information of the logs beyond a parameter's prior."""
    before, after = 100.0 * estimate["prior"]["tolerance"], estimate["percent"]
    value = formatting.quantity(estimate["prior"]["value"], estimate["unit"])
    told = f"{path} has a prior of {value} with a tolerance of {before:.2g} %"
    if after is None or after > _NOTHING_NEW * before:
        return f"{told}, and the logs add no information: standard errors include it."
    return f"{told}; the logs reduce it to {after:.2g} %."


def _own_phases(report: Mapping[str, Any]) -> list[str]:
    """Limit due to a line that begins each log in another phase."""
    late = [(log["name"], log["clock_put_back"]) for log in report["logs"] if log["clock_put_back"]]
    families = {e["family"] for e in report["after"]["effects"]}
    returns = "load_disturbance" in families or (report["unknown"] or {}).get("period")
    if not late or not returns:
        return []
    told = formatting.words([f"by {formatting.quantity(by, 's', digits=3)} in {name}" for name, by in late])
    return [
        f"The periodic effect begins each log in another phase, for which the clock was shifted {told}. In other logs "
        "its phase is unknown: predictions use that of the logs with unchanged clocks."
    ]


def _own_zeros(report: Mapping[str, Any]) -> list[str]:
    """A note where the logs' dynamic errors have different zeros."""
    zeros = {log["name"]: log["zero"] for log in report["logs"]}
    if len({*zeros.values()}) < 2:
        return []
    unit = report["units"]["dynamic_error"]
    told = formatting.words([f"{formatting.quantity(zero, unit)} from {name}" for name, zero in zeros.items()])
    return [
        f"The zero of the dynamic error differs between the logs, as where sensors are zeroed anew: {told} was "
        "subtracted. What all logs have in common, such as a constant load, may be a part of it."
    ]


def _absent(parameters: Mapping[str, Mapping[str, Any]]) -> dict[str, list[str]]:
    """Insignificant parameters of an effect, by unit, beside significant ones of the same unit, such as absent orders
    of a kinematic error."""
    fitted = {path: e for path, e in parameters.items() if not e.get("derived")}
    found: dict[str, list[str]] = {}
    for path, estimate in fitted.items():
        unit = estimate["unit"]
        if estimate["flag"] == NOT_TOLD_FROM_ZERO and any(e["unit"] == unit and not e["flag"] for e in fitted.values()):
            found.setdefault(unit, []).append(path)
    return found


def _absence(parameters: Mapping[str, Mapping[str, Any]], unit: str, paths: list[str]) -> str:
    """A sentence on insignificant parameters."""
    most = max(abs(end) for path in paths for end in parameters[path]["ci95"] if end is not None)
    others = max(abs(e["value"]) for e in parameters.values() if e["unit"] == unit and not e.get("derived"))
    bound, size = (formatting.quantity(value, unit, digits=2) for value in (most, others))
    subject = f"{formatting.words(paths)} {'is' if len(paths) == 1 else 'are'}"
    return f"{subject} not told from zero: at most {bound}, where the largest of the kind is {size}."


def _correlated(correlations: Sequence[Mapping[str, Any]]) -> list[str]:
    """A note on strongly correlated pairs, strongest first."""
    strong = [c for c in correlations if abs(c["value"] or 0.0) > _CORRELATED]
    pairs = [f"{' and '.join(c['between'])} ({c['value']:+.3f})" for c in strong[:_MOST_CORRELATIONS]]
    if len(strong) > _MOST_CORRELATIONS:
        pairs.append(f"{len(strong) - _MOST_CORRELATIONS} more pairs")
    told = "; ".join(pairs)
    return [f"Correlated, so that the data determine a combination of both better than each: {told}."] if told else []


def largest_twist(outcome: Outcome) -> float:
    """Largest dynamic error on training data."""
    return max(run.reach["twist"] for run in outcome.before.training)
