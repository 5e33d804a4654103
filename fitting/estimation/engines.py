"""Choice of the engine that evaluates a residual: machine code where processor and model allow it, else XLA."""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.machine_code import (
    blocks_by_machine_code,
    plain_residual_by_machine_code,
    residual_by_machine_code,
    simulated,
)
from fitting.estimation.residual import (
    Blocks,
    LinearisedResidual,
    Problem,
    Products,
    Unknowns,
    blocks,
    moved_residual,
    residual,
    seen_residual,
    simulate_segments,
)
from hdjax.engine import UntranslatableError, kernel, unusable
from hdjax.lanes import jit_lanes


def with_engine(problem: Problem, *, values: bool = False) -> Problem:
    """The problem with machine code for its model, where possible.

    Args:
        problem: the least-squares problem.
        values: whether the residual is needed without derivatives as well.
    """
    return _ready(problem, values)[0]


def why_not(problem: Problem) -> str | None:
    """The reason why XLA evaluates the residual; None where machine code does."""
    return _ready(problem, values=False)[1]


def _ready(problem: Problem, values: bool) -> tuple[Problem, str | None]:
    """The problem with machine code; or unchanged, and the reason."""
    reason = unusable() if problem.engine is None else f"{problem.engine} was requested"
    if reason is not None:
        return problem, reason
    try:
        made = kernel(
            problem.model,
            problem.free.paths,
            loaded=problem.segments.load_torque is not None,
            warm=problem.segments.temperature is not None,
            solver=problem.solver,
            values=values,
        )
    except UntranslatableError as error:
        return problem, f"the model uses {error}, which the machine-code engine does not support"
    return dataclasses.replace(problem, kernel=made), None


def linearise(problem: Problem, unknowns: Unknowns) -> Blocks:
    """Residual and Jacobian of a problem at given unknowns, by its engine."""
    if problem.kernel is not None:
        return blocks_by_machine_code(problem, unknowns)
    return _linearise_by_xla(problem, unknowns)


_linearise_by_xla = jit_lanes(blocks)


def residual_at(
    problem: Problem, unknowns: Unknowns
) -> tuple[Float[Array | np.ndarray, "segments rows"], Float[Array | np.ndarray, "segments states"]]:
    """[`fitting.estimation.residual.residual`][] at given unknowns: by machine code without derivatives, or by the XLA
    program that computes derivatives too, so that no second one is compiled."""
    if problem.kernel is not None:
        return plain_residual_by_machine_code(problem, unknowns)
    found = _linearise_by_xla(problem, unknowns)
    return found.residual, found.gap


def blocks_inside(problem: Problem, unknowns: Unknowns) -> Blocks:
    """[`linearise`][] inside a JAX program."""
    return blocks(problem, unknowns) if problem.kernel is None else blocks_by_machine_code(problem, unknowns)


def residual_inside(
    problem: Problem, unknowns: Unknowns
) -> tuple[Float[Array, "segments rows"], Float[Array, "segments states"]]:
    """[`fitting.estimation.residual.residual`][] inside a JAX program, by the problem's engine."""
    if problem.kernel is None or problem.kernel.values is None:
        return residual(problem, unknowns)
    return residual_by_machine_code(problem, unknowns)


def simulate(
    problem: Problem, unknowns: Unknowns
) -> tuple[Float[Array, "segments samples outputs"], Float[Array, "segments states"]]:
    """Outputs of a problem's model on each segment, and its final state, by the problem's engine."""
    ready = with_engine(problem)
    return _simulate_by_xla(problem, unknowns) if ready.kernel is None else simulated(ready, unknowns)


_simulate_by_xla = jit_lanes(simulate_segments)


def residual_and_products(unknowns: Unknowns, problem: Problem) -> tuple[LinearisedResidual, Products]:
    """The residual with weighted gaps, which [`fitting.estimation.levenberg_marquardt.ArrowLevenbergMarquardt`][]
    minimises; and its products for the normal equations."""
    found = blocks_inside(problem, unknowns)
    free = problem.free
    products = Products.of(found).beside_prior(free.off_prior(unknowns.parameters), free.precision * problem.active)
    return seen_residual(found, problem.gap_weight), products


@eqx.filter_custom_jvp
def residual_with_blocks(unknowns: Unknowns, problem: Problem) -> LinearisedResidual:
    """[`fitting.estimation.residual.residual`][] with weighted gaps, inside a JAX program. Its derivative is a product
    with the Jacobian's blocks, not a second simulation."""
    rows, gap = residual_inside(problem, unknowns)
    return LinearisedResidual(rows, gap * problem.gap_weight[None])


@residual_with_blocks.def_jvp
def _residual_jvp(primals, tangents):
    unknowns, problem = primals
    tangent, _ = tangents
    found = blocks_inside(problem, unknowns)
    joined, weight = problem.segments.joined, problem.gap_weight
    return seen_residual(found, weight), moved_residual(found, weight, joined, tangent)
