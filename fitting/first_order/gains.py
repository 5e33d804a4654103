"""Gain of forces along a fitted motion, to first order."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit
from fitting.estimation.linear_response import Followed, Forces
from fitting.estimation.projection import Answers, solved, without_undetermined
from fitting.estimation.residual import Problem
from fitting.first_order.linearised_fit import motion_and_residual
from fitting.first_order.motion import (
    acting_at_knots,
    acting_slopes_at_knots,
    conditions_at_knots,
    motions,
    unit_pushes,
    unit_readings,
)
from hdjax import Model, TwoInertiaModel
from hdjax.effects import Conditions, Motion
from hdjax.engine.pointwise import slopes_at_instants

# Passes of "least squares, then reweigh the outputs by the residual's covariance".
_REWEIGHTINGS = 2


Sizes = tuple[Float[np.ndarray, "segments knots forces"], ...]
"""Size of each force at each knot."""


class LinearisedFit(eqx.Module):
    """A fit linearised along its motion.

    Attributes:
        problem: the least-squares problem at the solution.
        followed: the motion.
        answers: responses of the residual to forces along it.
        motion: at each knot.
        conditions: time and temperature at each knot.
        pushes: change of the state's rates by a unit of each effect place, by its name.
        readings: change of the outputs at the samples likewise; none where all outputs depend on the state alone.
        error: whitened output error.
    """

    problem: Problem
    followed: Followed
    answers: Answers
    motion: Motion
    conditions: Conditions
    pushes: dict[str, Float[np.ndarray, "segments knots states"]]
    readings: dict[str, Float[np.ndarray, "segments samples outputs"]]
    error: Float[np.ndarray, "segments samples outputs"]

    @property
    def model(self) -> Model:
        """The fitted model."""
        return self.problem.model

    def acting(self, *names: str) -> "Acting":
        """Influence of a unit at each of some effect places."""
        pushes, readings = (tuple(by[n] for n in names if n in by) for by in (self.pushes, self.readings))
        return Acting(pushes, readings)


class Acting(eqx.Module):
    """Influence of a unit of each part of a force.

    Attributes:
        pushes: on the state's rates; none of an encoder error.
        readings: on the outputs at the samples; none where these depend on the state alone.
    """

    pushes: tuple[Float[np.ndarray, "segments knots states"], ...] = ()
    readings: tuple[Float[np.ndarray, "*#samples outputs"], ...] = ()


class Products(eqx.Module):
    """Inner products of the outputs' responses to forces, for each part of the data (one segment or several) and pair
    of outputs.

    The free parameters' columns come first, then those of the forces, all projected orthogonal to the initial states.

    Attributes:
        gram: of the columns.
        gradient: columns of one output against the residual of the other.
        square: of the residual.
        samples: number of valid samples.
    """

    gram: Float[np.ndarray, "parts outputs outputs columns columns"]
    gradient: Float[np.ndarray, "parts outputs outputs columns"]
    square: Float[np.ndarray, "parts outputs outputs"]
    samples: Float[np.ndarray, " parts"]

    def in_parts(self, many: int) -> "Products":
        """Summed over at most so many contiguous parts."""
        size = self.samples.size
        return self.added(np.arange(size) * many // size == np.arange(many)[:, None])

    def others(self) -> "Products":
        """For each part the sum of all others."""
        return self.added(~np.eye(self.samples.size, dtype=bool))

    def first(self, columns: int) -> "Products":
        """The products of the first columns."""
        return Products(self.gram[..., :columns, :columns], self.gradient[..., :columns], self.square, self.samples)

    def columns(self, which: Sequence[int]) -> "Products":
        """The products of some columns."""
        kept = np.asarray(which)
        return Products(self.gram[..., kept[:, None], kept], self.gradient[..., kept], self.square, self.samples)

    def added(self, which: Bool[np.ndarray, "sums parts"]) -> "Products":
        """Sums over the parts that each row of `which` selects."""
        return Products(*(np.tensordot(which.astype(float), a, axes=1) for a in vars(self).values()))


def linearise_along(fit: Fit) -> LinearisedFit:
    """Linearise a fit along its motion."""
    problem = fit.with_all_free().at_solution
    followed, segments, error = motion_and_residual(fit, problem, fit.unknowns)
    problem = replace(problem, segments=segments)
    conditions = conditions_at_knots(problem.segments)
    if isinstance(fit.model, TwoInertiaModel):
        conditions = replace(conditions, T_m=jnp.asarray(acting_at_knots(fit.model, problem.segments)))
    found = without_undetermined(linearise(problem, fit.unknowns), problem.free)
    return LinearisedFit(
        problem,
        followed,
        Answers.of(found, followed, segments, np.asarray(problem.whitening)),
        motions(fit.model, followed.states, conditions),
        conditions,
        unit_pushes(fit.model, followed.states, conditions),
        unit_readings(fit.model, followed.states[:, :-1], segments),
        error,
    )


def parameter_torques(
    look: LinearisedFit, push: Float[np.ndarray, "segments knots states"]
) -> Float[np.ndarray, "segments knots parameters"]:
    """The free parameters as torques at one place: the torque equivalent to a unit of each, at each knot.

    Zero for a parameter that acts at another place.
    """
    free, model, segments = look.problem.free, look.model, look.problem.segments
    values = np.array([float(model.get(path)) for path in free.paths])
    torque = acting_at_knots(model, segments)
    both = np.concatenate([np.broadcast_to(values, (*torque.shape, values.size)), torque[..., None]], axis=-1)
    around = (look.followed.states, 2), (look.conditions, 2)
    slopes = slopes_at_instants(_rates_at, (both, 2), ((free.paths, model), 0), *around)
    by_torque = acting_slopes_at_knots(model, free.paths, segments)
    found = slopes[..., :-1] + slopes[..., -1:] * by_torque[:, :, None, :]
    found = found * np.asarray(free.slopes(model))
    square = np.sum(push**2, axis=-1)[..., None]
    with np.errstate(all="ignore"):
        torques = np.einsum("skq,skqp->skp", push, found) / square
        elsewhere = np.sum((found - push[..., None] * torques[:, :, None, :]) ** 2, axis=(0, 1, 2))
    there = elsewhere < 1e-12 * np.sum(found**2, axis=(0, 1, 2))
    return np.where(there, torques, 0.0)


def _rates_at(both: Array, posed: tuple[tuple[str, ...], Model], state: Array, conditions: Conditions) -> Array:
    """The state's rates for given values of the parameters at the paths, and a torque."""
    paths, model = posed
    moved = model.replace(dict(zip(paths, both[:-1], strict=True))) if paths else model
    return moved.rates(state, both[-1], jnp.zeros_like(both[-1]), conditions)


