"""Steady motions of a chunk of points, their number of harmonics, and their check against time integration."""

import dataclasses
import math
from collections.abc import Mapping

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hdjax.dynamics import Model
from hdjax.forcing import Harmonic
from hdjax.sweep.blocks import in_tiles, tile_for
from hdjax.sweep.choice import Check, drawn_points
from hdjax.sweep.request import Case, Request
from hdjax.sweep.steady import MOTIONS, Balanced, amplitude_roots, balance_lanes, symmetric, waves
from hdjax.sweep.twist import has_twist_equation, twist_equation

# A block's Jacobians stay in a core's cache.
_BLOCK = 128
_TILE = 32768
_FEW, _MANY = 6, 40
_HARMONICS = (3, 5, 7, 9, 13, 17, 25)
_PILOT_HARMONICS = 17
_REFERENCE = 1e-11
_LOOKS = 64
_ALIKE = 1e-6
_START = "amplitude to start from"


@dataclasses.dataclass(frozen=True)
class SteadyRoute:
    """Harmonic balance.

    Attributes:
        harmonics: the highest order kept.
        odd: whether the even ones vanish.
    """

    harmonics: int
    odd: bool

    @property
    def description(self) -> str:
        """What a reader is told."""
        kind = "odd harmonics" if self.odd else "harmonics"
        return f"harmonic balance, {kind} up to {self.harmonics}, by lanes, double precision"

    @property
    def orders(self) -> list[int]:
        """The orders kept, without the mean."""
        return list(range(1, self.harmonics + 1, 2 if self.odd else 1))


@dataclasses.dataclass(frozen=True)
class SteadyStates:
    """Steady motions by point and by motion, of which there are up to three; NaN where there is none.

    Attributes:
        mean: [rad].
        cosine: cosine coefficients by order [rad]; the phase is counted from that of the forcing.
        sine: likewise.
        peak: largest |x| [rad].
        stable: no real multiplier above 1, that is not between two folds; False where there is no motion.
        exists: whether there is a motion.
        truncation: estimated size of the first harmonic left out over the largest.
        lost: points of which a motion was not found.
    """

    mean: Float[np.ndarray, "points motions"]
    cosine: Float[np.ndarray, "points motions harmonics"]
    sine: Float[np.ndarray, "points motions harmonics"]
    peak: Float[np.ndarray, "points motions"]
    stable: Bool[np.ndarray, "points motions"]
    exists: Bool[np.ndarray, "points motions"]
    truncation: Float[np.ndarray, "points motions"]
    lost: Bool[np.ndarray, " points"]


def require_balanced(model: Model, forcing: object) -> None:
    """Refuse a case whose steady motions are beyond this route.

    Raises:
        ValueError: that says what is in the way.
    """
    if not isinstance(forcing, Harmonic):
        raise ValueError(f"a steady sweep needs a Harmonic forcing, but has {type(forcing).__name__}")
    if not has_twist_equation(model):
        names = [e.name for e in model.effects]
        raise ValueError(
            f"a steady sweep can't carry {names}, which act beyond the mesh or have memory; ask a transient"
        )


def steady_states(
    case: Case, request: Request, route: SteadyRoute, values: Mapping[str, Float[np.ndarray, " points"]]
) -> SteadyStates:
    """The steady motions of points.

    Args:
        case: the model and its forcing.
        request: what is wanted.
        route: how.
        values: parameters of the points, by path.
    """
    count = len(next(iter(values.values())))
    starts, exists = in_tiles(_roots, case, values, tile=tile_for(count, _TILE), block=_TILE)
    if not np.isfinite(starts[exists]).all():
        raise ValueError("a steady sweep needs damping, a positive natural frequency and finite values at every point")
    point, motion = np.nonzero(exists)
    own = {path: v[point] for path, v in values.items()}
    found = _balanced(case, request, route, own, starts[point, motion], _FEW)
    slow = np.flatnonzero(~found.converged)
    if slow.size:
        # Few lanes need many iterations; with the others they would make these wait.
        again = {path: v[slow] for path, v in own.items()}
        found = _replaced(found, slow, _balanced(case, request, route, again, starts[point, motion][slow], _MANY))
    return _arranged(found, count, point, motion, route)


