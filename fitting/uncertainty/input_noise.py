"""Standard errors under noise of the logged torque, which the drive's dynamics colour.

The acting torque differs from the logged one by noise. So the residual is white encoder noise plus the drive's response
to torque noise. Where this describes the residual's spectrum, two or three variances determine it. Standard errors then
need only a few periods of data, where a nonparametric spectrum would be poorly determined. The variances are estimated
from the periodogram (Whittle 1953). The estimates' covariance follows from their sensitivity to each torque sample, by
one adjoint pass.
"""

from collections.abc import Sequence
from itertools import combinations

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.special import kolmogorov

from fitting.estimation.estimate import Fit
from fitting.estimation.linear_response import Followed, Forces, follow, respond
from fitting.estimation.projection import through_segments
from fitting.estimation.residual import Problem
from fitting.uncertainty.sandwich import Linearised, Record
from hdjax import Model
from hdjax.effects import Conditions
from hdjax.engine.pointwise import slopes_at_instants

# Draws of torque noise whose mean periodogram approximates its expectation.
_DRAWS = 16
_REWEIGHTINGS = 6
# Significance level at which the spectrum is rejected.
_REFUSED = 0.01


def torque_noise_covariance(
    fit: Fit, regression: Linearised, inverse: Float[np.ndarray, "parameters parameters"]
) -> Float[np.ndarray, "parameters parameters"] | None:
    """Covariance of the free vector where white noise of encoders and torque explains the residual's spectrum.

    Args:
        fit: the fit.
        regression: the same as a linear regression.
        inverse: (J^T J)^-1.

    Returns:
        The covariance; None where the residual has another spectrum.
    """
    problem = fit.at_solution
    followed = follow(problem, fit.unknowns)
    random = np.random.default_rng(0)
    noise = random.normal(size=(*problem.segments.weight.shape, _DRAWS))
    answers = _answers(problem, followed, noise)
    records = regression.records
    in_time = fit.by_stretch(answers)
    variances = _variances(records, in_time, inverse)
    if variances is None:
        return None
    *encoders, torque = variances
    slopes = _by_segment(records, fit)
    middle = torque * _torque_scores(problem, followed, slopes)
    # Noise of the motor's encoder enters both outputs.
    together = _covariance([r.residual[..., None] for r in records]) - torque * _covariance(in_time)
    together[np.diag_indices(len(encoders))] = encoders
    for record in records:
        middle += np.einsum("nop,oq,nqr->pr", record.slopes, together, record.slopes, optimize=True)
    return inverse @ middle @ inverse


def _by_segment(records: Sequence[Record], fit: Fit) -> Float[np.ndarray, "segments samples outputs parameters"]:
    """The records' slopes by segment, padded with zeros."""
    found = np.zeros((*fit.error.shape[:2], *records[0].slopes.shape[1:]))
    for own, record in zip(np.split(found, np.cumsum(fit.pieces)), records, strict=False):
        own.reshape(-1, *found.shape[2:])[: len(record.slopes)] = record.slopes
    return found


def _covariance(series: Sequence[np.ndarray]) -> np.ndarray:
    """Covariance of the outputs, over samples and draws."""
    both = np.concatenate([np.moveaxis(s, 2, 0).reshape(-1, s.shape[1]) for s in series])
    return both.T @ both / both.shape[0]


