"""Which engine evaluates a residual: machine code where this processor and the model allow it, XLA otherwise."""

import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.machine_code import blocks_by_machine_code, simulated
from fitting.residual import Blocks, Problem, Unknowns, blocks, simulate_segments
from hdjax.engine import UntranslatableError, kernel
from hdjax.lanes import jit_lanes


def with_engine(problem: Problem, *, values: bool = False) -> Problem:
    """The problem with machine code for its model, where that can be.

    Args:
        problem: what is solved.
        values: whether the residual is wanted without derivatives as well.
    """
    return problem if why_not(problem) else _with_kernel(problem, values)


def _with_kernel(problem: Problem, values: bool) -> Problem:
    import dataclasses

    loaded = problem.segments.load_torque is not None
    made = kernel(problem.model, problem.free.paths, loaded=loaded, solver=problem.solver, values=values)
    return dataclasses.replace(problem, kernel=made)


def why_not(problem: Problem) -> str | None:
    """Why XLA evaluates the residual; None where machine code does."""
    reason = unusable()
    if reason is not None:
        return reason
    try:
        _with_kernel(problem, False)
    except UntranslatableError as error:
        return f"the model uses {error}, which the engine for machine code does not know"
    return None


@functools.cache
def unusable() -> str | None:
    """Why there is no machine code on this machine; None where there is."""
    if jax.default_backend() != "cpu":
        return f"the computation runs on a {jax.default_backend()}"
    return None


def linearise(problem: Problem, unknowns: Unknowns, width: int | None = None) -> Blocks:
    """Residual and Jacobian of a problem at some point, by its engine.

    Args:
        problem: what is solved.
        unknowns: where.
        width: columns of the derivatives by parameters, those behind the last parameter zero; one each where None.
    """
    if problem.kernel is not None:
        return blocks_by_machine_code(problem, unknowns, width)
    found = linearise_by_xla(problem, unknowns)
    return found if width is None else widened(found, width)


linearise_by_xla = jit_lanes(blocks)


def widened(found: Blocks, width: int) -> Blocks:
    """The same with columns of zeros behind those of the last parameter."""
    import equinox as eqx

    def wide(columns: Array) -> Array:
        return jnp.asarray(np.pad(np.asarray(columns), [(0, 0)] * 2 + [(0, width - columns.shape[-1])]))

    places = (found.by_parameter, found.before_by_parameter)
    return eqx.tree_at(lambda b: (b.by_parameter, b.before_by_parameter), found, tuple(map(wide, places)))


def simulate(problem: Problem, unknowns: Unknowns) -> tuple[Float[Array, "segments samples outputs"], Any]:
    """Outputs of a problem's model on each segment, and the state it ends in, by its engine."""
    if problem.kernel is None:
        return simulate_segments(problem, unknowns)
    ready = with_engine(problem, values=True)
    assert ready.kernel is not None and ready.kernel.values is not None
    return simulated(ready, unknowns, ready.kernel.values)
