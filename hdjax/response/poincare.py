"""Steady forced motions at multiples of the forcing period: Poincare sections and bifurcation diagrams."""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hdjax.dynamics import Model, State
from hdjax.fourier import FourierSeries
from hdjax.response.marching import march, transient_and_steps


class PoincareSection(eqx.Module):
    """States at multiples of the forcing period, after a transient. Every field has a leading axis of lanes.

    Attributes:
        omega: forcing frequency [rad/s].
        states: the states, by period; names in `Model.state_names`.
        amplitude: half of peak to peak of x over the kept periods; zero where escaped.
        fundamental: amplitude of the harmonic at omega in x over the kept periods; zero where escaped.
        escaped: whether the motion grew beyond all numbers.
    """

    omega: Float[Array, "*lanes"]
    states: Float[Array, "*lanes kept states"]
    amplitude: Float[Array, "*lanes"]
    fundamental: Float[Array, "*lanes"]
    escaped: Bool[Array, "*lanes"]

    @property
    def lengths(self) -> Float[Array, "*lanes kept 2"]:
        """x and v / omega, the part of a state that is tested for repetition [rad]."""
        return jnp.stack([self.states[..., 0], self.states[..., 1] / self.omega[..., None]], axis=-1)


def poincare_section(
    model: Model,
    forcing: FourierSeries,
    initial_states: Float[Array, "lanes states"],
    *,
    transient_periods: int | None = None,
    kept_periods: int = 12,
    steps_per_period: int | None = None,
) -> PoincareSection:
    """Settled motions from many starts, at multiples of the forcing period.

    Args:
        model: a reduced model; a load torque is part of its forcing, see [`hdjax.Drive.error_forcing`][].
        forcing: the reduced drive's forcing.
        initial_states: states at t = 0, by row.
        transient_periods: periods before the section; where not given, until `exp(-mu t / 2)` has fallen to 1e-6.
        kept_periods: periods in the section.
        steps_per_period: Runge-Kutta steps for each forcing period; where not given, 64 for each turn of the fastest
            of natural frequency and forcing harmonics.
    """
    options = transient_and_steps(model, forcing.omega, forcing.harmonics, transient_periods, steps_per_period)
    return _sections(model, forcing, initial_states, kept_periods, *options)


def bifurcation_diagram(
    model: Model,
    forcings: FourierSeries,
    initial_state: State | None = None,
    *,
    transient_periods: int | None = None,
    kept_periods: int = 12,
    steps_per_period: int | None = None,
) -> PoincareSection:
    """Poincare sections over a parameter of the forcing, each from the same start.

    Args:
        model: a reduced model.
        forcings: forcings with a leading axis, for instance
            `jax.vmap(lambda A: harmonic_series(omega, A))(amplitudes)`; its frequencies may differ.
        initial_state: state at t = 0; at rest where not given.
        transient_periods: see [`poincare_section`][].
        kept_periods: see [`poincare_section`][].
        steps_per_period: see [`poincare_section`][].
    """
    options = transient_and_steps(model, forcings.omega, forcings.harmonics, transient_periods, steps_per_period)
    state = model.rest() if initial_state is None else initial_state
    states = jnp.tile(state, (forcings.omega.size, 1))
    return _sections(model, forcings, states, kept_periods, *options)


@eqx.filter_jit
def period_of(section: PoincareSection, *, max_period: int = 6, tolerance: float = 1e-3) -> Int[Array, "*lanes"]:
    """Number of forcing periods after which each motion repeats; 0 for chaos, an escape, or a motion that has not
    settled.

    Args:
        section: of more than `max_period` periods.
        max_period: the longest one to consider.
        tolerance: how close a repetition must come, relative to the amplitude (for v, to omega times that). A transient
            that shrinks by less than this in a repetition counts as settled.
    """
    kept = section.states.shape[-2]
    if kept <= max_period:
        raise ValueError(f"`section` must keep more than {max_period} periods, but keeps {kept}")
    points = section.lengths
    close = (tolerance * section.amplitude)[..., None, None]
    found = jnp.zeros(section.omega.shape, dtype=int)
    for p in range(max_period, 0, -1):
        repeats = jnp.all(jnp.abs(points[..., p:, :] - points[..., :-p, :]) <= close, axis=(-2, -1))
        found = jnp.where(repeats & ~section.escaped, p, found)
    return found


@eqx.filter_jit
def _sections(model, forcing, states, kept, transient, steps) -> PoincareSection:
    axis = 0 if forcing.omega.ndim else None
    lanes = eqx.filter_vmap(march, in_axes=(None, axis, 0, None, None, None))
    found = lanes(model, forcing, states, kept, transient, steps)
    omega = jnp.broadcast_to(forcing.omega, found.escaped.shape)
    return PoincareSection(omega, found.states, found.amplitude, found.fundamental, found.escaped)
