"""What is missing where the catalogue does not say: learned inside the equations, as a function of what matters.

Which place and which variables is decided on training data alone ([`fitting.discrepancy.variable_selection`][]); the
held-out stretches then judge one learned function, like any other effect. What no function of the present motion
explains may have a memory ([`fitting.discrepancy.dynamic_laws`][]).
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
from fitting.discrepancy.dynamic_laws import Remembered, Remembering, remembering
from fitting.discrepancy.variable_selection import (
    NEARLY,
    Candidate,
    LearnedLook,
    candidates,
    learned_look,
    looked_again,
    sizes_along,
)
from fitting.estimation.base_fit import leaves_white_noise
from fitting.estimation.estimate import Fit
from fitting.first_order.linearised_fit import motion_states
from fitting.first_order.motion import place_of, unit_reading
from fitting.first_order.surrogates import chance_of_gain
from hdjax import Model, sampled
from hdjax.effects import Conditions, Motion
from hdjax.effects.learned import Learned, LearnedReading
from hdjax.parameters import as_scalar

# What explains less than this share of the error, to first order, is not refitted: of what the base model leaves,
# and beside effects that have a name already.
_LEAST_SHARE, _LEAST_SHARE_BESIDE = 0.005, 0.02
# Steps that together take less than this share off the sum of squares are no better than one more coefficient.
_LEAST_PROGRESS = 2.0 * RULES.coefficient


class Unknown(eqx.Module):
    """What was learned and the data support: a function of the motion, or a torque with a memory of it.

    Attributes:
        before: the model without it.
        trial: the model with it.
        candidates: all places and variables, best first by the first look.
        chosen: the one that was taken.
        instants: of the training motion that stand for the density of the data, counted along its segments.
        states: of the model without it, there.
        conditions: time and temperature there.
        push: what a unit of torque adds to their rates: at its place, or in the mesh for an error of an angle.
        gain: decrease of the held-out objective.
        p_value: chance of such a gain where nothing is missing.
    """

    before: Trial
    trial: Trial
    candidates: tuple[Candidate | Remembered, ...]
    chosen: Candidate | Remembered
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
    """Learn what a model lacks.

    Args:
        before: the model.
        study: the data, and how they are cut.

    Returns:
        What was learned; None where nothing brings the training error down.
    """
    study.progress("looking for what the missing torque depends on")
    seen = learned_look(before.training)
    least = _LEAST_SHARE_BESIDE if before.model.effects else _LEAST_SHARE
    found = sorted((c for c in candidates(seen) if c.gain > least), key=lambda c: -c.gain)
    alone, pairs = ([c for c in found if (len(c.variables) > 1) == several] for several in (False, True))

    best = _likeliest(alone, None, before, study)
    memory: Remembering | None = None
    remembered: tuple[Remembered, Trial] | None = None
    if not _is_enough(best):
        memory = remembering(before, seen, study, least=least)
        # A law with memory has fewer parameters than a function of two variables.
        if memory.candidates and memory.candidates[0].gain > max((c.gain for c in alone), default=0.0):
            remembered = memory.put_inside(before, study, rival=best)
    if not _is_enough(remembered):
        if not _is_enough(best):
            worth = [c for c in pairs if best is None or c.gain >= best[0].gain + RULES.variable]
            best = _likeliest(worth, best, before, study)
        best = None if best is None else _refined(best, study)
        if memory is not None and remembered is None and not _is_enough(best):
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
    """[`learn`][], None also where the data do not support what was learned."""
    found = learn(before, study)
    return found if is_supported(found) else None


def _likeliest(
    found: Sequence[Candidate], best: tuple[Candidate, Trial] | None, before: Trial, study: Study
) -> tuple[Candidate, Trial] | None:
    """The best of the likeliest candidates and of what was the best so far, inside the equations."""
    for candidate in _rivals(found):
        study.progress(f"learning a function of {' and '.join(candidate.variables)}")
        # A whole step to what the first look found may leave the present model, where it is nothing, far behind.
        trial = _refitted(before, candidate, study, np.zeros(len(candidate.effect.c)))
        if trial is not None and _penalised(trial) < _penalised(before if best is None else best[1]):
            best = candidate, trial
    return best


def _is_enough(found: tuple[Candidate | Remembered, Trial] | None) -> bool:
    return found is not None and leaves_white_noise(found[1].training)


def _betters(trial: Trial, other: Trial, before: Trial) -> bool:
    """Whether a model explains more than another one: of the training data, with what its parameters cost, and of
    those it has not seen, where what it remembers has to last."""
    return _penalised(trial) < _penalised(other) and trial.gain_over(before) > other.gain_over(before)


def _refined(best: tuple[Candidate, Trial], study: Study) -> tuple[Candidate, Trial]:
    """The same variables with those functions of them, and as many, that a second look calls for, along the motion that
    the first fit found: the first look is but first order."""
    first, trial = best
    seen = learned_look(trial.training)
    for candidate in looked_again(first, seen):
        study.progress("learning its shape more closely")
        finer = _refitted(trial, candidate, study, _as_before(first, trial, candidate, seen))
        if finer is not None and _penalised(finer) < _penalised(best[1]):
            best = eqx.tree_at(lambda c: c.gain, candidate, first.gain), finer
    return best


def is_supported(found: Unknown | None) -> bool:
    """Whether a learned function is more than chance and more than an imperfection of the solver."""
    return found is not None and found.gain > RULES.least_gain and found.p_value <= RULES.significance


def share_of(named: Model, found: Unknown, fit: Fit | None = None) -> float:
    """Share of a learned torque's mean square that the effects of a model, beyond those it was learned with, make up.

    Near one the learned torque, which was free to be anything, has come out as those effects. Effects that cancel each
    other count with what they are apart: they are terms of a series.

    Args:
        named: the model with the effects.
        found: what was learned.
        fit: of that model, whose effects' own states count; where not given they are as after a long rest.
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
    """What the effects of a model, beyond those a function was learned with, do where the function acts: as a torque
    there, or to what an encoder reads."""
    if not issubclass(found.chosen.form, LearnedReading):
        return _torques(model, found, fit)
    unit = np.asarray(unit_reading(model, found.chosen.form))
    bare = eqx.tree_at(lambda m: m.effects, model, found.before.model.effects)
    states = jnp.asarray(found.states)
    added = np.asarray(jax.vmap(model.outputs)(states) - jax.vmap(bare.outputs)(states))
    return added @ unit / (unit @ unit)


