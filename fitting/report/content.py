"""Content of `report.json`."""

import dataclasses
import platform
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from typing import Any

from fitting.attribution.case_evidence import stored_evidence
from fitting.files import finite
from fitting.logs import findings
from fitting.next_experiment.proposal import NextExperiment
from fitting.outcome import Loop
from fitting.report.alternatives import alternatives
from fitting.report.earlier_schema import with_old_names
from fitting.report.fit_content import fit_dict, meaning
from fitting.report.intervals import say_what_intervals_hold, widen_by_ties
from fitting.report.limits import identifiability_dict, largest_twist, limits
from fitting.report.outcome import Outcome
from fitting.report.outputs import noise_of_outputs, units_of_outputs
from fitting.report.parameters import PARTS, account_dict, effect_dict, no_account
from fitting.report.proposal import proposal_dict
from fitting.report.rules import rules_dict
from fitting.report.steps import steps
from fitting.report.summary import summary
from fitting.report.unexplained import unexplained
from fitting.report.unknown import unknown_dict
from fitting.validation.extrapolation import extrapolations
from hdjax import TwoInertiaModel

SCHEMA = "hdjax-report/2"

_LIBRARIES = ("hdjax", "jax", "diffrax", "optimistix", "equinox", "numpy", "scipy")


def report_dict(
    outcome: Outcome,
    *,
    units: Mapping[str, str] | None = None,
    health: Sequence[tuple[str, findings.Finding]] = (),
    name: str = "drive",
    next_experiment: NextExperiment | None = None,
    sought: bool = False,
) -> dict[str, Any]:
    """The content of `report.json`: finite numbers and nulls only.

    Args:
        outcome: of the loop or of a fit.
        units: of `dynamic_error` and, in a reduced log, of `forcing`; SI where not given.
        health: findings of the health check, each with its log's name.
        name: of the drive.
        next_experiment: the proposed experiment.
        sought: whether an experiment was searched for, even if none was found.
    """
    units = {"dynamic_error": "rad", "forcing": "N m"} | units_of_outputs(outcome.stored) | dict(units or {})
    noise = noise_of_outputs(outcome.stored)
    output = list(noise)[-1]
    x_max = largest_twist(outcome)
    is_loop = isinstance(outcome, Loop)
    report = {
        "schema": SCHEMA,
        "version": version("hdjax"),
        "name": name,
        "decision": outcome.decision,
        "judged_on": list(outcome.after.parts())[-1],
        "summary": "",
        "times_noise": None,
        "free_runs_times_expected": None,
        "unknown_remains": None,
        "rules": [],
        "evidence": None,
        "output": output,
        "units": units,
        "noise": noise | {"memory": None, "torque": None},
        "parameters_from": outcome.parameters_from,
        "before": account_dict(outcome.before, units, x_max, start=None if is_loop else outcome.start),
        "after": _after(outcome, units, x_max),
        "extrapolation": _extrapolation(outcome, units),
        "identifiability": identifiability_dict(outcome.after.identifiability, units),
        "steps": steps(outcome),
        "alternatives": alternatives(outcome),
        "assumed": {},
        "goodness": None,
        "residual_tests": [],
        "frequency_response": None,
        "posterior": None,
        "meaning": [],
        "search_limited": False,
        "dropped": list(outcome.dropped),
        "unexplained": unexplained(outcome, noise[output]),
        "unknown": unknown_dict(outcome, units),
        "cannot_tell": [],
        "next_experiment": proposal_dict(next_experiment, units, logs_reach=x_max),
        "next_experiment_sought": sought,
        "hold": outcome.hold,
        "setting": None,
        **_circumstances(outcome),
        "health": [{"log": log} | dataclasses.asdict(f) for log, f in health],
        "versions": {"python": platform.python_version()} | {lib: version(lib) for lib in _LIBRARIES},
    }
    report |= _of_loop(outcome, noise) if is_loop else fit_dict(outcome, noise[output])
    report = finite(report)
    if is_loop:
        say_what_intervals_hold(report)
    report["summary"] = summary(report)
    report["meaning"] = [] if is_loop else meaning(report)
    report["cannot_tell"] = limits(report)
    return with_old_names(report)


