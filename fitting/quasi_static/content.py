"""Content of a quasi-static fit's `report.json`: figures, held-out errors, and limits of the logs."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from fitting import formatting
from fitting.quasi_static.facts import (
    ABOUT_SCALE,
    account,
    beyond_fitted,
    few_stretches,
    framed,
    log_dicts,
    no_account,
    not_identifiable,
    those_that_hold,
)
from fitting.quasi_static.fit import QuasiStaticFit
from fitting.quasi_static.intervals import Known
from fitting.quasi_static.preparation import MOVES, QuasiStaticData
from fitting.quasi_static.stretches import stretches
from fitting.quasi_static.torque_twist import SHAPES
from fitting.quasi_static.unseen_logs import UnseenLogs

# Smallest value that vendors' tables imply.
_TYPICAL_ALPHA = 1.1e5
_SEPARATING = "Cycle the torque slowly to larger twists, past the knees, in both directions."
_ONE_WAY = (
    "The joint moved one way only: its friction shifts the torque by a constant that is confounded with a bias of "
    "the sensor. Friction that depends on load or position bends the curve, and hysteresis is unknown. Run the "
    "same path both ways."
)
_BOTH_WAYS = (
    "The joint moved both ways: the width of the loop contains friction that depends on the direction of motion."
)
_MOVED = (
    "While the joint moves, kinematic error and eccentric encoders change the twist as well. They count as error "
    "here, and bend the curve where they are slow; hdjax close-loop searches for them."
)
_WRONG_WAY = (
    "The loop has the wrong orientation, as if the gear generated energy: the torque column lags or leads the twist, "
    "or contains friction that does not pass through the gear. The width is not that of the gear."
)
_ALL_FRICTION = (
    "The width of the loop contains all friction between the sensors: with a torque measured on the motor's side, "
    "mainly by its current, friction of motor and bearings counts as hysteresis of the gear."
)


def plain_shape(shape: str) -> str:
    """The name of a curve's shape for reports."""
    return "straight line" if shape == "linear" else shape


def report_dict(data: QuasiStaticData, fit: QuasiStaticFit, unseen: UnseenLogs) -> dict[str, Any]:
    """The report as JSON has it: finite numbers and nulls only.

    Args:
        data: The logs that were fitted.
        fit: Of these logs.
        unseen: Logs of test data.

    Returns:
        The keys of every fit's report, and `shapes` with each shape's figures.
    """
    rated, blocks = data.drive_file.rated_torque, fit.blocks
    shapes = {shape: account(fit.known[shape], fit.fits[shape].misfit, fit.held_out[shape]) for shape in SHAPES}
    parameters = fit.known[fit.chosen] | _unknown(fit, rated)
    content = {
        "noise": {"dynamic_error": blocks.twist_noise, "joint_torque": blocks.torque_noise},
        "shape": fit.chosen,
        "memory": fit.best.curve.memory,
        "rated_torque": rated,
        "torque_range": [float(np.min(blocks.torque)), float(np.max(blocks.torque))],
        "twist_range": float(np.ptp(blocks.twist)),
        "before": account(parameters, fit.best.misfit, fit.held_out[fit.chosen], unseen.misfit(fit.best)),
        "after": no_account(),
        "alternatives": [
            {
                "family": "stiffness_shape",
                "name": shape,
                "validation_rmse": shapes[shape]["rmse"]["validation"],
                "separable": fit.is_worse(shape, fit.chosen) or fit.is_worse(fit.chosen, shape),
                "separating_experiment": _SEPARATING,
            }
            for shape in SHAPES
            if shape != fit.chosen
        ],
        "shapes": shapes,
        "cannot_tell": [],
        "logs": [log | {"test": 0} for log in log_dicts(data, blocks.rows, blocks.reversals)] + _test_logs(unseen),
    }
    report = framed(dataclasses.replace(data, findings=data.findings | unseen.data.findings), content)
    return report | {"summary": summary(report), "cannot_tell": _limits(report, data, fit, unseen)}