def _torques(model: Model, found: Unknown, fit: Fit | None) -> Float[np.ndarray, " instants"]:
    """What the effects of a model, beyond those a function was learned with, are as a torque at the function's place,
    at the instants."""
    bare = eqx.tree_at(lambda m: m.effects, model, found.before.model.effects)
    zero = jnp.zeros(())
    silence = sampled(np.arange(2.0), np.zeros(2), hold="zero-order")

    count = found.states.shape[1]

    def added(state: Array, conditions: Conditions) -> Array:
        # An error of the torque is an effect as well.
        steady = silence.affine(jnp.ones(()), zero if conditions.T_m is None else conditions.T_m)
        acting, before = (m.actuate(steady)(zero) for m in (model, bare))
        own = model.rates(state, acting, zero, conditions)
        return own[:count] - bare.rates(state[:count], before, zero, conditions)

    rates = np.asarray(jax.vmap(added)(_own_motion(model, found, fit), found.conditions))
    return np.sum(found.push * rates, axis=1) / np.sum(found.push**2, axis=1)


def _own_motion(model: Model, found: Unknown, fit: Fit | None) -> Float[Array, "instants states"]:
    """The states at the instants, with those of effects that the model before has not as a fit has them."""
    states, rest = jnp.asarray(found.states), jnp.asarray(model.rest())
    further = model.state_names[states.shape[1] :]
    if fit is None or not further:
        return jnp.concatenate([states, jnp.broadcast_to(rest[states.shape[1] :], (len(states), len(further)))], axis=1)
    followed = motion_states(fit).reshape(-1, len(fit.model.state_names))[found.instants]
    own = [fit.model.state_names.index(name) for name in further]
    return jnp.concatenate([states, jnp.asarray(followed[:, own])], axis=1)


def without(values: np.ndarray, known: Float[np.ndarray, "instants known"]) -> np.ndarray:
    """What of values is no combination of known functions."""
    return values - known @ np.linalg.lstsq(known, values, rcond=1e-10)[0]


def _rivals(found: Sequence[Candidate]) -> list[Candidate]:
    """The candidates, best first, that are worth a refit: the best one, and another one that gains nearly as much."""
    return [c for c in found[:2] if c.gain > NEARLY * found[0].gain]


def _refitted(before: Trial, candidate: Candidate, study: Study, c: np.ndarray) -> Trial | None:
    """The model with a candidate inside, from given coefficients."""
    name = candidate.effect.name
    effect = eqx.tree_at(lambda e: e.c, candidate.effect, tuple(map(as_scalar, c)))
    bare = before.model.without_effect(name) if name in {e.name for e in before.model.effects} else before.model
    patient = replace(study, setting=replace(study.setting, least_progress=_LEAST_PROGRESS))
    return challenge([bare.with_effects(effect)], patient, before.hold, champion=before)


def _as_before(old: Candidate, trial: Trial, new: Candidate, seen: LearnedLook) -> np.ndarray:
    """The coefficients at which one candidate comes closest to what another one has come to in a trial."""
    fitted = trial.model.effect(old.effect.name)
    assert isinstance(fitted, Learned)
    ours, theirs = (sizes_along(c, seen)[0].reshape(-1, len(c.effect.c))[seen.instants] for c in (new, old))
    return np.linalg.lstsq(ours, theirs @ np.array([float(c) for c in fitted.c]), rcond=1e-10)[0]


def _penalised(trial: Trial) -> float:
    """The training objective, with what each parameter would gain on noise (Schwarz 1978)."""
    samples = float(trial.training.problem.segments.count)
    return trial.training.objective + 0.5 * len(trial.training.free.paths) * np.log(samples) / samples