def _arranged(found: Balanced, count: int, point: np.ndarray, motion: np.ndarray, route: SteadyRoute) -> SteadyStates:
    n = len(route.orders)
    unknowns = np.asarray(found.unknowns)
    shape = (count, MOTIONS)

    def placed(rows: np.ndarray, nothing: float | bool) -> np.ndarray:
        full = np.full((*shape, *rows.shape[1:]), nothing, rows.dtype)
        full[point, motion] = rows
        return full

    converged = placed(np.asarray(found.converged), False)
    wanted = placed(np.ones(point.size, dtype=bool), False)
    cosine, sine = (placed(unknowns[:, first::2][:, -n:], np.nan) for first in (0, 1))
    mean = placed(np.zeros(point.size) if route.odd else unknowns[:, 0], np.nan)
    peak, truncation = placed(np.asarray(found.peak), np.nan), placed(np.asarray(found.truncation), np.nan)
    exists = converged.copy()
    # Near a fold two starts may end in one motion.
    for a, b in ((1, 0), (2, 1), (2, 0)):
        apart = np.abs(cosine[:, a] - cosine[:, b]) + np.abs(sine[:, a] - sine[:, b])
        alike = np.max(apart, axis=1) < _ALIKE * peak[:, a]
        exists[:, a] &= ~(alike & exists[:, b])
    for array in (cosine, sine, mean, peak, truncation):
        array[~exists] = np.nan
    stable = placed(~np.asarray(found.saddle), False) & exists
    lost = np.any(wanted & ~exists, axis=1)
    return SteadyStates(mean, cosine, sine, peak, stable, exists, truncation, lost)


def _balanced(
    case: Case, request: Request, route: SteadyRoute, values: dict, starts: np.ndarray, iterations: int
) -> Balanced:
    tile = tile_for(starts.size, _TILE)
    return in_tiles(_Balance(route, iterations), case, values | {_START: starts}, tile=tile, block=_BLOCK)


class _Balance(eqx.Module):
    """Harmonic balance of a block of starts."""

    route: SteadyRoute = eqx.field(static=True)
    iterations: int = eqx.field(static=True)

    def __call__(self, case: Case, values: dict[str, Array]) -> Balanced:
        own = {path: v for path, v in values.items() if path != _START}
        kept = waves(self.route.harmonics, odd=self.route.odd, smooth=not case.model.effects)
        equation, push, still, omega = _posed_lanes(case, own, values[_START].size)
        found = balance_lanes(equation, push, still, omega, values[_START], kept, iterations=self.iterations)
        return eqx.tree_at(lambda b: b.unknowns, found, found.unknowns.T)


def _roots(case: Case, values: dict[str, Array]) -> tuple[Array, Array]:
    """One-harmonic amplitudes of a block of points."""
    equation, push, _, omega = _posed_lanes(case, values, next(iter(values.values())).size)
    return amplitude_roots(equation, push, omega)


def _posed_lanes(case: Case, values: dict[str, Array], lanes: int) -> tuple:
    return jax.vmap(lambda v: _posed(case.at(v)), axis_size=lanes)(values)


def _posed(case: Case) -> tuple:
    """A point's equation, its forcing acceleration's amplitude and constant part, and the frequency."""
    equation, forcing = twist_equation(case.model), case.forcing
    still = equation.gain * forcing.offset  # pyright: ignore[reportFunctionMemberAccess]
    return equation, equation.gain * forcing.amplitude, still, forcing.omega  # pyright: ignore[reportFunctionMemberAccess]


