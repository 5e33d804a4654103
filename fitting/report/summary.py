"""The decision in a few sentences."""

from collections.abc import Mapping, Sequence
from typing import Any

from fitting import formatting
from fitting.attribution.rules import RULES
from fitting.report.outputs import principal
from fitting.report.separating import plain_family
from fitting.report.unknown import place_and_variables
from hdjax.effects.learned import FAMILY

# Smallest relative change of the error that is stated.
_HARDLY = 0.1
# Share of the residual below which it does not depend on a quantity, assumed: a tenth of its rms.
_NO_SHARE = 0.01

# A temperature from zero kelvin differs by parts of a kelvin only in its fourth digit.
_DIGITS_OF_TEMPERATURE = 4
# Where something is missing, if the equation of one side leaves only noise: not on that side.
_WHERE_MISSING = {"motor equation": " on the load", "load equation": " on the motor"}
_COUNTS = ("No", "One", "Two", "Three", "Four", "Five", "Six", "Seven", "Eight", "Nine", "Ten")


def summary(report: Mapping[str, Any]) -> str:
    """The decision in a few sentences, and the extrapolation of test data."""
    return _decision(report) + summary_of_extrapolation(report["extrapolation"])


def _decision(report: Mapping[str, Any]) -> str:
    _, unit, noise = principal(report)
    on = report["judged_on"]
    before, after = (report[stage]["rmse"][on] for stage in ("before", "after"))
    families = list(dict.fromkeys(e["family"] for e in report["after"]["effects"] if e["family"] != "unknown"))
    found = formatting.words([plain_family(f) for f in families]) if families else ""
    decision = report["decision"]
    if decision == "fit_only":
        return f"The base model was fitted. On {on} data {_errs(before, noise, unit)}."
    if decision == "model_sufficient":
        errs = f"on {on} data {_errs(before, noise, unit)}"
        drifts = before is None or before >= RULES.excess * noise
        gains = f"none of the {report['forms_tried']} tried forms of missing physics has a significant gain"
        return (
            f"The model suffices: {'over short segments it leaves only noise' if drifts else errs}, and "
            f"{gains if report['forms_tried'] else 'no form of missing physics was tried'}."
            + (f" Free runs drift: {errs}." if drifts else "")
            + _remembering(report)
            + _noisy_torque(report)
        )
    if decision == "effect_found":
        opening = (
            "A missing effect was found"
            if len(families) == 1
            else f"{_count(len(families))} missing effects were found"
        )
        rest = ""
        if report["unknown"]:
            rest = f" Something unknown is also missing: a learned {_learned(report)}, represents it."
        elif report["times_noise"] >= RULES.excess:
            left = f"the residual is {formatting.number(report['times_noise'])} times the noise"
            rest = f" Something unknown is also missing: {left}."
            if report["evidence"]["challenge"]["imperfect"]:
                rest = f" {left.capitalize()}, which an inexact law of the effect may explain."
        elif report["unknown_remains"]:
            rest = f" Something unknown is also missing: free runs {_free_runs(report)}."
        elif report["noise"]["torque"] is None and (after is None or after >= RULES.excess * noise):
            rest = " Over short segments only noise is left; free runs drift."
        several = bool(report["unknown"]) or len(families) > 1
        subject = "Together they" if several else "The effect" if rest else "It"
        change = _change(subject, report, several=several)
        return f"{opening}: {found}.{rest} {change}{_ties(report)}{_remembering(report)}{_noisy_torque(report)}"
    left = report["unexplained"]
    missing = f"missing{_WHERE_MISSING.get(report['parameters_from'], '')}"
    missing += (
        ": --max-effects ended the search." if report["search_limited"] else " that the catalogue does not explain."
    )
    opening = f"A part was found ({found}), but something else is {missing}" if families else f"Something is {missing}"
    if report["unknown"]:
        learned = f"learned {_learned(report)},"
        return f"{opening} {_change(f'Together with a {learned} it' if families else f'A {learned}', report)}"
    if report["evidence"]["final"]["at_bounds"]:
        return f"{opening} A parameter of what was found has ended at a bound: its law does not fit."
    if report["evidence"]["final"]["surprise"] is not None:
        return f"{opening} Short segments hardly show it: free runs {_free_runs(report)}."
    depends = f"most on the {left['depends_on']} (which explains {formatting.percent(left['explained_share'])} of it)"
    if left["explained_share"] < _NO_SHARE:
        depends = "on none of the quantities that were examined"
    size = max(left["times_noise"], report["times_noise"])
    return f"{opening} The residual is {formatting.number(size)} times the measurement noise, and depends {depends}."


def _ties(report: Mapping[str, Any]) -> str:
    """Sentences on ties with other families than those found; empty without any."""
    found = {e["name"]: e["family"] for e in report["after"]["effects"]}
    tied: dict[str, dict[str, None]] = {}
    for other in report["alternatives"]:
        if not other["separable"] and other["family"] not in found.values():
            family = found.get(other["instead_of"], next(iter(found.values())))
            name = "an unknown term" if other["family"] == FAMILY else plain_family(other["family"])
            tied.setdefault(family, {})[name] = None
    return "".join(
        f" The data do not tell {plain_family(family)} from {formatting.words(list(names))}."
        for family, names in tied.items()
    )


