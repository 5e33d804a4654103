"""Stepped-sine sweeps up or down: response, jumps and hysteresis."""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jaxtyping import Array, Bool, Float

from hdjax.dynamics import Model, State
from hdjax.fourier import harmonic_series
from hdjax.parameters import Scalar, as_scalar
from hdjax.response.marching import march, transient_and_steps


class SweptSine(eqx.Module):
    """Response to a sine whose frequency changes in steps without a restart.

    Attributes:
        omegas: forcing frequencies [rad/s], rising whatever the direction.
        amplitude: half of peak to peak of x at each; zero where escaped.
        fundamental: amplitude of the harmonic at omega in x at each; zero where escaped.
        states: state at the end of each step.
        escaped: whether the motion had diverged.
    """

    omegas: Float[Array, " n"]
    amplitude: Float[Array, " n"]
    fundamental: Float[Array, " n"]
    states: Float[Array, "n states"]
    escaped: Bool[Array, " n"]

    def jumps(self, ratio: float = 1.3) -> Bool[Array, " neighbours"]:
        """Neighbouring frequencies between which the amplitude changes by more than a ratio.

        A fold is a jump for any frequency spacing; a steep flank only for a coarse one.
        """
        low = jnp.minimum(self.amplitude[1:], self.amplitude[:-1])
        high = jnp.maximum(self.amplitude[1:], self.amplitude[:-1])
        return (high > ratio * low) & ~self.escaped[1:] & ~self.escaped[:-1]


def swept_sine(
    model: Model,
    amplitude: Scalar | float,
    omegas: Float[Array | np.ndarray, " n"],
    direction: Literal["up", "down"] = "up",
    *,
    initial_state: State | None = None,
    transient_periods: int | None = None,
    kept_periods: int = 4,
    steps_per_period: int | None = None,
) -> SweptSine:
    """Sweep `amplitude cos(phase)` in steps of frequency, up or down, and measure the response at each.

    Each frequency begins with phase zero, where the one before ended: the forcing is continuous.

    Args:
        model: a reduced model.
        amplitude: of the reduced drive's forcing.
        omegas: forcing frequencies [rad/s], rising.
        direction: `"up"` starts at the lowest frequency, `"down"` at the highest.
        initial_state: state at the start; at rest where not given.
        transient_periods: periods at each frequency before it is measured; where not given, as many as
            [`hdjax.response.poincare.poincare_section`][] takes at the highest frequency.
        kept_periods: periods that are measured.
        steps_per_period: Runge-Kutta steps for each forcing period; where not given, as many as it takes at the lowest.
    """
    omegas = jnp.asarray(omegas, dtype=float)
    options = transient_and_steps(model, omegas, 1, transient_periods, steps_per_period)
    state = model.rest() if initial_state is None else initial_state
    return _swept(model, as_scalar(amplitude), omegas, state, direction == "down", kept_periods, *options)


def hysteresis_band(up: SweptSine, down: SweptSine, *, tolerance: float = 0.05) -> tuple[float, float] | None:
    """Lowest and highest frequency [rad/s] at which two sweeps measured different motions; None where they agree.

    Args:
        up: a sweep over rising frequencies.
        down: a sweep over the same frequencies, falling.
        tolerance: relative difference of amplitudes that counts.
    """
    a, b = np.asarray(up.amplitude), np.asarray(down.amplitude)
    apart = np.asarray(up.omegas)[np.abs(a - b) > tolerance * np.maximum(a, b)]
    return (float(apart[0]), float(apart[-1])) if apart.size else None


@eqx.filter_jit
def _swept(model, amplitude, omegas, state, falling, kept, transient, steps) -> SweptSine:
    def at(state, omega):
        measured = march(model, harmonic_series(omega, amplitude), state, kept, transient, steps)
        return measured.states[-1], measured

    _, found = lax.scan(at, state, omegas, reverse=falling)
    return SweptSine(omegas, found.amplitude, found.fundamental, found.states[:, -1], found.escaped)
