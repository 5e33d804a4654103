"""What a closed loop found, told to people (page, terminal) and to programs (JSON)."""

import dataclasses
import json
import math
import os
import platform
import re
from collections.abc import Callable, Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup, escape
from plotly.offline import get_plotlyjs

from fitting import findings, formatting
from fitting.attribution import Round, Trial, Verdict
from fitting.close_loop import Finding, Loop
from fitting.compare import Account
from fitting.diagnostics import Dependence, ResidualDiagnostics
from fitting.files import write_whole
from fitting.free_run import FreeRun
from fitting.plots import Plot, fit_plots, plots
from fitting.rig import Rig
from fitting.uncertainty import Estimate
from hdjax import Hold, Model, ReducedModel
from hdjax.effects import ActuatorEffect

SCHEMA = "hdjax-report/1"

_NORMAL_95 = 1.959963984540054
_LIBRARIES = ("hdjax", "jax", "diffrax", "optimistix", "equinox", "numpy", "scipy")
# Beyond it two parameters are told as one combination.
_CORRELATED = 0.9
_MOST_CORRELATIONS = 8
_COUNTS = ("No", "One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine", "Ten")
_PLAIN_FAMILY = {"torque_sensor": "torque sensor error", "unknown": "unknown term"}

# Which experiment separates two families; symmetric. Restates the look-alike column of EFFECTS.md.
_SEPARATING = {
    ("kinematic_error", "cogging"): "Run at two constant speeds: the force behind a geometric error grows with the "
    "square of the speed, a cogging torque stays the same.",
    ("kinematic_error", "encoder_eccentricity"): "Pass slowly through the speed at which the order meets the natural "
    "frequency: a kinematic error is amplified there, an encoder's error is not.",
    ("kinematic_error", "position_dependent_stiffness"): "Step the mean torque at one speed: a ripple of the stiffness "
    "grows with it, a kinematic error does not.",
    (
        "kinematic_error",
        "load_disturbance",
    ): "Change the motor speed: an error of the gear moves with it, a disturbance stays at its frequency.",
    ("cogging", "load_disturbance"): "Change the motor speed: cogging moves with it, a disturbance stays at its "
    "frequency.",
    ("cogging", "encoder_eccentricity"): "Lock the output and turn the motor slowly by hand: cogging takes torque, an "
    "encoder's error does not.",
    ("cogging", "position_dependent_friction"): "Run the same path in both directions: friction changes its sign, "
    "cogging does not.",
    ("stiffness_shape", "stiffness_shape"): "Drive to larger twists, past the knee of the stiffness, in both "
    "directions.",
    ("stiffness_shape", "backlash"): "Repeat with a preload: a dead zone disappears, a bent stiffness stays.",
    ("stiffness_shape", "hysteresis"): "Cycle the torque slowly at several amplitudes: hysteresis opens a loop, a bent "
    "stiffness retraces its curve.",
    ("stiffness_shape", "nonlinear_damping"): "Cycle the torque slowly: damping vanishes with the rate, stiffness does "
    "not.",
    ("backlash", "hysteresis"): "Repeat with a preload: a dead zone disappears, hysteresis stays.",
    ("backlash", "coulomb_friction"): "Repeat with a preload: a dead zone disappears, friction stays.",
    ("hysteresis", "coulomb_friction"): "Cycle the torque as a slow triangle at three rates, with small loops inside "
    "large ones: hysteresis has a slope before it slides and remembers its reversals.",
    ("hysteresis", "nonlinear_damping"): "Repeat the same twist at three rates: the area of a hysteresis loop stays, "
    "that of a damping loop grows with the rate.",
    ("hysteresis", "motor_friction"): "Lock the output and cycle the torque slowly: what the motor's own friction "
    "takes does not reach the twist, hysteresis shows in torque against twist.",
    ("hysteresis", "creep"): "Stop under load and wait: creep goes on for minutes, hysteresis does not.",
    ("coulomb_friction", "motor_friction"): "Turn the motor at constant speed, unloaded: its friction takes torque, "
    "friction between the mesh's sides does not.",
    ("coulomb_friction", "load_friction"): "Drive one side at a time, the other one locked.",
    ("coulomb_friction", "nonlinear_damping"): "Excite at several levels: the loss per cycle grows more slowly than "
    "the amplitude squared with Coulomb friction, and faster with nonlinear damping.",
    ("motor_friction", "motor_friction"): "Reverse slowly and dwell near standstill, where the two laws differ.",
    ("motor_friction", "load_friction"): "Drive one side at a time, the other one locked or uncoupled.",
    ("motor_friction", "torque_sensor"): "Run the same path in both directions: friction changes its sign, a bias does "
    "not.",
    ("motor_friction", "nonlinear_damping"): "Turn at several constant speeds: motor friction takes torque, damping of "
    "the mesh does not.",
    ("motor_friction", "position_dependent_friction"): "Turn slowly over several revolutions: a ripple that repeats "
    "with the angle belongs to the position.",
    ("position_dependent_friction", "kinematic_error"): "Run the same path in both directions: friction changes its "
    "sign, a kinematic error keeps its phase.",
    ("gravity_load", "torque_sensor"): "Turn the mount, or add a known mass: gravity follows, a sensor's bias does "
    "not.",
    ("gravity_load", "encoder_eccentricity"): "Turn the mount: gravity keeps to the vertical, the encoder's error to "
    "its disc.",
    ("gravity_load", "load_disturbance"): "Rest in several poses: gravity depends on the pose, not on time.",
    ("load_disturbance", "extra_resonance"): "Switch the excitation off, or change the load's inertia: a resonance "
    "needs the one and moves with the other.",
    ("temperature", "creep"): "Hold a constant torque at a constant temperature: creep relaxes, a thermal drift stays "
    "away.",
    ("temperature", "hysteresis"): "Cool down and repeat: thermal drift goes back to where it was.",
    ("torque_sensor", "torque_sensor"): "Rest without load, then apply a known torque: bias shows in the one, gain in "
    "the other.",
    ("input_delay", "nonlinear_damping"): "Excite up to several times the natural frequency: the phase of a delay "
    "keeps growing, that of damping saturates.",
    ("input_delay", "input_delay"): "Log the torque faster, or state its hold in the drive file.",
}
# Where the pair is not in the table: what brings out one family.
_REVEALING = {
    "kinematic_error": "repeat at two speeds and look for amplification at the natural frequency",
    "stiffness_shape": "cycle the torque slowly to larger twists",
    "backlash": "repeat with a preload, which removes a dead zone",
    "hysteresis": "cycle the torque slowly at three rates, with small loops inside large ones",
    "coulomb_friction": "let the drive ring down freely: the envelope falls along a straight line",
    "motor_friction": "run the same path in both directions at several constant speeds",
    "load_friction": "drive one side at a time, the other one locked",
    "nonlinear_damping": "excite at the natural frequency at several levels",
    "position_dependent_stiffness": "step the mean torque",
    "position_dependent_friction": "run the same path in both directions",
    "cogging": "turn slowly at two constant speeds",
    "gravity_load": "turn the mount, or add a known mass",
    "load_disturbance": "repeat at another motor speed and without excitation",
    "extra_resonance": "change the load's inertia",
    "temperature": "cool down and repeat",
    "torque_sensor": "reverse the direction, and check the sensor with a known torque",
    "input_delay": "excite up to several times the natural frequency",
    "encoder_eccentricity": "pass slowly through the natural frequency",
    "creep": "stop under load and wait for minutes",
}