def _replaced(found: Balanced, rows: np.ndarray, by: Balanced) -> Balanced:
    def put(old: np.ndarray, new: np.ndarray) -> np.ndarray:
        old = np.array(old)
        old[rows] = new
        return old

    return jax.tree.map(put, found, by)


def choose_steady(case: Case, request: Request) -> tuple[SteadyRoute, Check]:
    """As many harmonics as the tolerance needs on points drawn from the sweep, checked on others.

    The check integrates one period from the balanced motion, by adaptive steps: what it has moved away from the series.
    """
    require_balanced(case.model, case.forcing)
    pilot, other = drawn_points(request)
    values = request.design.values(pilot)
    offset = np.asarray(request.design.values(pilot).get("forcing.offset", case.forcing.offset))  # pyright: ignore
    odd = symmetric(case.model) and not np.any(offset)
    # One solution with many harmonics tells what fewer would leave out.
    full = SteadyRoute(_PILOT_HARMONICS, odd)
    found = steady_states(case, request, full, values)
    size = np.hypot(found.cosine, found.sine) / found.peak[..., None]
    needed = [
        h for h in _HARMONICS if np.nanmax(size[..., np.array(full.orders) > h], initial=0.0) <= request.tolerance
    ]
    route = SteadyRoute(min(needed, default=_HARMONICS[-1]), odd)
    others = request.design.values(other)
    while True:
        check = _checked(case, steady_states(case, request, route, others), route, others)
        finer = [h for h in _HARMONICS if h > route.harmonics]
        if check.error <= request.tolerance or not finer:
            return route, check
        route = SteadyRoute(finer[0], odd)


def _checked(case: Case, found: SteadyStates, route: SteadyRoute, values: dict) -> Check:
    point, motion = np.nonzero(found.exists)
    orders = np.array(route.orders, dtype=float)
    rows = [getattr(found, name)[point, motion] for name in ("mean", "cosine", "sine", "peak")]
    own = {path: jnp.asarray(v[point]) for path, v in values.items()}
    errors, reached = (np.asarray(a) for a in _one_period(case, own, *map(jnp.asarray, (*rows, orders))))
    reference = f"one period by adaptive Dopri8 of diffrax at rtol {_REFERENCE:g}"
    good = errors[reached]
    error, median = (float(np.max(good)), float(np.median(good))) if good.size else (math.nan, math.nan)
    return Check(int(point.size), int(np.sum(~reached)), error, median, reference)


@eqx.filter_jit
def _one_period(case: Case, values: dict, mean: Array, cosine: Array, sine: Array, peak: Array, orders: Array):
    """How far a motion that starts on each series has left it within a period, and whether it was integrated."""

    def one(values: dict, mean: Array, cosine: Array, sine: Array, peak: Array) -> tuple[Array, Array]:
        equation, push, still, omega = _posed(case.at(values))
        # In radians of the forcing, so that lanes step alike.
        start = jnp.stack([mean + jnp.sum(cosine), jnp.sum(orders * sine)])

        def field(angle, y: Array, _: object) -> Array:
            outside = push * jnp.cos(angle) + still
            return jnp.stack([y[1], equation.acceleration(y[0], omega * y[1], outside) / omega**2])

        at = jnp.linspace(0.0, 2 * np.pi, _LOOKS + 1)
        solution = dfx.diffeqsolve(
            dfx.ODETerm(field),
            dfx.Dopri8(),
            0.0,
            2 * np.pi,
            None,
            start,
            saveat=dfx.SaveAt(ts=at),
            stepsize_controller=dfx.PIDController(rtol=_REFERENCE, atol=_REFERENCE * peak),
            max_steps=100_000,
            throw=False,
        )
        angles = orders[:, None] * at[None, :]
        series = mean + cosine @ jnp.cos(angles) + sine @ jnp.sin(angles)
        x = jnp.asarray(solution.ys)[:, 0]
        return jnp.max(jnp.abs(x - series)) / peak, solution.result == dfx.RESULTS.successful

    return jax.vmap(one)(values, mean, cosine, sine, peak)
