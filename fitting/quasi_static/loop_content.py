"""Content of a quasi-static loop's `report.json`."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import numpy as np

from fitting import formatting
from fitting.quasi_static.attribution import TwistRound, TwistTrial, TwistVerdict
from fitting.quasi_static.facts import (
    ABOUT_SCALE,
    ARCMIN,
    account,
    beyond_fitted,
    estimates,
    few_stretches,
    framed,
    log_dicts,
    no_account,
    not_identifiable,
    rmse_dict,
    those_that_hold,
)
from fitting.quasi_static.lookalikes import lookalikes
from fitting.quasi_static.loop import Finding, QuasiStaticLoop
from fitting.quasi_static.noise_colour import DRAWS
from fitting.quasi_static.stretches import FOLDS, stretches
from fitting.quasi_static.test_part import Parted, misfit_on
from fitting.quasi_static.twist_model import stiffness_of, strengths_of
from fitting.report.rules import rules_dict

# Ratio of residual and point-to-point noise above which the residual is slow.
_NOISE = 2.0
_TOLD_APART = "None is needed: the held-out stretches distinguish the two."
_TIED = "Record more data: several slow cycles at several loads, both ways, and a rest under load at the end."
_WRONG_WAY = (
    "The loop has the wrong orientation, as if the gear generated energy. Hysteresis of the gear alone can't cause "
    "that. Friction on the motor's side does where the torque is a motor's current, since it bears a part of the "
    "torque that the gear transmits. So does a torque channel that lags."
)
_ALL_FRICTION = (
    "The loop contains all friction between torque and twist: with a torque measured on the motor's side, mainly by "
    "its current, friction of motor and bearings counts as hysteresis of the gear."
)
_SLOWER = (
    "The residual is slower than the twist's noise, and on held-out stretches depends on no logged quantity: "
    "coloured noise, an error of the torque, or too few cycles to detect an effect."
)
_ONE_WAY = (
    "The joint moved one way only: hysteresis is unknown. Friction that is constant during motion is part of the "
    "zero, and friction that depends on load or position is part of the stiffness."
)


def loop_report(parts: Parted, loop: QuasiStaticLoop) -> dict[str, Any]:
    """The report as JSON has it: finite numbers and nulls only.

    Args:
        parts: The logs.
        loop: On their fitted part.
    """
    points, after = loop.held.points, no_account()
    if loop.after is not loop.before:
        after = _account(parts, loop.after) | {"effects": [_effect(loop, one) for one in loop.findings]}
    before = _account(parts, loop.before)
    content = {
        "decision": loop.decision,
        "judged_on": "selection" if before["rmse"]["test"] is None else "test",
        "rules": rules_dict(loop.checks),
        "noise": {"dynamic_error": points.twist_noise, "joint_torque": points.torque_noise},
        "torque_range": [float(np.min(points.torque)), float(np.max(points.torque))],
        "before": before,
        "after": after,
        "steps": [{"added": added, "held_out_rmse": trial.rmse} for added, trial in loop.steps],
        "alternatives": _alternatives(loop),
        "dropped": list(loop.dropped),
        "unexplained": _unexplained(loop) if loop.decision == "unexplained" else None,
        "unknown": None,
        "cannot_tell": [],
        "next_experiment": None,
        "setting": {"stretches": int(loop.held.stretch[-1]) + 1, "folds": FOLDS},
        "forms_tried": loop.forms_tried,
        "surrogates": DRAWS,
        "logs": _logs(parts),
    }
    report = framed(parts.data, content)
    return report | {"summary": _summary(report), "cannot_tell": _limits(report, loop, parts)}


def _logs(parts: Parted) -> list[dict[str, Any]]:
    """The logs, each with its number of test rows, then logs that are test data alone."""
    tests = {one.points.names[0]: one for one in parts.tests}
    fitted = log_dicts(parts.data, parts.points.rows, parts.points.reversals)
    found = [log | {"test": tests.pop(log["name"]).rows if log["name"] in tests else 0} for log in fitted]
    return found + [
        {
            "name": name,
            "samples": len(one.points.twist) * one.points.rows[0],
            "held_out": 0,
            "seconds": one.points.duration,
            "rows_per_block": one.points.rows[0],
            "reversals": one.points.reversals[0],
            "motion": one.points.motion[0],
            "test": one.rows,
        }
        for name, one in tests.items()
    ]


def _account(parts: Parted, trial: TwistTrial) -> dict[str, Any]:
    test = misfit_on(parts.tests, trial.model, parts.points)
    return account(stiffness_of(parts.points, trial.model), trial.model.misfit, trial.held_out, test)


def _effect(loop: QuasiStaticLoop, finding: Finding) -> dict[str, Any]:
    points, model, forms = loop.evidence_of(finding)
    parameters: dict[str, Any] = {}
    for form in forms:
        for name, known in estimates(strengths_of(points, model, form)).items():
            path = f"{finding.family}.{name}"
            number = sum(other == path or other.startswith(f"{path} (") for other in parameters)
            parameters[f"{path} ({number + 1})" if number else path] = known | _in_arcmin(name, known)
    at_rest = None
    if finding.at_rest is not None:
        trials = {"before": finding.at_rest.round.before, "after": finding.at_rest.after}
        rmse = {name: {"rmse": rmse_dict(trial.model.misfit, trial.held_out)} for name, trial in trials.items()}
        at_rest = {"rests": len(points.names), **rmse, "gain": finding.at_rest.gain}
    return {
        "family": finding.family,
        "name": " and ".join(form.name for form in finding.forms),
        "equation": "; ".join(form.equation for form in finding.forms),
        "parameters": parameters,
        "validation_gain": finding.validation_gain,
        "p_value": finding.p_value,
        "at_rest": at_rest,
    }


def _in_arcmin(name: str, known: Mapping[str, Any]) -> dict[str, Any]:
    """Small angles in arcmin, beside SI; None for phases."""
    if known["unit"] != "rad" or known["value"] is None:
        return {}
    if name.startswith("phase"):
        return {"arcmin": None}
    ends = [None if end is None else ARCMIN * end for end in known["ci95"]]
    return {"arcmin": {"value": ARCMIN * known["value"], "ci95": ends}}


def _alternatives(loop: QuasiStaticLoop) -> list[dict[str, Any]]:
    """Effects that the equation can't distinguish from a found one, then those that were refitted in its place."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for one in loop.findings:
        shifted = any(form.includes for form in one.forms)
        alike = lookalikes(one.family, loop.held.points, at_rest=one.at_rest is not None, shifted=shifted)
        for family, experiment in alike:
            if family == "coulomb_friction" and _slides_late(loop, one):
                continue
            name = f"{family.replace('_', ' ')} instead of {one.family.replace('_', ' ')}"
            pair, rmse = (family, one.family), (loop.after.rmse, loop.after.rmse)
            found[pair] = _alternative(pair, name, rmse, False, experiment)
    kept = {form for one in loop.findings for form in one.forms}
    for this in loop.rounds:
        if this.accepted and kept & set(this.winner.trial.beyond(this.before)):
            for rival in this.verdicts[1:]:
                if _is_reported(rival, this):
                    pair, rmse = (rival.family, this.winner.name), (rival.trial.rmse, this.winner.trial.rmse)
                    experiment = _TOLD_APART if rival.separable else _TIED
                    entry = _alternative(pair, rival.name, rmse, rival.separable, experiment)
                    found.setdefault((rival.name, this.winner.name), entry)
    return sorted(found.values(), key=lambda one: (one["separable"], one["validation_rmse"]))