def products(look: LinearisedFit, acting: Acting, sizes: Sizes) -> Products:
    """Inner products of the outputs' responses to forces.

    Args:
        look: the fit.
        acting: influence of the forces' parts: mostly a torque at one place, or a sensor error.
        sizes: of each, at each knot; linear between.
    """
    columns = _columns(look, acting, sizes)
    segments, samples, outputs, count = columns.shape
    flat = columns.reshape(segments, samples, -1)
    transposed = np.swapaxes(flat, 1, 2)
    gram = (transposed @ flat).reshape(segments, outputs, count, outputs, count)
    gradient = np.swapaxes((transposed @ look.error).reshape(segments, outputs, count, outputs), 2, 3)
    square = np.swapaxes(look.error, 1, 2) @ look.error
    return Products(np.swapaxes(gram, 2, 3), gradient, square, np.sum(look.answers.weight, axis=1))


def _columns(
    look: LinearisedFit, acting: Acting, sizes: Sizes
) -> Float[np.ndarray, "segments samples outputs columns"]:
    """Derivatives of the whitened outputs by the free parameters and by each force."""
    followed, forces, reading = look.followed, None, None
    if acting.readings:
        both = zip(acting.readings, sizes, strict=True)
        reading = np.sum([reads[..., None] * size[:, :-1, None, :] for reads, size in both], axis=0)
    if acting.pushes:
        lands: list[np.ndarray] = []
        parts: list[np.ndarray] = []
        for push, size in zip(acting.pushes, sizes, strict=True):
            lands += [followed.from_start @ push[:, :-1, :, None], followed.from_end @ push[:, 1:, :, None]]
            parts += [size[:, :-1], size[:, 1:]]
        forces = Forces(np.concatenate(lands, axis=-1), np.stack(parts, axis=2))
    return np.concatenate([look.answers.parameters, look.answers.to(forces, reading)], axis=-1)


def best_steps(found: Products) -> Float[np.ndarray, "parts columns"]:
    """For each part of the data the step that minimises the determinant of the outputs' error covariance: least
    squares, reweighted by the residual's covariance."""
    samples = np.maximum(found.samples, 1.0)[:, None, None]
    weight = np.broadcast_to(np.eye(found.square.shape[1]), found.square.shape)
    steps = np.zeros((found.samples.size, found.gram.shape[-1]))
    for _ in range(_REWEIGHTINGS):
        gram = np.einsum("sij,sijpq->spq", weight, found.gram)
        gradient = np.einsum("sij,sijp->sp", weight, found.gradient)
        steps = solved(gram, gradient[..., None])[..., 0]
        weight = np.linalg.pinv(left_after(found, steps) / samples, hermitian=True)
    return steps


def left_after(
    found: Products, steps: Float[np.ndarray, "parts columns"]
) -> Float[np.ndarray, "parts outputs outputs"]:
    """Squared output errors of each part of the data after its step."""
    against = np.einsum("sijp,sp->sij", found.gradient, steps)
    explained = np.einsum("sijpq,sp,sq->sij", found.gram, steps, steps, optimize=True)
    return found.square - against - np.swapaxes(against, 1, 2) + explained
