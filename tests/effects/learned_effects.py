"""Learned effects of given functions, and the rates of a model that holds them."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from hdjax.effects import Conditions
from hdjax.effects.learned import LearnedMeshTorque, LearnedPeriodic, LearnedTorque
from hdjax.effects.learned_axes import UNITS, Axis, LinearAxis, PeriodicAxis, SignAxis


@eqx.filter_jit
def rates(model, state):
    return model.rates(state, jnp.zeros(()), jnp.zeros(()), Conditions(jnp.asarray(0.2), jnp.asarray(0.4)))


@eqx.filter_jit
def slopes(model, state):
    return jax.jacfwd(lambda s: rates(model, s))(state)


def learned_effect(form, *axes: Axis, c=None):
    count = int(np.prod([a.count for a in axes])) if axes else 1
    return form(axes=axes, mixing=jnp.eye(count), c=np.zeros(count) if c is None else c)


def jumping_torque(
    form: type[LearnedTorque], *, level: float, corner: float, slope: float = 0.0, on: Axis | None = None
):
    """A torque that opposes the rate at its place by a level and in proportion to it.

    `on` has functions of one further variable, all of equal weight.
    """
    rate = next(variable for variable in UNITS if form.may_jump_with(variable))
    against = 1.0 if form is LearnedMeshTorque else -1.0
    axes = SignAxis(rate, corner=corner, beside=LinearAxis(rate)), *([] if on is None else [on])
    mixing = np.kron(np.eye(2), np.ones((1 if on is None else on.count, 1)))
    return form.made_of(axes, mixing, [against * level, against * slope])


def periodic_torque(form: type[LearnedTorque], at: float, c: list[float]) -> LearnedPeriodic:
    """A torque whose coefficients are a constant, a cosine and a sine of time."""
    effect = form.made_of((PeriodicAxis("time", at, 1),), np.eye(3), c)
    assert isinstance(effect, LearnedPeriodic)
    return effect
