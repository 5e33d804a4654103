"""Identifiability: undetermined directions, and parameters that are insignificant or at a bound."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np
from scipy.special import stdtrit

from fitting.estimation.estimate import Fit
from fitting.estimation.free_parameters import named
from fitting.estimation.scales import scales
from fitting.formatting import Place, in_log_units, words
from fitting.uncertainty.held_values import Held, held_values
from fitting.uncertainty.sandwich import directions
from fitting.uncertainty.standard_errors import Estimate, Uncertainty, uncertainty
from hdjax import Drive, Model, ReducedModel, TwoInertiaModel
from hdjax.effects import ActuatorEffect
from hdjax.parameters import ParameterInfo

# A direction is not determined if two standard errors along it exceed 40 %.
_WEAK = 0.2
# Parameters with less than this share of a direction are omitted.
_SHARE = 0.2
# Most members of a direction whose moves are told.
_MOST_MOVES = 3
# A positive parameter below this share of its starting value has ended at zero.
_VANISHED = 1e-3
# Relative distance within which a value is at a bound.
_AT_BOUND = 0.01


class Direction(eqx.Module):
    """A principal direction of the free parameters, whose estimate is uncorrelated with all others.

    Attributes:
        weights: entries of a unit vector by path. A positive parameter enters by its logarithm, any other in `units`.
        members: the paths with more than a small share of it.
        units: unit of each parameter: 1 for a logarithm, else in SI units.
        std: standard error along the direction.
        sentence: states what is not determined; None where the direction is determined.
    """

    weights: dict[str, float]
    members: tuple[str, ...] = eqx.field(static=True)
    units: dict[str, float]
    std: float
    sentence: str | None


class Identifiability(eqx.Module):
    """What the logs of a fit do not determine.

    Attributes:
        reasons: by path of each parameter that is not identifiable, a sentence with reason and remedy.
        directions: principal directions of the free parameters, the least determined first.
        held: fixed values of the drive file.
        bounds: by path of each parameter that ended at a bound, a sentence about it.
    """

    reasons: dict[str, str]
    directions: tuple[Direction, ...]
    held: tuple[Held, ...]
    bounds: dict[str, str]

    def note(self, path: str) -> str | None:
        """The reason why a parameter's value is not reliable; None where it is."""
        return self.bounds.get(path) or self.reasons.get(path)


def identifiability(
    fit: Fit, found: Uncertainty, *, drive_from: tuple[Fit, Uncertainty] | None = None
) -> Identifiability:
    """Find what the logs of a fit do not determine.

    Coefficients of learned functions have no meaning one by one: of them only their influence on the named parameters
    is considered.

    Args:
        fit: the fit.
        found: its uncertainty.
        drive_from: a fit of one side's equation that supplies the drive's parameters, and its uncertainty.
    """
    if not fit.free.paths:
        return Identifiability({}, (), (), {})
    estimates = {
        p: e for (p, e), own in zip(found.estimates.items(), named(fit.model, fit.free.paths), strict=True) if own
    }
    x_max = scales(fit.stretches, fit.model).x_max
    x_unit = "rad" if isinstance(fit.model.drive, Drive) else "[x]"
    known, first = fit.model.parameters(), fit.problem.model
    units = {p: unit_in_log(p, e.unit, fit.model) for p, e in estimates.items()}
    infos = {p: replace(_in_units_of(fit.model, known[p][1]), unit=units[p]) for p in estimates}
    bounds = {p: at_bound(p, float(known[p][0]), infos[p], start=float(first.get(p))) for p in estimates}
    vague = {p: replace(e, unit=units[p]) for p, e in estimates.items() if not e.identifiable}
    return Identifiability(
        reasons={p: reason(e, x_max=x_max, x_unit=x_unit) for p, e in vague.items()},
        directions=_directions(fit, found),
        held=held_values(*(drive_from or (fit, found))) if drive_from or isinstance(fit.model, TwoInertiaModel) else (),
        bounds={p: sentence for p, sentence in bounds.items() if sentence is not None},
    )


def unit_in_log(path: str, unit: str, model: Model, *, response: str = "[x]", forcing: str = "[u]") -> str:
    """The unit of a parameter, or of a figure of its effect; of a reduced drive in units of its log.

    Args:
        path: of the parameter.
        unit: in SI.
        model: with the parameter.
        response: unit of the dynamic error.
        forcing: of the forcing.
    """
    if not isinstance(model, ReducedModel):
        return unit
    place: Place = "drive"
    if "." in path:
        place = "actuator" if isinstance(model.effect(path.split(".")[0]), ActuatorEffect) else "mesh"
    return in_log_units(unit, response=response, forcing=forcing, place=place)


