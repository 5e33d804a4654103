"""What forces along a fitted motion would explain of what a fit leaves over, to first order."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.along import acting_at_knots, conditions_at_knots, motions, unit_pushes
from fitting.engines import linearise
from fitting.estimate import Fit
from fitting.explained import explained, solved, without_untold
from fitting.followed import Followed, follow
from fitting.residual import Blocks, Problem
from fitting.sight import where_it_goes
from hdjax import Model, TwoInertiaModel
from hdjax.effects import Conditions, Motion
from hdjax.where import where

# Passes of "least squares, then weigh the outputs by what is left over".
_REWEIGHTINGS = 2


Sizes = tuple[Float[Array | np.ndarray, "segments knots forces"], ...]
"""How much of each thing there is."""


class Look(eqx.Module):
    """A fit, linearised along its motion.

    Attributes:
        problem: what was solved, at the solution.
        blocks: its residual and derivatives.
        followed: the motion and its answer to small forces.
        motion: at each knot.
        conditions: likewise.
        pushes: what a unit of each thing that effects can add does there to the state's rates, by its name.
        error: whitened output error.
    """

    problem: Problem
    blocks: Blocks
    followed: Followed
    motion: Motion
    conditions: Conditions
    pushes: dict[str, Float[Array, "segments knots states"]]
    error: Float[Array, "segments samples outputs"]

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

    pushes: tuple[Float[Array, "segments knots states"], ...] = ()
    reading: Float[Array, " outputs"] | None = None


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
    problem = eqx.tree_at(lambda p: (p.model, p.active), fit.problem, (fit.model, jnp.ones(len(fit.free.paths))))
    kept, followed = where_it_goes(fit, follow(problem, fit.unknowns))
    error = jnp.asarray(fit.error)
    if not kept.all():
        weight = where(kept[:, None], problem.segments.weight, 0.0)
        problem = eqx.tree_at(lambda p: p.segments.weight, problem, weight)
        error = where(kept[:, None, None], error, 0.0)
    conditions = conditions_at_knots(problem.segments)
    if isinstance(fit.model, TwoInertiaModel):
        conditions = replace(conditions, T_m=acting_at_knots(fit.model, problem.segments))
    return Look(
        problem,
        without_untold(linearise(problem, fit.unknowns), problem.free),
        followed,
        motions(fit.model, followed.states, conditions),
        conditions,
        unit_pushes(fit.model, followed.states, conditions),
        error @ fit.problem.whitening.T,
    )


def parameter_torques(
    look: Look, push: Float[Array, "segments knots states"]
) -> Float[Array, "segments knots parameters"]:
    """The free parameters as torques at one place: what torque there a unit of each stands for, at each knot.

    Zero for a parameter that acts at another place.
    """
    return _parameter_torques(look.problem, look.followed.states, look.conditions, push)


@eqx.filter_jit
def _parameter_torques(problem: Problem, states: Array, conditions: Conditions, push: Array) -> Array:
    zero = jnp.zeros(())
    vector = problem.free.pack(problem.model)

    def rates(vector: Array) -> Array:
        model = problem.free.unpack(problem.model, vector)
        acting = acting_at_knots(model, problem.segments)
        return jax.vmap(jax.vmap(lambda s, T, c: model.rates(s, T, zero, c)))(states, acting, conditions)

    found = jax.jacfwd(rates)(vector)
    square = jnp.sum(push**2, axis=-1)[..., None]
    torque = jnp.einsum("skq,skqp->skp", push, found) / square
    elsewhere = jnp.sum((found - push[..., None] * torque[:, :, None, :]) ** 2, axis=(0, 1, 2))
    there = elsewhere < 1e-12 * jnp.sum(found**2, axis=(0, 1, 2))
    return where(there, torque, 0.0)


def products(look: Look, acting: Acting, sizes: Sizes) -> Products:
    """What forces would do to the outputs.

    Args:
        look: the fit.
        acting: what each force is made of, some of the look's pushes: a torque at one place, mostly; or what a unit of
            a reading is.
        sizes: how much of each, at each knot; in a straight line between.
    """
    found = _products(look, acting, tuple(jnp.asarray(a) for a in sizes))
    return Products(*(np.asarray(a) for a in found))


@eqx.filter_jit
def _products(look: Look, acting: Acting, sizes: Sizes) -> tuple[Array, Array, Array, Array]:
    columns = _columns(look, acting, sizes)
    error = look.error
    gram = jnp.einsum("snip,snjq->sijpq", columns, columns)
    gradient = jnp.einsum("snip,snj->sijp", columns, error)
    return gram, gradient, jnp.einsum("sni,snj->sij", error, error), jnp.sum(look.problem.segments.weight, axis=1)


def _columns(look: Look, acting: Acting, sizes: Sizes) -> Float[Array, "segments samples outputs columns"]:
    """The whitened outputs' derivative by the free parameters and by each force."""
    size, reading = sizes[0], jnp.zeros(())
    forces = jnp.zeros((*size.shape[:2], look.followed.states.shape[-1], size.shape[-1]))
    if acting.reading is not None:
        reading = acting.reading[None, None, :, None] * size[:, :-1, None, :]
    for push, size in zip(acting.pushes, sizes, strict=acting.reading is None):
        forces = forces + push[..., None] * size[:, :, None, :]
    segments, whitening = look.problem.segments, look.problem.whitening
    return explained(look.blocks, look.followed, segments, whitening, forces[:, :-1], forces[:, 1:], reading)


def surrogate_gains(
    looks: tuple[Look, Look],
    acting: tuple[Acting, Acting],
    sizes: tuple[Sizes, Sizes],
    surrogates: tuple[np.ndarray, np.ndarray],
) -> Float[np.ndarray, " draws"]:
    """What forces gain on unseen data where there is nothing to find.

    Args:
        looks: at the data that are fitted, and at unseen data.
        acting: what the forces are made of, likewise.
        sizes: likewise.
        surrogates: residuals of the same colour with random phases, by draw, segment and row.
    """
    (gram, gradient), (unseen_gram, unseen_gradient) = (
        [np.asarray(a) for a in _against(look, unit, tuple(jnp.asarray(one) for one in size), jnp.asarray(drawn))]
        for look, unit, size, drawn in zip(looks, acting, sizes, surrogates, strict=True)
    )
    known = len(looks[0].problem.free.paths)
    loss = []
    for columns in (known, gram.shape[0]):
        step = np.zeros_like(gradient)
        step[:columns] = solved(gram[:columns, :columns], gradient[:columns])
        loss.append(-2 * np.sum(step * unseen_gradient, axis=0) + np.sum(step * (unseen_gram @ step), axis=0))
    rows = float(jnp.sum(looks[1].problem.segments.weight)) * looks[1].error.shape[2]
    return (loss[0] - loss[1]) / (2 * rows)


@eqx.filter_jit
def _against(look: Look, acting: Acting, sizes: Sizes, surrogates: Array) -> tuple[Array, Array]:
    columns = _columns(look, acting, sizes)
    rows = columns.reshape(columns.shape[0], -1, columns.shape[-1])
    return jnp.einsum("srp,srq->pq", rows, rows), jnp.einsum("srp,dsr->pd", rows, surrogates)


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
