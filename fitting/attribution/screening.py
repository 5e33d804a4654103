"""A first look at the whole catalogue: what would each effect explain, to first order?

At zero strength an effect changes nothing, but the derivative of the simulated outputs with respect to its strength is
there: the answer of the present model to a small force along its own motion. Least squares on those derivatives gives
each effect's strength and gain to first order (a score test), on held-out data too. The same linear algebra applied to
surrogates of the residual gives the law of the best gain where there is nothing to find.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Generic

import equinox as eqx
import numpy as np
from jaxtyping import Float
from typing_extensions import TypeVar

from fitting.estimate import Fit
from fitting.experiment import scales
from fitting.explained import solved
from fitting.free import strength_paths
from fitting.sight import Answered, Sight, batches, follow_on, sight
from fitting.spectral_lines import spectral_lines
from fitting.surrogates import DRAWS
from hdjax import Model, TwoInertiaModel
from hdjax.effects import CATALOGUE, Effect, Scales, applicable


class Lead(eqx.Module):
    """One form of an effect, as the first look sees it.

    Attributes:
        effect: the form at the strengths that suit best to first order.
        drive_changes: change of the parameters that were free already, by path.
        gain: decrease of the objective on held-out data, to first order.
        own_states: where the effect's own states start in each training segment, driven by the present model's motion;
            None for an effect without.
    """

    effect: Effect
    drive_changes: dict[str, float]
    gain: float
    own_states: Float[np.ndarray, "segments own"] | None = None


# What a look at the catalogue says of a form; of quasi-static logs likewise.
LeadT = TypeVar("LeadT", default=Lead)


class Screen(eqx.Module, Generic[LeadT]):
    """The first look at the whole catalogue.

    Attributes:
        leads: best first.
        null_gains: the best gain over the catalogue in each of the surrogates.
    """

    leads: tuple[LeadT, ...]
    null_gains: Float[np.ndarray, " draws"]

    def p_value(self, gain: float) -> float:
        """How often chance alone makes the best of the catalogue at least this good."""
        return (1 + int(np.sum(self.null_gains >= gain))) / (1 + self.null_gains.size)


def screen(
    training: Fit,
    held_out: Fit,
    *,
    catalogue: Sequence[type[Effect]] = CATALOGUE,
    seed: int = 0,
) -> Screen:
    """Look at every form that the current model lacks.

    Args:
        training: fit of the current model.
        held_out: the same model's parameters on held-out stretches (states fitted, parameters held).
        catalogue: forms to look at.
        seed: of the surrogates.
    """
    model = training.model
    present = {e.name for e in model.effects}
    lines = replace(scales(training.stretches, model), residual_frequencies=spectral_lines(training))
    found = _applicable([form for form in catalogue if form.name not in present], lines, model)
    proposals = tuple(effect for effects in found.values() for effect in effects)
    free_now = training.free.paths
    leads: dict[str, Lead] = {}
    null_gains = np.full(DRAWS, -np.inf)
    sights = sight(training, seed), sight(held_out, seed + 1)
    known = len(free_now)
    for batch in batches(sights, proposals, follow_on(training, held_out)):
        scores = [_score(*pair) for pair in zip(sights, batch.answers, strict=True)]
        for effect, own, states in zip(batch.proposals, batch.columns, batch.own_states, strict=True):
            fitted, unseen = (score.columns([*range(known), *(known + c for c in own)]) for score in scores)
            columns = list(range(known, known + len(own)))
            paths = strength_paths(effect)
            info = model.with_effects(effect).parameters()
            positive = [c for c, p in zip(columns, paths, strict=True) if info[p][1].positive]
            step, gain = _linear_gain(fitted, unseen, known, positive)
            null_gains = np.maximum(null_gains, _null_gains(fitted, unseen, known))
            if effect.name in leads and leads[effect.name].gain >= gain:
                continue
            strengths = {p: float(info[p][0]) + step[c] for c, p in zip(columns, paths, strict=True)}
            filled = model.with_effects(effect).replace(strengths).effect(effect.name)
            changes = {p: step[i] for i, p in enumerate(free_now)}
            leads[effect.name] = Lead(filled, changes, gain, None if states is None else _filled_up(states, training))
    ordered = sorted(leads.values(), key=lambda lead: -lead.gain)
    return Screen(tuple(ordered), null_gains)


def _applicable(
    catalogue: Sequence[type[Effect]], scales: Scales, model: Model
) -> dict[type[Effect], tuple[Effect, ...]]:
    return applicable(catalogue, scales, has_motor=isinstance(model, TwoInertiaModel))


def _filled_up(states: np.ndarray, fit: Fit) -> np.ndarray:
    """One row for each of a fit's segments; those without data are like the last one that has some."""
    return np.pad(states, ((0, len(fit.unknowns.states) - len(states)), (0, 0)), mode="edge")