def needed_twist(alpha: Estimate, size: float, *, x_max: float) -> float:
    """Largest twist that a similar log needs for an alpha of a given size to be significantly nonzero.

    The standard error of alpha is inversely proportional to the cubic torque, and so to the third power of the twist.

    Args:
        alpha: its estimate.
        size: of the alpha to be detected, in the estimate's unit.
        x_max: largest twist in the fitted logs.
    """
    return x_max * np.cbrt(_reach(alpha) / abs(size)) if size else np.inf


def needed_samples(estimate: Estimate, size: float) -> float:
    """Factor of the sample count at which a parameter of a given size is significantly nonzero."""
    return (_reach(estimate) / abs(size)) ** 2 if size else np.inf


def reason(estimate: Estimate, *, x_max: float, x_unit: str) -> str:
    """The reason why a parameter is not identifiable, and a remedy.

    Args:
        estimate: of the parameter.
        x_max: largest twist in the fitted logs.
        x_unit: unit of the twist.
    """
    path, unit = estimate.path, "" if estimate.unit == "1" else f" {estimate.unit}"
    low, high = estimate.ci95
    largest = max(abs(low), abs(high))
    opening = f"{path} is not identifiable from these logs"
    if low >= 0 or high <= 0 or not np.isfinite(largest):
        known = f"it may lie {_between(low, high, unit)}"
    elif path == "alpha":
        known = (
            f"|alpha| is at most {largest:.2g}{unit}, so that alpha x^2 is at most {largest * x_max**2:.2g} at their "
            f"largest twist of {x_max:.2g} {x_unit}"
        )
    else:
        known = f"it may be anything up to {largest:.2g}{unit} either way"
    samples = needed_samples(estimate, estimate.value)
    if low >= 0 or high <= 0 or not np.isfinite(samples):
        return f"{opening}: {known}."
    twist = f"a twist above {needed_twist(estimate, estimate.value, x_max=x_max):.2g} {x_unit}, or "
    return (
        f"{opening}: {known}. For {estimate.value:.2g}{unit} to differ from zero they would need "
        f"{twist if path == 'alpha' else ''}{samples:.2g} times the samples."
    )


def _between(low: float, high: float, unit: str) -> str:
    """An interval in words; its ends may be infinite."""
    if not np.isfinite([low, high]).any():
        return "anywhere"
    if not np.isfinite(high):
        return f"above {low:.2g}{unit}"
    return f"between {low:.2g} and {high:.2g}{unit}" if np.isfinite(low) else f"below {high:.2g}{unit}"


def _reach(estimate: Estimate) -> float:
    """Half the length of a parameter's interval."""
    return float(stdtrit(estimate.degrees_of_freedom, 0.975)) * estimate.std


def _directions(fit: Fit, found: Uncertainty) -> tuple[Direction, ...]:
    """Principal axes of the covariance of the named parameters, in units of the free vector, which are of order one.

    A part of the whole covariance is that of its parameters where all others are fitted as well.
    """
    own = np.flatnonzero(named(fit.model, fit.free.paths))
    paths = [fit.free.paths[i] for i in own]
    logarithmic, scale = np.array(fit.free.logarithmic)[own], np.asarray(fit.free.scale)[own]
    units = dict(zip(paths, np.where(logarithmic, 1.0, scale).tolist(), strict=True))
    made: list[Direction] = []
    for std, vector in directions(found.covariance[np.ix_(own, own)]):
        weights = dict(zip(paths, vector.tolist(), strict=True))
        largest = max(abs(w) for w in weights.values())
        members = tuple(p for p, w in weights.items() if abs(w) >= _SHARE * largest)
        made.append(Direction(weights, members, units, std, None))
    told = _not_separated(fit, [d for d in made if d.std > _WEAK])
    return tuple(replace(d, sentence=told.get(i)) for i, d in enumerate(made))


def _not_separated(fit: Fit, weak: Sequence[Direction]) -> dict[int, str]:
    """Sentences on weak directions, by their places. Those that share members are told together: the logs do not
    determine the products that are constant along one of them either."""
    told: dict[int, str] = {}
    rest = list(range(len(weak)))
    while rest:
        first, *rest = rest
        members, together = set(weak[first].members), 1
        while met := [i for i in rest if members.intersection(weak[i].members)]:
            members.update(*(weak[i].members for i in met))
            together += len(met)
            rest = [i for i in rest if i not in met]
        if together == 1 and 1 < len(members) <= _MOST_MOVES:
            told[first] = _not_determined(fit, weak[first])
        elif len(members) > 1:
            names = words([p for p in fit.free.paths if p in members])
            several = "one combination of them is" if together == 1 else f"{together} combinations of them are"
            told[first] = f"The logs do not separate {names}: {several} not determined."
    return told


