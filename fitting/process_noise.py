"""Noise of the logged torque as process noise: its variance from the innovations of a linearised Kalman filter.

What acts and what was logged differ by noise; the drive answers it, so that simulations leave more than the encoders'
noise although no effect is missing. Along a fitted motion the deviation from it is linear and driven by that noise.
The filter's innovations are white under the right variances, which maximise their likelihood.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from fitting.engines import linearise
from fitting.estimate import Fit, segments_of_logs
from fitting.followed import Followed, follow
from fitting.residual import Problem, Unknowns
from fitting.torque_noise import torque_pushes
from hdjax import Model

# Standard deviations, in units of what simulations leave, by which a segment's first state may be off.
_FREE = 10.0
# Samples of a segment in which the filter finds that state, which the likelihood leaves out.
_LEAD = 12
# Shares of its rms between which the torque's noise is sought, and how well its logarithm is wanted.
_LEAST, _MOST, _SETTLED = 1e-5, 1.0, 0.02
# Logs that are asked at most, and segments of each, evenly spread: some thousand samples know a variance to a few
# percent.
_LOGS, _SEGMENTS = 4, 24
# Lags over which innovations are tested for whiteness.
_LAGS = 20


class TorqueNoise(eqx.Module):
    """Noise of the torque beside that of the encoders.

    Attributes:
        std: of one sample, held through its interval [N m], or in the forcing's unit; rms over the logs.
        share: the same over the rms of the torque.
        innovations: rms of each output's innovations in units of what the filter expects; the largest.
        predictable: share of the innovations' variance that earlier ones predict, of the output and the log where it is
            largest: none where the noise is white.
        likelihood: log likelihood of the innovations, but for a constant.
        count: how many there are.
    """

    std: float
    share: float
    innovations: float
    predictable: float
    likelihood: float
    count: int = eqx.field(static=True)


class _Steps(eqx.Module):
    """The linearised motion, a sample after the other, of several segments at once.

    Attributes:
        transition: of a deviation of the state through a sample interval.
        push: what a unit of torque adds to it.
        readout: of the outputs.
        error: of the outputs, and its derivatives by the free parameters.
        counts: whether a sample has weight.
        prior: covariance of the first states.
        torque: its rms.
    """

    transition: Float[np.ndarray, "samples segments states states"]
    push: Float[np.ndarray, "samples segments states"]
    readout: Float[np.ndarray, "samples segments outputs states"]
    error: Float[np.ndarray, "samples segments outputs columns"]
    counts: Bool[np.ndarray, "samples segments"]
    prior: Float[np.ndarray, "states states"]
    torque: float


def torque_noise(fit: Fit, outputs: Float[np.ndarray, "outputs outputs"]) -> TorqueNoise:
    """The noise of the torque that a fit's residual shows.

    Args:
        fit: of a model from which nothing is thought to be missing, over short horizons.
        outputs: covariance of the measurement noise.

    References:
        Ljung (1999), System Identification, 2nd edition, sections 7.3 and 16.6.
    """
    # Loaded here: it takes as long as jax, and only what nothing else explains needs it.
    from scipy.optimize import minimize_scalar

    problem = eqx.tree_at(lambda p: p.model, fit.problem, fit.model)
    followed = follow(problem, fit.unknowns)
    # Each log on its own: its sensor may have been set to another range.
    logs = segments_of_logs(fit)
    found = []
    for i in np.unique(np.linspace(0, len(logs) - 1, min(_LOGS, len(logs))).astype(int)):
        steps = _steps(fit, problem, followed, logs[i])

        def unlikely(logarithm: float, steps: _Steps = steps) -> float:
            return -_filtered(steps, steps.torque * float(np.exp(logarithm)), outputs)[1]

        span = np.log([_LEAST, _MOST])
        best = minimize_scalar(unlikely, bounds=tuple(span), method="bounded", options={"xatol": _SETTLED})
        share = float(np.exp(best.x))
        innovations, likelihood = _filtered(steps, share * steps.torque, outputs)
        count = steps.counts[_LEAD:].sum() * innovations.shape[2]
        found.append((share * steps.torque, share, *_size_and_colour(innovations), likelihood, count))
    std, share, size, predictable, likelihood, count = np.array(found).T
    std, share = (float(np.sqrt(np.mean(np.square(values)))) for values in (std, share))
    largest = float(np.max(size)), float(np.max(predictable))
    return TorqueNoise(std, share, *largest, float(np.sum(likelihood)), int(np.sum(count)))


def _steps(fit: Fit, problem: Problem, followed: Followed, own: Bool[np.ndarray, " segments"]) -> _Steps:
    weight = np.asarray(problem.segments.weight)
    used = np.flatnonzero(weight.any(axis=1) & own)
    used = used[np.unique(np.linspace(0, used.size - 1, min(_SEGMENTS, used.size)).astype(int))]
    read = followed.readout[used]
    rms = np.sqrt(np.diag(np.asarray(fit.covariance)))
    torque = np.asarray(problem.segments.torque.coefficients)[used, :, 0]

    def in_time(values: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.swapaxes(values, 0, 1))

    return _Steps(
        in_time(followed.transition[used]),
        in_time(torque_pushes(problem.model, followed)[used]),
        in_time(read),
        in_time(np.concatenate([np.asarray(fit.error)[used, ..., None], _by_parameter(fit)[used]], axis=3)),
        in_time(weight[used] > 0),
        np.diag(_freedom(problem.model, followed.states[used], read, rms) ** 2),
        max(float(np.std(torque)), 1e-300),
    )


def _by_parameter(fit: Fit) -> Float[np.ndarray, "segments samples outputs parameters"]:
    """Derivatives of the error. Simulations of a motion that the noise drives know parameters less well than the
    filter does, so that it takes a step of its own."""
    found = linearise(fit.problem, fit.unknowns)
    segments, samples, outputs = fit.error.shape
    rows = np.asarray(found.by_parameter)[:, : samples * outputs].reshape(segments, samples, outputs, -1)
    return np.linalg.solve(np.asarray(fit.problem.whitening), rows)


def _freedom(model: Model, states: np.ndarray, read: np.ndarray, rms: np.ndarray) -> Float[np.ndarray, " states"]:
    """By how much each state may be off where a segment begins."""
    angles = len(model.motion_states) // 2
    shown = np.abs(read[0, 0][:, :angles])
    angle = _FREE * np.max(np.where(shown > 0, rms[:, None] / np.where(shown > 0, shown, 1.0), 0.0), axis=0)
    hidden = np.std(states.reshape(-1, states.shape[-1]), axis=0)[2 * angles :]
    return np.concatenate([angle, angle * float(model.drive.omega_0), hidden])


def _filtered(
    steps: _Steps, std: float, outputs: Float[np.ndarray, "outputs outputs"]
) -> tuple[Float[np.ndarray, "samples segments outputs"], float]:
    """Standardised innovations at the parameters that suit them best, and their log likelihood but for a constant."""
    samples, segments, size = steps.push.shape
    mean = np.zeros((segments, size, steps.error.shape[3]))
    spread = np.broadcast_to(steps.prior, (segments, size, size))
    white, logarithms = np.zeros(steps.error.shape), 0.0
    for i in range(samples):
        read, counts = steps.readout[i], steps.counts[i]
        expected = spread @ np.swapaxes(read, 1, 2)
        own = read @ expected + outputs
        error = steps.error[i] - read @ mean
        gain = np.swapaxes(np.linalg.solve(own, np.swapaxes(expected, 1, 2)), 1, 2) * counts[:, None, None]
        mean = mean + gain @ error
        spread = spread - gain @ np.swapaxes(expected, 1, 2)
        if i >= _LEAD:
            lower = np.linalg.cholesky(own)
            white[i] = np.linalg.solve(lower, error) * counts[:, None, None]
            logarithms += float(np.sum(counts[:, None] * np.log(np.diagonal(lower, axis1=1, axis2=2))))
        push = std * steps.push[i]
        mean = steps.transition[i] @ mean
        spread = steps.transition[i] @ spread @ np.swapaxes(steps.transition[i], 1, 2)
        spread = spread + push[:, :, None] * push[:, None, :]
    columns = white[..., 1:].reshape(white[..., 0].size, -1)
    size_of = np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    moved = np.linalg.lstsq(columns / size_of, white[..., 0].ravel(), rcond=1e-10)[0] / size_of
    innovations = white[..., 0] - white[..., 1:] @ moved
    return innovations, -0.5 * float(np.sum(innovations**2)) - logarithms


def _size_and_colour(innovations: Float[np.ndarray, "samples segments outputs"]) -> tuple[float, float]:
    """Rms of the output where it is largest; and the sum of squared autocorrelations, less what chance makes of it."""
    kept = innovations[_LEAD:]
    square, lags = np.sum(kept**2, axis=(0, 1)), min(_LAGS, len(kept) - 1)
    correlation = [np.sum(kept[lag:] * kept[:-lag], axis=(0, 1)) / square for lag in range(1, lags + 1)]
    count = kept.shape[0] * kept.shape[1]
    colour = np.max(np.sum(np.square(correlation), axis=0)) - lags / count
    return float(np.sqrt(np.max(square) / count)), max(0.0, float(colour))


def spread_by_torque(problem: Problem, unknowns: Unknowns, std: float) -> Float[np.ndarray, "segments samples"]:
    """Standard deviation of the last output that noise of the torque makes along each segment, from its start on.

    Args:
        problem: the segments.
        unknowns: where they start.
        std: of the noise of one sample.
    """
    followed = follow(problem, unknowns)
    push = std * torque_pushes(problem.model, followed)
    segments, samples, size = push.shape
    spread, found = np.zeros((segments, size, size)), np.zeros((segments, samples))
    for i in range(samples):
        read = followed.readout[:, i, -1]
        found[:, i] = np.einsum("si,sij,sj->s", read, spread, read)
        transition = followed.transition[:, i]
        spread = transition @ spread @ np.swapaxes(transition, 1, 2) + push[:, i, :, None] * push[:, i, None, :]
    return np.sqrt(np.maximum(found, 0.0))