def _test_logs(unseen: UnseenLogs) -> list[dict[str, Any]]:
    blocks = unseen.blocks
    logs = log_dicts(unseen.data, [one.rows[0] for one in blocks], [one.reversals[0] for one in blocks])
    return [log | {"held_out": 0, "test": count} for log, count in zip(logs, unseen.rows, strict=True)]


def summary(report: Mapping[str, Any]) -> str:
    """The result in a few sentences."""
    known, shape = report["before"]["parameters"], plain_shape(report["shape"])
    names = [n for n in ("K", "K1", "K2", "K3") if n in known and known[n]["identifiable"]]
    validation = formatting.quantity(report["before"]["rmse"]["validation"], "rad")
    width = known["hysteresis_width"]
    test = report["before"]["rmse"]["test"]
    errs = f"it errs by {validation} rms"
    if test is not None:
        errs += f", on test data by {formatting.quantity(test, 'rad', like=report['before']['rmse']['validation'])}"
    loop = "The logs do not show a width of the loop"
    if width["value"] is not None and width["identifiable"]:
        loop = f"The loop is {_with_interval(width)} wide at zero torque"
    if not names:
        return (
            "The logs do not determine a stiffness: what the twist does beside the torque outweighs what the torque "
            f"does to it. On stretches that a straight line has not seen {errs}."
        )
    stiffness = formatting.words([f"{name} {_with_interval(known[name])}" for name in names])
    article = "" if shape.endswith("slopes") else "a "
    return (
        f"Torque and twist follow {article}{shape} with {stiffness}. {loop}. On stretches that "
        f"the fit has not seen {errs}."
    )


def _with_interval(known: Mapping[str, Any]) -> str:
    value = formatting.quantity(known["value"], known["unit"])
    if None in known["ci95"]:
        return f"{value} (interval unknown)"
    low, high = (formatting.quantity(end, known["unit"], like=known["value"]) for end in known["ci95"])
    return f"{value} ({low} to {high})"


def _unknown(fit: QuasiStaticFit, rated: float | None) -> dict[str, Known]:
    """The vendors' figures that the chosen curve lacks, each with the reason."""
    chosen, memory = fit.known[fit.chosen], fit.best.curve.memory

    def missing(rows: Sequence[tuple[str, str, str, str]]) -> dict[str, Known]:
        told = {name: Known(None, None, None, unit, False, text, why) for name, unit, text, why in rows}
        return {name: known for name, known in told.items() if name not in chosen}

    bent, alpha = {}, {}
    if fit.chosen in ("linear", "two slopes"):
        bend = "second knee" if fit.chosen == "two slopes" else "knee"
        reach = formatting.quantity(float(np.max(np.abs(fit.blocks.torque))), "N m")
        why = f"held-out stretches do not significantly support a {bend} up to {reach}"
        if fit.undetermined is not None:
            why = "the curve bends more than the chosen one, but the logs do not determine where and how much"
        bent = missing(
            [
                ("K2", "N m/rad", "stiffness from T1 to T2", why),
                ("T1", "N m", "torque at the first knee", why),
                ("K3", "N m/rad", "stiffness beyond T2", why),
                ("T2", "N m", "torque at the second knee", why),
            ]
        )
        if fit.chosen == "linear":
            one = fit.known["cubic"]["alpha"]
            if chosen["K"].value is None:
                one = dataclasses.replace(one, value=None, std=None, ci95=None, reason=chosen["K"].reason)
            why = _alpha_reason(fit, one) if fit.undetermined is None and one.ci95 else one.reason or why
            alpha = {"alpha": dataclasses.replace(one, identifiable=False, reason=why)}
    still = "the torque does not turn back" if max(fit.blocks.reversals) == 0 else "the joint turned one way only"
    short = f"the torque's range of +-{fit.blocks.amplitude:.3g} N m does not cover "
    few, cycles = f"{short}4 % of rated torque", f"{short}cycles of rated torque" if memory else still
    if rated is None:
        few = cycles = "the rated torque defines it, so give [drive] rated_torque in the drive file"
    text = "width of the loop at zero torque"
    return (
        bent
        | alpha
        | missing(
            [
                ("hysteresis_width", "rad", text, still),
                ("lost_motion", "rad", "twist between -4 % and +4 % of rated torque", few),
                ("hysteresis_loss", "rad", f"{text}, for cycles of rated torque", cycles),
            ]
        )
    )


