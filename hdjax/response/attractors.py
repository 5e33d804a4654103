"""Coexisting periodic motions of a forced drive, and their basins of attraction."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from hdjax.dynamics import Model
from hdjax.fourier import FourierSeries
from hdjax.response.poincare import PoincareSection, period_of, poincare_section

ESCAPED, UNSETTLED = -1, -2
"""Labels of initial states without a periodic motion: diverged, and chaotic or not settled."""


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
        labels: place in `attractors` reached from `x[i], v[j]`, or `ESCAPED` or `UNSETTLED`.
        attractors: the periodic motions found, by rising amplitude.
    """

    x: np.ndarray
    v: np.ndarray
    labels: np.ndarray
    attractors: tuple[Attractor, ...]

    @property
    def escaped(self) -> float:
        """Share of the starts that diverge."""
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

    Starts that reach the same sub-harmonic in another phase belong to one attractor. Chaotic attractors are not
    distinguished: their starts are labelled `UNSETTLED`.

    Args:
        model: a reduced model; hidden states start at rest.
        forcing: the reduced drive's forcing.
        x_range: twists of the starts [rad], from and to.
        v_range: rates of the starts [rad/s], from and to.
        grid: starts along each axis.
        max_period: longest sub-harmonic to look for, in forcing periods.
        tolerance: of [`hdjax.response.poincare.period_of`][]; two motions are one attractor within ten times that.
        transient_periods: see [`hdjax.response.poincare.poincare_section`][].
        steps_per_period: see [`hdjax.response.poincare.poincare_section`][].
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
    """Group lanes whose motions pass through the same points; each group is labelled by its first lane."""
    points = np.asarray(section.lengths)
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
