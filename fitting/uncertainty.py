"""How well the data determine each parameter, also where the model is not quite right."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.arrow import project
from fitting.estimate import Fit, short_horizon
from fitting.residual import Blocks, Problem, linearise
from hdjax.parameters import ParameterInfo

_NORMAL_95 = 1.959963984540054
# Eigenvalues of the scaled information below this are directions that the data do not see at all.
_BLIND = 1e-12


class Estimate(eqx.Module):
    """One fitted parameter.

    Attributes:
        path: dotted path.
        value: in SI units.
        std: standard error, robust against coloured residuals (sandwich).
        std_classical: standard error from J^T J alone, which takes the residual for white noise.
        ci95: 95 % interval.
        unit: SI unit.
        identifiable: whether the data tell the parameter from zero; of a positive parameter, whether they know it
            to better than a factor of about two.
    """

    path: str = eqx.field(static=True)
    value: float
    std: float
    std_classical: float
    ci95: tuple[float, float]
    unit: str = eqx.field(static=True)
    identifiable: bool


class Uncertainty(eqx.Module):
    """Standard errors of all free parameters, and how they go together.

    Attributes:
        estimates: by dotted path.
        correlation: of the free parameters, in the order of `estimates`.
    """

    estimates: dict[str, Estimate]
    correlation: Float[np.ndarray, "parameters parameters"]


def uncertainty(fit: Fit) -> Uncertainty:
    """Standard errors and intervals of a fit.

    The classical covariance is (J^T J)^-1 after each segment's initial state is eliminated. The robust one is the
    sandwich (J^T J)^-1 M (J^T J)^-1, with M summed over chunks of a few natural periods within which residuals may be
    correlated in any way (White 1980; Liang and Zeger 1986).
    """
    free = fit.free
    if not free.paths:
        return Uncertainty({}, np.zeros((0, 0)))
    problem = eqx.tree_at(lambda p: p.model, fit.problem, fit.model)
    chunk = min(short_horizon(fit.model, fit.stretches), fit.error.shape[1])
    information, meat = (np.asarray(a) for a in _information(problem, linearise(problem, fit.unknowns), chunk))
    classical = _inverse(information)
    robust = classical @ meat @ classical
    slopes = np.abs(np.asarray(free.slopes(fit.model)))
    known = fit.model.parameters()
    estimates = {}
    for i, path in enumerate(free.paths):
        value, info = known[path]
        # Clusters under-estimate where they are few; the larger of the two is the honest one.
        error = float(np.sqrt(max(robust[i, i], classical[i, i])))
        estimates[path] = _estimate(
            path,
            float(value),
            info,
            error,
            float(np.sqrt(classical[i, i])),
            float(slopes[i]),
            free.logarithmic[i],
        )
    spread = np.sqrt(np.diag(classical))
    return Uncertainty(estimates, classical / np.outer(spread, spread))


def _estimate(
    path: str,
    value: float,
    info: ParameterInfo,
    error: float,
    classical: float,
    slope: float,
    logarithmic: bool,
) -> Estimate:
    if logarithmic:
        factor = float(np.exp(min(_NORMAL_95 * error, 700.0)))
        interval = (value / factor, value * factor)
        identifiable = error < 0.5
    else:
        interval = (value - _NORMAL_95 * slope * error, value + _NORMAL_95 * slope * error)
        identifiable = not interval[0] <= 0.0 <= interval[1]
    return Estimate(
        path=path,
        value=value,
        std=slope * error,
        std_classical=slope * classical,
        ci95=interval,
        unit=info.unit,
        identifiable=bool(identifiable),
    )


@eqx.filter_jit
def _information(problem: Problem, found: Blocks, chunk: int) -> tuple[Array, Array]:
    projected = project(found, problem.segments.joined)
    information = jnp.einsum("srp,srq->pq", projected, projected)
    outputs = problem.segments.measured.shape[-1]
    samples = problem.segments.measured.shape[1]
    scores = projected * found.residual[:, :, None]
    segments, _, parameters = scores.shape
    scores = scores[:, : samples * outputs].reshape(segments, samples, outputs, parameters).sum(2)
    padding = -samples % chunk
    scores = jnp.pad(scores, ((0, 0), (0, padding), (0, 0)))
    clusters = scores.reshape(segments, -1, chunk, parameters).sum(2)
    meat = jnp.einsum("scp,scq->pq", clusters, clusters)
    return information, meat


def _inverse(information: np.ndarray) -> np.ndarray:
    """Inverse after scaling to unit diagonal; directions that the data do not see get a huge variance."""
    diagonal = np.diag(information)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    scaled = information * np.outer(scale, scale)
    values, vectors = np.linalg.eigh(scaled)
    values = np.maximum(values, _BLIND)
    return (vectors / values) @ vectors.T * np.outer(scale, scale)
