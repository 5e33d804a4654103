"""A learned function as a curve (or a surface) with standard errors, over the range of the data."""

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.discrepancy.learn import Unknown
from fitting.uncertainty.standard_errors import Uncertainty
from hdjax import Model
from hdjax.effects import Motion
from hdjax.effects.learned import LEARNED, Learned, LearnedPeriodic, LearnedTorque
from hdjax.effects.learned_axes import AngleAxis

WORDS = {
    "mesh": "torque in the mesh",
    "motor": "torque on the motor",
    "load": "torque on the load",
    "mesh angle": "error of the mesh's angle",
    "motor encoder": "error of the motor's encoder",
    "load encoder": "error of the load's encoder",
}
"""Quantity and place of each learned function, for reports."""

PLACES = dict(zip((form.name for form in LEARNED), WORDS, strict=True))
"""Name of the place of each learned function."""

_POINTS = {1: 200, 2: 41}


class LearnedCurve(eqx.Module):
    """A learned function.

    Attributes:
        place: "mesh", "motor" or "load" of a torque; "mesh angle", "motor encoder" or "load encoder" of an error there.
        quantity: "torque" or "error".
        variables: its arguments.
        period: of a periodic function of time [s]; None otherwise.
        at: variables at instants of the training data, by column; angles within one turn if the data exceed it, and
            time within one period.
        value: at those instants [N m or rad].
        std: its standard error.
        known: functions that the drive's parameters represent at those instants; the learned function is orthogonal to
            them.
        grid: evenly spaced values of each variable over its range in the data.
        on_grid: value on the grid, one axis for each variable.
        std_on_grid: standard error on the grid.
    """

    place: str = eqx.field(static=True)
    quantity: Literal["torque", "error"] = eqx.field(static=True)
    variables: tuple[str, ...] = eqx.field(static=True)
    period: float | None = eqx.field(static=True)
    at: Float[np.ndarray, "instants variables"]
    value: Float[np.ndarray, " instants"]
    std: Float[np.ndarray, " instants"]
    known: Float[np.ndarray, "instants known"]
    grid: tuple[Float[np.ndarray, " points"], ...]
    on_grid: Float[np.ndarray, "..."]
    std_on_grid: Float[np.ndarray, "..."]


def period_of(effect: Learned) -> float | None:
    """Period of a learned function of time [s]; None of any other."""
    return 2 * np.pi / float(effect.omega) if isinstance(effect, LearnedPeriodic) else None


def learned_curve(found: Unknown, model: Model, uncertainty: Uncertainty) -> LearnedCurve:
    """The curve of a learned function.

    Args:
        found: the learned function and its training motion.
        model: with the final values.
        uncertainty: of the values.
    """
    name = found.chosen.form.name
    effect = model.effect(name)
    assert isinstance(effect, Learned)
    values = np.stack([np.asarray(getattr(found.motion, v)) for v in found.chosen.variables], axis=1)
    period = period_of(effect)
    if period is not None:
        values = np.mod(values, period)
    for column, axis in zip(values.T, effect.axes, strict=True):
        if isinstance(axis, AngleAxis) and np.ptp(column) > 2 * np.pi:
            column[:] = np.mod(column, 2 * np.pi)
    points = _POINTS[values.shape[1]]
    grid = tuple(np.linspace(*_range(column), points) for column in values.T)
    mesh = np.stack([g.reshape(-1) for g in np.meshgrid(*grid, indexing="ij")], axis=1)
    value, std = _evaluated(model, name, uncertainty, values)
    on_grid, std_on_grid = (a.reshape([points] * len(grid)) for a in _evaluated(model, name, uncertainty, mesh))
    return LearnedCurve(
        PLACES[name],
        "torque" if isinstance(effect, LearnedTorque) else "error",
        found.chosen.variables,
        period,
        values,
        value,
        std,
        found.chosen.known,
        grid,
        on_grid,
        std_on_grid,
    )


def _range(values: np.ndarray) -> tuple[float, float]:
    low, high = np.quantile(values, [1e-3, 1.0 - 1e-3])
    return float(low), float(high)


def _evaluated(model: Model, name: str, uncertainty: Uncertainty, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Value and standard error of a model's learned function at rows of its variables."""

    def at(moved: Model, row: Array) -> Array:
        effect = moved.effect(name)
        assert isinstance(effect, Learned)
        zero = jnp.zeros(())
        names = [axis.variable for axis in effect.axes]
        return effect.value(replace(Motion(x=zero, v=zero), **dict(zip(names, row, strict=True))))

    return with_errors(at, model, name, uncertainty, values)


def with_errors(
    function: Callable[[Model, Array], Array], model: Model, name: str, uncertainty: Uncertainty, at: np.ndarray
) -> tuple[Float[np.ndarray, " rows"], Float[np.ndarray, " rows"]]:
    """Values of a function of a model and a row, and their standard errors to first order due to those of one effect.

    Args:
        function: scalar.
        model: with the estimates.
        name: of the effect.
        uncertainty: of the estimates.
        at: rows of arguments.
    """
    paths, covariance = uncertainty.of_effect(name)

    def of_parameters(parameters: Array, row: Array) -> Array:
        return function(model.replace(dict(zip(paths, parameters, strict=True))), row)

    along = jax.vmap(jax.value_and_grad(of_parameters), in_axes=(None, 0))
    value, slopes = (np.asarray(a) for a in along(jnp.stack(model.values(paths)), jnp.asarray(at)))
    variance = np.einsum("np,pq,nq->n", slopes, covariance, slopes)
    return value, np.sqrt(np.maximum(variance, 0.0))
