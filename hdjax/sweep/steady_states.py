"""Steady motions of a chunk of points, their number of harmonics, and their check against time integration."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hdjax.dynamics import Model
from hdjax.forcing import Harmonic
from hdjax.sweep.balance import MOTIONS, Balanced, amplitude_roots, balance_lanes, one_harmonic, symmetric, waves
from hdjax.sweep.check import Check, drawn_points
from hdjax.sweep.request import Case, Request
from hdjax.sweep.tiles import in_tiles
from hdjax.sweep.twist_equation import has_twist_equation, twist_equation

# A block's Jacobians stay in a core's cache.
_BLOCK = 128
_TILE = 16384
_FEW_BLOCKS = 16
_FEW, _MANY = 6, 40
# A motion is first balanced with few harmonics, and with more if the truncation error is too large.
_LADDER = (5, 11, 25)
# Share of the tolerance for the estimated truncation error.
_SAFETY = 0.3
_ATTEMPTS = 3
_REFERENCE = 1e-11
_LOOKS = 64
_CHECKED_BLOCK = 64
_ALIKE = 1e-6
_START = "series to start from"


@dataclasses.dataclass(frozen=True)
class SteadyRoute:
    """Harmonic balance.

    Attributes:
        harmonics: the highest order kept of any motion.
        odd: whether the even ones vanish.
        truncation: largest omitted harmonic over the largest one, at most.
    """

    harmonics: int
    odd: bool
    truncation: float

    @property
    def description(self) -> str:
        """Description for reports."""
        kind = "odd harmonics" if self.odd else "harmonics"
        return f"harmonic balance by lanes, {kind} up to {self.harmonics} where a motion needs them, double precision"

    @property
    def orders(self) -> list[int]:
        """The orders kept, without the mean."""
        return list(range(1, self.harmonics + 1, 2 if self.odd else 1))

    @property
    def rungs(self) -> list[int]:
        """Highest orders of the successive balances."""
        return [*(h for h in _LADDER if h < self.harmonics), self.harmonics]


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
        truncation: estimated size of the largest omitted harmonic over the largest kept.
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
    """Refuse a case that this method does not support.

    Raises:
        ValueError: states the reason.
    """
    if not isinstance(forcing, Harmonic):
        raise ValueError(f"a steady sweep needs a Harmonic forcing, but has {type(forcing).__name__}")
    if not has_twist_equation(model):
        names = [e.name for e in model.effects]
        raise ValueError(
            f"a steady sweep can't carry {names}, which act beyond the mesh or have memory; ask a transient"
        )


def steady_states(case: Case, route: SteadyRoute, values: Mapping[str, Float[np.ndarray, " points"]]) -> SteadyStates:
    """The steady motions of points.

    Args:
        case: the model and its forcing.
        route: the method.
        values: parameters of the points, by path.
    """
    count = len(next(iter(values.values())))
    starts, exists = in_tiles(_roots, case, values, tile=_tile(count), block=_BLOCK)
    if not np.isfinite(starts[exists]).all():
        raise ValueError("a steady sweep needs damping, a positive natural frequency and finite values at every point")
    point, motion = np.nonzero(exists)
    own = {path: v[point] for path, v in values.items()}
    found, waiting = None, np.arange(point.size)
    series = np.zeros((point.size, 2, 1 if route.odd else 2))
    series[..., -1] = starts[exists]
    for harmonics in route.rungs:
        kept = {path: v[waiting] for path, v in own.items()}
        rung = _balanced(case, SteadyRoute(harmonics, route.odd, 0.0), kept, series[waiting])
        found = _widened(rung, route) if found is None else _replaced(found, waiting, _widened(rung, route))
        # Motions that were not found are searched again from their start.
        series = np.where(found.converged[:, None, None], found.unknowns, _padded(series, found.unknowns.shape[-1]))
        waiting = waiting[~(rung.converged & (rung.truncation <= route.truncation))]
        if not waiting.size:
            break
    assert found is not None
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
    cosine, sine = (placed(unknowns[:, part, -n:], np.nan) for part in (0, 1))
    mean = placed(np.zeros(point.size) if route.odd else unknowns[:, 0, 0], np.nan)
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


def _balanced(case: Case, route: SteadyRoute, values: dict, series: np.ndarray) -> Balanced:
    """A rung of the ladder: motions near series, with all harmonics of a route."""
    width = len(route.orders) + (not route.odd)
    starts = _padded(series, width)[..., :width]
    program = _Balance(route.harmonics, route.odd)

    def solved(rows: Any, iterations: int) -> Balanced:
        own = {path: v[rows] for path, v in values.items()} | {_START: starts[rows]}
        tile = _tile(len(own[_START]))
        return in_tiles(program, (case, jnp.asarray(iterations)), own, tile=tile, block=_BLOCK)

    found = solved(slice(None), _FEW)
    slow = np.flatnonzero(~found.converged)
    # A few lanes need many iterations; they are run separately, so that the others do not wait.
    return _replaced(found, slow, solved(slow, _MANY)) if slow.size else found


def _tile(rows: int) -> int:
    """One of two shapes of program: a third would take longer to compile than it saves."""
    return _TILE if rows > _FEW_BLOCKS * _BLOCK else _BLOCK


class _Balance(eqx.Module):
    """Harmonic balance of a block of starts."""

    harmonics: int = eqx.field(static=True)
    odd: bool = eqx.field(static=True)

    def __call__(self, constants: tuple[Case, Array], values: dict[str, Array]) -> Balanced:
        case, iterations = constants
        start = jnp.moveaxis(values[_START], 0, -1)
        own = {path: v for path, v in values.items() if path != _START}
        kept = waves(self.harmonics, odd=self.odd, smooth=not case.model.effects)
        equation, push, still, omega = _posed_lanes(case, own, start.shape[-1])
        found = balance_lanes(equation, push, still, omega, start, kept, iterations=iterations)
        return eqx.tree_at(lambda b: b.unknowns, found, jnp.moveaxis(found.unknowns, -1, 0))


def _roots(case: Case, values: dict[str, Array]) -> tuple[Array, Array]:
    """Cosine and sine of the one-harmonic motions of a block of points, and which of them exist."""
    equation, push, _, omega = _posed_lanes(case, values, len(next(iter(values.values()))))
    amplitudes, exists = amplitude_roots(equation, push, omega)
    series = jax.vmap(one_harmonic, in_axes=(None, None, 1), out_axes=1)(equation, omega, amplitudes)
    # The amplitudes are those of a positive forcing.
    return jnp.stack(series, axis=-1) * jnp.sign(push)[:, None, None], exists


def _padded(series: np.ndarray, width: int) -> np.ndarray:
    """Series padded with zeros to as many orders."""
    return np.pad(series, [(0, 0), (0, 0), (0, max(0, width - series.shape[-1]))])


def _widened(found: Balanced, route: SteadyRoute) -> Balanced:
    """Motions padded to the method's harmonics."""
    width = len(route.orders) + (not route.odd)
    return eqx.tree_at(lambda b: b.unknowns, found, _padded(np.asarray(found.unknowns), width))


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
    """The number of harmonics for the tolerance on random points of the sweep, checked on others.

    The check integrates one period from the balanced motion, by adaptive steps, and compares the motion with the
    series.
    """
    require_balanced(case.model, case.forcing)
    pilot, other = drawn_points(request)
    values = request.points.values(pilot)
    offset = request.points.column("forcing.offset")
    if offset is None:
        offset = np.asarray(case.forcing.offset)  # pyright: ignore[reportFunctionMemberAccess]
    odd = symmetric(case.model) and not np.any(offset)
    route = SteadyRoute(_LADDER[-1], odd, _SAFETY * request.tolerance)
    found = steady_states(case, route, values)
    # The number that any of the points needs, and the next larger one, since other points may need it.
    taken = np.max(np.array(route.orders) * np.any(found.cosine[found.exists] != 0.0, axis=0), initial=1)
    rung = min(int(np.searchsorted(_LADDER, taken)) + 1, len(_LADDER) - 1)
    others = request.points.values(other)
    for attempts in range(_ATTEMPTS, 0, -1):
        route = dataclasses.replace(route, harmonics=_LADDER[rung])
        check = _checked(case, steady_states(case, route, others), route, others)
        # Where no point could be checked, the error is NaN.
        if not check.error > request.tolerance or attempts == 1:
            break
        rung = min(rung + 1, len(_LADDER) - 1)
        route = dataclasses.replace(route, truncation=0.1 * route.truncation)
    return route, check