class _Score(eqx.Module):
    """Inner products of sensitivities with each other, with the residual, and with its surrogates.

    Attributes:
        gram: of the projected columns: of what was free already, then of strengths.
        gradient: columns against the residual.
        surrogate_gradients: columns against each surrogate.
        rows: number of measured values, at least one.
    """

    gram: np.ndarray
    gradient: np.ndarray
    surrogate_gradients: np.ndarray
    rows: float

    def columns(self, which: list[int]) -> "_Score":
        """Those of some columns alone."""
        own = self.gram[np.ix_(which, which)], self.gradient[which], self.surrogate_gradients[which]
        return _Score(*own, self.rows)


def _score(sight: Sight, answered: Answered) -> _Score:
    answers = sight.answers
    # Where the model runs away in every segment, nothing is told.
    rows = max(float(np.sum(answers.weight)) * sight.residual.shape[-1], 1.0)
    explained = np.concatenate([answers.parameters, answered], axis=-1)
    flat = explained.reshape(-1, explained.shape[-1])
    against = (sight.surrogates.reshape(len(sight.surrogates), -1) @ flat).T
    return _Score(flat.T @ flat, flat.T @ sight.residual.reshape(-1), against, rows)


def _linear_gain(fitted: _Score, unseen: _Score, known: int, positive: list[int]) -> tuple[dict[int, float], float]:
    """Least-squares step of the columns, and what it gains on unseen data beyond refitting those that were free
    already, the first ones.

    A strength that can't be negative is left at zero where it would be.
    """
    kept = list(range(known, len(fitted.gram)))
    while True:
        chosen = [*range(known), *kept]
        step = _solve(fitted.gram, fitted.gradient[:, None], chosen)[:, 0]
        wrong = [i for i in kept if i in positive and step[i] < 0]
        if not wrong:
            break
        kept = [i for i in kept if i not in wrong]
    reference = _solve(fitted.gram, fitted.gradient[:, None], list(range(known)))[:, 0]
    gain = _loss(unseen, reference[:, None]) - _loss(unseen, step[:, None])
    return dict(enumerate(step.tolist())), float(gain[0] / (2 * unseen.rows))


def _null_gains(fitted: _Score, unseen: _Score, known: int) -> np.ndarray:
    """[`_linear_gain`][] of each surrogate."""
    reference, step = (
        _solve(fitted.gram, fitted.surrogate_gradients, list(range(count))) for count in (known, len(fitted.gram))
    )
    before = _loss(unseen, reference, unseen.surrogate_gradients)
    after = _loss(unseen, step, unseen.surrogate_gradients)
    return (before - after) / (2 * unseen.rows)


def _solve(gram: np.ndarray, gradient: np.ndarray, chosen: list[int]) -> np.ndarray:
    """Least squares over the chosen columns; zero for the others."""
    solution = np.zeros_like(gradient)
    solution[chosen] = solved(gram[np.ix_(chosen, chosen)], gradient[chosen])
    return solution


def _loss(score: _Score, step: np.ndarray, gradient: np.ndarray | None = None) -> np.ndarray:
    """Change of the sum of squares by a step, for each column of it."""
    against = score.gradient[:, None] if gradient is None else gradient
    return -2 * np.sum(step * against, axis=0) + np.sum(step * (score.gram @ step), axis=0)
