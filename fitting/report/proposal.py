"""The next experiment in a report: its information, its limits, and the command as a table."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from fitting import formatting
from fitting.next_experiment.proposal import NextExperiment, Precision, Separation, is_decided
from fitting.report.limits import in_words_of_log
from hdjax.effects.learned import FAMILY

COMMAND_FILE = "next_experiment.csv"
"""File of the command."""

# Expected log-likelihood ratios: not informative below the first, decisive above the second.
_NOTHING, _DECISIVE = 0.05, 10.0
# Largest ratio that is stated as a number.
_LARGEST_TOLD = 1e6


def command_table(found: NextExperiment) -> str:
    """The command as CSV: `time` [s] and `motor_torque` [N m], or `forcing` in the log's unit."""
    rows = (f"{t:.9g},{u:.9g}" for t, u in zip(found.time, found.command, strict=True))
    return "\n".join([f"time,{_input(found)}", *rows, ""])


def proposal_dict(
    found: NextExperiment | None, units: Mapping[str, str], *, logs_reach: float
) -> dict[str, Any] | None:
    """The next experiment in a report; None without one.

    Args:
        found: the experiment.
        units: of `dynamic_error` and `forcing`.
        logs_reach: largest dynamic error of the logs.
    """
    if found is None:
        return None
    limits = found.limits
    drive = found.motor_speed is not None
    told = [_of_tie(found.found, s) for s in found.separations]
    alpha = None if found.precision is None else _of_alpha(found, found.precision, units)
    return {
        "file": COMMAND_FILE,
        "signal": _input(found),
        "question": "alpha" if alpha else "tie",
        "found": found.found,
        "begins_like": found.begins_like,
        "unit": "N m" if drive else units["forcing"],
        "samples": int(found.time.size),
        "starts_at": found.motor_angle if drive else None,
        "limits": {
            "largest_torque": limits.torque,
            "largest_speed": limits.speed,
            "largest_travel": limits.travel,
            "largest_twist": limits.twist,
            "duration": limits.duration,
            "time_step": limits.time_step,
        },
        "reaches": {
            "torque": float(np.max(np.abs(found.command))),
            "speed": float(np.max(np.abs(found.motor_speed))) if found.motor_speed is not None else None,
            "dynamic_error": float(np.max(np.abs(found.dynamic_error))),
        },
        "logs_reach": logs_reach,
        "separations": told,
        "alpha": alpha,
        "says": [alpha["says"]] if alpha else [s["says"] for s in told],
    }


def next_lines(report: Mapping[str, Any]) -> list[str]:
    """Sentences on the next experiment, or how to request one; empty where none is needed.

    Args:
        report: from [`fitting.report.report_dict`][].
    """
    proposed = report["next_experiment"]
    if proposed:
        return [*proposed["says"], f"The command is in {proposed['file']}."]
    if report["next_experiment_sought"]:
        return ["No next experiment: either none is needed, or no command within the limits was found."]
    if report["decision"] == "fit_only":
        known = report["before"]["parameters"]["alpha"]["identifiable"]
        return [] if known else ["--next-experiment searches for a command that determines alpha."]
    # A search tells names from each other, not a learned term.
    named = report["decision"] == "effect_found" and not report["unknown"]
    tie = named and any(not a["separable"] and a["family"] != FAMILY for a in report["alternatives"])
    return ["--next-experiment searches for a command that separates the tied explanations."] if tie else []


def _input(found: NextExperiment) -> str:
    return "forcing" if found.motor_speed is None else "motor_torque"


def _of_tie(found: str, separation: Separation) -> dict[str, Any]:
    return {
        "rival": separation.rival,
        "family": separation.family,
        "log_likelihood_ratio": {
            "logs": _both(separation.on_logs),
            "proposed": _both(separation.proposed),
        },
        "says": _tie_says(found, separation),
    }


def _both(ratios: tuple[float, float] | None) -> dict[str, float | None]:
    one, other = ratios or (None, None)
    return {"if_found_is_right": one, "if_rival_is_right": other}


def _tie_says(found: str, separation: Separation) -> str:
    rival, logs, proposed = separation.rival, separation.on_logs, separation.proposed
    if proposed is None:
        if logs is None or not is_decided(logs):
            return f"{rival} is not smooth enough for a gradient search: no command was searched against it."
        return (
            f"Simulations as long as the logs already separate {found} and {rival}, with expected log-likelihood "
            f"ratios of {_ratio(logs[0])} and {_ratio(logs[1])}: no new experiment is needed."
        )
    cases = zip((found, rival), logs or (None, None), proposed, strict=True)
    sentence = "; ".join(
        f"if {name} is right, the expected log-likelihood ratio in its favour is {_ratio(new)} "
        f"(the logs: {'unknown' if old is None else _ratio(old)})"
        for name, old, new in cases
    )
    sentence = f"Between {found} and {rival}: {sentence}."
    if max(proposed) < _NOTHING:
        sentence += " With its parameters free, each can imitate the other."
    else:
        for name, other, new in ((found, rival, proposed[0]), (rival, found, proposed[1])):
            if new < _NOTHING:
                sentence += f" With its parameters free, {other} can imitate {name}, but not the reverse."
    if max(proposed) < _DECISIVE:
        more = _DECISIVE / max(max(proposed), 1e-300)
        needs = f"about {formatting.number(more, 2)} times the duration" if more < 1e4 else "wider limits"
        sentence += f" That is not decisive: it would need {needs}, or less noise."
    return sentence


def _ratio(value: float) -> str:
    if value < _NOTHING:
        return "0"
    return f"above {_LARGEST_TOLD:.0e}" if value > _LARGEST_TOLD else formatting.number(value, 2)


def _of_alpha(found: NextExperiment, precision: Precision, units: Mapping[str, str]) -> dict[str, Any]:
    fitted, visible = abs(precision.fitted), precision.visible
    unit = precision.unit
    sentence = (
        f"The standard error of alpha falls from {precision.on_logs:.2g} {unit} on the logs to "
        f"{precision.proposed:.2g} {unit}, under noise alone: an alpha above {visible:.2g} {unit} would be "
        "significantly nonzero."
    )
    needed = None
    if fitted and fitted < visible:
        # The cubic torque grows with the third power of the twist, and thus of the torque.
        needed = found.limits.torque * float(np.cbrt(visible / fitted))
        torque = f"{formatting.number(needed, 2)} {'N m' if found.motor_speed is not None else units['forcing']}"
        sentence += (
            f" No excitation within the limits distinguishes the fitted value of {precision.fitted:.2g} {unit} from "
            f"zero: that would need a torque of about {torque}, or less noise."
        )
    return {
        "fitted": precision.fitted,
        "std": {"logs": precision.on_logs, "proposed": precision.proposed},
        "visible": visible,
        "needed_torque": needed,
        "says": in_words_of_log(sentence, units),
    }
