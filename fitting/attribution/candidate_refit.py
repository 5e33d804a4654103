"""Refits with an effect from screening inside the equations, or with another hold of the torque."""

from dataclasses import replace

import numpy as np

from fitting.attribution.candidate_fit import Trial, challenge, completed, first_pass, lasting_share, trained
from fitting.attribution.rules import RULES
from fitting.attribution.screening import Lead
from fitting.attribution.study import Study
from fitting.estimation.estimate import Fit, Strategy
from fitting.uncertainty.identifiability import parameters_at_bounds
from fitting.uncertainty.one_side import contradicts, without_mesh_priors
from hdjax import Hold, Model
from hdjax.effects import Effect, InputDelay, Scales
from hdjax.parameters import ParameterInfo, own_parameters

# Iterations after which another hold of the torque must explain more: it changes the motion so little that few suffice.
_HOLD_STEPS = Strategy(3, reweigh=False, begin_anew_above=np.inf, retry_states=False)
# A shape that is so much smaller than a typical one has no influence, and no slope leads back. Assumed: it decides only
# whether one more start is tried.
_VANISHED = 1e-6


def try_lead(before: Trial, lead: Lead, study: Study, give_up_above: float) -> Trial | None:
    """Refit with the effect, from several starts: the first-order estimate, typical values, and values that replace a
    part of the model's parameters. None where the required objective is not reached.

    Args:
        before: the current model.
        lead: the effect.
        study: the data, and how they are cut.
        give_up_above: the training objective that it must reach.
    """
    return complete_refit(before, lead, begin(before, lead, study), study, give_up_above)


def begin(before: Trial, lead: Lead, study: Study, *, sibling: Trial | None = None) -> Fit:
    """The first pass of a refit.

    Args:
        before: the current model.
        lead: the effect.
        study: the data, and how they are cut.
        sibling: a refit with a form of its family or at its place, whose values are one more start.
    """
    model = before.model
    if contradicts(lead.effect, study.side):
        model = without_mesh_priors(model)
    known = model.parameters()
    moved = {}
    for path, change in lead.drive_changes.items():
        value, info = known[path]
        new = float(value) + change
        # First-order changes may overshoot; a positive parameter stays positive.
        moved[path] = max(new, 0.3 * float(value)) if info.positive else new
    swing = study.scales(before.training.stretches, model)
    starts = [
        _with_form(model.replace(moved), _with_positive_strengths(lead.effect)),
        *(_with_form(model, effect) for effect in lead.effect.typical(swing)),
        *(_with_form(model.replace(values), effect) for values, effect in lead.effect.imitated(model.drive, swing)),
    ]
    near = [before.training] * len(starts)
    if sibling is not None and (alike := _as_sibling(lead.effect, before, sibling)) is not None:
        starts, near = [*starts, alike], [*near, sibling.training]
    found = first_pass(starts, study, before.hold, near=near, champion=before, own_states=lead.own_states)
    if found.objective <= before.training.objective:
        return found
    # Without strength it is the current model: the first-order estimates lead away from that.
    start = _with_form(model, _with_positive_strengths(_without_strength(lead.effect)))
    again = first_pass([start], study, before.hold, champion=before, own_states=lead.own_states)
    return min(found, again, key=lambda fit: fit.objective)


def _as_sibling(effect: Effect, before: Trial, sibling: Trial) -> Model | None:
    """The sibling's model with another form, which takes over the parameters of the same name; None where the sibling
    replaces an effect of the current model."""
    *others, own = sibling.model.effects
    if [e.name for e in others] != [e.name for e in before.model.effects]:
        return None
    theirs = dict(own_parameters(own))
    effect = replace(effect, **{n: getattr(own, n) for n, _ in own_parameters(effect) if n in theirs})
    return _with_form(sibling.model.without_effect(own.name), _with_positive_strengths(effect))