def _alpha_reason(fit: QuasiStaticFit, alpha: Known) -> str:
    largest = 0.5 * float(np.ptp(fit.blocks.twist))
    assert alpha.ci95 is not None
    visible = max(abs(alpha.ci95[0]), abs(alpha.ci95[1]))
    reason = (
        "held-out stretches do not significantly support a bend at twists up to "
        f"{formatting.quantity(largest, 'rad')}, where "
        f"alpha below {formatting.number(visible, 2)} rad^-2 can't be detected"
    )
    if visible <= _TYPICAL_ALPHA:
        return reason
    # The cubic term's twist grows with the cube of the twist, at the same noise.
    needed = formatting.quantity(largest * (visible / _TYPICAL_ALPHA) ** (1 / 3), "rad")
    return f"{reason}; alpha of 1.1e5, the least in vendors' tables, would need x above {needed}"


def _limits(report: Mapping[str, Any], data: QuasiStaticData, fit: QuasiStaticFit, unseen: UnseenLogs) -> list[str]:
    known, best, motion = report["before"]["parameters"], fit.best, set(data.motion)
    reasons: dict[str, list[str]] = {}
    for name, one in known.items():
        if not one["identifiable"]:
            reasons.setdefault(one["reason"], []).append(name)
    width = known["hysteresis_width"]
    backwards = width["identifiable"] and width["value"] < 0
    left, elastic = np.mean(best.misfit**2), np.var(best.curve.elastic(best.parameters, fit.blocks.torque)[0])
    softer = float(left / (elastic + left))
    bias = (
        " on a straight line" if fit.chosen == "linear" else ", since torques have mostly one sign: it is taken as zero"
    )
    notes = [
        *((True, f"{not_identifiable(names)}: {reason}.") for reason, names in reasons.items()),
        (fit.undetermined, _about_shape(report, fit)),
        (backwards, _WRONG_WAY),
        (width["value"] is not None and not backwards, _ALL_FRICTION),
        ("one way" in motion, _ONE_WAY),
        ("both ways" in motion, _BOTH_WAYS),
        (motion & set(MOVES), _MOVED),
        ("unknown" in motion, "Whether the joint moved is unknown, since no motor angle or velocity was logged."),
        (True, ABOUT_SCALE),
        (
            softer >= 1e-3,
            "The noise of both axes was estimated; misfit beyond it was ascribed to the twist. If it were an "
            f"error of the torque instead, the drive would be softer by up to {formatting.percent(softer)}.",
        ),
        (not best.curve.biased, f"A bias of the torque and the zero of the twist are confounded{bias}."),
        (
            not best.curve.drifting,
            "A drift of the twist with time is taken as zero: two full torque cycles are needed to determine it.",
        ),
        beyond_fitted(unseen.torque, fit.blocks.torque, fit.blocks.torque_noise),
        few_stretches(int(stretches(best.residual, fit.blocks.log)[-1]) + 1),
    ]
    return those_that_hold(notes)


def _about_shape(report: Mapping[str, Any], fit: QuasiStaticFit) -> str:
    shape = fit.undetermined or fit.chosen
    better, chosen = (report["shapes"][s]["rmse"]["validation"] for s in (shape, fit.chosen))
    return (
        f"The {plain_shape(shape)} predict{'s' if shape == 'cubic' else ''} held-out stretches better "
        f"({formatting.quantity(better, 'rad')} rms, against {formatting.quantity(chosen, 'rad', like=better)}), but "
        f"the logs do not determine all of its figures, so that the {plain_shape(fit.chosen)} is chosen: its "
        "stiffness is a mean over the torque's range. Record several slow cycles over the whole range."
    )
