"""Nonparametric terms learned inside the equations, where no effect of the catalogue explains the discrepancy.

Place and variables are chosen on training data alone ([`fitting.discrepancy.variable_selection`][]); one learned
function is then evaluated on held-out data, like any other effect. A discrepancy that no function of the present motion
explains may have memory ([`fitting.discrepancy.dynamic_laws`][]).
"""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from fitting.attribution.candidate_fit import Trial, challenge
from fitting.attribution.rules import RULES
from fitting.attribution.study import Study
from fitting.discrepancy.dynamic_laws import MemoryCandidate, MemoryScreen, screen_memory
from fitting.discrepancy.variable_selection import (
    NEARLY,
    Candidate,
    SearchContext,
    candidates,
    reselected,
    search_context,
    sizes_along,
)
from fitting.estimation.base_fit import leaves_white_noise
from fitting.estimation.estimate import Fit
from fitting.first_order.linearised_fit import motion_states
from fitting.first_order.motion import place_of, unit_reading
from fitting.first_order.surrogates import chance_of_gain
from hdjax import Model, sampled
from hdjax.dynamics import Inputs
from hdjax.effects import Conditions, Motion
from hdjax.effects.learned import Learned, LearnedReading
from hdjax.parameters import as_scalar

# Smallest first-order gain for a refit: on the residual of the base model, and beside named effects.
_LEAST_SHARE, _LEAST_SHARE_BESIDE = 0.005, 0.02
# Least relative decrease of the sum of squares over a few steps: that of one more coefficient.
_LEAST_PROGRESS = 2.0 * RULES.coefficient


class Unknown(eqx.Module):
    """A learned term: a function of the motion, or a torque with memory.

    Attributes:
        before: the model without it.
        trial: the model with it.
        candidates: all places and variables, best first by first-order gain.
        chosen: the selected candidate.
        instants: sample of the training motion with the density of the data, counted along its segments.
        states: of the model without it, at these instants.
        conditions: time and temperature at these instants.
        push: change of the states' rates by a unit of torque: at its place, or in the mesh for an error of an angle.
        gain: decrease of the held-out objective.
        p_value: of this gain.
    """

    before: Trial
    trial: Trial
    candidates: tuple[Candidate | MemoryCandidate, ...]
    chosen: Candidate | MemoryCandidate
    instants: Int[np.ndarray, " instants"]
    states: Float[np.ndarray, "instants states"]
    conditions: Conditions
    push: Float[np.ndarray, "instants states"]
    gain: float
    p_value: float

    @property
    def motion(self) -> Motion:
        """The motion at the instants."""
        return jax.vmap(self.before.model.motion)(jnp.asarray(self.states), self.conditions)


def learn(before: Trial, study: Study) -> Unknown | None:
    """Learn a term that a model lacks.

    Where its residual appears white, little can be missing: a function of one variable is all that the data may show.

    Args:
        before: the current model.
        study: the data and their segmentation.

    Returns:
        The learned term; None where none reduces the training error.
    """
    study.progress("screening variables of a learned term")
    seen = search_context(before.training)
    least = _LEAST_SHARE_BESIDE if before.model.effects else _LEAST_SHARE
    faint = leaves_white_noise(before.training)
    found = sorted((c for c in candidates(seen, pairs=not faint) if c.gain > least), key=lambda c: -c.gain)
    alone, pairs = ([c for c in found if (len(c.variables) > 1) == several] for several in (False, True))

    best = _likeliest(alone, None, before, study)
    memory: MemoryScreen | None = None
    remembered: tuple[MemoryCandidate, Trial] | None = None
    refitted, enough = False, _is_enough(best)
    if not (faint or enough):
        memory = screen_memory(before, seen, study, least=least)
        # A law with memory has fewer parameters than a function of two variables.
        refitted = bool(memory.candidates) and memory.candidates[0].gain > max((c.gain for c in alone), default=0.0)
        if refitted:
            remembered = memory.put_inside(before, study, rival=best)
    if not _is_enough(remembered):
        if not enough:
            worth = [c for c in pairs if best is None or c.gain >= best[0].gain + RULES.variable]
            best = _likeliest(worth, best, before, study)
        best = None if best is None else _refined(best, study)
        if memory is not None and not refitted and not _is_enough(best):
            remembered = memory.put_inside(before, study, rival=best)

    if remembered is not None and (best is None or _betters(remembered[1], best[1], before)):
        assert memory is not None
        gain = remembered[1].gain_over(before)
        chosen, trial, p_value = *remembered, memory.screen.p_value(gain)
    elif best is not None:
        chosen, trial = best
        gain = before.held_out.objective - trial.held_out.objective
        p_value = chance_of_gain(before.held_out, trial.held_out, study.seed)
    else:
        return None
    instants = seen.instants
    states, acting = (
        np.asarray(a).reshape(-1, a.shape[2])[instants]
        for a in (seen.look.followed.states, seen.torque_push(place_of(chosen.form)))
    )
    conditions = jax.tree.map(lambda a: a.reshape(-1)[instants], seen.look.conditions)
    others = (*found, *(memory.candidates if memory is not None else ()))
    ranked = tuple(sorted(others, key=lambda c: -c.gain))
    return Unknown(before, trial, ranked, chosen, instants, states, conditions, acting, gain, p_value)