def complete_refit(before: Trial, lead: Lead, begun: Fit, study: Study, give_up_above: float) -> Trial | None:
    """The completed refit after its first pass, or None where it is given up; arguments as in [`try_lead`][]."""
    trial = completed(begun, study, before.hold, champion=before, give_up_above=give_up_above)
    if trial is None:
        return None
    starts = _unstuck(trial.model, study.scales(before.training.stretches, before.model))
    if starts:
        near = [trial.training] * len(starts)
        again = first_pass(starts, study, before.hold, near=near, champion=before)
        trial = completed(again, study, before.hold, champion=trial) or trial
    return replace(trial, lasting=lasting_share(lead.effect, before, trial))


def _unstuck(model: Model, scales: Scales) -> list[Model]:
    """Models with the parameters of each effect that ended at a bound, and its vanished shapes, at the values of its
    proposals. The others stay as they are. A shape without limit ends in a simpler law, far from the optimum.
    """
    found = {}
    for effect in model.effects:
        names = {path.removeprefix(f"{effect.name}.") for path in parameters_at_bounds(model, effect.name)}
        shapes = [name for name, info in own_parameters(effect) if info.role == "shape" and info.positive]
        for proposal in type(effect).proposals(scales) if names or shapes else ():
            typical = {name: float(getattr(proposal, name)) for name in {*names, *shapes}}
            vanished = {n for n in shapes if 0.0 < float(getattr(effect, n)) < _VANISHED * typical[n]}
            values = {f"{effect.name}.{n}": typical[n] for n in names | vanished}
            if values and all(values.values()):
                found[tuple(values.items())] = model.replace(values)
    return list(found.values())


def try_hold(before: Trial, hold: Hold, study: Study) -> Trial | None:
    """Refit with another hold. The motion hardly changes, so that a few steps from the current fit show whether more
    are worthwhile.

    Args:
        before: the current model.
        hold: what the torque does between samples.
        study: the data, and how they are cut.
    """
    near = trained(_as_late(before, hold), study, hold, before.training, _HOLD_STEPS)
    if near.objective > before.training.objective + RULES.least_gain:
        return None
    return challenge(near.model, study, hold, champion=before)


def under_best_hold(current: Trial, study: Study) -> Trial:
    """The current model under the hold that predicts selection data best."""
    trials = [try_hold(current, hold, study) for hold in study.data if hold != current.hold]
    best = max((t for t in trials if t is not None), key=lambda t: t.gain_over(current), default=current)
    return best if best.gain_over(current) > RULES.least_gain else current


def _as_late(before: Trial, hold: Hold) -> Model:
    """The current model with its delay changed so that the torque is as late as before on average: a zero-order hold is
    half a sample later than any other."""
    later = 0.5 * ((before.hold == "zero-order") - (hold == "zero-order"))
    step = before.training.stretches[0].experiment.time_step
    delays = [e for e in before.model.effects if isinstance(e, InputDelay)]
    return before.model.replace({f"{e.name}.delay": float(e.delay) + later * step for e in delays})


def _with_form(model: Model, effect: Effect) -> Model:
    """The model with an effect, which takes over the strengths of those that it replaces."""
    for other in (e for e in model.effects if effect.replaces(e)):
        shared = _strengths(effect).keys() & _strengths(other).keys()
        effect = replace(effect, **{n: getattr(effect, n) + getattr(other, n) for n in shared})
        model = model.without_effect(other.name)
    return model.with_effects(effect)


def _without_strength(effect: Effect) -> Effect:
    return replace(effect, **dict.fromkeys(_strengths(effect), 0.0))


def _with_positive_strengths(effect: Effect) -> Effect:
    """The effect with every positive strength above zero, so that its logarithm exists."""
    positive = [name for name, info in _strengths(effect).items() if info.positive]
    return replace(effect, **{name: max(float(getattr(effect, name)), 1e-6) for name in positive})


def _strengths(effect: Effect) -> dict[str, ParameterInfo]:
    return {name: info for name, info in own_parameters(effect) if info.role == "strength"}