def _checked(case: Case, found: SteadyStates, route: SteadyRoute, values: dict) -> Check:
    point, motion = np.nonzero(found.exists)
    reference = f"one period by adaptive Dopri8 of diffrax at rtol {_REFERENCE:g}"
    if not point.size:
        return Check(0, 0, math.nan, math.nan, reference)
    # As many orders as there can be: one program for all routes.
    orders = np.arange(1 if route.odd else 0, _LADDER[-1] + 1, 2 if route.odd else 1)
    series = np.stack([found.cosine[point, motion], found.sine[point, motion]], axis=1)
    if not route.odd:
        mean = found.mean[point, motion]
        series = np.concatenate([np.stack([mean, np.zeros_like(mean)], axis=1)[..., None], series], axis=-1)
    own = {path: v[point] for path, v in values.items()} | {_START: _padded(series, orders.size)}
    constants = case, jnp.asarray(orders.astype(float))
    block = {"tile": _CHECKED_BLOCK, "block": _CHECKED_BLOCK}
    errors, reached = in_tiles(_one_period, constants, own, **block, checked=True)
    good = errors[reached]
    error, median = (float(np.max(good)), float(np.median(good))) if good.size else (math.nan, math.nan)
    return Check(int(point.size), int(np.sum(~reached)), error, median, reference)


