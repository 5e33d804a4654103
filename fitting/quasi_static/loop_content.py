"""What the loop found on quasi-static logs, as `report.json` has it."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from fitting import formatting
from fitting.files import finite
from fitting.quasi_static.attribution import Rival, Trial
from fitting.quasi_static.facts import (
    ABOUT_SCALE,
    ARCMIN,
    ending,
    estimates,
    few_stretches,
    heading,
    log_dict,
    rmse_dict,
)
from fitting.quasi_static.lookalikes import lookalikes
from fitting.quasi_static.loop import Finding, QuasiStaticLoop
from fitting.quasi_static.noise_colour import DRAWS
from fitting.quasi_static.preparation import QuasiStaticData
from fitting.quasi_static.rests import RestLook
from fitting.quasi_static.strengths import stiffness_of, strengths_of
from fitting.quasi_static.stretches import FOLDS, stretches

# A residual this much larger than the noise of neighbouring points is slower than they are.
_NOISE = 2.0
_TOLD_APART = "None is needed: the held-out stretches tell the two apart."
_TIED = "Log more: several slow cycles at several loads, both ways, and a rest under load at the end."


def loop_report(data: QuasiStaticData, loop: QuasiStaticLoop) -> dict[str, Any]:
    """The report as JSON has it: finite numbers and nulls only.

    Args:
        data: The logs.
        loop: On these logs.
    """
    points, nothing = loop.held.points, loop.after is loop.before
    after = {"effects": [], "parameters": {}, "derived": {}, "rmse": rmse_dict(None, None)}
    if not nothing:
        after = _account(loop, loop.after) | {"effects": [_effect(loop, one) for one in loop.findings]}
    report = heading(data) | {
        "decision": loop.decision,
        "noise": {"dynamic_error": points.twist_noise, "joint_torque": points.torque_noise},
        "torque_range": [float(np.min(points.torque)), float(np.max(points.torque))],
        "before": _account(loop, loop.before),
        "after": after,
        "steps": _steps(loop),
        "alternatives": _alternatives(loop),
        "dropped": list(loop.dropped),
        "unexplained": _unexplained(loop),
        "unknown": None,
        "cannot_tell": [],
        "next_experiment": None,
        "setting": {"stretches": int(loop.held.stretch[-1]) + 1, "folds": FOLDS},
        "forms_tried": loop.forms_tried,
        "surrogates": DRAWS,
        "logs": [log_dict(data, i, points.rows[i], points.reversals[i]) for i in range(len(data.logs))],
    }
    report = finite(report | ending(data))
    report["summary"] = _summary(report)
    report["cannot_tell"] = _limits(report, loop)
    return report


def _account(loop: QuasiStaticLoop, trial: Trial) -> dict[str, Any]:
    return {
        "effects": [],
        "parameters": estimates(stiffness_of(loop.held.points, trial.model)),
        "derived": {},
        "rmse": _rmse(trial),
    }


def _rmse(trial: Trial) -> dict[str, float | None]:
    return rmse_dict(float(np.sqrt(np.mean(trial.model.misfit**2))), trial.rmse)


def _effect(loop: QuasiStaticLoop, finding: Finding) -> dict[str, Any]:
    points, model, forms = loop.told_by(finding)
    parameters: dict[str, Any] = {}
    for form in forms:
        for name, known in estimates(strengths_of(points, model, form)).items():
            path = f"{finding.family}.{name}"
            number = sum(other == path or other.startswith(f"{path} (") for other in parameters)
            parameters[f"{path} ({number + 1})" if number else path] = known | _in_arcmin(name, known)
    return {
        "family": finding.family,
        "name": " and ".join(form.name for form in finding.forms),
        "equation": "; ".join(form.equation for form in finding.forms),
        "parameters": parameters,
        "validation_gain": finding.validation_gain,
        "p_value": finding.p_value,
        "at_rest": None if finding.at_rest is None else _at_rest(finding.at_rest),
    }


def _at_rest(found: RestLook) -> dict[str, Any]:
    before, after = found.round.before, found.after
    return {
        "rests": len(found.held.points.names),
        "before": {"rmse": _rmse(before)},
        "after": {"rmse": _rmse(after)},
        "gain": found.gain,
    }


def _in_arcmin(name: str, known: Mapping[str, Any]) -> dict[str, Any]:
    """The unit in which small angles are stated, beside SI; phases are not small."""
    if known["unit"] != "rad" or known["value"] is None:
        return {}
    if name.startswith("phase"):
        return {"arcmin": None}
    ends = [None if end is None else ARCMIN * end for end in known["ci95"]]
    return {"arcmin": {"value": ARCMIN * known["value"], "ci95": ends}}


def _steps(loop: QuasiStaticLoop) -> list[dict[str, Any]]:
    found = [{"added": None, "held_out_rmse": loop.before.rmse}]
    for this in loop.rounds:
        if this.accepted:
            found.append({"added": this.rivals[0].lead.name, "held_out_rmse": this.rivals[0].trial.rmse})
    if loop.at_rest is not None and loop.at_rest.form is not None:
        found.append({"added": loop.at_rest.form.name, "held_out_rmse": loop.after.rmse})
    return found


def _alternatives(loop: QuasiStaticLoop) -> list[dict[str, Any]]:
    """What the equation can't tell from an effect whatever the fit, then what was refitted in its place."""
    points = loop.held.points
    kept = {form for one in loop.findings for form in one.forms}
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for one in loop.findings:
        for family, experiment in lookalikes(one.family, points, at_rest=one.at_rest is not None):
            if family == "coulomb_friction" and _slides_late(loop, one):
                continue
            found[family, one.family] = {
                "family": family,
                "name": f"{family.replace('_', ' ')} instead of {one.family.replace('_', ' ')}",
                "validation_rmse": loop.after.rmse,
                "separable": False,
                "separating_experiment": experiment,
                "instead_of": one.family,
                "validation_rmse_of_found": loop.after.rmse,
            }
    for this in loop.rounds:
        if not this.accepted or not kept & set(this.rivals[0].lead.forms):
            continue
        winner = this.rivals[0]
        for rival in this.rivals[1:]:
            families = set(rival.lead.families)
            same = families <= set(winner.lead.families)
            if len(families) > 1 or (same and rival.separable):
                continue
            found.setdefault((rival.lead.name, winner.lead.name), _refitted(rival, winner))
    return sorted(found.values(), key=lambda one: (one["separable"], one["validation_rmse"]))