def _not_determined(fit: Fit, weak: Direction) -> str:
    """A weak direction as a sentence."""
    units, largest = weak.units, max(abs(w) for w in weak.weights.values())
    part = {p: weak.weights[p] / largest for p in weak.members}
    logarithmic = dict(zip(fit.free.paths, fit.free.logarithmic, strict=True))
    values = {p: float(fit.model.get(p)) for p in part}
    # Relative changes are easier to read; near zero they do not exist.
    relative = {
        p: w if logarithmic[p] else w * units[p] / values[p]
        for p, w in part.items()
        if logarithmic[p] or abs(values[p]) > 0.1 * units[p]
    }
    moves = [
        f"{p} by {10 * relative[p]:+.2g} %" if p in relative else f"{p} by {0.1 * w * units[p]:+.2g}"
        for p, w in part.items()
    ]
    names = list(part)
    sentence = f"The logs do not separate {words(names)}: {words(moves)} together hardly change the simulation"
    if len(relative) < len(part):
        return f"{sentence}."
    # Products of the other parameters with powers of the least changed one are constant along the direction.
    still = min(relative, key=lambda p: abs(relative[p]))
    known = [f"{p} {_power(still, -relative[p] / relative[still])}" for p in names if p != still]
    return f"{sentence}. They determine {words(known)}, but no factor alone."


def _power(path: str, exponent: float) -> str:
    return path if np.isclose(exponent, 1.0) else f"{path}^{exponent:.2g}"


def _in_units_of(model: Model, info: ParameterInfo) -> ParameterInfo:
    """Metadata of a model's parameter. A reduced log has arbitrary units, so that only signs remain of bounds in SI
    units."""
    if isinstance(model.drive, Drive) or info.unit == "1":
        return info
    low, high = info.bounds
    return replace(info, bounds=(low if low == 0.0 else -np.inf, high if high == 0.0 else np.inf))


def at_bound(path: str, value: float, info: ParameterInfo, *, start: float) -> str | None:
    """A sentence about a parameter that ended at a bound of its domain; None where it did not.

    Args:
        path: of the parameter.
        value: fitted.
        info: of the parameter.
        start: starting value.
    """
    if info.positive and value < _VANISHED * start:
        return (
            f"{path} went from {start:.2g} to {value:.2g} {info.unit}, its bound at zero: the logs do not support "
            "it, and its standard error has no meaning."
        )
    bound = reached_bound(value, info)
    if bound is None:
        return None
    return (
        f"{path} ended at its bound of {bound:.3g} {info.unit}: the fit would leave the physical range, and its "
        "standard error has no meaning."
    )


def reached_bound(value: float, info: ParameterInfo) -> float | None:
    """The nonzero bound that a parameter has reached or passed; None without one.

    Args:
        value: fitted.
        info: of the parameter.
    """
    low, high = info.bounds
    for bound, beyond in ((low, value < low), (high, value > high)):
        if beyond or (bound and np.isfinite(bound) and abs(value - bound) <= _AT_BOUND * abs(bound)):
            return bound
    return None


def parameters_at_bounds(model: Model, name: str) -> list[str]:
    """The paths of an effect's parameters that ended at a bound of their domain. A shape that ended at zero does not
    count: it gives another law.

    Args:
        model: with fitted values.
        name: of the effect.
    """
    known = {p: v for p, v in model.parameters().items() if p.startswith(f"{name}.")}
    return [p for p, (v, info) in known.items() if reached_bound(float(v), _in_units_of(model, info)) is not None]


def outside_domain(fit: Fit, name: str) -> list[str]:
    """The paths of an effect's parameters whose whole interval is at a bound of their domain, or beyond: its law does
    not fit. A parameter that the data do not determine may end anywhere.

    Args:
        fit: of the model.
        name: of the effect.
    """
    ended, known = parameters_at_bounds(fit.model, name), fit.model.parameters()
    found = uncertainty(fit, torque_noise=False).estimates if ended else {}

    def ends_outside(path: str) -> bool:
        info = _in_units_of(fit.model, known[path][1])
        return all(reached_bound(end, info) is not None for end in found[path].ci95)

    return [path for path in ended if path not in found or ends_outside(path)]
