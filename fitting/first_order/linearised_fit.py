"""Fitted motions, and the responses to all proposals of the catalogue along them, in batches."""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit, lost
from fitting.estimation.free_parameters import strength_paths
from fitting.estimation.linear_response import Followed, follow
from fitting.estimation.problem import STEP_ANGLE, suggested_substeps
from fitting.estimation.projection import Answers, without_undetermined
from fitting.estimation.residual import Problem, Unknowns
from fitting.estimation.segments import Segments
from fitting.first_order.close_following import followed_closely
from fitting.first_order.motion import Along, along
from fitting.first_order.regressors import regressors
from fitting.first_order.surrogates import Surrogates
from hdjax.effects import Effect

# Numbers in the columns of a batch, limited by memory.
_NUMBERS = 1 << 22

# For training and held-out segments, whose numbers differ.
Answered = Float[np.ndarray, "_ _ outputs columns"]


class FittedMotion(eqx.Module):
    """A fit's motion, its residual and its responses to forces.

    Attributes:
        seen: inputs of effects along the motion.
        answers: responses of the residual to forces, and to free parameters in physical units.
        residual: whitened.
        surrogates: of the residual.
    """

    seen: Along
    answers: Answers
    residual: Float[np.ndarray, "segments samples outputs"]
    surrogates: Surrogates


def fitted_motion(fit: Fit, seed: int) -> FittedMotion:
    """Linearise a fit along its motion.

    Args:
        fit: of the current model.
        seed: of the surrogates.
    """
    problem, unknowns = _linearised(fit)
    found = without_undetermined(linearise(problem, unknowns), problem.free)
    slopes = np.asarray(fit.free.slopes(fit.model))
    found = replace(
        found,
        by_parameter=jnp.asarray(np.asarray(found.by_parameter) / slopes),
        before_by_parameter=jnp.asarray(np.asarray(found.before_by_parameter) / slopes),
    )
    followed, segments, residual = motion_and_residual(fit, problem, unknowns)
    return FittedMotion(
        seen=along(fit.model, followed, segments, fit.stretches),
        answers=Answers.of(found, followed, segments, np.asarray(problem.whitening)),
        residual=residual,
        surrogates=Surrogates.of(fit, seed),
    )


def along_measured_motion(fitted: FittedMotion, fit: Fit) -> FittedMotion:
    """The same with inputs of effects along the measured motion, see [`fitting.first_order.close_following`][].

    Args:
        fitted: along the fit's own motion.
        fit: that was linearised.
    """
    seen = along(fit.model, followed_closely(fit), fitted.seen.segments, fit.stretches)
    return replace(fitted, seen=seen)


def motion_and_residual(
    fit: Fit, problem: Problem, unknowns: Unknowns
) -> tuple[Followed, Segments, Float[np.ndarray, "segments samples outputs"]]:
    """A fitted motion, its data, and the whitened residual. Segments in which the simulation diverges are zero, with
    weight zero.

    Args:
        fit: the fit.
        problem: its problem, or the first segments of it.
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
    """The states of a fitted model in its segments with data; zero where it diverges."""
    return np.nan_to_num(follow(*_linearised(fit)).states, posinf=0.0, neginf=0.0)


def follow_on(training: Fit, held_out: Fit) -> bool:
    """Whether each held-out stretch begins at the end of a training stretch."""
    ends = [(s.name, s.stop) for s in training.stretches]
    return ends == [(s.name, s.start) for s in held_out.stretches]


class Batch(eqx.Module):
    """Proposals evaluated together.

    Attributes:
        proposals: effects at zero strength.
        columns: of each proposal.
        answers: responses of the outputs to a unit of each strength, along the training motion and along the held-out
            one.
        own_states: hidden states of each proposal at the start of each training segment; None without any.
    """

    proposals: list[Effect]
    columns: list[list[int]]
    answers: tuple[Answered, Answered]
    own_states: list[np.ndarray | None]


def batches(
    fitted_motions: tuple[FittedMotion, FittedMotion], proposals: Sequence[Effect], goes_on: bool
) -> Iterator[Batch]:
    """Responses to the proposals, in batches of forms limited by memory.

    Args:
        fitted_motions: along training stretches, and along held-out ones.
        proposals: effects at zero strength.
        goes_on: whether the held-out stretches begin at the ends of the training stretches, see [`follow_on`][].
    """
    room = max(1, _NUMBERS // max(s.residual.size for s in fitted_motions))
    waiting: list[Batch] = []
    for form in dict.fromkeys(type(p) for p in proposals):
        same = [p for p in proposals if type(p) is form]
        fitted, memory = regressors(fitted_motions[0].seen, same)
        unseen, _ = regressors(fitted_motions[1].seen, same, memory if goes_on else None)
        strengths = len(strength_paths(same[0]))
        columns = [list(range(i * strengths, (i + 1) * strengths)) for i in range(len(same))]
        own = [None if memory is None else memory.at_starts[..., i] for i in range(len(same))]
        first, second = (
            s.answers.to(f.forces, f.reading) for s, f in zip(fitted_motions, (fitted, unseen), strict=True)
        )
        waiting.append(Batch(same, columns, (first, second), own))
        if sum(batch.answers[0].shape[-1] for batch in waiting) >= room:
            yield _together(waiting)
            waiting = []
    if waiting:
        yield _together(waiting)


def _together(parts: Sequence[Batch]) -> Batch:
    """Batches joined into one."""
    widths = [part.answers[0].shape[-1] for part in parts]
    firsts = np.cumsum(widths) - widths
    columns = [[int(first) + c for c in own] for part, first in zip(parts, firsts, strict=True) for own in part.columns]
    first, second = (np.concatenate(own, axis=-1) for own in zip(*(part.answers for part in parts), strict=True))
    proposals, own = ([one for part in parts for one in getattr(part, name)] for name in ("proposals", "own_states"))
    return Batch(proposals, columns, (first, second), own)


def _linearised(fit: Fit) -> tuple[Problem, Unknowns]:
    """A fit's problem and unknowns at its solution, without padding segments."""
    problem, count = fit.with_all_free().at_solution, fit.pieces.sum()
    segments, states = jax.tree.map(
        lambda a: jnp.asarray(np.asarray(a)[:count]), (problem.segments, fit.unknowns.states)
    )
    # Held-out fits fix their parameters; here all of them are free. Sensitivities need no more solver steps than this;
    # the residual is that of the fit.
    substeps = suggested_substeps(fit.model, fit.stretches, step_angle=2 * STEP_ANGLE)
    return replace(problem, segments=segments, substeps=substeps), replace(fit.unknowns, states=states)