def _slides_late(loop: QuasiStaticLoop, finding: Finding) -> bool:
    """Whether the logs know the torque that it takes to change the branch; Coulomb friction takes none."""
    return any(strengths_of(loop.held.points, loop.after.model, form)["reach"].identifiable for form in finding.forms)


def _refitted(rival: Rival, winner: Rival) -> dict[str, Any]:
    return {
        "family": rival.lead.families[0],
        "name": rival.lead.name,
        "validation_rmse": rival.trial.rmse,
        "separable": rival.separable,
        "separating_experiment": _TOLD_APART if rival.separable else _TIED,
        "instead_of": winner.lead.name,
        "validation_rmse_of_found": winner.trial.rmse,
    }


def _unexplained(loop: QuasiStaticLoop) -> dict[str, Any] | None:
    if loop.decision != "unexplained":
        return None
    left: dict[str, Any] = dict.fromkeys(("depends_on", "explained_share", "p_value"))
    return {
        "rms": loop.after.rmse,
        "times_noise": loop.after.rmse / loop.held.points.twist_noise,
        **(left if loop.left is None else dataclasses.asdict(loop.left)),
    }


def _summary(report: Mapping[str, Any]) -> str:
    """The decision in plain words."""
    before, after = (report[key]["rmse"]["validation"] for key in ("before", "after"))
    noise = report["noise"]["dynamic_error"]
    families = [one["family"].replace("_", " ") for one in report["after"]["effects"]]
    said = f"{formatting.quantity(before, 'rad')} rms ({formatting.number(before / noise)} times the twist's noise)"
    if report["decision"] == "model_sufficient":
        tried = (
            f"none of the {report['forms_tried']} forms of missing physics that were tried gains more than chance would"
        )
        if before < _NOISE * noise:
            return f"The straight line suffices: on held-out stretches it errs by {said}, and {tried}."
        return (
            f"Nothing more than a straight line is supported: on held-out stretches it errs by {said}, but {tried}, "
            "and what is left over depends on nothing that was logged."
        )
    change = (
        ""
        if after is None
        else (
            f" The held-out error falls from {formatting.quantity(before, 'rad')} to "
            f"{formatting.quantity(after, 'rad', like=before)} rms."
        )
    )
    resting = next((one["at_rest"] for one in report["after"]["effects"] if one["at_rest"]), None)
    if resting is not None:
        start, end = (resting[key]["rmse"]["validation"] for key in ("before", "after"))
        change += (
            f" While the joint rests it falls from {formatting.quantity(start, 'rad')} to "
            f"{formatting.quantity(end, 'rad', like=start)}."
        )
    if report["decision"] == "effect_found":
        count = "A missing effect was" if len(families) == 1 else f"{len(families)} missing effects were"
        return f"{count} found: {formatting.words(families)}.{change}"
    left = report["unexplained"]
    part = f" A part was found ({formatting.words(families)}).{change}" if families else ""
    depends = "depends on nothing that was logged"
    if left["depends_on"] is not None:
        share = formatting.percent(left["explained_share"])
        depends = f"depends on the {left['depends_on']}, which accounts for {share} of it on unseen stretches"
    return (
        f"Something is missing that the catalogue does not explain.{part} What is left over, "
        f"{formatting.number(left['times_noise'])} times the twist's noise, {depends}."
    )


