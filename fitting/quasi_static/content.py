"""What a quasi-static fit found, as `report.json` has it: figures, held-out errors, and what the logs can't tell."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from fitting import formatting
from fitting.files import finite
from fitting.quasi_static.facts import ABOUT_SCALE, ending, estimates, few_stretches, heading, log_dict, rmse_dict
from fitting.quasi_static.fit import QuasiStaticFit
from fitting.quasi_static.intervals import Known
from fitting.quasi_static.preparation import QuasiStaticData
from fitting.quasi_static.stretches import stretches
from fitting.quasi_static.torque_twist import SHAPES, Shape

PLAIN_SHAPE: dict[Shape, str] = {
    "linear": "straight line",
    "cubic": "cubic",
    "two slopes": "two slopes",
    "three slopes": "three slopes",
}
# The least of the values that vendors' tables imply.
_TYPICAL_ALPHA = 1.1e5
_SEPARATING = "Cycle the torque slowly to larger twists, past the knees, in both directions."


def report_dict(data: QuasiStaticData, fit: QuasiStaticFit) -> dict[str, Any]:
    """The report as JSON has it: finite numbers and nulls only.

    Args:
        data: The logs that were fitted.
        fit: Of these logs.

    Returns:
        The keys of every fit's report; `shapes` has each shape's own figures besides.
    """
    rated = data.drive_file.rated_torque
    parameters = fit.known[fit.chosen] | _unknown(fit, rated)
    shapes = {shape: _account(fit, shape, fit.known[shape]) for shape in SHAPES}
    blocks = fit.blocks
    report = heading(data) | {
        "noise": {"dynamic_error": blocks.twist_noise, "joint_torque": blocks.torque_noise},
        "shape": fit.chosen,
        "memory": fit.best.curve.memory,
        "rated_torque": rated,
        "torque_range": [float(np.min(blocks.torque)), float(np.max(blocks.torque))],
        "twist_range": float(np.ptp(blocks.twist)),
        "before": _account(fit, fit.chosen, parameters),
        "after": {"effects": [], "parameters": {}, "derived": {}, "rmse": rmse_dict(None, None)},
        "alternatives": [_alternative(fit, shape) for shape in SHAPES if shape != fit.chosen],
        "shapes": shapes,
        "cannot_tell": [],
        "logs": [log_dict(data, i, blocks.rows[i], blocks.reversals[i]) for i in range(len(data.logs))],
    }
    report = finite(report | ending(data))
    report["summary"] = summary(report)
    report["cannot_tell"] = _limits(report, data, fit)
    return report


def summary(report: Mapping[str, Any]) -> str:
    """The result in plain words."""
    known = report["before"]["parameters"]
    names = [n for n in ("K", "K1", "K2", "K3") if n in known and known[n]["value"] is not None]
    stiffness = formatting.words([f"{name} {_with_interval(known[name])}" for name in names])
    validation = formatting.quantity(report["before"]["rmse"]["validation"], "rad")
    width = known.get("hysteresis_width", {})
    loop = "The logs do not show a width of the loop"
    if width.get("value") is not None and width["identifiable"]:
        loop = f"The loop is {_with_interval(width)} wide at zero torque"
    return (
        f"Torque and twist follow {_article(PLAIN_SHAPE[report['shape']])} with {stiffness}. {loop}. On stretches that "
        f"the fit has not seen it errs by {validation} rms."
    )


def _article(shape: str) -> str:
    return f"a {shape}" if shape in ("straight line", "cubic") else shape


def _with_interval(known: Mapping[str, Any]) -> str:
    value = formatting.quantity(known["value"], known["unit"])
    if None in known["ci95"]:
        return f"{value} (interval unknown)"
    low, high = (formatting.quantity(end, known["unit"], like=known["value"]) for end in known["ci95"])
    return f"{value} ({low} to {high})"


def _account(fit: QuasiStaticFit, shape: Shape, known: Mapping[str, Known]) -> dict[str, Any]:
    training = float(np.sqrt(np.mean(fit.fits[shape].misfit ** 2)))
    validation = float(np.sqrt(np.mean(fit.held_out[shape] ** 2)))
    return {
        "effects": [],
        "parameters": estimates(known),
        "derived": {},
        "rmse": rmse_dict(training, validation),
    }


def _alternative(fit: QuasiStaticFit, shape: Shape) -> dict[str, Any]:
    return {
        "family": "stiffness_shape",
        "name": shape,
        "validation_rmse": float(np.sqrt(np.mean(fit.held_out[shape] ** 2))),
        "separable": fit.is_worse(shape, fit.chosen) or fit.is_worse(fit.chosen, shape),
        "separating_experiment": _SEPARATING,
    }


def _unknown(fit: QuasiStaticFit, rated: float | None) -> dict[str, Known]:
    """The figures that vendors state and the chosen curve does not have, each with the reason."""
    chosen = fit.known[fit.chosen]
    reach = formatting.quantity(float(np.max(np.abs(fit.blocks.torque))), "N m")
    missing: dict[str, Known] = {}

    def tell(name: str, unit: str, description: str, reason: str) -> None:
        if name not in chosen:
            missing[name] = Known(None, None, None, unit, False, description, reason)

    if fit.chosen in ("linear", "two slopes"):
        bend = "second knee" if fit.chosen == "two slopes" else "knee"
        why = f"held-out stretches do not clearly show a {bend} up to {reach}"
        if fit.undetermined is not None:
            why = "the curve bends more than the chosen one, but the logs do not determine where and how much"
        if fit.chosen == "linear":
            tell("K2", "N m/rad", "stiffness from T1 to T2", why)
            tell("T1", "N m", "torque at the first knee", why)
        tell("K3", "N m/rad", "stiffness beyond T2", why)
        tell("T2", "N m", "torque at the second knee", why)
    if fit.chosen == "linear":
        alpha = fit.known["cubic"]["alpha"]
        reason = _alpha_reason(fit, alpha) if fit.undetermined is None else alpha.reason or why
        missing["alpha"] = dataclasses.replace(alpha, identifiable=False, reason=reason)
    if fit.best.curve.memory is None:
        why = "the torque does not turn back" if max(fit.blocks.reversals) == 0 else "the joint turned one way only"
        tell("hysteresis_width", "rad", "width of the loop at zero torque", why)
    if rated is None:
        why = "the rated torque defines it, so give [drive] rated_torque in the drive file"
        tell("lost_motion", "rad", "twist between -4 % and +4 % of rated torque", why)
        tell("hysteresis_loss", "rad", "width of the loop at zero torque, for cycles of rated torque", why)
    else:
        why = f"the torque's range of +-{fit.blocks.amplitude:.3g} N m does not cover "
        tell("lost_motion", "rad", "twist between -4 % and +4 % of rated torque", f"{why}4 % of rated torque")
        why = f"{why}cycles of rated torque" if fit.best.curve.memory else missing["hysteresis_width"].reason
        tell("hysteresis_loss", "rad", "width of the loop at zero torque, for cycles of rated torque", why)
    return missing


def _alpha_reason(fit: QuasiStaticFit, alpha: Known) -> str:
    largest = 0.5 * float(np.ptp(fit.blocks.twist))
    assert alpha.ci95 is not None
    visible = max(abs(alpha.ci95[0]), abs(alpha.ci95[1]))
    reason = (
        f"held-out stretches do not clearly show a bend at twists up to {formatting.quantity(largest, 'rad')}, where "
        f"alpha below {formatting.number(visible, 2)} rad^-2 can't be seen"
    )
    if visible > _TYPICAL_ALPHA:
        # At the same noise the twist of the cubic term grows with the cube of the twist.
        needed = largest * (visible / _TYPICAL_ALPHA) ** (1 / 3)
        reason += (
            f"; alpha of 1.1e5, the least in vendors' tables, would need x above {formatting.quantity(needed, 'rad')}"
        )
    return reason


def _limits(report: Mapping[str, Any], data: QuasiStaticData, fit: QuasiStaticFit) -> list[str]:
    known = report["before"]["parameters"]
    reasons: dict[str, list[str]] = {}
    for name, one in known.items():
        if not one["identifiable"]:
            reasons.setdefault(one["reason"], []).append(name)
    notes = [
        f"{formatting.words(names)} {'is' if len(names) == 1 else 'are'} not identifiable from these logs: {reason}."
        for reason, names in reasons.items()
    ]
    notes += _about_shape(report, fit)
    notes += _about_hysteresis(known)
    notes += _about_motion(data)
    notes += _about_axes(fit)
    if not fit.best.curve.biased:
        notes.append(
            "A bias of the torque and the zero of the twist can't be told apart"
            + (
                " on a straight line"
                if fit.chosen == "linear"
                else ", since the torque has one sign only: it is taken as zero"
            )
            + "."
        )
    if not fit.best.curve.drifting:
        notes.append(
            "A drift of the twist with time is taken as zero: it takes two full torque cycles to tell it apart."
        )
    count = int(stretches(fit.best.residual, fit.blocks.log)[-1]) + 1
    return notes + few_stretches(count)


def _about_shape(report: Mapping[str, Any], fit: QuasiStaticFit) -> list[str]:
    shape = fit.undetermined
    if shape is None:
        return []
    better, chosen = (report["shapes"][s]["rmse"]["validation"] for s in (shape, fit.chosen))
    return [
        f"The {PLAIN_SHAPE[shape]} predict{'s' if shape == 'cubic' else ''} held-out stretches better "
        f"({formatting.quantity(better, 'rad')} rms, against {formatting.quantity(chosen, 'rad', like=better)}), but "
        f"the logs do not determine all of its figures, so that the {PLAIN_SHAPE[fit.chosen]} stands: its stiffness is "
        "a mean over the torque's range. Record several slow cycles over the whole range."
    ]


def _about_hysteresis(known: Mapping[str, Any]) -> list[str]:
    width = known.get("hysteresis_width")
    if width is None or width["value"] is None:
        return []
    if width["value"] < 0 and width["identifiable"]:
        return [
            "The loop runs the wrong way round, as if the gear gave out energy: the torque column lags behind or leads "
            "the twist, or holds friction that does not pass through the gear. The width is not one of the gear."
        ]
    return [
        "The width of the loop contains all friction between the sensors: a torque measured on the motor's side, by "
        "its current above all, counts friction of motor and bearings as hysteresis of the gear."
    ]


def _about_motion(data: QuasiStaticData) -> list[str]:
    notes = []
    if "one way" in data.motion:
        notes.append(
            "The joint moved one way only: its friction shifts the torque by a constant that can't be told from a bias "
            "of the sensor, friction that depends on load or position bends the curve, and nothing is known of "
            "hysteresis. Run the same path both ways."
        )
    if "both ways" in data.motion:
        notes.append(
            "The joint moved both ways: friction that follows the direction of motion is contained in the width of the "
            "loop."
        )
    if {"one way", "both ways"} & set(data.motion):
        notes.append(
            "While the joint moves, kinematic error and eccentric encoders move the twist as well; they count as error "
            "here, and bend the curve where they are slow; hdjax close-loop looks for them."
        )
    if "unknown" in data.motion:
        notes.append("Whether the joint moved is unknown, since no motor angle or velocity was logged.")
    notes.append(ABOUT_SCALE)
    return notes


def _about_axes(fit: QuasiStaticFit) -> list[str]:
    elastic = float(np.var(fit.best.curve.elastic(fit.best.parameters, fit.blocks.torque)[0]))
    share = float(np.mean(fit.best.misfit**2)) / (elastic + float(np.mean(fit.best.misfit**2)))
    if share < 1e-3:
        return []
    return [
        "The noise of both axes was measured and weighed; what exceeds it was ascribed to the twist. If it were an "
        f"error of the torque instead, the drive would be softer by up to {formatting.percent(share)}."
    ]