def _variances(
    records: Sequence[Record], answers: Sequence[np.ndarray], inverse: np.ndarray
) -> Float[np.ndarray, " sources"] | None:
    """Variances of each output's white noise and of torque noise; None where they do not describe the spectrum."""
    measured, expected = [], []
    for record, answer in zip(records, answers, strict=True):
        count, outputs = record.residual.shape
        left = np.stack([_power(_left_over(record, _unit(record, o), inverse)).mean(axis=2) for o in range(outputs)])
        drive = _power(_left_over(record, answer, inverse)).mean(axis=2)
        inside = slice(1, (count - 1) // 2)
        measured.append(_power(record.residual[..., None])[inside, :, 0].ravel())
        columns = np.concatenate([left, drive[None]])[:, inside]
        expected.append(columns.reshape(outputs + 1, -1).T)
    power, shapes = np.concatenate(measured), np.concatenate(expected)
    known = shapes.sum(axis=1) > 1e-9 * shapes.sum(axis=1).max()
    if not known.any():
        return None
    power, shapes = power[known], shapes[known]
    level = np.full(power.size, power.mean())
    found = np.zeros(shapes.shape[1])
    for _ in range(_REWEIGHTINGS):
        found = nonnegative(shapes / level[:, None], power / level)
        level = np.maximum(shapes @ found, 1e-6 * power.mean())
    # Under the right spectrum, the periodogram is exponentially distributed.
    adequate = uniformity(1.0 - np.exp(-power / level)) > _REFUSED
    return found if adequate and found[-1] > 0.0 else None


def nonnegative(
    shapes: Float[np.ndarray, "lines sources"], power: Float[np.ndarray, " lines"]
) -> Float[np.ndarray, " sources"]:
    """Nonnegative least squares, by trying each subset of the two or three sources.

    Replaces `scipy.optimize.nnls`, whose import takes as long as all other imports of a fit.
    """
    # Responses to torque noise may be orders of magnitude larger than those to encoder noise.
    scale = np.maximum(np.linalg.norm(shapes, axis=0), np.finfo(float).tiny)
    gram, moment = (shapes / scale).T @ (shapes / scale), (shapes / scale).T @ power
    best, most = np.zeros(moment.size), 0.0
    for size in range(1, moment.size + 1):
        for chosen in map(list, combinations(range(moment.size), size)):
            found = np.linalg.lstsq(gram[np.ix_(chosen, chosen)], moment[chosen])[0]
            # Decrease of the sum of squares.
            gain = float(moment[chosen] @ found)
            if (found >= 0.0).all() and gain > most:
                best, most = np.zeros(moment.size), gain
                best[chosen] = found
    return best / scale


def uniformity(values: Float[np.ndarray, " n"]) -> float:
    """p-value of Kolmogorov's test for the uniform law from 0 to 1, with Stephens's correction for few values.

    Replaces `scipy.stats.kstest`, whose import takes as long as that of jax.

    References:
        Stephens, M. A. (1970), Journal of the Royal Statistical Society B 32, 115-122.
    """
    ordered, count = np.sort(values), values.size
    above, below = np.arange(1, count + 1) / count - ordered, ordered - np.arange(count) / count
    root = np.sqrt(count)
    return float(kolmogorov((root + 0.12 + 0.11 / root) * max(above.max(), below.max())))


def _unit(record: Record, output: int) -> Float[np.ndarray, "n outputs draws"]:
    """Draws of white noise in one output."""
    random = np.random.default_rng(1 + output)
    found = np.zeros((*record.residual.shape, _DRAWS))
    found[:, output] = random.normal(size=(record.residual.shape[0], _DRAWS))
    return found


def _left_over(record: Record, drawn: np.ndarray, inverse: np.ndarray) -> np.ndarray:
    """Residual of a disturbance after a fit of initial states and parameters."""
    left = drawn - np.einsum("nop,pq,mrq,mrd->nod", record.slopes, inverse, record.slopes, drawn, optimize=True)
    for start, basis in record.bases():
        own, flat = slice(start, start + len(basis)), basis.reshape(-1, basis.shape[2])
        part = left[own].reshape(len(flat), -1)
        left[own] = (part - flat @ (flat.T @ part)).reshape(len(basis), *left.shape[1:])
    return left


def _power(series: np.ndarray) -> np.ndarray:
    return np.abs(np.fft.rfft(series, axis=0)) ** 2 / series.shape[0]


def torque_pushes(model: Model, followed: Followed) -> Float[np.ndarray, "segments samples states"]:
    """Change of the state at a sample interval's end by a unit of torque held through it.

    Args:
        model: the equations.
        followed: the motion.
    """
    torque, rest = np.zeros(1), np.asarray(model.rest())
    rate = slopes_at_instants(_rates, (torque, 0), (model, 0), (rest, 0))[:, 0]
    return (followed.from_start + followed.from_end) @ rate


def _rates(torque: Array, model: Model, state: Array) -> Array:
    # Independent of time and temperature.
    zero = jnp.zeros_like(torque[0])
    return model.rates(state, torque[0], zero, Conditions(time=zero, temperature=zero))


def _answers(
    problem: Problem, followed: Followed, noise: Float[np.ndarray, "segments samples draws"]
) -> Float[np.ndarray, "segments samples outputs draws"]:
    """Whitened residual due to torque noise, carried on across joined segments."""
    forces = Forces(torque_pushes(problem.model, followed)[..., None], noise[:, :, None, :])
    joined = np.asarray(problem.segments.joined)
    before = np.roll(respond(followed, forces)[1], 1, axis=0), np.roll(_across(followed), 1, axis=0)
    own, across = (np.where(joined[:, None, None], a, 0.0) for a in before)
    outputs, _ = respond(followed, forces, through_segments(joined, across, own))
    return -(np.asarray(problem.whitening) @ outputs) * np.asarray(problem.segments.weight)[:, :, None, None]


def _across(followed: Followed) -> Float[np.ndarray, "segments states states"]:
    """Transition matrix of the state across each segment."""
    states = followed.states.shape[-1]
    found = np.broadcast_to(np.eye(states), (len(followed.states), states, states))
    for transition in np.swapaxes(followed.transition, 0, 1):
        found = transition @ found
    return found


def _torque_scores(
    problem: Problem, followed: Followed, slopes: Float[np.ndarray, "segments samples outputs parameters"]
) -> Float[np.ndarray, "parameters parameters"]:
    """Covariance of J^T r for torque noise of unit variance, by the adjoint of the linear response."""
    pushes = torque_pushes(problem.model, followed)
    white = np.asarray(problem.whitening) @ followed.readout
    read = -np.swapaxes(white, 2, 3) @ slopes * np.asarray(problem.segments.weight)[:, :, None, None]

    def back(costate: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Costates at segment starts, from those at segment ends, and scores."""
        scores = np.zeros((*read.shape[:2], read.shape[-1]))
        for i in reversed(range(read.shape[1])):
            scores[:, i] = (pushes[:, i, None, :] @ costate)[:, 0]
            costate = read[:, i] + np.swapaxes(followed.transition[:, i], 1, 2) @ costate
        return costate, scores

    own, _ = back(np.zeros((len(read), *read.shape[2:])))
    goes_on = np.append(np.asarray(problem.segments.joined)[1:], False)
    across = np.swapaxes(_across(followed), 1, 2)
    starts = through_segments(goes_on[::-1], across[::-1], own[::-1])[::-1]
    _, scores = back(np.where(goes_on[:, None, None], np.roll(starts, -1, axis=0), 0.0))
    flat = scores.reshape(-1, scores.shape[-1])
    return flat.T @ flat