def summary_of_extrapolation(told: Sequence[Mapping[str, Any]]) -> str:
    """A sentence on test data beyond the fitted range; empty without any."""
    beyond = []
    for one in told:
        to = "up to" if one["test"] > one["fitted"] else "down to"
        digits = _DIGITS_OF_TEMPERATURE if one["unit"] == "K" else 3
        test = formatting.quantity(one["test"], one["unit"], digits=digits)
        fitted = formatting.quantity(one["fitted"], one["unit"], like=one["test"], digits=digits)
        beyond.append(f"{one['quantity']} {to} {test} (fitted {to} {fitted})")
    if not beyond:
        return ""
    return f" Test data go beyond what was fitted, so that the model extrapolates: {formatting.words(beyond)}."


def _remembering(report: Mapping[str, Any]) -> str:
    """The assumption behind a large noise estimate; empty where short pieces determine the noise."""
    memory = report["noise"]["memory"]
    if memory is None:
        return ""
    longest = max(log["seconds"] for log in report["logs"])
    long = f"about {formatting.quantity(memory, 's', digits=2)}" if memory < longest else "more than the logs' length"
    return (
        f" The residual has a correlation time of {long}, and is "
        "attributed to noise of the sensors: with such noise the innovations are white. An untried effect that is as "
        "slow would look the same."
    )


def _noisy_torque(report: Mapping[str, Any]) -> str:
    """A sentence on a noisy torque channel; empty without one."""
    std = report["noise"]["torque"]
    if std is None:
        return ""
    return (
        f" The torque channel is noisy by {formatting.quantity(std, report['units']['forcing'], digits=2)} rms. The "
        "drive responds to it, so that free-run errors exceed the sensors' noise for any model."
    )


def _learned(report: Mapping[str, Any]) -> str:
    unknown = report["unknown"]
    return place_and_variables(unknown["place"], unknown["variables"], unknown["period"], unknown["memory"])


def _change(subject: str, report: Mapping[str, Any], *, several: bool = False) -> str:
    """Change of the error by the accepted effects."""
    on = report["judged_on"]
    before, after = (report[stage]["rmse"][on] for stage in ("before", "after"))
    (output, unit, noise), s = principal(report), "" if several else "s"
    then, now = _rmse(before, unit), _against_noise(after, noise, unit, like=before)
    motor = [report[stage]["rmse_motor_angle"][on] for stage in ("before", "after")]
    if not _falls(before, after) and _falls(*motor):
        first, last = (_rmse(value, "rad", motor[0]) for value in motor)
        return (
            f"{subject} affect{s} the motor's angle, whose error on {on} data falls by {_removed(*motor)}, from "
            f"{first} to {last}. The {output} is hardly affected, with an error of {then} before and {now} after."
        )
    if after is None and before is None:
        return f"{subject} explain{s} short segments alone: free runs along {on} data diverge before and after."
    if before is None:
        return f"{subject} keep{s} free runs along {on} data from diverging; the error is {now}."
    if after is None or after > before:
        where = f"short segments alone; over whole stretches of {on} data the error rises"
        return f"{subject} explain{s} {where} from {then} to {now}."
    return f"{subject} remove{s} {_removed(before, after)} of the error on {on} data, which falls from {then} to {now}."


def _free_runs(report: Mapping[str, Any]) -> str:
    _, unit, noise = principal(report)
    rmse, beyond = report["after"]["rmse"], report["free_runs_times_expected"]
    if None in (beyond, rmse["training"], rmse["selection"]):
        return "diverge"
    times, most = formatting.number(beyond), max(rmse["training"], rmse["selection"])
    size = _against_noise(most, noise, unit)
    return f"along training or selection data err by up to {size}, {times} times what noise and uncertainty allow"


def _count(number: int) -> str:
    return _COUNTS[number] if number < len(_COUNTS) else str(number)


def _rmse(value: float | None, unit: str, like: float | None = None) -> str:
    return "a simulation that diverged" if value is None else formatting.quantity(value, unit, like=like)


def _against_noise(value: float | None, noise: float, unit: str, like: float | None = None) -> str:
    if value is None:
        return _rmse(value, unit)
    return f"{_rmse(value, unit, like)} rms ({formatting.number(value / noise)} times the measurement noise)"


def _errs(value: float | None, noise: float, unit: str) -> str:
    return "its free run diverges" if value is None else f"it errs by {_against_noise(value, noise, unit)}"


def _falls(before: float | None, after: float | None) -> bool:
    """Whether an error decreases noticeably."""
    return after is not None and (before is None or after < (1.0 - _HARDLY) * before)


def _removed(before: float | None, after: float | None) -> str:
    if before is None or after is None:
        return "much"
    return formatting.percent(1.0 - after / before)


def gain(effect: Mapping[str, Any]) -> str:
    """What an effect does to the error of free runs on selection data."""
    if effect["gain"] is None:
        return "free runs on selection data diverge with it"
    if effect["gain"] == 1.0:
        return "free runs on selection data diverge without it, but not with it"
    return f"with it the error of free runs on selection data is {formatting.smaller(effect['gain'])} than without"


def chance(effect: Mapping[str, Any], report: Mapping[str, Any]) -> str:
    """The p-value, as a bound where the number of draws limits it."""
    p = effect["p_value"]
    smallest = 1.0 / (1 + report["surrogates"])
    if p is None:
        return "p unknown"
    return f"p {'≤' if p <= 1.001 * smallest else '='} {p:.2g}"