class FitOnly(eqx.Module):
    """A fit without a search for effects; stands in for a [`Loop`][] in reports.

    Attributes:
        account: the fitted model's.
        noise: covariance of the measurement noise of the outputs.
        hold: what the torque does between samples, as used.
        residual: diagnostics of what the model leaves over, or None.
        seconds: where the time went.
    """

    account: Account
    noise: Float[Array, "outputs outputs"]
    hold: Hold | None = eqx.field(static=True, default=None)
    residual: ResidualDiagnostics | None = None
    seconds: dict[str, float] | None = None
    decision: ClassVar[str] = "fit_only"
    findings: ClassVar[tuple[Finding, ...]] = ()
    rounds: ClassVar[tuple[Round, ...]] = ()
    dropped: ClassVar[tuple[str, ...]] = ()

    @property
    def before(self) -> Account:
        """The one account that there is."""
        return self.account

    @property
    def after(self) -> Account:
        """Likewise."""
        return self.account


Outcome = Loop | FitOnly


def report_dict(
    outcome: Outcome,
    *,
    units: Mapping[str, str] | None = None,
    health: Sequence[tuple[str, findings.Finding]] = (),
    name: str = "drive",
) -> dict[str, Any]:
    """The report as JSON has it: finite numbers and nulls only.

    Args:
        outcome: of the loop or of a fit.
        units: of `dynamic_error` and, in a reduced log, of `forcing`; SI where not given.
        health: what the health gate said, each finding with its log's name.
        name: the drive's.
    """
    units = {"dynamic_error": "rad", "forcing": "N m"} | dict(units or {})
    noise = float(np.sqrt(np.asarray(outcome.noise)[-1, -1]))
    after = _account_dict(outcome.after, units) if isinstance(outcome, Loop) else _no_account()
    report = {
        "schema": SCHEMA,
        "version": version("hdjax"),
        "name": name,
        "decision": outcome.decision,
        "summary": "",
        "units": units,
        "noise": {"dynamic_error": noise},
        "before": _account_dict(outcome.before, units),
        "after": after | {"effects": [_effect_dict(f, outcome, units) for f in outcome.findings]},
        "alternatives": alternatives(outcome),
        "dropped": list(outcome.dropped),
        "unexplained": _unexplained(outcome, noise)
        if isinstance(outcome, Loop) and outcome.decision == "unexplained"
        else None,
        "cannot_tell": [],
        "hold": outcome.hold,
        "setting": _setting(outcome),
        "forms_tried": max((len(r.verdicts) for r in outcome.rounds), default=0),
        "surrogates": max((int(r.screen.null_gains.size) for r in outcome.rounds), default=0),
        "seconds": dict(outcome.seconds or {}),
        "logs": [_log_dict(*runs) for runs in zip(outcome.before.training, outcome.before.validation, strict=True)],
        "health": [{"log": log} | dataclasses.asdict(f) for log, f in health],
        "versions": {"python": platform.python_version()} | {lib: version(lib) for lib in _LIBRARIES},
    }
    report = _finite(report)
    report["summary"] = summary(report)
    report["cannot_tell"] = _limits(report, outcome, _largest_twist(outcome))
    return report


