"""What forces along a fitted motion would explain of what a fit leaves over, to first order."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit
from fitting.estimation.linear_response import Followed, Forces
from fitting.estimation.projection import Answers, solved, without_untold
from fitting.estimation.residual import Problem
from fitting.first_order.linearised_fit import where_it_goes
from fitting.first_order.motion import (
    acting_at_knots,
    acting_slopes_at_knots,
    conditions_at_knots,
    motions,
    unit_pushes,
)
from hdjax import Model, TwoInertiaModel
from hdjax.effects import Conditions, Motion
from hdjax.engine.pointwise import slopes_at_instants

# Passes of "least squares, then weigh the outputs by what is left over".
_REWEIGHTINGS = 2


Sizes = tuple[Float[np.ndarray, "segments knots forces"], ...]
"""How much of each thing there is."""


class Look(eqx.Module):
    """A fit, linearised along its motion.

    Attributes:
        problem: what was solved, at the solution.
        followed: the motion.
        answers: of the residual to what acts along it.
        motion: at each knot.
        conditions: likewise.
        pushes: what a unit of each thing that effects can add does there to the state's rates, by its name.
        error: whitened output error.
    """

    problem: Problem
    followed: Followed
    answers: Answers
    motion: Motion
    conditions: Conditions
    pushes: dict[str, Float[np.ndarray, "segments knots states"]]
    error: Float[np.ndarray, "segments samples outputs"]

    @property
    def model(self) -> Model:
        """The fitted model."""
        return self.problem.model


class Acting(eqx.Module):
    """What a unit of each of a force's parts does.

    Attributes:
        pushes: to the state's rates.
        reading: to the outputs, in place of that, where it is no force but an error of what an encoder reads.
    """

    pushes: tuple[Float[np.ndarray, "segments knots states"], ...] = ()
    reading: Float[np.ndarray, " outputs"] | None = None


class Products(eqx.Module):
    """Inner products of what forces would do to the outputs, for each part of the data (a segment, or several) and pair
    of outputs.

    The free parameters' columns come first, then those of the forces; what each simulation's first state could do as
    well is taken off.

    Attributes:
        gram: of the columns.
        gradient: columns of one output against the residual of the other.
        square: of the residual.
        samples: number of samples with weight.
    """

    gram: Float[np.ndarray, "parts outputs outputs columns columns"]
    gradient: Float[np.ndarray, "parts outputs outputs columns"]
    square: Float[np.ndarray, "parts outputs outputs"]
    samples: Float[np.ndarray, " parts"]

    def in_parts(self, many: int) -> "Products":
        """Added up in parts of what follows one another, so many at most."""
        size = self.samples.size
        return self.added(np.arange(size) * many // size == np.arange(many)[:, None])

    def others(self) -> "Products":
        """For each part all the others, added up."""
        return self.added(~np.eye(self.samples.size, dtype=bool))

    def first(self, columns: int) -> "Products":
        """Those of the first columns alone."""
        return Products(self.gram[..., :columns, :columns], self.gradient[..., :columns], self.square, self.samples)

    def columns(self, which: Sequence[int]) -> "Products":
        """Those of some columns alone."""
        kept = np.asarray(which)
        return Products(self.gram[..., kept[:, None], kept], self.gradient[..., kept], self.square, self.samples)

    def added(self, which: Bool[np.ndarray, "sums parts"]) -> "Products":
        """Added up over the parts that each row of `which` names."""
        return Products(*(np.tensordot(which.astype(float), a, axes=1) for a in vars(self).values()))


def look_along(fit: Fit) -> Look:
    """Linearise a fit along its motion."""
    problem = fit.with_all_free().at_solution
    followed, segments, error = where_it_goes(fit, problem, fit.unknowns)
    problem = replace(problem, segments=segments)
    conditions = conditions_at_knots(problem.segments)
    if isinstance(fit.model, TwoInertiaModel):
        conditions = replace(conditions, T_m=jnp.asarray(acting_at_knots(fit.model, problem.segments)))
    found = without_untold(linearise(problem, fit.unknowns), problem.free)
    return Look(
        problem,
        followed,
        Answers.of(found, followed, segments, np.asarray(problem.whitening)),
        motions(fit.model, followed.states, conditions),
        conditions,
        unit_pushes(fit.model, followed.states, conditions),
        error,
    )


def parameter_torques(
    look: Look, push: Float[np.ndarray, "segments knots states"]
) -> Float[np.ndarray, "segments knots parameters"]:
    """The free parameters as torques at one place: what torque there a unit of each stands for, at each knot.

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
    """The state's rates with some values of the parameters at the paths, and a torque."""
    paths, model = posed
    moved = model.replace(dict(zip(paths, both[:-1], strict=True))) if paths else model
    return moved.rates(state, both[-1], jnp.zeros_like(both[-1]), conditions)


def products(look: Look, acting: Acting, sizes: Sizes) -> Products:
    """What forces would do to the outputs.

    Args:
        look: the fit.
        acting: what each force is made of, some of the look's pushes: a torque at one place, mostly; or what a unit of
            a reading is.
        sizes: how much of each, at each knot; in a straight line between.
    """
    columns = _columns(look, acting, sizes)
    segments, samples, outputs, count = columns.shape
    flat = columns.reshape(segments, samples, -1)
    transposed = np.swapaxes(flat, 1, 2)
    gram = (transposed @ flat).reshape(segments, outputs, count, outputs, count)
    gradient = np.swapaxes((transposed @ look.error).reshape(segments, outputs, count, outputs), 2, 3)
    square = np.swapaxes(look.error, 1, 2) @ look.error
    return Products(np.swapaxes(gram, 2, 3), gradient, square, np.sum(look.answers.weight, axis=1))


def _columns(look: Look, acting: Acting, sizes: Sizes) -> Float[np.ndarray, "segments samples outputs columns"]:
    """The whitened outputs' derivative by the free parameters and by each force."""
    followed = look.followed
    if acting.reading is not None:
        reading = acting.reading[:, None] * sizes[0][:, :-1, None, :]
        return np.concatenate([look.answers.parameters, look.answers.to(None, reading)], axis=-1)
    lands: list[np.ndarray] = []
    parts: list[np.ndarray] = []
    for push, size in zip(acting.pushes, sizes, strict=True):
        lands += [followed.from_start @ push[:, :-1, :, None], followed.from_end @ push[:, 1:, :, None]]
        parts += [size[:, :-1], size[:, 1:]]
    forces = Forces(np.concatenate(lands, axis=-1), np.stack(parts, axis=2))
    return np.concatenate([look.answers.parameters, look.answers.to(forces)], axis=-1)


def best_steps(found: Products) -> Float[np.ndarray, "parts columns"]:
    """For each part of the data the step that leaves the smallest determinant of the outputs' error covariance there:
    least squares that weigh the outputs by what is left over."""
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
    """Squares of the outputs' errors in each part of the data after a step for it."""
    against = np.einsum("sijp,sp->sij", found.gradient, steps)
    explained = np.einsum("sijpq,sp,sq->sij", found.gram, steps, steps, optimize=True)
    return found.square - against - np.swapaxes(against, 1, 2) + explained
