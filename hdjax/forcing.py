"""Torques and forcings as functions of time."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PRNGKeyArray

from hdjax.parameters import as_scalar


class Harmonic(eqx.Module):
    """`amplitude cos(omega t + phase) + offset`.

    Attributes:
        amplitude: peak value [N m, or the forcing's unit].
        omega: angular frequency [rad/s].
        phase: phase at t = 0 [rad].
        offset: mean value.
    """

    amplitude: Array = eqx.field(converter=as_scalar)
    omega: Array = eqx.field(converter=as_scalar)
    phase: Array = eqx.field(converter=as_scalar, default=0.0)
    offset: Array = eqx.field(converter=as_scalar, default=0.0)

    def __call__(self, t: Array) -> Array:
        return self.offset + self.amplitude * jnp.cos(self.omega * t + self.phase)


class MultiHarmonic(eqx.Module):
    """`sum_n amplitudes[n] cos(omegas[n] t + phases[n])`, any frequencies."""

    amplitudes: Float[Array, " n"]
    omegas: Float[Array, " n"]
    phases: Float[Array, " n"]

    def __call__(self, t: Array) -> Array:
        return jnp.sum(self.amplitudes * jnp.cos(self.omegas * t + self.phases))


class Chirp(eqx.Module):
    """A sine whose frequency runs linearly from `omega_start` to `omega_end` over `duration`.

    Attributes:
        amplitude: peak value.
        omega_start: angular frequency at t = 0 [rad/s].
        omega_end: angular frequency at t = duration [rad/s].
        duration: sweep time [s].
    """

    amplitude: Array = eqx.field(converter=as_scalar)
    omega_start: Array = eqx.field(converter=as_scalar)
    omega_end: Array = eqx.field(converter=as_scalar)
    duration: Array = eqx.field(converter=as_scalar)

    def __call__(self, t: Array) -> Array:
        rate = (self.omega_end - self.omega_start) / self.duration
        return self.amplitude * jnp.sin((self.omega_start + 0.5 * rate * t) * t)


def random_phase_multisine(
    *, rms: float, omega_min: float, omega_max: float, period: float, key: PRNGKeyArray
) -> MultiHarmonic:
    """A periodic signal with a flat spectrum between two frequencies and random phases.

    Args:
        rms: root mean square of the signal.
        omega_min: lowest angular frequency [rad/s].
        omega_max: highest angular frequency [rad/s].
        period: period [s]; the lines are multiples of `2 pi / period`.
        key: source of the phases.

    Raises:
        ValueError: no line is between the two frequencies, or the period is not above zero.
    """
    if not period > 0.0:
        raise ValueError(f"`period` must be above zero, but is {period} s")
    line = 2 * jnp.pi / period
    # The edges are lines of the band, to rounding.
    first, last = int(jnp.ceil(omega_min / line - 1e-9)), int(jnp.floor(omega_max / line + 1e-9))
    if last < max(first, 1):
        raise ValueError(
            f"`period` must be long enough for a line between {omega_min} and {omega_max} rad/s, but is {period} s"
        )
    n = jnp.arange(max(first, 1), last + 1, dtype=float)
    phases = jax.random.uniform(key, n.shape, minval=0.0, maxval=2 * jnp.pi)
    amplitudes = jnp.full(n.shape, rms * jnp.sqrt(2.0 / n.size))
    return MultiHarmonic(amplitudes, line * n, phases)
