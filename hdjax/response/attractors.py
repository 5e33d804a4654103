"""What a forced drive settles to, from many starts at once: Poincare sections, basins, bifurcations, swept sines.

All of it marches in a fixed number of classical Runge-Kutta steps for each forcing period, so that every start is one
lane of one program. An oscillation that takes s steps for a turn loses `(2 pi)^5 / (120 s^4)` rad of phase in it:
5e-6 rad at 64 steps, which is the default for the fastest of natural frequency and forcing harmonics. A motion whose
amplitude makes it faster than that needs more. A motion that grows beyond all numbers has `escaped`; it keeps the last
finite state of its section. For alpha > 0, which bounds every motion, an escape says that the steps are too large.
"""

import math
from typing import Any, Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int

from hdjax.dynamics import Model, State
from hdjax.effects import ActuatorEffect
from hdjax.fourier import FourierSeries, harmonic_series
from hdjax.parameters import Scalar, as_scalar
from hdjax.response.shooting import require_reduced

STEPS = 64
"""Steps for a turn of the fastest oscillation."""
SETTLED = 1e-6
"""What is left of a disturbance after the default transient."""
ESCAPED, UNSETTLED = -1, -2
"""Labels of starts that reach no periodic motion: beyond all numbers, and chaotic or not settled."""


class PoincareSection(eqx.Module):
    """States at multiples of the forcing period, after a transient. Every field has an axis of lanes in front.

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


def poincare_section(
    model: Model,
    forcing: FourierSeries,
    initial_states: Float[Array, "lanes states"],
    *,
    transient_periods: int | None = None,
    kept_periods: int = 12,
    steps_per_period: int | None = None,
) -> PoincareSection:
    """What motions from many starts have settled to, at multiples of the forcing period.

    Args:
        model: a reduced model; a load torque is part of its forcing, see [`hdjax.Drive.error_forcing`][].
        forcing: the reduced drive's forcing.
        initial_states: states at t = 0, by row.
        transient_periods: periods before the section; where not given, what `exp(-mu t / 2)` takes to fall to 1e-6.
        kept_periods: periods in the section.
        steps_per_period: Runge-Kutta steps for each forcing period; where not given, 64 for each turn of the fastest
            of natural frequency and forcing harmonics.
    """
    options = _options(model, forcing.omega, forcing.harmonics, transient_periods, steps_per_period)
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
    options = _options(model, forcings.omega, forcings.harmonics, transient_periods, steps_per_period)
    state = model.rest() if initial_state is None else initial_state
    states = jnp.tile(state, (forcings.omega.size, 1))
    return _sections(model, forcings, states, kept_periods, *options)


@eqx.filter_jit
def period_of(section: PoincareSection, *, max_period: int = 6, tolerance: float = 1e-3) -> Int[Array, "*lanes"]:
    """After how many forcing periods each motion repeats; 0 for chaos, an escape, or a motion that has not settled.

    Args:
        section: of more than `max_period` periods.
        max_period: the longest to look for.
        tolerance: how close a repetition must come, relative to the amplitude (for v, to omega times that). A transient
            that shrinks by less than this in a repetition counts as settled.
    """
    kept = section.states.shape[-2]
    if kept <= max_period:
        raise ValueError(f"`section` must keep more than {max_period} periods, but keeps {kept}")
    points = _lengths(section.states, section.omega[..., None])
    close = (tolerance * section.amplitude)[..., None, None]
    found = jnp.zeros(section.omega.shape, dtype=int)
    for p in range(max_period, 0, -1):
        repeats = jnp.all(jnp.abs(points[..., p:, :] - points[..., :-p, :]) <= close, axis=(-2, -1))
        found = jnp.where(repeats & ~section.escaped, p, found)
    return found


# -- basins --


class Attractor(eqx.Module):
    """A periodic motion that a share of the starts settles to.

    Attributes:
        period: forcing periods after which it repeats.
        states: its states at multiples of the forcing period, by row.
        amplitude: half of peak to peak of x.
        fraction: share of the starts that reach it.
    """

    period: int
    states: np.ndarray
    amplitude: float
    fraction: float


class Basins(eqx.Module):
    """Which attractor each start of a grid settles to.

    Attributes:
        x: twists of the starts [rad].
        v: rates of the starts [rad/s].
        labels: place in `attractors` reached from `x[i], v[j]`, or [`ESCAPED`][] or [`UNSETTLED`][].
        attractors: the periodic motions found, by rising amplitude.
    """

    x: np.ndarray
    v: np.ndarray
    labels: np.ndarray
    attractors: tuple[Attractor, ...]

    @property
    def escaped(self) -> float:
        """Share of the starts that grow beyond all numbers."""
        return float(np.mean(self.labels == ESCAPED))

    @property
    def unsettled(self) -> float:
        """Share of the starts that are chaotic or have not settled."""
        return float(np.mean(self.labels == UNSETTLED))


def attractors(
    model: Model,
    forcing: FourierSeries,
    x_range: tuple[float, float],
    v_range: tuple[float, float],
    grid: int = 100,
    *,
    max_period: int = 6,
    tolerance: float = 1e-3,
    transient_periods: int | None = None,
    steps_per_period: int | None = None,
) -> Basins:
    """The coexisting attractors that a grid of starts settles to, and their basins.

    Starts that reach the same sub-harmonic in another phase belong to one attractor. Chaotic attractors are not told
    apart: their starts are labelled [`UNSETTLED`][].

    Args:
        model: a reduced model; own states of its effects start at rest.
        forcing: the reduced drive's forcing.
        x_range: twists of the starts [rad], from and to.
        v_range: rates of the starts [rad/s], from and to.
        grid: starts along each axis.
        max_period: longest sub-harmonic to look for, in forcing periods.
        tolerance: of [`period_of`][]; two motions are one attractor within ten times that.
        transient_periods: see [`poincare_section`][].
        steps_per_period: see [`poincare_section`][].
    """
    x, v = np.linspace(*x_range, grid), np.linspace(*v_range, grid)
    own = np.tile(np.asarray(model.rest())[2:], (grid * grid, 1))
    starts = np.concatenate([np.stack(np.meshgrid(x, v, indexing="ij"), axis=-1).reshape(-1, 2), own], axis=1)
    section = poincare_section(
        model,
        forcing,
        jnp.asarray(starts),
        transient_periods=transient_periods,
        kept_periods=2 * max_period,
        steps_per_period=steps_per_period,
    )
    periods = period_of(section, max_period=max_period, tolerance=tolerance)
    labels, found = _grouped(section, np.asarray(periods), 10.0 * tolerance)
    return Basins(x=x, v=v, labels=labels.reshape(grid, grid), attractors=found)


def _grouped(
    section: PoincareSection, periods: np.ndarray, tolerance: float
) -> tuple[np.ndarray, tuple[Attractor, ...]]:
    """Label lanes whose motions pass through the same points; each group's first lane stands for it."""
    points = np.asarray(_lengths(section.states, section.omega[..., None]))
    amplitudes = np.asarray(section.amplitude)
    labels = np.where(np.asarray(section.escaped), ESCAPED, UNSETTLED)
    open_lanes = periods > 0
    groups = []
    while open_lanes.any():
        # Short periods first: a motion that still spirals onto one can repeat after a multiple a little sooner.
        first = int(np.argmin(np.where(open_lanes, periods, np.iinfo(periods.dtype).max)))
        visited = points[first, -periods[first] :]
        distance = np.abs(points[:, -1, None, :] - visited).max(axis=-1).min(axis=-1)
        members = open_lanes & (periods % periods[first] == 0) & (distance <= tolerance * amplitudes[first])
        open_lanes &= ~members
        groups.append((float(amplitudes[first]), first, members))
    groups.sort(key=lambda group: group[0])
    found = []
    for label, (amplitude, first, members) in enumerate(groups):
        labels[members] = label
        period = int(periods[first])
        states = np.asarray(section.states[first, -period:])
        found.append(Attractor(period, states, amplitude, float(members.mean())))
    return labels, tuple(found)