def summary(report: Mapping[str, Any]) -> str:
    """The decision in plain words."""
    unit = report["units"]["dynamic_error"]
    noise = report["noise"]["dynamic_error"]
    before = report["before"]["rmse"]["validation"]
    after = report["after"]["rmse"]["validation"]
    families = list(dict.fromkeys(e["family"] for e in report["after"]["effects"]))
    found = formatting.words([plain_family(f) for f in families]) if families else ""
    decision = report["decision"]
    if decision == "fit_only":
        return f"The base model was fitted. On held-out data it errs by {_against_noise(before, noise, unit)}."
    if decision == "model_sufficient":
        return (
            f"The model suffices: on held-out data it errs by {_against_noise(before, noise, unit)}, and none of the "
            f"{report['forms_tried']} forms of missing physics that were tried gains more than chance would."
        )
    if decision == "effect_found":
        opening = (
            "A missing effect was found"
            if len(families) == 1
            else f"{_count(len(families))} missing effects were found"
        )
        return (
            f"{opening}: {found}. {'It removes' if len(families) == 1 else 'Together they remove'} "
            f"{_removed(before, after)} of the held-out error, which falls from {_rmse(before, unit)} to "
            f"{_against_noise(after, noise, unit, like=before)}."
        )
    left = report["unexplained"]
    opening = "Something is missing that the catalogue does not explain."
    if families:
        opening = f"A part was found ({found}), but something else is missing that the catalogue does not explain."
    return (
        f"{opening} What is left over is {formatting.number(left['times_noise'])} times the measurement noise, and "
        f"depends most on the {left['depends_on']} (which accounts for "
        f"{formatting.percent(left['explained_share'])} of it)."
    )


def report_text(report: Mapping[str, Any]) -> str:
    """A compact summary for the terminal.

    Args:
        report: from [`report_dict`][].
    """
    unit = report["units"]["dynamic_error"]
    final = report["after"] if report["after"]["parameters"] else report["before"]
    lines = ["[Decision]", f"    {report['summary']}", "[Rms error of the free runs]"]
    shown = [("model", report["before"])]
    if report["after"]["effects"]:
        shown = [("before", report["before"]), ("after", report["after"])]
    lines.append("    " + " " * 12 + "".join(f"{n:>14}" for n, _ in shown))
    for key, label in (("training", "training"), ("validation", "held out")):
        values = "".join(f"{_plain_number(a['rmse'][key]):>14}" for _, a in shown)
        lines.append(f"    {label:12}{values} {unit}")
    lines.append(f"    {'noise':12}{_plain_number(report['noise']['dynamic_error']):>14} {unit}")
    lines.append("[Parameters]")
    lines += _parameter_lines(final["parameters"])
    for effect in report["after"]["effects"]:
        gain = formatting.percent(effect["validation_gain"])
        lines.append(f"[Effect: {effect['name']}] {effect['family']}, gain {gain}, {_chance(effect, report)}")
        lines += _parameter_lines(effect["parameters"])
    for other in report["alternatives"]:
        kind = "ruled out" if other["separable"] else "TIE"
        lines.append(f"[Alternative: {other['name']}] {kind}. {other['separating_experiment']}")
    for note in report["cannot_tell"]:
        lines.append(f"[Note] {note}")
    return "\n".join(lines)


