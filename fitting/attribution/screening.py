"""Screening: first-order gain of each effect of the catalogue.

The derivative of the simulated outputs by an effect's strength at zero is the model's response to a small force along
its motion. Least squares with these regressors gives each effect's strength and gain to first order (a score test),
also on held-out data. Applied to surrogates of the residual, it gives the null distribution of the best gain.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Generic

import equinox as eqx
import numpy as np
from jaxtyping import Float
from typing_extensions import TypeVar

from fitting.estimation.estimate import Fit
from fitting.estimation.free_parameters import MESH, strength_paths
from fitting.estimation.scales import scales
from fitting.estimation.whole_log_fit import follows
from fitting.first_order.linearised_fit import (
    along_measured_motion,
    fitted_motion,
    follow_on,
    responses,
)
from fitting.first_order.spectral_lines import spectral_lines
from fitting.first_order.surrogates import DRAWS, PARTNERS, Scores, null_gains
from fitting.uncertainty.one_side import contradicts
from hdjax import TwoInertiaModel
from hdjax.effects import CATALOGUE, ActuatorEffect, Effect, applicable

# Relative error of the motion above which effects are evaluated along the measured motion as well.
_NEAR = 0.1


class Lead(eqx.Module):
    """One form of an effect with its first-order estimates.

    Attributes:
        effect: the form with first-order estimates of its strengths.
        drive_changes: change of the other free parameters, by path.
        gain: decrease of the objective on held-out data, to first order.
        own_states: hidden initial states in each training segment, driven by the current model's motion; None for an
            effect without.
    """

    effect: Effect
    drive_changes: dict[str, float]
    gain: float
    own_states: Float[np.ndarray, "segments own"] | None = None


# Type of a form's screening result, also of quasi-static logs.
LeadT = TypeVar("LeadT", default=Lead)


class Screen(eqx.Module, Generic[LeadT]):
    """Result of screening the catalogue.

    Attributes:
        leads: best first.
        null_gains: best gain over the catalogue for each surrogate.
    """

    leads: tuple[LeadT, ...]
    null_gains: Float[np.ndarray, " draws"]

    def p_value(self, gain: float) -> float:
        """p-value of a gain under the null distribution of the catalogue's best; one where that is unknown."""
        if not np.isfinite(self.null_gains).any():
            # The response to every form diverges.
            return 1.0
        return (1 + int(np.sum(self.null_gains >= gain))) / (1 + self.null_gains.size)


def screen(
    training: Fit,
    held_out: Fit,
    *,
    catalogue: Sequence[type[Effect]] = CATALOGUE,
    seed: int = 0,
    side: Fit | None = None,
) -> Screen:
    """Screen every form that the current model lacks.

    Args:
        training: fit of the current model.
        held_out: the same model's parameters on held-out stretches (states fitted, parameters held).
        catalogue: candidate forms.
        seed: of the surrogates.
        side: the fit of one side's equation that the priors of K, alpha and B_sp are from.
    """
    model = training.model
    present = {name for e in model.effects for name in (e.name, *e.contains)}
    lines = replace(scales(training.stretches, model), residual_frequencies=spectral_lines(training))
    forms = [form for form in catalogue if form.name not in present]
    found = applicable(forms, lines, has_motor=isinstance(model, TwoInertiaModel))
    proposals = tuple(effect for effects in found.values() for effect in effects)
    strays = not follows(training, share=_NEAR)
    # Fixed parameters stay fixed: their influence along a motion that deviates is not that along the true one.
    free_now = () if strays and training.was_held else training.free.paths
    skipped = len(training.free.paths) - len(free_now)
    known = len(free_now)
    off, slope = _priors(training)
    free_mesh = np.where([path in MESH for path in training.free.paths], 0.0, slope)

    leads: dict[str, Lead] = {}
    chance = np.full(DRAWS * PARTNERS, -np.inf)
    for effect, own, states, scores in _responses(training, held_out, proposals, seed, strays=strays):
        used = [*range(known), *(skipped + known + c for c in own)]
        fitted, unseen = (each.columns(used) for each in scores)
        if known:
            fitted = fitted.beside_prior(off, free_mesh if contradicts(effect, side) else slope)
        if not (np.isfinite(fitted.gram).all() and np.isfinite(unseen.gram).all()):
            # Its response diverges along this motion: nothing is known to first order.
            continue
        paths, info = strength_paths(effect), model.with_effects(effect).parameters()
        positive = [known + i for i, p in enumerate(paths) if info[p][1].positive]
        step, gain = _linear_gain(fitted, unseen, known, positive)
        chance = np.maximum(chance, null_gains(fitted, unseen, known))
        if effect.name in leads and leads[effect.name].gain >= gain:
            continue
        strengths = {p: float(info[p][0]) + step[known + i] for i, p in enumerate(paths)}
        filled = model.with_effects(effect).replace(strengths).effect(effect.name)
        changes = {p: step[i] for i, p in enumerate(free_now)}
        leads[effect.name] = Lead(filled, changes, gain, None if states is None else _filled_up(states, training))
    ordered = sorted(leads.values(), key=lambda lead: -lead.gain)
    return Screen(tuple(ordered), chance)


