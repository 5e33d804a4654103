"""Dry friction during one step of an explicit solver: sliding, stopping and sticking, or reversal.

The friction's mean over the step is computed at the step's start, with all other accelerations constant (compare the
time stepping of Moreau 1988, where it is determined by the step's end). A remaining rate that should be zero is removed
by the next step.
"""

import dataclasses
import functools
import math
from collections.abc import Iterable, Sequence

import jax
import jax.numpy as jnp
from jaxtyping import Array

from hdjax.dynamics import Model
from hdjax.effects import Conditions, DryFriction, Rubbing
from hdjax.elementary import exponential
from hdjax.where import where

# Width of a linear ramp from -1 to 1, in corner rates, with the same integral deviation from the sign as a hyperbolic
# tangent.
_RAMP = 2.0 * math.log(2.0)
# Number of sweeps over the signs of several rates, found one after the other.
_SWEEPS = 2


def over_step(
    model: Model, state: Sequence[Array], torque: Array, load_torque: Array, conditions: Conditions, step: Array
) -> dict[str, Rubbing] | None:
    """Dry friction of a drive during one step from a state; None without any.

    Args:
        model: the equations.
        state: at the step's start.
        torque: likewise, as for [`hdjax.dynamics.Model.rates`][].
        load_torque: likewise.
        conditions: likewise.
        step: its length [s].
    """
    dry = [effect for effect in model.effects if isinstance(effect, DryFriction)]
    if not dry:
        return None
    # A learned term on the motor may depend on the incoming torque.
    motion = model.motion(state, dataclasses.replace(conditions, T_m=torque))
    names = sorted({effect.opposes for effect in dry})
    against = [[effect for effect in dry if effect.opposes == name] for name in names]
    levels = [_total(effect.level(motion, model.drive) for effect in same) for same in against]
    corners = [functools.reduce(jnp.maximum, (effect.corner for effect in same)) for same in against]
    moved = [[step * model.mobility(name, other) for other in names] for name in names]
    reaches = [[move * level for move, level in zip(row, levels, strict=True)] for row in moved]

    own = [row[i] for i, row in enumerate(reaches)]

    def rubbing(signs: Sequence[Array], turns: Sequence[Array]) -> dict[str, Rubbing]:
        return {n: Rubbing(sign, turn) for n, sign, turn in zip(names, signs, turns, strict=True)}

    # Rates without friction: computed with some friction, which is then subtracted.
    some = rubbing([jnp.zeros_like(level) for level in levels], own)
    slopes = model.component_rates(state, torque, load_torque, dataclasses.replace(conditions, rubbing=some))
    rates, accelerations = jax.jvp(
        lambda *now: [getattr(model.motion(now, conditions), name) for name in names], tuple(state), tuple(slopes)
    )
    motion = dataclasses.replace(motion, rubbing=some)
    taken = [_total(effect.dry(motion, model.drive) for effect in same) for same in against]
    changes = [
        step * acceleration + _total(move * torque for move, torque in zip(row, taken, strict=True))
        for acceleration, row in zip(accelerations, moved, strict=True)
    ]
    # A rate that crosses zero within a fraction of a step, unresolved by the stages, also uses the mean. Friction with
    # a negative coefficient has none.
    turns = [where(r > 0.0, jnp.hypot(r, change), r) for r, change in zip(own, changes, strict=True)]
    return rubbing(mean_signs(rates, changes, reaches, corners), turns)


def mean_signs(
    rates: Sequence[Array],
    changes: Sequence[Array],
    reaches: Sequence[Sequence[Array]],
    corners: Sequence[Array],
) -> list[Array]:
    """Signs of rates against which there is dry friction, averaged over a step in which all else accelerates evenly.

    Args:
        rates: at the step's start [rad/s].
        changes: of each rate in the step, without the friction [rad/s].
        reaches: decrease of each rate (first index) by the friction against each rate (second index) in a step of
            forward sliding [rad/s].
        corners: rate over which each sign reverses [rad/s].
    """
    signs = [jnp.zeros_like(rate) for rate in rates]
    each = range(len(signs))
    for _ in range(1 if len(signs) == 1 else _SWEEPS):
        for i in each:
            lowered = sum((reaches[i][j] * signs[j] for j in each if j != i), jnp.zeros_like(rates[i]))
            signs[i] = _mean_sign(rates[i], changes[i] - lowered, reaches[i][i], corners[i])
    return signs


def _mean_sign(rate: Array, change: Array, reach: Array, corner: Array) -> Array:
    """The mean sign of one rate, from its end, which has a closed form for a linear ramp.

    In units of the step the rate obeys `rate' = change - reach clip(rate / ramp, -1, 1)`: a straight line outside the
    ramp, an exponential inside.
    """
    way = where(rate >= 0.0, 1.0, -1.0)
    rate, change = way * rate, way * change
    # Where the friction is negligible, so is its sign.
    reach = jnp.maximum(reach, 1e-9 * (rate + jnp.abs(change)) + 1e-15)
    ramp = jnp.hypot(_RAMP * corner, 1e-3 * reach)

    above, slowing = jnp.maximum(rate - ramp, 0.0), reach - change
    slows_down = (above > 0.0) & (above < slowing)
    time = 1.0 - where(slows_down, above / where(slows_down, slowing, 1.0), 0.0)
    goal, start = ramp * change / reach, jnp.minimum(rate, ramp)
    inside = goal + (start - goal) * exponential(-reach * time / ramp)

    side = where(change >= 0.0, 1.0, -1.0)
    overcome = jnp.abs(change) > (1.0 + 1e-9) * reach
    farther = where(overcome, (goal - start) / where(overcome, goal - side * ramp, 1.0), 1.0)
    remaining = time - jnp.log(farther) * ramp / reach
    beyond = side * ramp + (change - side * reach) * remaining

    end = where(overcome & (remaining > 0.0), beyond, inside)
    end = where((above > 0.0) & ~slows_down, rate - slowing, end)
    return way * (rate + change - end) / reach


def _total(terms: Iterable[Array]) -> Array:
    return functools.reduce(jnp.add, terms)
