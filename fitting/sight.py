"""Fitted motions, and what all proposals of the catalogue would do along them, a few at a time."""

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import replace
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.along import Along, along
from fitting.engines import linearise
from fitting.estimate import Fit, lost
from fitting.experiment import Segments
from fitting.explained import without_untold
from fitting.followed import Followed, follow
from fitting.free import strength_paths
from fitting.memory import Memory
from fitting.posing import STEP_ANGLE, suggested_substeps
from fitting.regressors import Regressors, regressors
from fitting.residual import Blocks, Problem
from fitting.surrogates import surrogates
from hdjax.effects import Effect
from hdjax.where import where

_Item = TypeVar("_Item")
_Found = TypeVar("_Found")
# Forms that are looked at at a time.
_BEFOREHAND = 2
# Columns that one program takes at once; as many proposals as fit share it.
_COLUMNS = 16


class Sight(eqx.Module):
    """A fit's motion, and its residual in the form that inner products take.

    Attributes:
        seen: the motion as effects look at it.
        found: the residual's derivatives by what is free already, in physical units.
        whitening: of the outputs.
        residual: whitened.
        surrogates: of it.
    """

    seen: Along
    found: Blocks
    whitening: Float[Array, "outputs outputs"]
    residual: Float[Array, "segments samples outputs"]
    surrogates: Float[Array, "draws segments rows"]


def sight(fit: Fit, seed: int) -> Sight:
    """Look along a fit's motion.

    Args:
        fit: of the model without what is looked for.
        seed: of the surrogates.
    """
    problem = _looked_at(fit)
    followed: Followed = _on_host(follow(problem, fit.unknowns))
    found: Blocks = _on_host(without_untold(linearise(problem, fit.unknowns), problem.free))
    slopes = fit.free.slopes(fit.model)[None, None, :]
    found = replace(
        found,
        by_parameter=found.by_parameter / slopes,
        before_by_parameter=found.before_by_parameter / slopes,
    )
    segments: Segments = _on_host(problem.segments)
    whitening = _on_host(problem.whitening)
    residual = _on_host(fit.error) @ whitening.T
    kept, followed = where_it_goes(fit, followed)
    segments = replace(segments, weight=where(kept[:, None], segments.weight, 0.0))
    residual = where(kept[:, None, None], residual, 0.0)
    seen = along(fit.model, followed, segments, fit.stretches)
    return Sight(seen, found, whitening, residual, jnp.asarray(surrogates(fit, seed)))


def where_it_goes(fit: Fit, followed: Followed) -> tuple[Bool[np.ndarray, " segments"], Followed]:
    """The segments in which a model does not run away, and its motion with zeros in the others: there is none to look
    along."""
    kept = ~lost(fit) & np.isfinite(np.asarray(followed.transition)).all(axis=(1, 2, 3))
    if kept.all():
        return kept, followed
    return kept, jax.tree.map(lambda a: where(kept.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0), followed)


def motion_states(fit: Fit) -> Float[np.ndarray, "segments knots states"]:
    """The states that a fitted model goes through; zero where it runs away."""
    return np.nan_to_num(np.asarray(follow(_looked_at(fit), fit.unknowns).states), posinf=0.0, neginf=0.0)


def follow_on(training: Fit, held_out: Fit) -> bool:
    """Whether each held-out stretch begins where a training stretch ends."""
    ends = [(s.name, s.stop) for s in training.stretches]
    return ends == [(s.name, s.start) for s in held_out.stretches]


def _on_host(tree):
    """Arrays by way of the host: what follows is not shared among devices."""
    return jax.tree.map(lambda a: jnp.asarray(np.asarray(a)) if eqx.is_array(a) else a, tree)


class Batch(eqx.Module):
    """Proposals that one program takes at once.

    Attributes:
        columns: of each proposal, by its place in the list.
        forces: regressors along the training motion and along the held-out one.
        own_states: where each proposal's own states start in each training segment; None where it has none.
    """

    columns: dict[int, list[int]]
    forces: tuple[Regressors, Regressors]
    own_states: dict[int, np.ndarray | None]


def batches(sights: tuple[Sight, Sight], proposals: Sequence[Effect], goes_on: bool) -> Iterator[Batch]:
    """Regressors of the proposals, as many as go into one program.

    Args:
        sights: along training stretches, and along held-out ones.
        proposals: effects at zero strength.
        goes_on: whether the held-out stretches begin where the training stretches end, see [`follow_on`][].
    """

    def looked_at(same: Sequence[Effect]) -> tuple[Regressors, Regressors, Memory | None]:
        fitted, memory = regressors(sights[0].seen, same)
        unseen, _ = regressors(sights[1].seen, same, memory if goes_on else None)
        return fitted, unseen, memory

    columns: dict[int, list[int]] = {}
    own: dict[int, np.ndarray | None] = {}
    waiting: list[tuple[Regressors, Regressors]] = []
    taken, index = 0, 0
    forms = dict.fromkeys(type(p) for p in proposals)
    alike = [[p for p in proposals if type(p) is form] for form in forms]
    for same, (*found, memory) in zip(alike, _beforehand(looked_at, alike), strict=True):
        strengths = len(strength_paths(same[0]))
        for i in range(len(same)):
            if waiting and taken + strengths > _COLUMNS:
                yield Batch(columns, _filled(waiting), own)
                columns, own, waiting, taken = {}, {}, [], 0
            mine = slice(i * strengths, (i + 1) * strengths)
            waiting.append(jax.tree.map(lambda a, mine=mine: a[..., mine], tuple(found)))
            columns[index] = list(range(taken, taken + strengths))
            own[index] = None if memory is None else memory.at_starts[..., i]
            taken, index = taken + strengths, index + 1
    if waiting:
        yield Batch(columns, _filled(waiting), own)


def _beforehand(find: Callable[[_Item], _Found], items: Sequence[_Item]) -> Iterator[_Found]:
    """What is found of each item in turn, the next two while the last one is used: each form has a program of its own
    to be compiled."""
    with ThreadPoolExecutor(_BEFOREHAND) as workers:
        coming: deque[Future[_Found]] = deque()
        for item in items:
            coming.append(workers.submit(find, item))
            if len(coming) > _BEFOREHAND:
                yield coming.popleft().result()
        while coming:
            yield coming.popleft().result()


def _filled(parts: Sequence[tuple[Regressors, Regressors]]) -> tuple[Regressors, Regressors]:
    """The parts side by side, with columns of zeros up to the next size that has a program."""
    missing = -sum(part.reading.shape[-1] for part, _ in parts) % _COLUMNS

    def joined(*columns: np.ndarray) -> np.ndarray:
        return np.concatenate([*columns, np.zeros((*columns[0].shape[:-1], missing))], axis=-1)

    return jax.tree.map(joined, *parts)


def _looked_at(fit: Fit) -> Problem:
    """What a fit has solved, at its solution."""
    # Held-out fits hold their parameters; here all of them count. A first-order look needs no finer sensitivities
    # than this; the residual is the fit's own.
    return replace(
        fit.problem,
        model=fit.model,
        active=jnp.ones_like(fit.problem.active),
        substeps=suggested_substeps(fit.model, fit.stretches, step_angle=2 * STEP_ANGLE),
    )