# -- swept sines --


class SweptSine(eqx.Module):
    """Response to a sine whose frequency goes from step to step while the drive keeps moving.

    Attributes:
        omegas: forcing frequencies [rad/s], rising whatever the direction.
        amplitude: half of peak to peak of x at each; zero where escaped.
        fundamental: amplitude of the harmonic at omega in x at each; zero where escaped.
        states: state at the end of each step.
        escaped: whether the motion had grown beyond all numbers.
    """

    omegas: Float[Array, " n"]
    amplitude: Float[Array, " n"]
    fundamental: Float[Array, " n"]
    states: Float[Array, "n states"]
    escaped: Bool[Array, " n"]

    def jumps(self, ratio: float = 1.3) -> Bool[Array, " neighbours"]:
        """Between which neighbouring frequencies the amplitude changes by more than a ratio.

        A fold is a jump however fine the frequencies; a steep flank is one only where they are coarse.
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
        transient_periods: periods at each frequency before it is measured; see [`poincare_section`][], at the highest
            frequency.
        kept_periods: periods that are measured.
        steps_per_period: see [`poincare_section`][], at the lowest frequency.
    """
    omegas = jnp.asarray(omegas, dtype=float)
    options = _options(model, omegas, 1, transient_periods, steps_per_period)
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
        section = _section(model, harmonic_series(omega, amplitude), state, kept, transient, steps)
        return section.states[-1], section

    last, found = lax.scan(at, state, omegas, reverse=falling)
    return SweptSine(omegas, found.amplitude, found.fundamental, found.states[:, -1], found.escaped)


# -- marching --


def _options(
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


@eqx.filter_jit
def _sections(model, forcing, states, kept, transient, steps) -> PoincareSection:
    axis = 0 if forcing.omega.ndim else None
    lanes = eqx.filter_vmap(_section, in_axes=(None, axis, 0, None, None, None))
    return lanes(model, forcing, states, kept, transient, steps)


def _section(model: Model, forcing: FourierSeries, state: State, kept: int, transient: int, steps: int):
    """One lane of [`poincare_section`][]. The state travels as separate numbers: each is one row of lanes."""
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
    return PoincareSection(
        omega=forcing.omega,
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


def _lengths(states: Array, omega: Array) -> Array:
    """x and v / omega, the part of a state whose repetition is looked for."""
    return jnp.stack([states[..., 0], states[..., 1] / omega], axis=-1)