def learn_supported(before: Trial, study: Study) -> Unknown | None:
    """[`learn`][], None also where the data do not support the term."""
    found = learn(before, study)
    return found if is_supported(found) else None


def _likeliest(
    found: Sequence[Candidate], best: tuple[Candidate, Trial] | None, before: Trial, study: Study
) -> tuple[Candidate, Trial] | None:
    """The best, inside the equations, of the first candidate, a second of nearly the same gain, and the best one so
    far."""
    for candidate in (c for c in found[:2] if c.gain > NEARLY * found[0].gain):
        study.progress(f"learning a function of {' and '.join(candidate.variables)}")
        # A full step to the first-order estimate may be far worse than the current model, where the term is zero.
        trial = _refitted(before, candidate, study, np.zeros(len(candidate.effect.c)))
        if trial is not None and _penalised(trial) < _penalised(before if best is None else best[1]):
            best = candidate, trial
    return best


def _is_enough(found: tuple[Candidate | MemoryCandidate, Trial] | None) -> bool:
    return found is not None and leaves_white_noise(found[1].training)


def _betters(trial: Trial, other: Trial, before: Trial) -> bool:
    """Whether a model is better than another one: on training data, penalised for its parameters, and on held-out data,
    where the gain of memory must persist."""
    return _penalised(trial) < _penalised(other) and trial.gain_over(before) > other.gain_over(before)


def _refined(best: tuple[Candidate, Trial], study: Study) -> tuple[Candidate, Trial]:
    """A refit with the same variables, and functions selected again along the motion of the first fit, since the first
    selection was of first order only."""
    first, trial = best
    seen = search_context(trial.training)
    for candidate in reselected(first, seen):
        study.progress("refining the learned function")
        finer = _refitted(trial, candidate, study, _as_before(first, trial, candidate, seen))
        if finer is not None and _penalised(finer) < _penalised(best[1]):
            best = eqx.tree_at(lambda c: c.gain, candidate, first.gain), finer
    return best


def is_supported(found: Unknown | None) -> bool:
    """Whether a learned function is significant, and its gain exceeds what solver errors may cause."""
    return found is not None and found.gain > RULES.least_gain and found.p_value <= RULES.significance


def share_of(named: Model, found: Unknown, fit: Fit | None = None) -> float:
    """Share of a learned torque's mean square that further effects of a model reproduce.

    Near one, the learned torque is equal to those effects. Effects that cancel each other count separately: they are
    terms of a series.

    Args:
        named: the model with the effects.
        found: the learned term.
        fit: of that model, which supplies hidden states; where not given they are those after a long rest.
    """
    known = found.before.model.effects
    apart = [
        without(_done(eqx.tree_at(lambda m: m.effects, named, (*known, e)), found, fit), found.chosen.known)
        for e in named.effects
        if e.name not in {k.name for k in known}
    ]
    learned = without(_done(found.trial.model, found, found.trial.training), found.chosen.known)
    alike = float(sum(part @ learned for part in apart) ** 2)
    return alike / max(float(sum(part @ part for part in apart)) * float(learned @ learned), 1e-300)


