"""Transients of a chunk of points by any of the routes."""

import dataclasses
from collections.abc import Mapping
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hdjax.engine import unusable
from hdjax.sweep.machine_code import NAMES, address, transients_by_code
from hdjax.sweep.request import Case, Request, duration
from hdjax.sweep.runge_kutta import march_adaptively, march_steps
from hdjax.sweep.splitting import ABA864, SRKN14, STRANG, march_split
from hdjax.sweep.tiles import in_tiles, tile_for
from hdjax.sweep.windows import Windows

Method = Literal["strang", "aba864", "srkn14", "tsit5", "dopri8", "adaptive"]
_SPLITTINGS = {"strang": STRANG, "aba864": ABA864, "srkn14": SRKN14}
_NAMES = {method: splitting.name for method, splitting in _SPLITTINGS.items()} | NAMES
# Number of lanes per pass, whose states and constants stay in a core's cache.
_BLOCK = 1024
# Adaptive lanes wait for the slowest of their block.
_ADAPTIVE_BLOCK = 64


@dataclasses.dataclass(frozen=True)
class TransientRoute:
    """Method for transients.

    Attributes:
        method: splitting, Runge-Kutta steps or adaptive steps.
        substeps: steps of each window; for adaptive steps, points to search the largest |x|.
        single: whether in single precision.
        tolerance: of adaptive steps.
        by_code: whether Runge-Kutta steps are taken by machine code. Without it, only `tsit5` is available.
    """

    method: Method
    substeps: int
    single: bool = False
    tolerance: float = 1e-11
    by_code: bool = False

    @property
    def description(self) -> str:
        """What a reader is told."""
        precision = "single" if self.single else "double"
        if self.method == "adaptive":
            return f"adaptive Dopri8 of diffrax at rtol {self.tolerance:g}, {precision} precision"
        name = _NAMES[self.method]
        name += " by machine code" if self.by_code else ""
        return f"fixed-step lanes, {name}, {self.substeps} steps a window, {precision} precision"


def transients(
    case: Case, request: Request, route: TransientRoute, values: Mapping[str, Float[np.ndarray, " points"]]
) -> tuple[Windows, Bool[np.ndarray, " points"]]:
    """The motions of points, by rows, and which of them reached their end.

    Args:
        case: the model and its forcing.
        request: of the sweep.
        route: how.
        values: parameters of the points, by path.

    Raises:
        RuntimeError: the method needs machine code, which is unavailable.
    """
    if route.by_code:
        return _by_code(case, request, route, values)
    # One shape of program for pilots and chunks: compiling another takes longer than the lanes that fill this one.
    tile, block = tile_for(request.points.size), _BLOCK
    if adaptive := route.method == "adaptive":
        tile, block = _ADAPTIVE_BLOCK, _ADAPTIVE_BLOCK
    # The search points of adaptive steps are part of the program; numbers of steps and tolerances are data.
    fixed = dataclasses.replace(route, substeps=route.substeps if adaptive else 0, tolerance=0.0)
    wanted = (request.duration, request.periods, request.windows, request.peaks)
    numbers = jnp.asarray(route.substeps, dtype=int), jnp.asarray(route.tolerance, dtype=float)
    return in_tiles(_Lanes(fixed, *wanted), (case, *numbers), values, tile=tile, block=block, checked=adaptive)


def _by_code(
    case: Case, request: Request, route: TransientRoute, values: Mapping[str, Float[np.ndarray, " points"]]
) -> tuple[Windows, Bool[np.ndarray, " points"]]:
    assert route.method == "tsit5" or route.method == "dopri8"
    code = address(case, request, route.method)
    if code is None:
        raise RuntimeError(f"the sweep's route was chosen with machine code, which is missing here: {unusable()}")
    found = transients_by_code(code, case, request, values, route.substeps)
    return found, np.all(np.isfinite(np.asarray(found.x)), axis=1)


class _Lanes(eqx.Module):
    """Transients of a block of points: the static part of the program. Values and numbers of steps are data."""

    route: TransientRoute = eqx.field(static=True)
    duration: float | None = eqx.field(static=True)
    periods: float | None = eqx.field(static=True)
    windows: int = eqx.field(static=True)
    peaks: bool = eqx.field(static=True)

    def __call__(self, constants: tuple[Case, Array, Array], values: dict[str, Array]) -> tuple[Windows, Array]:
        case, substeps, tolerance = constants
        dtype = jnp.float32 if self.route.single else jnp.result_type(float)

        def lane(values: dict[str, Array]) -> tuple[Windows, Array]:
            own = jax.tree.map(lambda a: a.astype(dtype) if eqx.is_inexact_array(a) else a, case.at(values))
            return _motion(own, self, substeps, tolerance)

        return jax.vmap(lane)(values)


def _motion(case: Case, wanted: _Lanes, substeps: Array, tolerance: Array) -> tuple[Windows, Array]:
    """One point's transient from rest."""
    model, route, length = case.model, wanted.route, duration(case, wanted.duration, wanted.periods)
    common = {"windows": wanted.windows, "peaks": wanted.peaks}
    if route.method == "adaptive":
        scale = _size(case, length)
        return march_adaptively(
            model,
            case.forcing,
            model.rest(),
            length,
            windows=wanted.windows,
            looks=route.substeps,
            tolerance=tolerance,
            scale=scale,
        )
    if route.method == "tsit5":
        found = march_steps(model, case.forcing, model.rest(), length, substeps=substeps, **common)
    else:
        rest = jnp.zeros(2, length.dtype)
        method = _SPLITTINGS[route.method]
        found = march_split(model, case.forcing, rest, length, method=method, substeps=substeps, **common)  # pyright: ignore[reportArgumentType]
    return found, jnp.all(jnp.isfinite(found.x)) & jnp.all(jnp.isfinite(found.peak))


def _size(case: Case, length: Array) -> Array:
    """The twist that the forcing's largest value would hold [rad]."""
    drive = case.model.drive
    gain = drive.k_T / (drive.N * drive.J_m) if hasattr(drive, "J_m") else drive.gain  # pyright: ignore[reportAttributeAccessIssue]
    pushes = jax.vmap(case.forcing)(jnp.linspace(0.0, 1.0, 65) * length)
    return jnp.maximum(jnp.abs(gain) * jnp.max(jnp.abs(pushes)) / drive.omega_0**2, 1e-30)