def _one_period(constants: tuple[Case, Array], values: dict[str, Array]) -> tuple[Array, Array]:
    """Relative deviation of motions from their series within a period, and whether they were integrated."""
    case, orders = constants
    at = jnp.linspace(0.0, 2 * np.pi, _LOOKS + 1)
    waves = jnp.stack([jnp.cos(orders[:, None] * at[None, :]), jnp.sin(orders[:, None] * at[None, :])])

    def one(values: dict[str, Array]) -> tuple[Array, Array]:
        series = values.pop(_START)
        equation, push, still, omega = _posed(case.at(values))
        x = jnp.einsum("pk,pkt->t", series, waves)
        # A drive without a forcing rests: any size will do.
        size = jnp.max(jnp.abs(x))
        size = jnp.where(size > 0.0, size, 1.0)

        def field(angle, y: Array, _: object) -> Array:
            # In radians of the forcing, so that lanes step alike.
            outside = push * jnp.cos(angle) + still
            return jnp.stack([y[1], equation.acceleration(y[0], omega * y[1], outside) / omega**2])

        solution = dfx.diffeqsolve(
            dfx.ODETerm(field),
            dfx.Dopri8(),
            0.0,
            2 * np.pi,
            None,
            jnp.stack([x[0], jnp.sum(orders * series[1])]),
            saveat=dfx.SaveAt(ts=at),
            stepsize_controller=dfx.PIDController(rtol=_REFERENCE, atol=_REFERENCE * size),
            max_steps=100_000,
            throw=False,
        )
        left = jnp.max(jnp.abs(jnp.asarray(solution.ys)[:, 0] - x)) / size
        return left, solution.result == dfx.RESULTS.successful

    return jax.vmap(one)(values)
