"""Runge-Kutta steps for any model under any forcing, as lanes.

Fixed ones are slower than [`hdjax.sweep.splitting`][], whose steps need not resolve the oscillation, but suit every
smooth model. They are for devices and models without machine code ([`hdjax.sweep.machine_code`][]). Adaptive ones also
suit nonsmooth models, and are the reference of every sweep of transients.
"""

from collections.abc import Callable

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from hdjax.dynamics import Model
from hdjax.effects import Conditions
from hdjax.sweep.windows import Windows, largest_between

_TABLEAU = dfx.Tsit5.tableau
_NODES = (0.0, *map(float, _TABLEAU.c))
_ROWS = tuple(tuple(map(float, row)) for row in _TABLEAU.a_lower)
_WEIGHTS = tuple(map(float, _TABLEAU.b_sol))
_MOST_STEPS = 1_000_000


def march_steps(
    model: Model,
    forcing: Callable[[Array], Array],
    state: Float[Array, " states"],
    duration: Float[Array, ""],
    *,
    windows: int,
    substeps: Int[Array, ""],
    peaks: bool,
) -> Windows:
    """March one drive by Tsit5; a lane of a vmapped program.

    Args:
        model: any model.
        forcing: motor torque, or a reduced drive's forcing, as a function of time.
        state: at t = 0.
        duration: of the motion [s].
        windows: number of equal parts of the duration.
        substeps: steps of each window; data, so that one compiled program serves any number.
        peaks: whether to compute the largest |x| of each window.
    """
    width = duration / windows
    h = width / substeps.astype(width.dtype)
    none = jnp.zeros_like(h)
    count = state.size

    def step(y: list[Array], t: Array) -> list[Array]:
        slopes: list[list[Array]] = []
        for row, node in zip(((), *_ROWS), _NODES, strict=True):
            now = _advanced(y, h, row, slopes)
            at = t + node * h
            slopes.append(model.component_rates(now, forcing(at), none, Conditions(time=at)))
        return _advanced(y, h, _WEIGHTS, slopes)

    def at(y: list[Array], t: Array) -> tuple[Array, Array, Array]:
        return twist(model, jnp.stack(y), forcing(t), t)

    def window(carry: list[Array], index: Array) -> tuple[list[Array], tuple[Array, ...]]:
        begin = index * width

        def advance(j: Array, c: tuple[list[Array], Array]) -> tuple[list[Array], Array]:
            packed, peak = c
            y, t = _unpacked(packed, count), begin + h * j.astype(h.dtype)
            moved = jax.lax.optimization_barrier(_packed(step(y, t)))
            if peaks:
                peak = jnp.maximum(peak, largest_between(at(y, t), at(_unpacked(moved, count), t + h), h))
            return moved, peak

        end, peak = jax.lax.fori_loop(0, substeps, advance, (carry, none))
        x, v, _ = at(_unpacked(end, count), begin + width)
        return end, (x, v, peak)

    _, found = jax.lax.scan(window, _packed(list(state)), jnp.arange(windows, dtype=h.dtype))
    return Windows(*found)


def march_adaptively(
    model: Model,
    forcing: Callable[[Array], Array],
    state: Float[Array, " states"],
    duration: Float[Array, ""],
    *,
    windows: int,
    looks: int,
    tolerance: Float[Array, ""],
    scale: Float[Array, ""],
) -> tuple[Windows, Bool[Array, ""]]:
    """March one drive by diffrax; a lane of a vmapped program.

    Args:
        model: any model.
        forcing: motor torque, or a reduced drive's forcing, as a function of time.
        state: at t = 0.
        duration: of the motion [s].
        windows: number of equal parts of the duration.
        looks: points of each window between which the largest |x| is searched.
        tolerance: relative tolerance.
        scale: size of the motion, to which the absolute tolerance is relative [rad].

    Returns:
        The motion, and whether the solver reached the end.
    """

    def field(t, y: Array, _: object) -> Array:
        return model.rates(y, forcing(t), jnp.zeros_like(t), Conditions(time=t))

    times = jnp.linspace(0.0, 1.0, windows * looks + 1) * duration
    solution = dfx.diffeqsolve(
        dfx.ODETerm(field),
        dfx.Dopri8(),
        times[0],
        times[-1],
        None,
        state,
        saveat=dfx.SaveAt(ts=times),
        stepsize_controller=dfx.PIDController(rtol=tolerance, atol=tolerance * scale),
        max_steps=_MOST_STEPS,
        throw=False,
    )
    states = jnp.asarray(solution.ys)
    x, v, a = jax.vmap(lambda y, t: twist(model, y, forcing(t), t))(states, times)
    starts, ends = ((x[part], v[part], a[part]) for part in (slice(None, -1), slice(1, None)))
    between = largest_between(starts, ends, jnp.full_like(x[1:], 1.0) * (duration / (windows * looks)))
    peak = jnp.max(between.reshape(windows, looks), axis=1)
    reached = (solution.result == dfx.RESULTS.successful) & jnp.all(jnp.isfinite(x))
    return Windows(x[looks::looks], v[looks::looks], peak), reached


def twist(
    model: Model, state: Float[Array, " states"], torque: Array, time: Float[Array, ""]
) -> tuple[Array, Array, Array]:
    """The measured dynamic error [rad], its rate and its acceleration at a state, under a torque that holds."""
    none, conditions = jnp.zeros_like(torque), Conditions(time=time)

    def rate(state: Array) -> tuple[Array, Array]:
        moving = model.rates(state, torque, none, conditions)
        x, v = jax.jvp(lambda y: model.outputs(y)[-1], (state,), (moving,))
        return v, x

    moving = model.rates(state, torque, none, conditions)
    v, a, x = jax.jvp(rate, (state,), (moving,), has_aux=True)
    return x, v, a


def _advanced(y: list[Array], h: Array, weights: tuple[float, ...], slopes: list[list[Array]]) -> list[Array]:
    used = [(w, k) for w, k in zip(weights, slopes, strict=False) if w != 0.0]
    return [c + h * sum((w * k[i] for w, k in used), jnp.zeros_like(h)) for i, c in enumerate(y)]


def _packed(y: list[Array]) -> list[Array]:
    """Pairs of states as complex numbers: a step with a single result is computed once, not once per result."""
    padded = y + [jnp.zeros_like(y[0])] * (len(y) % 2)
    return [jax.lax.complex(a, b) for a, b in zip(padded[::2], padded[1::2], strict=True)]


def _unpacked(packed: list[Array], count: int) -> list[Array]:
    return [part for z in packed for part in (z.real, z.imag)][:count]