def report_page(report: Mapping[str, Any], pictures: Sequence[Plot]) -> str:
    """The page: self-contained, reads without a network.

    Args:
        report: from [`report_dict`][].
        pictures: from [`fitting.plots.plots`][].
    """
    environment = Environment(
        loader=PackageLoader("fitting", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # `tojson` writes <, >, & and ' as escapes, so that no name can end the script.
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    environment.filters |= {
        "quantity": formatting.quantity,
        "number": formatting.number,
        "percent": formatting.percent,
        "unit": formatting.pretty_unit,
        "measured": lambda p: formatting.measured(p["value"], p["std"], p["unit"]),
        "in_factor": lambda p, factor: formatting.in_factor(p["value"], p["std"], factor),
        "interval_in_factor": lambda p, factor: formatting.interval_in_factor(p["ci95"], p["std"], factor),
        "interval": lambda p: formatting.interval(p["ci95"], p["std"], p["unit"]),
        "family": plain_family,
        "code": _code,
        "symbol": _symbol,
    }
    final = report["after"] if report["after"]["parameters"] else report["before"]
    return environment.get_template("report.html.jinja").render(
        report=report,
        final=final,
        x_unit=report["units"]["dynamic_error"],
        chance=lambda effect: _chance(effect, report),
        rows=_parameter_rows(report, final),
        drive_notes=[n for n in report["cannot_tell"] if n.split(" is not identifiable")[0] in final["parameters"]],
        changes=_changes(report),
        sections={s: [p for p in pictures if p.section == s] for s in ("fit", "left_over", "found")},
        plotlyjs=Markup(get_plotlyjs()),
    )


def write_report(
    out_dir: str | os.PathLike[str],
    outcome: Outcome,
    *,
    model_json: str,
    units: Mapping[str, str] | None = None,
    health: Sequence[tuple[str, findings.Finding]] = (),
    name: str = "drive",
) -> dict[str, Path]:
    """Write `report.html`, `report.json` and `model.json`: all of them, whole, or none.

    Args:
        out_dir: folder; made where absent.
        outcome: of the loop or of a fit.
        model_json: the fitted model, as `hdjax predict` reads it.
        units: see [`report_dict`][].
        health: see [`report_dict`][].
        name: the drive's.

    Returns:
        The files' paths, by name.
    """
    report = report_dict(outcome, units=units, health=health, name=name)
    texts = {
        "report.html": report_page(report, _pictures(outcome, report)),
        "report.json": json.dumps(report, indent=1, allow_nan=False) + "\n",
        "model.json": model_json,
    }
    paths = {file: Path(out_dir) / file for file in texts}
    write_whole({paths[file]: text for file, text in texts.items()})
    return paths


def write_loop_report(out_dir: str | os.PathLike[str], loop: Loop, *, rig: Rig, model_json: str) -> dict[str, Path]:
    """[`write_report`][] of a loop on a rig's logs."""
    return write_report(out_dir, loop, model_json=model_json, **_of_rig(rig))


def write_fit_report(
    out_dir: str | os.PathLike[str],
    account: Account,
    *,
    rig: Rig,
    noise: Float[Array, "outputs outputs"],
    hold: Hold,
    model_json: str,
    residual: ResidualDiagnostics | None = None,
    seconds: Mapping[str, float] | None = None,
) -> dict[str, Path]:
    """[`write_report`][] of a fit of a rig's logs.

    Args:
        out_dir: folder; made where absent.
        account: the fitted model's.
        rig: the drive and its logs.
        noise: covariance of the measurement noise of the outputs.
        hold: what the torque does between samples, as used.
        model_json: the fitted model, as `hdjax predict` reads it.
        residual: diagnostics of what the model leaves over; without it the page shows none.
        seconds: where the time went.
    """
    fitted = FitOnly(account=account, noise=noise, hold=hold, residual=residual, seconds=dict(seconds or {}))
    return write_report(out_dir, fitted, model_json=model_json, **_of_rig(rig))


def loop_text(loop: Loop, *, rig: Rig) -> str:
    """[`report_text`][] of a loop on a rig's logs."""
    return report_text(report_dict(loop, **_of_rig(rig)))


def fit_text(account: Account, *, rig: Rig, noise: Float[Array, "outputs outputs"]) -> str:
    """[`report_text`][] of a fit of a rig's logs."""
    return report_text(report_dict(FitOnly(account=account, noise=noise), **_of_rig(rig)))


def alternatives(outcome: Outcome) -> list[dict[str, Any]]:
    """What else was refitted inside the equations: ties, and families that the data rule out."""
    names = {f.name for f in outcome.findings}
    families = {f.family for f in outcome.findings}
    found: dict[str, dict[str, Any]] = {}
    for this in outcome.rounds:
        if not this.accepted or this.winner.name not in names:
            continue
        for verdict in this.verdicts:
            if verdict.trial is None or verdict.name in names or (verdict.family in families and verdict.separable):
                continue
            entry = _alternative(verdict, verdict.trial, this.winner)
            known = found.get(verdict.name)
            if known is None or _closeness(entry) < _closeness(known):
                found[verdict.name] = entry
    return sorted(found.values(), key=_closeness)


def separating_experiment(one: str, other: str) -> str:
    """The experiment that tells two families apart."""
    known = _SEPARATING.get((one, other)) or _SEPARATING.get((other, one))
    if known:
        return known
    hints = [f"for {plain_family(f)}, {_REVEALING[f]}" for f in dict.fromkeys((one, other)) if f in _REVEALING]
    if not hints:
        return "Repeat at another amplitude, speed and mean torque."
    sentence = "; ".join(hints)
    return f"{sentence[0].upper()}{sentence[1:]}."


def plain_family(family: str) -> str:
    """A family's name in prose."""
    return _PLAIN_FAMILY.get(family, family.replace("_", " "))


def _of_rig(rig: Rig) -> dict[str, Any]:
    """What a report says of the drive and its logs."""
    return {
        "name": rig.name,
        "units": rig.logs[0].units,
        "health": [(log, finding) for log, found in rig.findings.items() for finding in found],
    }


def _count(number: int) -> str:
    return _COUNTS[number] if number < len(_COUNTS) else str(number)


def _pictures(outcome: Outcome, report: Mapping[str, Any]) -> list[Plot]:
    if isinstance(outcome, Loop):
        return plots(outcome, units=report["units"])
    noise, unit = report["noise"]["dynamic_error"], report["units"]["dynamic_error"]
    return fit_plots(outcome.account, outcome.residual, noise=noise, unit=unit)


def _account_dict(account: Account, units: Mapping[str, str]) -> dict[str, Any]:
    drive_paths = [p for p in account.uncertainty.estimates if "." not in p]
    return {
        "effects": [],
        "parameters": {p: _estimate_dict(account.uncertainty.estimates[p], account.model, units) for p in drive_paths},
        "derived": _derived(account, _drive_quantities),
        "rmse": {"training": account.training_rmse, "validation": account.validation_rmse},
    }


def _no_account() -> dict[str, Any]:
    return {"effects": [], "parameters": {}, "derived": {}, "rmse": {"training": None, "validation": None}}


def _estimate_dict(estimate: Estimate, model: Model, units: Mapping[str, str]) -> dict[str, Any]:
    return {
        "value": estimate.value,
        "std": estimate.std,
        "ci95": list(estimate.ci95),
        "unit": _unit_in_log(estimate.unit, estimate.path, model, units),
        "identifiable": estimate.identifiable,
        "std_classical": estimate.std_classical,
        "description": model.parameters()[estimate.path][1].doc,
    }


def _unit_in_log(unit: str, path: str, model: Model, units: Mapping[str, str]) -> str:
    """The unit of what stands at a path; a reduced drive's come from the log."""
    if not isinstance(model, ReducedModel):
        return unit
    place: formatting.Place = "drive"
    if "." in path:
        effect = model.effect(path.split(".")[0])
        place = "actuator" if isinstance(effect, ActuatorEffect) else "mesh"
    return formatting.in_log_units(unit, response=units["dynamic_error"], forcing=units["forcing"], place=place)


def _effect_dict(finding: Finding, outcome: Outcome, units: Mapping[str, str]) -> dict[str, Any]:
    """An accepted effect with its fitted and derived quantities."""
    entry: dict[str, Any] = {
        "family": finding.family,
        "name": finding.name,
        "parameters": {},
        "validation_gain": finding.validation_gain,
        "p_value": finding.p_value,
    }
    if finding.effect is None:
        return entry | {"equation": f"Between samples the torque follows a {outcome.hold} hold."}
    account = outcome.after
    prefix = f"{finding.name}."
    entry["equation"] = (type(finding.effect).__doc__ or finding.name).splitlines()[0]
    entry["parameters"] = {
        path: _estimate_dict(estimate, account.model, units)
        for path, estimate in account.uncertainty.estimates.items()
        if path.startswith(prefix)
    }
    derived = _derived(account, lambda m: m.effect(finding.name).derived(m.drive))
    for name, quantity in derived.items():
        quantity["unit"] = _unit_in_log(quantity["unit"], prefix + name, account.model, units)
        entry["parameters"][prefix + name] = quantity
    return entry


def _drive_quantities(model: Model) -> dict[str, tuple[Array, str]]:
    drive = model.drive
    found = {"natural_frequency": (drive.omega_0 / (2 * jnp.pi), "Hz")}
    return found if isinstance(model, ReducedModel) else found | {"mu": (drive.mu, "1/s")}


def _derived(account: Account, quantities: Callable[[Model], dict[str, tuple[Array, str]]]) -> dict[str, Any]:
    """Quantities that follow from fitted ones, with their standard errors to first order."""
    model, estimates = account.model, account.uncertainty.estimates
    known = quantities(model)
    if not known:
        return {}
    paths = list(estimates)

    def values(vector: Array) -> Array:
        moved = model.replace({p: vector[i] for i, p in enumerate(paths)})
        return jnp.stack([value for value, _ in quantities(moved).values()])

    slopes = np.asarray(jax.jacfwd(values)(jnp.asarray([e.value for e in estimates.values()], dtype=float)))
    spread = np.array([e.std for e in estimates.values()])
    with np.errstate(all="ignore"):
        scaled = slopes * spread
        variance = np.einsum("ip,pq,iq->i", scaled, np.asarray(account.uncertainty.correlation), scaled)
        errors = np.sqrt(variance)
    return {
        name: _derived_dict(name, float(value), float(error), unit)
        for (name, (value, unit)), error in zip(known.items(), errors, strict=True)
    }


def _derived_dict(name: str, value: float, error: float, unit: str) -> dict[str, Any]:
    half = _NORMAL_95 * error
    # An angle may well be zero; it is known when it is known to a quarter turn.
    known = half < math.pi / 2 if name.startswith("ph") else abs(value) > half
    return {
        "value": value,
        "std": error,
        "ci95": [value - half, value + half],
        "unit": unit,
        "identifiable": bool(known),
        "derived": True,
        "description": name.replace("_", " "),
    }


def _alternative(verdict: Verdict, trial: Trial, winner: Verdict) -> dict[str, Any]:
    experiment = separating_experiment(winner.family, verdict.family)
    if verdict.separable:
        experiment = "None is needed: the held-out data tell the two apart."
    return {
        "family": verdict.family,
        "name": verdict.name,
        "validation_rmse": _held_out_rmse(trial),
        "separable": verdict.separable,
        "separating_experiment": experiment,
        "instead_of": winner.name,
        "validation_rmse_of_found": None if winner.trial is None else _held_out_rmse(winner.trial),
    }


def _held_out_rmse(trial: Trial) -> float:
    """Rms of the dynamic error on held-out segments, whose initial states are fitted."""
    return float(np.sqrt(np.asarray(trial.held_out.covariance)[-1, -1]))


def _closeness(alternative: Mapping[str, Any]) -> tuple[bool, float]:
    return alternative["separable"], alternative["validation_rmse"]


def _unexplained(outcome: Outcome, noise: float) -> dict[str, Any] | None:
    """How much is left over, and on what it depends most; None where that is not the decision."""
    if not isinstance(outcome, Loop) or outcome.decision != "unexplained":
        return None
    residual = outcome.residual_after
    shares = {name: explained_share(d, residual.rms) for name, d in residual.dependence.items()}
    most = max(shares, key=lambda name: shares[name])
    words = {"x": "dynamic error", "v": "rate of the dynamic error"}
    return {
        "rms": residual.rms,
        "times_noise": residual.rms / noise,
        "depends_on": words.get(most, most),
        "explained_share": shares[most],
        "explained_shares": shares,
    }


def explained_share(dependence: Dependence, rms: float) -> float:
    """Share of the residual's mean square that its mean over bins of a quantity accounts for."""
    # Means of bins scatter even where nothing depends on anything; that is taken off.
    square = np.mean(dependence.mean**2 - dependence.standard_error**2)
    return float(np.clip(square / rms**2, 0.0, 1.0)) if rms > 0 else 0.0


def _limits(report: Mapping[str, Any], outcome: Outcome, largest: float) -> list[str]:
    """What these data can't tell, a sentence each."""
    final = report["after"] if report["after"]["parameters"] else report["before"]
    notes = [
        _unidentifiable(path, estimate, largest, report["units"]["dynamic_error"])
        for path, estimate in final["parameters"].items()
        if not estimate["identifiable"]
    ]
    for effect in report["after"]["effects"]:
        notes += _unidentifiable_parts(effect)
    for other in report["alternatives"]:
        if not other["separable"]:
            notes.append(
                f"A tie: {other['name']} ({plain_family(other['family'])}) explains the held-out data about as well "
                f"as {other['instead_of']}. {other['separating_experiment']}"
            )
    return notes + _correlated(outcome.after)


def _unidentifiable(path: str, estimate: Mapping[str, Any], largest: float, x_unit: str) -> str:
    value, std, unit = estimate["value"], estimate["std"], estimate["unit"]
    if value is None or std is None:
        return f"{path} is not identifiable from these logs."
    limit = formatting.quantity(_NORMAL_95 * std, unit, digits=2)
    if path == "alpha":
        return (
            f"alpha is not identifiable from these logs: the largest measured twist, "
            f"{formatting.quantity(largest, x_unit)}, gives alpha x² = {formatting.number(value * largest**2, 2)}. "
            f"alpha could be told from zero only above {limit}, where alpha x² is "
            f"{formatting.number(_NORMAL_95 * std * largest**2, 2)}."
        )
    low, high = estimate["ci95"]
    if low is not None and low > 0:
        factor = math.sqrt(high / low) if high is not None else math.inf
        known = f"only to within a factor of {formatting.number(factor, 2)}" if factor < 1e3 else "not at all"
        return f"{path} is not identifiable from these logs: they determine it {known}."
    return f"{path} is not identifiable from these logs: it could be told from zero only above {limit}."


def _unidentifiable_parts(effect: Mapping[str, Any]) -> list[str]:
    """One sentence about all fitted parameters of an effect that the data do not determine."""
    vague = {
        path.split(".")[1]: e
        for path, e in effect["parameters"].items()
        if not e["identifiable"] and not e.get("derived")
    }
    if not vague:
        return []
    limits = [
        f"{symbol} (±{formatting.quantity(_NORMAL_95 * e['std'], e['unit'], digits=2)})" if e["std"] else symbol
        for symbol, e in vague.items()
    ]
    verb = "is" if len(limits) == 1 else "are"
    return [
        f"Of {effect['name']}, {formatting.words(limits)} {verb} not identifiable from these logs; "
        "in brackets how far from the value the truth may be."
    ]


def _correlated(account: Account) -> list[str]:
    names = list(account.uncertainty.estimates)
    matrix = np.asarray(account.uncertainty.correlation)
    pairs = [(abs(matrix[i, j]), i, j) for i in range(len(names)) for j in range(i)]
    strong = sorted((p for p in pairs if p[0] > _CORRELATED), reverse=True)
    notes = [
        f"{names[j]} and {names[i]} are correlated by {formatting.number(float(matrix[i, j]), 3)}: the data determine "
        "a combination of the two better than each."
        for _, i, j in strong[:_MOST_CORRELATIONS]
    ]
    if len(strong) > _MOST_CORRELATIONS:
        notes.append(f"{len(strong) - _MOST_CORRELATIONS} more pairs are correlated above {_CORRELATED}.")
    return notes


def _largest_twist(outcome: Outcome) -> float:
    return max(float(np.max(np.abs(run.measured))) for run in outcome.before.training)


def _parameter_rows(report: Mapping[str, Any], final: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The drive's parameters and what follows from them, each with the unit in which its numbers read well."""
    rows = []
    derived = {"natural_frequency": ("f₀", "natural frequency at small twist"), "mu": ("μ", "damping of the twist")}
    entries = [(p, p, e["description"], "parameters", e) for p, e in final["parameters"].items()]
    entries += [(k, *derived[k], "derived", e) for k, e in final["derived"].items()]
    for key, symbol, meaning, kind, estimate in entries:
        factor, unit = formatting.scaled_unit(abs(estimate["value"] or 0.0), estimate["unit"])
        before = report["before"][kind][key]
        rows.append(
            {
                "symbol": symbol,
                "meaning": meaning,
                "unit": unit,
                "factor": factor,
                "before": before,
                "final": estimate,
                "flagged": kind == "parameters" and not estimate["identifiable"],
            }
        )
    return rows


def _changes(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The drive's parameters without and with what was found."""
    if not report["after"]["effects"]:
        return []
    rows = []
    for path, with_it in report["after"]["parameters"].items():
        without = report["before"]["parameters"].get(path)
        if without is None or None in (without["value"], with_it["value"]):
            continue
        change = with_it["value"] - without["value"]
        rows.append(
            {
                "path": path,
                "without": without,
                "with": with_it,
                "relative": change / abs(without["value"]) if without["value"] else None,
                "in_std": change / without["std"] if without["std"] else None,
            }
        )
    return rows


def _log_dict(training: FreeRun, validation: FreeRun) -> dict[str, Any]:
    return {
        "name": training.name,
        "samples": int(training.time.size + validation.time.size),
        "held_out": int(validation.time.size),
        "seconds": float(validation.time[-1] - training.time[0]),
    }


def _setting(outcome: Outcome) -> dict[str, int] | None:
    """How the logs were cut, and the solver's steps in the end."""
    if not isinstance(outcome, Loop):
        return None
    return dataclasses.asdict(outcome.setting) | {"substeps": outcome.after_substeps}


def _rmse(value: float | None, unit: str, like: float | None = None) -> str:
    return "a simulation that diverged" if value is None else formatting.quantity(value, unit, like=like)


def _against_noise(value: float | None, noise: float, unit: str, like: float | None = None) -> str:
    if value is None:
        return _rmse(value, unit)
    return f"{_rmse(value, unit, like)} rms ({formatting.number(value / noise)} times the measurement noise)"


def _removed(before: float | None, after: float | None) -> str:
    if before is None or after is None:
        return "much"
    return formatting.percent(1.0 - after / before)


def _chance(effect: Mapping[str, Any], report: Mapping[str, Any]) -> str:
    """The p-value, with a sign where fewer draws than it would take were made."""
    p = effect["p_value"]
    smallest = 1.0 / (1 + report["surrogates"])
    if p is None:
        return "p unknown"
    return f"p {'≤' if p <= 1.001 * smallest else '='} {p:.2g}"


def _parameter_lines(parameters: Mapping[str, Any]) -> list[str]:
    width = max((len(p) for p in parameters), default=0)
    return [f"    {path:{width}}  {_parameter_line(estimate)}" for path, estimate in parameters.items()]


def _parameter_line(estimate: Mapping[str, Any]) -> str:
    value, std = estimate["value"], estimate["std"]
    low, high = estimate["ci95"]
    share = f" ({100 * std / abs(value):.2g} %)" if value and std is not None else ""
    flag = "" if estimate["identifiable"] else "  NOT IDENTIFIABLE"
    unit = "" if estimate["unit"] == "1" else f" {estimate['unit']}"
    return (
        f"{_plain_number(value, 6)} +/- {_plain_number(std, 2)}{share}{unit}"
        f"  [{_plain_number(low, 6)}, {_plain_number(high, 6)}]{flag}"
    )


def _plain_number(value: float | None, digits: int = 4) -> str:
    return "n/a" if value is None else f"{value:.{digits}g}"


def _code(text: str) -> Markup:
    """Text with its `backticked` parts as code."""
    parts = re.split(r"`([^`]*)`", text)
    return Markup("").join(Markup("<code>{}</code>").format(p) if i % 2 else escape(p) for i, p in enumerate(parts))


def _symbol(path: str) -> Markup:
    """A parameter's path, breakable after its dot."""
    return Markup("<code>{}</code>").format(Markup(".<wbr>").join(path.split(".")))


def _finite(value: Any) -> Any:
    """The same structure with null in place of what is no finite number."""
    if isinstance(value, Mapping):
        return {k: _finite(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(v) for v in value]
    if isinstance(value, bool) or not isinstance(value, float | np.floating):
        return value
    return float(value) if math.isfinite(value) else None