def _limits(report: Mapping[str, Any], loop: QuasiStaticLoop) -> list[str]:
    points, model = loop.held.points, loop.after.model
    parameters = dict((report["after"]["parameters"] or report["before"]["parameters"]).items())
    for one in report["after"]["effects"]:
        parameters |= one["parameters"]
    vague = [name for name, known in parameters.items() if not known["identifiable"] and "phase" not in name]
    notes = (
        [f"{formatting.words(vague)} {'is' if len(vague) == 1 else 'are'} not identifiable from these logs."]
        if vague
        else []
    )
    friction = parameters.get("hysteresis.friction")
    if friction is not None:
        notes += _about_loops(friction["value"])
    if loop.decision == "model_sufficient" and loop.after.rmse > _NOISE * points.twist_noise:
        notes.append(
            "What is left over is slower than the twist's noise, and follows nothing that was logged, as far as "
            "held-out stretches can tell: noise of that colour, an error of the torque, or too few cycles to tell an "
            "effect."
        )
    error = formatting.quantity(float(abs(loop.before.model.coefficients[0])) * points.torque_error, "rad")
    notes.append(
        f"The torque is still off by {formatting.quantity(points.torque_error, 'N m')} rms when its noise is taken "
        f"off, which is {error} of twist: an effect that follows the torque and is smaller than that can't be seen."
    )
    if "one way" in points.motion:
        notes.append(
            "The joint moved one way only: nothing is said of hysteresis, friction that is constant while it moves is "
            "a part of the zero, and friction that depends on load or position is a part of the stiffness."
        )
    own_stiffness = next((one.at_rest.own_stiffness for one in loop.findings if one.at_rest is not None), None)
    if own_stiffness is not None:
        notes.append(
            "At rest the twist may as well follow the torque as logged, with a stiffness of "
            f"{formatting.quantity(own_stiffness, 'N m/rad')}, which the logs as a whole rule out. Where the stiffness "
            "of the whole logs is none of the gear alone, since it holds friction or an encoder's error, that would be "
            "no creep."
        )
    count = int(stretches(model.misfit, points.log, each=2)[-1]) + 1
    return [*notes, *few_stretches(count), ABOUT_SCALE]


def _about_loops(friction: float) -> list[str]:
    if friction < 0:
        return [
            "The loop runs the wrong way round, as if the gear gave out energy. Hysteresis of the gear alone can't do "
            "that; friction on the motor's side does where the torque is a motor's current, since it bears a part of "
            "the torque that the gear passes on, and so does a torque channel that lags behind."
        ]
    return [
        "The loop contains all friction between torque and twist: a torque measured on the motor's side, by its "
        "current above all, counts friction of motor and bearings as hysteresis of the gear."
    ]