def _slides_late(loop: QuasiStaticLoop, finding: Finding) -> bool:
    """Whether the logs determine the torque over which the branch changes; for Coulomb friction it is zero."""
    return any(strengths_of(loop.held.points, loop.after.model, form)["reach"].identifiable for form in finding.forms)


def _is_reported(rival: TwistVerdict, this: TwistRound) -> bool:
    """Whether a candidate is a single form, and of another family than the winner or tied with it.

    A tied generalisation of the winner is the same effect.
    """
    forms, taken = (verdict.trial.beyond(this.before) for verdict in (rival, this.winner))
    same = forms[0].family in {form.family for form in taken}
    general = forms[0].includes in {form.name for form in taken}
    return len(forms) == 1 and not (same and (rival.separable or general))


def _alternative(
    families: tuple[str, str], name: str, rmse: tuple[float, float], separable: bool, experiment: str
) -> dict[str, Any]:
    return {
        "family": families[0],
        "name": name,
        "validation_rmse": rmse[0],
        "separable": separable,
        "separating_experiment": experiment,
        "instead_of": families[1],
        "validation_rmse_of_found": rmse[1],
    }


def _unexplained(loop: QuasiStaticLoop) -> dict[str, Any]:
    left: dict[str, Any] = dict.fromkeys(("depends_on", "explained_share", "p_value"))
    size = {"rms": loop.after.rmse, "times_noise": loop.after.rmse / loop.held.points.twist_noise}
    return size | (left if loop.left is None else dataclasses.asdict(loop.left))