def _done(model: Model, found: Unknown, fit: Fit | None) -> Float[np.ndarray, " instants"]:
    """Contribution of a model's further effects at the learned function's place: a torque, or an encoder error."""
    if not issubclass(found.chosen.form, LearnedReading):
        return _torques(model, found, fit)
    unit = np.asarray(unit_reading(model, found.chosen.form))
    bare = eqx.tree_at(lambda m: m.effects, model, found.before.model.effects)
    states = _own_motion(model, found, fit), jnp.asarray(found.states)
    own, others = (_readings(of, along, found.conditions) for of, along in zip((model, bare), states, strict=True))
    return np.asarray(own - others) @ unit / (unit @ unit)


def _readings(
    model: Model, states: Float[Array, "instants states"], conditions: Conditions
) -> Float[Array, "instants outputs"]:
    """Outputs of a model at instants without a load torque."""

    def read(state: Array, at: Conditions) -> Array:
        nothing = jnp.zeros(())
        return model.outputs(state, Inputs(nothing if at.T_m is None else at.T_m, nothing, at))

    return jax.vmap(read)(states, conditions)


def _torques(model: Model, found: Unknown, fit: Fit | None) -> Float[np.ndarray, " instants"]:
    """A model's further effects as a torque at the learned function's place, at the instants."""
    bare = eqx.tree_at(lambda m: m.effects, model, found.before.model.effects)
    zero = jnp.zeros(())
    silence = sampled(np.arange(2.0), np.zeros(2), hold="zero-order")

    count = found.states.shape[1]

    def added(state: Array, conditions: Conditions) -> Array:
        # Actuator effects count as well.
        steady = silence.affine(jnp.ones(()), zero if conditions.T_m is None else conditions.T_m)
        acting, before = (m.actuate(steady)(zero) for m in (model, bare))
        own = model.rates(state, acting, zero, conditions)
        return own[:count] - bare.rates(state[:count], before, zero, conditions)

    rates = np.asarray(jax.vmap(added)(_own_motion(model, found, fit), found.conditions))
    return np.sum(found.push * rates, axis=1) / np.sum(found.push**2, axis=1)


def _own_motion(model: Model, found: Unknown, fit: Fit | None) -> Float[Array, "instants states"]:
    """The states at the instants, with the fit's hidden states of effects that the preceding model lacks."""
    states, rest = jnp.asarray(found.states), jnp.asarray(model.rest())
    further = model.state_names[states.shape[1] :]
    if fit is None or not further:
        return jnp.concatenate([states, jnp.broadcast_to(rest[states.shape[1] :], (len(states), len(further)))], axis=1)
    followed = motion_states(fit).reshape(-1, len(fit.model.state_names))[found.instants]
    own = [fit.model.state_names.index(name) for name in further]
    return jnp.concatenate([states, jnp.asarray(followed[:, own])], axis=1)


def without(values: np.ndarray, known: Float[np.ndarray, "instants known"]) -> np.ndarray:
    """The part of values that is orthogonal to known functions."""
    return values - known @ np.linalg.lstsq(known, values, rcond=1e-10)[0]


def _refitted(before: Trial, candidate: Candidate, study: Study, c: np.ndarray) -> Trial | None:
    """The model with a candidate inside, from given coefficients."""
    name = candidate.effect.name
    effect = eqx.tree_at(lambda e: e.c, candidate.effect, tuple(map(as_scalar, c)))
    bare = before.model.without_effect(name) if name in {e.name for e in before.model.effects} else before.model
    patient = replace(study, setting=replace(study.setting, least_progress=_LEAST_PROGRESS))
    return challenge(bare.with_effects(effect), patient, before.hold, champion=before)


def _as_before(old: Candidate, trial: Trial, new: Candidate, seen: SearchContext) -> np.ndarray:
    """The coefficients with which one candidate approximates another one's fitted function best."""
    fitted = trial.model.effect(old.effect.name)
    assert isinstance(fitted, Learned)
    ours, theirs = (sizes_along(c, seen)[0].reshape(-1, len(c.effect.c))[seen.instants] for c in (new, old))
    return np.linalg.lstsq(ours, theirs @ np.array([float(c) for c in fitted.c]), rcond=1e-10)[0]


def _penalised(trial: Trial) -> float:
    """The training objective with a penalty per parameter (Schwarz 1978)."""
    samples = float(trial.training.problem.segments.count)
    return trial.training.objective + 0.5 * len(trial.training.free.paths) * np.log(samples) / samples
