"""Fast refits of a model to many data sets, as in a bootstrap."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from fitting.estimation.arrow_system import normal_equations
from fitting.estimation.engines import linearise, residual_inside, with_engine
from fitting.estimation.estimate import Fit
from fitting.estimation.residual import Blocks, Problem, Products, Unknowns
from hdjax.lanes import jit_lanes

# Data sets in parallel; more would exceed the processor's cache.
_BATCH = 8
# Tolerance of the last step, in standard errors of the parameters.
_CLOSE = 1e-3


def refits(
    found: Fit, measured: Float[Array, "draws segments samples outputs"], *, steps: int = 3
) -> tuple[Float[Array, "draws parameters"], Float[Array, " draws"]]:
    """Fit the model of a fit to other data on the same segments, under the same weights.

    For data that differ by noise, as in a bootstrap. The parameters then change by a few standard errors, over which
    the sensitivities are nearly constant. They are computed once, at the fit, and each refit takes a few Gauss-Newton
    steps with them (the chord method). A step costs one simulation without sensitivities.

    Args:
        found: the fit, with its segments and weights.
        measured: the outputs in place of those of `found.problem.segments`.
        steps: most Gauss-Newton steps. Each reduces the error by about the parameters' relative change, so that the
            iteration ends after a step of a thousandth of a standard error.

    Returns:
        The free vector (see [`fitting.estimation.free_parameters.FreeParameters`][]) by draw, and the size of the last
        step, in standard errors of the joint estimate.
    """
    problem = with_engine(found.at_solution, values=True)
    return _refits(problem, found.unknowns, linearise(problem, found.unknowns), jnp.asarray(measured), steps)


@jit_lanes
def _refits(problem: Problem, start: Unknowns, at_start: Blocks, measured: Array, steps: int) -> tuple[Array, Array]:
    def refit(data: Array) -> tuple[Array, Array]:
        own = eqx.tree_at(lambda p: p.segments.measured, problem, data)

        def improved(at: tuple[Unknowns, Array, Array]) -> tuple[Unknowns, Array, Array]:
            unknowns, _, count = at
            rows, gap = residual_inside(own, unknowns)
            here = eqx.tree_at(lambda b: (b.residual, b.gap), at_start, (rows, gap))
            system = normal_equations(Products.of(here), problem.segments.joined)
            step = system.step(jnp.zeros(()))
            information, _, _, _ = system.eliminate(jnp.zeros(()), jnp.ones(()))
            moved = jnp.sqrt(step.parameters @ information @ step.parameters)
            return jax.tree.map(jnp.add, unknowns, step), moved, count + 1

        def goes_on(at: tuple[Unknowns, Array, Array]) -> Array:
            _, moved, count = at
            return (count < steps) & ~(moved < _CLOSE)

        begin = start, jnp.full((), jnp.inf), jnp.zeros((), int)
        unknowns, moved, _ = jax.lax.while_loop(goes_on, improved, begin)
        return jnp.asarray(unknowns.parameters), moved

    return jax.lax.map(refit, measured, batch_size=_BATCH)