def _summary(report: Mapping[str, Any]) -> str:
    """The decision in a few sentences."""
    effects, before = report["after"]["effects"], report["before"]["rmse"][report["judged_on"]]
    families = [one["family"].replace("_", " ") for one in effects]
    if report["decision"] == "model_sufficient":
        return _nothing_found(report, before)
    change = ""
    if effects:
        on = "error on test data" if report["judged_on"] == "test" else "held-out error"
        change = f" The {on} {_from_to(report, report['judged_on'])} rms."
    for resting in [one["at_rest"] for one in effects if one["at_rest"]][:1]:
        change += f" While the joint rests the held-out error {_from_to(resting, 'selection')}."
    if report["decision"] == "effect_found":
        count = "A missing effect was" if len(families) == 1 else f"{len(families)} missing effects were"
        return f"{count} found: {formatting.words(families)}.{change}"
    left = report["unexplained"]
    part = f" A part was found ({formatting.words(families)}).{change}" if families else ""
    depends = "depends on no logged quantity"
    if left["depends_on"] is not None:
        share = formatting.percent(left["explained_share"])
        depends = f"depends on the {left['depends_on']}, which explains {share} of it on held-out stretches"
    cause = (
        " that the catalogue does not explain" if report["forms_tried"] else ": no form of missing physics was tried"
    )
    return (
        f"Something is missing{cause}.{part} The residual, "
        f"{formatting.number(left['times_noise'])} times the twist's noise, {depends}."
    )


def _nothing_found(report: Mapping[str, Any], before: float) -> str:
    noise = report["noise"]["dynamic_error"]
    on = "test data" if report["judged_on"] == "test" else "held-out stretches"
    errs = (
        f"on {on} it errs by {formatting.quantity(before, 'rad')} rms "
        f"({formatting.number(before / noise)} times the twist's noise)"
    )
    count = report["forms_tried"]
    tried = "no form of missing physics was tried"
    if count:
        tried = f"none of the {count} tried forms of missing physics has a significant gain"
    if report["dropped"]:
        tried += " and a size that the logs determine"
    if before < _NOISE * noise:
        return f"The straight line suffices: {errs}, and {tried}."
    return (
        f"Nothing more than a straight line is supported: {errs}, but {tried}, "
        "and the residual depends on no logged quantity."
    )


def _from_to(accounts: Mapping[str, Any], part: str) -> str:
    start, end = (accounts[key]["rmse"][part] for key in ("before", "after"))
    verb = "falls" if end < start else "rises"
    return f"{verb} from {formatting.quantity(start, 'rad')} to {formatting.quantity(end, 'rad', like=start)}"


def _limits(report: Mapping[str, Any], loop: QuasiStaticLoop, parts: Parted) -> list[str]:
    points, model = loop.held.points, loop.after.model
    parameters = dict(report["after"]["parameters"] or report["before"]["parameters"])
    for one in report["after"]["effects"]:
        parameters |= one["parameters"]
    vague = [name for name, known in parameters.items() if not known["identifiable"] and "phase" not in name]
    friction = parameters.get("hysteresis.friction", {"value": 0.0})["value"]
    slower = loop.decision == "model_sufficient" and loop.after.rmse > _NOISE * points.twist_noise
    error = formatting.quantity(float(abs(loop.before.model.coefficients[0])) * points.torque_error, "rad")
    unseen = np.concatenate([one.points.torque[one.scored] for one in parts.tests] or [points.torque[:0]])
    own = next((one.at_rest.own_stiffness for one in loop.findings if one.at_rest is not None), None)
    notes = [
        (vague, f"{not_identifiable(vague)}." if vague else ""),
        (
            loop.dropped and not loop.findings,
            f"{formatting.words([*loop.dropped] or ['none']).capitalize()} had a significant gain, but the logs do not "
            "determine how large the effect is.",
        ),
        (friction < 0, _WRONG_WAY),
        (friction > 0, _ALL_FRICTION),
        (slower, _SLOWER),
        (
            True,
            f"After smoothing, the torque has an error of {formatting.quantity(points.torque_error, 'N m')} rms, "
            f"which is {error} of twist: a smaller effect that depends on the torque can't be detected.",
        ),
        ("one way" in points.motion, _ONE_WAY),
        (
            own is not None,
            "At rest the twist may also depend on the torque as logged, with a stiffness of "
            f"{formatting.quantity(own, 'N m/rad')}, which the whole logs exclude. If their stiffness is not that of "
            "the gear alone, since it contains friction or an encoder's error, there may be no creep.",
        ),
        (
            not parts.tests,
            "The logs are too short to set test data aside, or their ends are at rest: no error on unused data is "
            "stated. Name another log with --test.",
        ),
        beyond_fitted(unseen, points.torque, points.torque_error),
        few_stretches(int(stretches(model.misfit, points.log, each=2)[-1]) + 1),
        (True, ABOUT_SCALE),
    ]
    return those_that_hold(notes)
