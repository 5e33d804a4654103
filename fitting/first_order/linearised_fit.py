"""Fitted motions, and what all proposals of the catalogue would do along them, some at a time."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit, lost
from fitting.estimation.experiment import Segments
from fitting.estimation.free_parameters import strength_paths
from fitting.estimation.linear_response import Followed, follow
from fitting.estimation.problem import STEP_ANGLE, suggested_substeps
from fitting.estimation.projection import Answers, without_untold
from fitting.estimation.residual import Problem, Unknowns
from fitting.first_order.close_following import followed_closely
from fitting.first_order.motion import Along, along
from fitting.first_order.regressors import regressors
from fitting.first_order.surrogates import surrogates
from hdjax.effects import Effect

# Numbers that the columns of a batch have: what a computer has room for.
_NUMBERS = 1 << 22

# Of training and of held-out segments, which are not as many.
Answered = Float[np.ndarray, "_ _ outputs columns"]


class Sight(eqx.Module):
    """A fit's motion, and its residual in the form that inner products take.

    Attributes:
        seen: the motion as effects look at it.
        answers: of the residual to what acts, parameters that are free already in physical units.
        residual: whitened.
        surrogates: of it.
    """

    seen: Along
    answers: Answers
    residual: Float[np.ndarray, "segments samples outputs"]
    surrogates: Float[np.ndarray, "draws segments rows"]


def sight(fit: Fit, seed: int, *, measured: bool = False) -> Sight:
    """Look along a fit's motion.

    Args:
        fit: of the model without what is looked for.
        seed: of the surrogates.
        measured: whether effects look at the measured motion, see [`fitting.first_order.close_following`][].
    """
    problem, unknowns = _looked_at(fit)
    found = without_untold(linearise(problem, unknowns), problem.free)
    slopes = np.asarray(fit.free.slopes(fit.model))
    found = replace(
        found,
        by_parameter=jnp.asarray(np.asarray(found.by_parameter) / slopes),
        before_by_parameter=jnp.asarray(np.asarray(found.before_by_parameter) / slopes),
    )
    followed, segments, residual = where_it_goes(fit, problem, unknowns)
    seen = followed_closely(fit) if measured else followed
    return Sight(
        seen=along(fit.model, seen, segments, fit.stretches),
        answers=Answers.of(found, followed, segments, np.asarray(problem.whitening)),
        residual=residual,
        surrogates=surrogates(fit, seed)[:, : len(residual)],
    )


def where_it_goes(
    fit: Fit, problem: Problem, unknowns: Unknowns
) -> tuple[Followed, Segments, Float[np.ndarray, "segments samples outputs"]]:
    """A fitted motion, its data, and the whitened residual; zero, and without weight, in segments in which the model
    runs away: there is no motion to look along.

    Args:
        fit: the fit.
        problem: what it has solved, or the first segments of that.
        unknowns: the solution.
    """
    followed, segments = follow(problem, unknowns), problem.segments
    count = len(followed.states)
    kept = ~lost(fit)[:count] & np.isfinite(followed.transition).all(axis=(1, 2, 3))
    residual = fit.white_error[:count]
    if kept.all():
        return followed, segments, residual
    followed, weight, residual = jax.tree.map(
        lambda a: np.where(kept.reshape(-1, *[1] * (a.ndim - 1)), a, 0.0),
        (followed, np.asarray(segments.weight), residual),
    )
    return followed, replace(segments, weight=jnp.asarray(weight)), residual


def motion_states(fit: Fit) -> Float[np.ndarray, "segments knots states"]:
    """The states that a fitted model goes through, in its segments with data; zero where it runs away."""
    return np.nan_to_num(follow(*_looked_at(fit)).states, posinf=0.0, neginf=0.0)


def follow_on(training: Fit, held_out: Fit) -> bool:
    """Whether each held-out stretch begins where a training stretch ends."""
    ends = [(s.name, s.stop) for s in training.stretches]
    return ends == [(s.name, s.start) for s in held_out.stretches]


class Batch(eqx.Module):
    """Some proposals, looked at together.

    Attributes:
        proposals: effects at zero strength.
        columns: of each proposal.
        answers: of the outputs to a unit of each strength, along the training motion and along the held-out one.
        own_states: where each proposal's own states start in each training segment; None where it has none.
    """

    proposals: list[Effect]
    columns: list[list[int]]
    answers: tuple[Answered, Answered]
    own_states: list[np.ndarray | None]


def batches(sights: tuple[Sight, Sight], proposals: Sequence[Effect], goes_on: bool) -> Iterator[Batch]:
    """What the proposals would do, form by form, as many forms at a time as there is room for.

    Args:
        sights: along training stretches, and along held-out ones.
        proposals: effects at zero strength.
        goes_on: whether the held-out stretches begin where the training stretches end, see [`follow_on`][].
    """
    room = max(1, _NUMBERS // max(s.residual.size for s in sights))
    waiting: list[Batch] = []
    for form in dict.fromkeys(type(p) for p in proposals):
        same = [p for p in proposals if type(p) is form]
        fitted, memory = regressors(sights[0].seen, same)
        unseen, _ = regressors(sights[1].seen, same, memory if goes_on else None)
        strengths = len(strength_paths(same[0]))
        columns = [list(range(i * strengths, (i + 1) * strengths)) for i in range(len(same))]
        own = [None if memory is None else memory.at_starts[..., i] for i in range(len(same))]
        first, second = (s.answers.to(f.forces, f.reading) for s, f in zip(sights, (fitted, unseen), strict=True))
        waiting.append(Batch(same, columns, (first, second), own))
        if sum(batch.answers[0].shape[-1] for batch in waiting) >= room:
            yield _together(waiting)
            waiting = []
    if waiting:
        yield _together(waiting)


def _together(parts: Sequence[Batch]) -> Batch:
    """Batches side by side."""
    widths = [part.answers[0].shape[-1] for part in parts]
    firsts = np.cumsum(widths) - widths
    columns = [[int(first) + c for c in own] for part, first in zip(parts, firsts, strict=True) for own in part.columns]
    first, second = (np.concatenate(own, axis=-1) for own in zip(*(part.answers for part in parts), strict=True))
    proposals, own = ([one for part in parts for one in getattr(part, name)] for name in ("proposals", "own_states"))
    return Batch(proposals, columns, (first, second), own)


def _looked_at(fit: Fit) -> tuple[Problem, Unknowns]:
    """What a fit has solved, and where, at its solution; without segments that only fill up."""
    problem, count = fit.with_all_free().at_solution, fit.pieces.sum()
    segments, states = jax.tree.map(
        lambda a: jnp.asarray(np.asarray(a)[:count]), (problem.segments, fit.unknowns.states)
    )
    # Held-out fits hold their parameters; here all of them count. A first-order look needs no finer sensitivities
    # than this; the residual is the fit's own.
    substeps = suggested_substeps(fit.model, fit.stretches, step_angle=2 * STEP_ANGLE)
    return replace(problem, segments=segments, substeps=substeps), replace(fit.unknowns, states=states)
