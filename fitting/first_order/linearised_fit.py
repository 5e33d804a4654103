"""Fitted motions, and the responses to proposals of the catalogue along them."""

from collections.abc import Sequence
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
from fitting.first_order.regressors import Regressors, regressors
from fitting.first_order.surrogates import Scores, Surrogates
from hdjax.effects import Effect


class FittedMotion(eqx.Module):
    """A fit's motion, its residual and its responses to forces.

    Attributes:
        seen: inputs of effects along the motion.
        answers: responses of the residual to forces, and to free parameters in physical units.
        residual: whitened.
        surrogates: of the residual.
        known: scores of the free parameters.
    """

    seen: Along
    answers: Answers
    residual: Float[np.ndarray, "segments samples outputs"]
    surrogates: Surrogates
    known: Scores

    def scores(self, regressors: Regressors) -> Scores:
        """Scores of the free parameters and of an effect's strengths."""
        columns, known = self.answers.to(regressors.forces, regressors.reading), self.answers.parameters
        own = Scores.of(columns, self.answers.weight, self.residual, self.surrogates)
        with np.errstate(over="ignore", invalid="ignore"):
            across = known.reshape(-1, known.shape[-1]).T @ columns.reshape(-1, columns.shape[-1])
        return self.known.joined(own, across)


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
    answers, surrogates = Answers.of(found, followed, segments, np.asarray(problem.whitening)), Surrogates.of(fit, seed)
    return FittedMotion(
        seen=along(fit.model, followed, segments, fit.stretches),
        answers=answers,
        residual=residual,
        surrogates=surrogates,
        known=Scores.of(answers.parameters, answers.weight, residual, surrogates),
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


class Responses(eqx.Module):
    """First-order responses to the proposals of one form.

    Attributes:
        proposals: effects of one form at zero strength.
        columns: of each proposal, among those of the strengths.
        scores: of the free parameters and the strengths, along the training motion and along the held-out one.
        own_states: hidden states of each proposal at the start of each training segment; None without any.
    """

    proposals: list[Effect]
    columns: list[list[int]]
    scores: tuple[Scores, Scores]
    own_states: list[np.ndarray | None]


def responses(
    fitted_motions: tuple[FittedMotion, FittedMotion], proposals: Sequence[Effect], goes_on: bool
) -> Responses:
    """Responses to proposals of one form.

    Args:
        fitted_motions: along training stretches, and along held-out ones.
        proposals: effects of one form at zero strength.
        goes_on: whether the held-out stretches begin at the ends of the training stretches, see [`follow_on`][].
    """
    first, second = fitted_motions
    fitted, memory = regressors(first.seen, proposals)
    unseen, _ = regressors(second.seen, proposals, memory if goes_on else None)
    strengths = len(strength_paths(proposals[0]))
    columns = [list(range(i * strengths, (i + 1) * strengths)) for i in range(len(proposals))]
    own = [None if memory is None else memory.at_starts[..., i] for i in range(len(proposals))]
    scores = first.scores(fitted), second.scores(unseen)
    return Responses(list(proposals), columns, scores, own)


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