def _after(outcome: Outcome, units: Mapping[str, str], x_max: float) -> dict[str, Any]:
    """The final model of a loop; a fit has none."""
    if not isinstance(outcome, Loop):
        return no_account()
    after = account_dict(outcome.after, units, x_max)
    if outcome.parameters_from == "torque":
        widen_by_ties(after, outcome, x_max)
    return after | {"effects": [effect_dict(f, outcome, units) for f in outcome.findings]}


def _of_loop(outcome: Loop, noise: Mapping[str, Any]) -> dict[str, Any]:
    """What only a loop has: evidence, checks, noise with memory and of the torque, settings."""
    setting = {
        "horizon": outcome.setting.segmentation.horizon,
        "halo": outcome.setting.halo,
        "substeps": outcome.after_substeps,
        "count": outcome.setting.segmentation.count,
        "least_progress": outcome.setting.least_progress,
        "thorough": outcome.setting.thorough,
    }
    return {
        "times_noise": outcome.times_noise,
        "free_runs_times_expected": outcome.surprise,
        "unknown_remains": outcome.unknown_remains,
        "rules": rules_dict(outcome.checks),
        "evidence": stored_evidence(outcome.case),
        "noise": dict(noise) | {"memory": outcome.noise_memory, "torque": outcome.torque_noise},
        "setting": setting,
        "search_limited": outcome.limited,
    }


def _extrapolation(outcome: Outcome, units: Mapping[str, str]) -> list[dict[str, Any]]:
    """In what test data go beyond the fitted data."""
    twist, forcing = units["dynamic_error"], units["forcing"]
    told = {
        "twist": ("dynamic error", twist),
        "speed": ("rate of the dynamic error", f"{twist}/s"),
        "torque": ("forcing", forcing),
    }
    if isinstance(outcome.stored.model, TwoInertiaModel):
        told = {"twist": ("twist", twist), "speed": ("motor speed", "rad/s"), "torque": ("torque", forcing)}
        told |= {angle: (angle, "rad") for angle in ("motor angle", "output angle")}
    told["temperature"] = ("temperature", "K")
    return [
        {"quantity": told[one.quantity][0], "unit": told[one.quantity][1], "fitted": one.fitted, "test": one.test}
        for one in extrapolations(outcome.after)
    ]


def _circumstances(outcome: Outcome) -> dict[str, Any]:
    """Data and computation of the outcome."""
    not_machine_code = outcome.after.not_machine_code
    return {
        "engine": {"name": "machine code" if not_machine_code is None else "XLA", "reason": not_machine_code},
        "forms_tried": max((len(r.verdicts) for r in outcome.rounds), default=0),
        "surrogates": max((int(r.screen.null_gains.size) for r in outcome.rounds), default=0),
        "seconds": dict(outcome.seconds),
        "logs": _logs(outcome),
    }


def _logs(outcome: Outcome) -> list[dict[str, Any]]:
    """Number of samples of each log, or test log, by use."""
    found: dict[str, dict[str, Any]] = {}
    for part, runs in outcome.after.parts().items():
        for run in runs:
            log = found.setdefault(run.name, {"name": run.name, "samples": 0} | dict.fromkeys(PARTS, 0))
            log["zero"] = run.zero
            log[part] += int(run.time.size)
            log["samples"] += int(run.time.size)
            log["seconds"] = log.get("seconds", 0.0) + float(run.time[-1] - run.time[0])
    late = outcome.put_back if isinstance(outcome, Loop) else ()
    put_back = dict(zip((run.name for run in outcome.after.training), late, strict=False))
    return [log | {"clock_put_back": put_back.get(name, 0.0)} for name, log in found.items()]
