"""A lead of the first look, or another hold of the torque, put inside the equations and refitted."""

from dataclasses import replace

import equinox as eqx
import numpy as np

from fitting.attribution.candidate_fit import Trial, challenge, first_pass, lasting_share, to_the_end, trained
from fitting.attribution.rules import RULES
from fitting.attribution.screening import Lead
from fitting.attribution.study import Study
from fitting.estimation.estimate import Fit, Strategy
from fitting.estimation.scales import scales
from hdjax import Hold
from hdjax.effects import Effect
from hdjax.parameters import as_scalar, own_parameters

# Iterations after which another hold of the torque must explain more: it moves the motion so little that the first
# one finds the way.
_HOLD_STEPS = Strategy(3, reweigh=False, begin_anew_above=np.inf, retry_states=False)


def try_lead(before: Trial, lead: Lead, study: Study, give_up_above: float) -> Trial | None:
    """Refit with the effect, from the first-order estimate, from what is typical, and from what the model's own
    parameters may stand for; None where it does not come as far as it is to.

    Args:
        before: the current model.
        lead: what is put inside it.
        study: the data, and how they are cut.
        give_up_above: the training objective that it must reach.
    """
    return go_on(before, lead, begin(before, lead, study), study, give_up_above)


def begin(before: Trial, lead: Lead, study: Study) -> Fit:
    """The first pass of such a refit; arguments as in [`try_lead`][]."""
    model = before.model
    known = model.parameters()
    moved = {}
    for path, change in lead.drive_changes.items():
        value, info = known[path]
        new = float(value) + change
        # First-order changes may overshoot; a positive parameter stays positive.
        moved[path] = max(new, 0.3 * float(value)) if info.positive else new
    first = model.replace(moved).with_effects(_with_positive_strengths(lead.effect))
    swing = scales(before.training.stretches, model)
    starts = [
        first,
        *(model.with_effects(effect) for effect in lead.effect.typical(swing)),
        *(model.replace(values).with_effects(effect) for values, effect in lead.effect.imitated(model.drive, swing)),
    ]
    return first_pass(starts, study, before.hold, champion=before, own_states=lead.own_states)


def go_on(before: Trial, lead: Lead, begun: Fit, study: Study, give_up_above: float) -> Trial | None:
    """The rest of it, as far as it is worth it, from where its first pass has begun; arguments as in [`try_lead`][]."""
    trial = to_the_end(begun, study, before.hold, champion=before, give_up_above=give_up_above)
    return None if trial is None else replace(trial, lasting=lasting_share(lead.effect, before, trial))


def try_hold(before: Trial, hold: Hold, study: Study) -> Trial | None:
    """Refit under another hold. It acts on the same motion, so that a few steps from the present fit tell whether it
    is worth more.

    Args:
        before: the current model.
        hold: what the torque does between samples.
        study: the data, and how they are cut.
    """
    near = trained(before.model, study, hold, before.training, _HOLD_STEPS)
    if near.objective > before.training.objective + RULES.least_gain:
        return None
    return challenge([near.model], study, hold, champion=before)


def _with_positive_strengths(effect: Effect) -> Effect:
    """The effect with every positive strength off zero, where its logarithm can move."""
    for name, info in own_parameters(effect):
        if info.role == "strength" and info.positive:
            value = float(getattr(effect, name))
            effect = eqx.tree_at(lambda e, n=name: getattr(e, n), effect, as_scalar(max(value, 1e-6)))
    return effect
