"""One unknown constant of each log beside a fit's parameters: sensitivities, and the step to all of them together."""

from collections.abc import Mapping

import equinox as eqx
import numpy as np
from jaxtyping import Float

from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit, log_of, segments_by
from fitting.estimation.projection import FirstStates


class LogColumns(eqx.Module):
    """Sensitivity of a fit's residual to a constant of each of several logs.

    Attributes:
        logs: the logs.
        std: prior standard deviation of each log's constant.
        residual: of the fit.
        parameters: its derivative by the free vector, projected orthogonal to the initial states.
        columns: its derivative by each log's constant, projected likewise.
    """

    logs: tuple[str, ...] = eqx.field(static=True)
    std: Float[np.ndarray, " logs"]
    residual: Float[np.ndarray, "segments rows"]
    parameters: Float[np.ndarray, "segments rows parameters"]
    columns: Float[np.ndarray, "segments rows logs"]


def log_columns(
    found: Fit,
    std: Mapping[str, float],
    change: Float[np.ndarray, "segments rows"],
    gap: Float[np.ndarray, "segments states"],
) -> LogColumns:
    """Sensitivities to a constant of each log.

    Args:
        found: the fit.
        std: prior standard deviation of the constants, by log; infinite without a prior.
        change: derivative of the residual by the constant of a segment's log.
        gap: likewise of the gaps before joined segments.
    """
    problem, own = found.at_solution, segments_by(found, log_of)
    seen = linearise(problem, found.unknowns)
    states = FirstStates.of(seen, problem.segments.joined)
    of_log = np.stack([own[log] for log in std], axis=-1)[:, None]
    # A gap is a segment's initial state minus the preceding segment's final state.
    columns = states.without(change[:, :, None] * of_log, -gap[:, :, None] * of_log)
    return LogColumns(
        logs=tuple(std),
        std=np.array(list(std.values())),
        residual=np.asarray(seen.residual),
        parameters=states.parameters_without(seen),
        columns=columns,
    )


def step_to_constants(found: Fit, seen: LogColumns) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n n"]]:
    """Gauss-Newton step of a fit's parameters and of a constant of each log, and their covariance; NaN where a
    simulation diverges."""
    columns = np.concatenate([seen.parameters, seen.columns], axis=2)
    columns = columns.reshape(-1, columns.shape[2])
    precision, off = np.asarray(found.free.precision), np.asarray(found.free.off_prior(found.free.pack(found.model)))
    prior = np.diag(np.concatenate([precision**2, 1.0 / seen.std**2]))
    with np.errstate(all="ignore"):
        information, slope = columns.T @ columns + prior, columns.T @ seen.residual.reshape(-1)
    slope[: precision.size] += precision * off
    if not (np.isfinite(information).all() and np.isfinite(slope).all()):
        return np.nan * slope, np.nan * information
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    covariance = np.linalg.pinv(information * np.outer(scale, scale), hermitian=True) * np.outer(scale, scale)
    return -covariance @ slope, covariance
