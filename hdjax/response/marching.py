"""A forced motion in a fixed number of classical Runge-Kutta steps for each forcing period.

Every start is one lane of one program. An oscillation that takes s steps for a turn loses `(2 pi)^5 / (120 s^4)` rad of
phase in it: 5e-6 rad at 64 steps, which is the default for the fastest of natural frequency and forcing harmonics. A
motion whose amplitude makes it faster than that needs more. A motion that diverges has `escaped`; it keeps its last
finite state. For alpha > 0, which bounds every motion, an escape means that the steps are too large.
"""

import math
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Bool, Float

from hdjax.dynamics import Model, State
from hdjax.effects import ActuatorEffect
from hdjax.fourier import FourierSeries
from hdjax.response.shooting import require_reduced

STEPS = 64
"""Steps for a turn of the fastest oscillation."""
SETTLED = 1e-6
"""Remaining share of a disturbance after the default transient."""


class Measured(eqx.Module):
    """A motion's last periods.

    Attributes:
        states: at the end of each period.
        amplitude: half of peak to peak of x over them; zero where escaped.
        fundamental: amplitude of the harmonic at omega in x over them; zero where escaped.
        escaped: whether the motion diverged.
    """

    states: Float[Array, "kept states"]
    amplitude: Float[Array, ""]
    fundamental: Float[Array, ""]
    escaped: Bool[Array, ""]


def transient_and_steps(
    model: Model, omegas: Array, harmonics: int, transient_periods: int | None, steps_per_period: int | None
) -> tuple[int, int]:
    """Periods of the transient and steps for each period, by default from the drive's own rates."""
    require_reduced(model)
    actuators = [effect.name for effect in model.effects if isinstance(effect, ActuatorEffect)]
    if actuators:
        raise ValueError(f"`model` must be without effects on a sampled signal, but has {actuators}")

    def known(value: Array, name: str) -> np.ndarray:
        if isinstance(value, Tracer):
            raise ValueError(f"`{name}` must be given where the drive or the frequency is traced")
        return np.asarray(value)

    if transient_periods is None:
        mu = float(known(model.drive.mu, "transient_periods"))
        if mu <= 0.0:
            raise ValueError(f"`transient_periods` must be given where mu is not positive, but mu is {mu}")
        fastest = float(known(omegas, "transient_periods").max())
        transient_periods = math.ceil(-2.0 * math.log(SETTLED) / mu * fastest / (2.0 * math.pi))
    if steps_per_period is None:
        slowest = float(known(omegas, "steps_per_period").min())
        turns = float(known(model.drive.omega_0, "steps_per_period")) / slowest
        # Whole multiples, so that near frequencies share a program.
        steps_per_period = STEPS * math.ceil(max(turns, harmonics))
    return transient_periods, steps_per_period


def march(model: Model, forcing: FourierSeries, state: State, kept: int, transient: int, steps: int) -> Measured:
    """March through the transient, then measure the kept periods.

    Args:
        model: a reduced model.
        forcing: the reduced drive's forcing.
        state: state at t = 0.
        kept: periods to measure.
        transient: periods before.
        steps: for each period.
    """
    # The state travels as separate numbers: each is one row of lanes.
    h = 2.0 * jnp.pi / (forcing.omega * steps)
    values = forcing.values(2 * steps)
    start, middle = values[::2], values[1::2]
    torques = (start, middle, jnp.roll(start, -1))
    phase = 2.0 * jnp.pi / steps * jnp.arange(steps, dtype=float)
    waves = (jnp.cos(phase), jnp.sin(phase))

    def settle(state, _):
        end, _ = lax.scan(lambda y, u: (_step(model, h, y, u)[0], None), state, torques)
        return _held(end, state)[0], None

    def measure(state, _):
        nothing = jnp.zeros_like(h)
        carry = (state, nothing + jnp.inf, nothing - jnp.inf, nothing, nothing)
        (end, *measured), _ = lax.scan(lambda c, u: (_measured_step(model, h, c, u), None), carry, (torques, waves))
        end, finite = _held(end, state)
        return end, (end, measured, finite)

    settled, _ = lax.scan(settle, tuple(state), length=transient)
    _, (points, (low, high, cosine, sine), finite) = lax.scan(measure, settled, length=kept)
    escaped = ~finite[-1]
    amplitude = 0.5 * (jnp.max(high) - jnp.min(low))
    fundamental = 2.0 / steps * jnp.hypot(jnp.mean(cosine), jnp.mean(sine))
    return Measured(
        states=jnp.stack(points, axis=-1),
        amplitude=jnp.where(escaped, 0.0, amplitude),
        fundamental=jnp.where(escaped, 0.0, fundamental),
        escaped=escaped,
    )


def _held(end: tuple[Array, ...], start: tuple[Array, ...]) -> tuple[tuple[Array, ...], Array]:
    """The end of a period, or its start where the motion escaped; from there it escapes in each further period."""
    finite = jnp.all(jnp.isfinite(jnp.stack(end)))
    return tuple(jnp.where(finite, e, s) for e, s in zip(end, start, strict=True)), finite


def _step(
    model: Model, h: Array, state: tuple[Array, ...], torques: tuple[Array, ...]
) -> tuple[tuple[Array, ...], Any]:
    """A classical Runge-Kutta step, and the rates at its start."""
    start, middle, end = torques
    load = jnp.zeros_like(h)
    k1 = model.component_rates(state, start, load)
    k2 = model.component_rates(_moved(state, h / 2, k1), middle, load)
    k3 = model.component_rates(_moved(state, h / 2, k2), middle, load)
    k4 = model.component_rates(_moved(state, h, k3), end, load)
    return _moved(state, h / 6, [a + 2.0 * (b + c) + d for a, b, c, d in zip(k1, k2, k3, k4, strict=True)]), k1


def _measured_step(model: Model, h: Array, carry: Any, inputs: Any) -> Any:
    """A step that keeps the extremes of x and its harmonic at omega."""
    state, low, high, cosine, sine = carry
    torques, (wave_cosine, wave_sine) = inputs
    end, rates = _step(model, h, state, torques)
    x, v, a = state[0], state[1], rates[1]
    # The extreme of the parabola through this point, where it lies within a step.
    near = jnp.abs(v) <= jnp.abs(a) * h
    extreme = x - jnp.where(near, v**2 / jnp.where(near & (a != 0.0), 2.0 * a, 1.0), 0.0)
    return end, jnp.minimum(low, extreme), jnp.maximum(high, extreme), cosine + x * wave_cosine, sine + x * wave_sine


def _moved(state: tuple[Array, ...], h: Array, rates: list[Array]) -> tuple[Array, ...]:
    return tuple(y + h * k for y, k in zip(state, rates, strict=True))
