"""Transients of a chunk of points by any of the routes."""

import dataclasses
from collections.abc import Mapping
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hdjax.lanes import jit_lanes, spread
from hdjax.sweep.adaptive import march_adaptively
from hdjax.sweep.request import Case, Request, duration
from hdjax.sweep.splitting import ABA864, STRANG, march_split
from hdjax.sweep.stepping import march_steps
from hdjax.sweep.windows import Windows

Method = Literal["strang", "aba864", "tsit5", "adaptive"]
_SPLITTINGS = {"strang": STRANG, "aba864": ABA864}
# The lanes that are moved together: their states and constants stay in a core's cache.
_BLOCK = 1024
# Adaptive lanes wait for the slowest of their block.
_ADAPTIVE_BLOCK = 64
_TILE = 16384


@dataclasses.dataclass(frozen=True)
class Route:
    """How transients are worked out.

    Attributes:
        method: splitting, Runge-Kutta steps or adaptive steps.
        substeps: steps of each window; for adaptive steps, looks for the largest |x|.
        single: whether in single precision.
        tolerance: of adaptive steps.
    """

    method: Method
    substeps: int
    single: bool = False
    tolerance: float = 1e-11

    @property
    def description(self) -> str:
        """What a reader is told."""
        precision = "single" if self.single else "double"
        if self.method == "adaptive":
            return f"adaptive Dopri8 of diffrax at rtol {self.tolerance:g}, {precision} precision"
        names = {"strang": STRANG.name, "aba864": ABA864.name, "tsit5": "Tsit5"}
        return f"fixed-step lanes, {names[self.method]}, {self.substeps} steps a window, {precision} precision"


def transients(
    case: Case, request: Request, route: Route, values: Mapping[str, Float[np.ndarray, " points"]]
) -> tuple[Windows, Bool[np.ndarray, " points"]]:
    """The motions of points, by rows, and which of them reached their end.

    Args:
        case: the model and its forcing.
        request: what is wanted.
        route: how.
        values: parameters of the points, by path.
    """
    count = len(next(iter(values.values())))
    devices = len(jax.local_devices())
    # One shape of program for pilots and chunks: compiling another takes longer than the lanes that fill this one.
    tile = 1 << max(min(request.design.size, _TILE) - 1, 1).bit_length()
    block = min(_BLOCK, tile) if route.method != "adaptive" else min(_ADAPTIVE_BLOCK, tile)
    lanes = block if route.method == "adaptive" else tile
    together = devices if lanes % (devices * block) == 0 else 1
    substeps = jnp.asarray(route.substeps, dtype=int)
    fixed = dataclasses.replace(route, substeps=route.substeps if route.method == "adaptive" else 0)
    parts = []
    for begin in range(0, count, lanes):
        own = {path: v[begin : begin + lanes] for path, v in values.items()}
        # The last point fills the rest.
        filled = {path: jnp.asarray(np.pad(v, (0, lanes - len(v)), mode="edge")) for path, v in own.items()}
        parts.append(_lanes(case, spread(filled, lanes), substeps, _Wanted(request), fixed, together, block))
    flat = [jax.tree.map(lambda a: np.asarray(a).reshape(lanes, *a.shape[3:]), part) for part in parts]
    return jax.tree.map(lambda *rows: np.concatenate(rows)[:count], *flat)


class _Wanted:
    """What of a request shapes the program: requests that differ in their design alone share it."""

    def __init__(self, request: Request):
        self.request = request
        self._key = (request.duration, request.periods, request.windows, request.peaks)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Wanted) and self._key == other._key

    def __hash__(self) -> int:
        return hash(self._key)


@jit_lanes
def _lanes(
    case: Case, values: dict[str, Array], substeps: Array, wanted: _Wanted, route: Route, together: int, block: int
) -> tuple[Windows, Array]:
    dtype = jnp.float32 if route.single else jnp.result_type(float)

    def lane(values: dict[str, Array]) -> tuple[Windows, Array]:
        own = jax.tree.map(lambda a: a.astype(dtype) if eqx.is_inexact_array(a) else a, case.at(values))
        return _motion(own, wanted.request, route, substeps)

    # One block of each device at a time: the device's axis stays whole through the loop.
    blocks = jax.tree.map(lambda v: jnp.moveaxis(v.reshape(together, -1, block), 1, 0), values)
    found = jax.lax.map(jax.vmap(jax.vmap(lane)), blocks)
    return jax.tree.map(lambda a: jnp.moveaxis(a, 0, 1), found)


def _motion(case: Case, request: Request, route: Route, substeps: Array) -> tuple[Windows, Array]:
    """One point's transient from rest."""
    model, length = case.model, duration(request, case)
    common = {"windows": request.windows, "peaks": request.peaks}
    if route.method == "adaptive":
        scale = _size(case, length)
        return march_adaptively(
            model,
            case.forcing,
            model.rest(),
            length,
            windows=request.windows,
            looks=route.substeps,
            tolerance=route.tolerance,
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
    gain = 1.0 / (drive.N * drive.J_m) if hasattr(drive, "J_m") else drive.gain  # pyright: ignore[reportAttributeAccessIssue]
    pushes = jax.vmap(case.forcing)(jnp.linspace(0.0, 1.0, 65) * length)
    return jnp.maximum(gain * jnp.max(jnp.abs(pushes)) / drive.omega_0**2, 1e-30)