def _priors(fit: Fit) -> tuple[Float[np.ndarray, " free"], Float[np.ndarray, " free"]]:
    """Deviation of each free parameter from its prior mean, in standard deviations, and its derivative by the
    parameter."""
    free = fit.free
    slope = np.asarray(free.precision) / np.asarray(free.slopes(fit.model))
    return np.asarray(free.off_prior(free.pack(fit.model))), slope


def _responses(
    training: Fit, held_out: Fit, proposals: Sequence[Effect], seed: int, *, strays: bool
) -> Iterator[tuple[Effect, list[int], np.ndarray | None, tuple[Scores, Scores]]]:
    """Each proposal, its columns, its hidden states at the start of each training segment, and the scores of its form
    along training and held-out data.

    Where the model's motion strays from the log, effects are evaluated along the measured motion too. The true one is
    between the two: an encoder reads a kinematic error as a twist that the spring does not have.
    """
    first, second = fitted_motion(training, seed), fitted_motion(held_out, seed + 1)
    passes = [((first, second), proposals)]
    if strays:
        measured = along_measured_motion(first, training), along_measured_motion(second, held_out)
        # Effects on the torque signal do not depend on the motion.
        passes.append((measured, [p for p in proposals if not isinstance(p, ActuatorEffect)]))
    goes_on = follow_on(training, held_out)
    for motions, tried in passes:
        for form in dict.fromkeys(type(p) for p in tried):
            found = responses(motions, [p for p in tried if type(p) is form], goes_on)
            for effect, columns, states in zip(found.proposals, found.columns, found.own_states, strict=True):
                yield effect, columns, states, found.scores


def _filled_up(states: np.ndarray, fit: Fit) -> np.ndarray:
    """One row for each of a fit's segments; those without data repeat the last one with data."""
    return np.pad(states, ((0, len(fit.unknowns.states) - len(states)), (0, 0)), mode="edge")


def _linear_gain(fitted: Scores, unseen: Scores, known: int, positive: list[int]) -> tuple[dict[int, float], float]:
    """Least-squares step of the columns, and its gain on held-out data relative to refitting the free parameters (the
    first columns).

    A strength that can't be negative is zero where its estimate is.
    """
    kept, against = list(range(known, len(fitted.gram))), fitted.gradient[:, None]
    while True:
        step = fitted.steps(against, [*range(known), *kept])
        wrong = [i for i in kept if i in positive and step[i, 0] < 0]
        if not wrong:
            break
        kept = [i for i in kept if i not in wrong]
    before, after = (
        unseen.loss(s, unseen.gradient[:, None]) for s in (fitted.steps(against, list(range(known))), step)
    )
    return dict(enumerate(step[:, 0].tolist())), float((before - after)[0])
