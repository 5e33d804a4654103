"""Adaptive steps at a given tolerance: the reference of every sweep, and the route for sharp corners."""

from collections.abc import Callable

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hdjax.dynamics import Model
from hdjax.sweep.stepping import twist
from hdjax.sweep.windows import Windows, largest_between

_MOST_STEPS = 1_000_000


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
        duration: how long [s].
        windows: equal parts of the duration that are observed.
        looks: points of each window between which the largest |x| is looked for.
        tolerance: relative tolerance.
        scale: size of the motion, of which the absolute tolerance is the same part [rad].

    Returns:
        The motion, and whether the solver reached the end.
    """

    def field(t, y: Array, _: object) -> Array:
        return model.rates(y, forcing(t), jnp.zeros_like(t))

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
    x, v, a = jax.vmap(lambda y, t: twist(model, y, forcing(t)))(states, times)
    starts, ends = ((x[part], v[part], a[part]) for part in (slice(None, -1), slice(1, None)))
    between = largest_between(starts, ends, jnp.full_like(x[1:], 1.0) * (duration / (windows * looks)))
    peak = jnp.max(between.reshape(windows, looks), axis=1)
    reached = (solution.result == dfx.RESULTS.successful) & jnp.all(jnp.isfinite(x))
    return Windows(x[looks::looks], v[looks::looks], peak), reached
