"""Noise model: white or exponentially correlated noise of the sensors, and noise of the logged torque.

The acting torque differs from the logged one by noise. The drive responds to it, so that residuals exceed the sensors'
noise although no effect is missing. The deviation from a fitted motion is linear and driven by that noise. Under the
right variances the innovations of a Kalman filter are white, and their likelihood is largest.
"""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float
from scipy.special import expit

from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit, log_of, segments_by
from fitting.estimation.linear_response import follow
from fitting.estimation.problem import with_hidden_states
from fitting.estimation.residual import RUNAWAY, Problem, Unknowns
from fitting.uncertainty.innovations import SensorNoise, Steps, filtered, spread_evenly, white_noise
from fitting.uncertainty.input_noise import torque_pushes
from hdjax import Model, TwoInertiaModel

# Prior standard deviation of a segment's initial state, in units of the residual.
_FREE = 10.0
# Starting values of torque noise, as shares of the torque's rms: the smallest (up to one), and their number.
_LEAST, _SHARES = 1e-5, 11
# Most logs that are used, and segments of each, evenly spaced: some thousand samples determine a variance to a few
# percent. Correlated sensor noise is estimated from fewer.
_LOGS, _SEGMENTS, _SEGMENTS_OF_MEMORY = 4, 24, 24
# Lags of the whiteness test of innovations.
_LAGS = 20
# Starting values of the sensors' noise: nine tenths of the estimate from short pieces (log odds); half of it white,
# half with a correlation time of five samples.
_MOST_OF_IT, _HALF, _FIVE_SAMPLES = 2.2, np.log(0.5), 1.5
# Least share of that estimate: below it, rounding would make variances of the filter negative.
_LEAST_OF_IT = 1e-6
# Step of its differences, gradient of the likelihood at which it ends [nats per sample], and most iterations; where
# only noise is left, about ten suffice.
_STEP, _FLAT, _ITERATIONS = 1e-4, 1e-4, 15


class NoiseModel(eqx.Module):
    """Fitted noise of torque and sensors.

    Attributes:
        std: of a torque sample that is held through its interval [N m], or in the forcing's unit; rms over the logs.
        share: `std` over the rms of the torque.
        sensors: noise of the outputs.
        size: largest rms of an output's innovations over its expected value.
        predictable: share of the innovations' variance that earlier ones predict, of the output and log where it is
            largest; zero for white innovations.
        likelihood: log likelihood of the innovations, up to a constant.
        without: log likelihood without torque noise.
        count: number of innovations.
    """

    std: float
    share: float
    sensors: SensorNoise
    size: float
    predictable: float
    likelihood: float
    without: float
    count: int = eqx.field(static=True)


def noise_model(
    fit: Fit,
    outputs: Float[Array | np.ndarray, "outputs outputs"],
    *,
    predictable: float,
    residual: Float[Array | np.ndarray, "outputs outputs"] | None = None,
) -> NoiseModel | None:
    """Estimate the noise model of a fit's residual; None where the model diverges, or the sensors have no noise.

    Each log has its own torque noise, since its torque sensor may have another range. The sensors' white noise is at
    most the estimate from short pieces, which includes torque noise. Correlated sensor noise is added only where
    innovations are predictable without it.

    Args:
        fit: of a model that is assumed complete, over short horizons.
        outputs: covariance of the measurement noise, estimated from short pieces.
        predictable: share of the innovations' variance that is negligible.
        residual: covariance of a residual, which sets how far initial states may be off; that of the fit if None.
            Likelihoods of two models can be compared only for the same one.

    References:
        Ljung (1999), System Identification, 2nd edition, sections 7.3 and 16.6.
    """
    with np.errstate(all="ignore"):
        steps = _steps(fit, np.asarray(fit.covariance if residual is None else residual))
    if not np.all(np.abs(steps.transition) < RUNAWAY):
        return None
    try:
        with np.errstate(invalid="ignore"):
            return _likeliest_model(steps, white_noise(np.asarray(outputs)), predictable)
    except np.linalg.LinAlgError:
        # Sensors without noise: by rounding, a variance is not positive.
        return None


def _likeliest_model(steps: Steps, known: SensorNoise, predictable: float) -> NoiseModel:
    """The noise model of linearised segments; arguments as in [`noise_model`][]."""
    count = len(known.white)

    def white(unknowns: np.ndarray) -> SensorNoise:
        nothing = np.zeros_like(unknowns)
        return SensorNoise(known.combined, np.maximum(expit(unknowns), _LEAST_OF_IT), nothing, nothing)

    def with_memory(unknowns: np.ndarray) -> SensorNoise:
        fast, slow, odds = np.split(unknowns, 3, axis=-1)
        return SensorNoise(known.combined, np.maximum(np.exp(fast), _LEAST_OF_IT), np.exp(slow), expit(odds))

    shares, sensors = _likeliest(steps, _first_shares(steps, known), white, np.full(count, _MOST_OF_IT))
    found = _judged(steps, shares, sensors)
    if found.predictable <= predictable:
        return found
    first = np.repeat([_HALF, _HALF, _FIVE_SAMPLES], count)
    return _judged(steps, *_likeliest(steps.fewer(_SEGMENTS_OF_MEMORY), shares, with_memory, first))


def _judged(steps: Steps, shares: Float[np.ndarray, " logs"], sensors: SensorNoise) -> NoiseModel:
    """Innovation statistics under noise of given size."""
    innovations, logarithms = filtered(steps, np.stack([shares, 0.0 * shares]) * steps.torque, sensors)
    std, share = (float(np.sqrt(np.mean(np.square(v)))) for v in (shares * steps.torque, shares))
    counts, logs = steps.counts[steps.lead :], [steps.log == i for i in range(shares.size)]
    each = [_size_and_colour(innovations[0, own], float(counts[:, own].sum())) for own in logs]
    size, colour = np.max(each, axis=0)
    samples = int(counts.sum())
    # The innovations are those of the independent combinations.
    units = samples * float(np.linalg.slogdet(sensors.combined)[1])
    likelihood, without = -np.sum(0.5 * innovations**2 + logarithms, axis=(1, 2, 3)) - units
    count = samples * innovations.shape[3]
    return NoiseModel(std, share, sensors, float(size), float(colour), float(likelihood), float(without), count)


def _first_shares(steps: Steps, sensors: SensorNoise) -> Float[np.ndarray, " logs"]:
    """The most likely starting value of torque noise for each log."""
    shares = np.geomspace(_LEAST, 1.0, _SHARES)
    innovations, logarithms = filtered(steps, shares[:, None] * steps.torque, sensors)
    unlikely = np.sum(0.5 * innovations**2 + logarithms, axis=(2, 3))
    by_log = unlikely @ (steps.log[:, None] == np.arange(steps.torque.size))
    return shares[np.argmin(by_log, axis=0)]


def _likeliest(
    steps: Steps,
    shares: Float[np.ndarray, " logs"],
    noise: Callable[[np.ndarray], SensorNoise],
    first: Float[np.ndarray, " unknowns"],
) -> tuple[Float[np.ndarray, " logs"], SensorNoise]:
    """Maximum-likelihood noise of each log's torque and of the sensors: by scoring (Ljung 1999, section 10.2), with the
    Fisher information of Gaussian innovations.

    Args:
        steps: the linearised motion.
        shares: starting values of the torque noise.
        noise: sensor noise as a function of unknowns.
        first: their starting values.
    """
    # Imported here: it takes as long as jax, and is rarely needed.
    from scipy.optimize import minimize

    logs = shares.size
    own = steps.log == np.arange(logs)[:, None]

    def at(unknowns: np.ndarray) -> tuple[np.ndarray, SensorNoise]:
        return np.exp(unknowns[..., :logs]), noise(unknowns[..., logs:])

    def seen(unknowns: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        # Each segment belongs to one log, so the shares of all logs are varied together.
        together = np.concatenate([np.ones((1, logs)), np.zeros((first.size, logs))])
        apart = np.concatenate([np.zeros((1, first.size)), np.eye(first.size)])
        varied = unknowns + _STEP * np.concatenate([0.0 * unknowns[None], np.hstack([together, apart])])
        varied_shares, sensors = at(varied)
        innovations, logarithms = filtered(steps, varied_shares * steps.torque, sensors)

        def slopes(values: np.ndarray) -> np.ndarray:
            found = (values[1:] - values[0]) / _STEP
            return np.concatenate([own[..., None, None] * found[0], found[1:]]).reshape(unknowns.size, -1)

        now, size = innovations[0].ravel(), innovations[0].size
        moved, grown = slopes(innovations), slopes(logarithms)
        value = 0.5 * float(now @ now) + float(logarithms[0].sum())
        errors = moved + now * grown
        information = 2.0 * grown @ grown.T + errors @ errors.T
        return value / size, (moved @ now + grown.sum(axis=1)) / size, information / size

    last: list[tuple[np.ndarray, tuple]] = []

    def once(unknowns: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
        if not last or not np.array_equal(last[0][0], unknowns):
            last[:] = [(unknowns.copy(), seen(unknowns))]
        return last[0][1]

    solution = minimize(
        lambda u: once(u)[0],
        np.concatenate([np.log(shares), first]),
        jac=lambda u: once(u)[1],
        hess=lambda u: once(u)[2],
        method="trust-exact",
        options={"gtol": _FLAT, "max_trust_radius": 3.0, "maxiter": _ITERATIONS},
    )
    return at(solution.x)


def _steps(fit: Fit, residual: Float[np.ndarray, "outputs outputs"]) -> Steps:
    problem = fit.at_solution
    followed = follow(problem, fit.unknowns)
    weight = np.asarray(problem.segments.weight)
    logs = [np.flatnonzero(weight.any(axis=1) & own) for own in segments_by(fit, log_of).values()]
    logs = [own for own in logs if own.size]
    logs = [logs[i] for i in spread_evenly(len(logs), _LOGS)]
    logs = [own[spread_evenly(own.size, _SEGMENTS)] for own in logs]
    used = np.concatenate(logs)
    read = followed.readout[used]
    off = _hidden_gaps(problem, followed.states)
    rms = np.sqrt(np.diag(residual))
    torque = np.asarray(problem.segments.torque.coefficients)

    def in_time(values: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.moveaxis(values, 0, -1))

    return Steps(
        in_time(followed.transition[used]),
        in_time(torque_pushes(problem.model, followed)[used]),
        in_time(read),
        in_time(np.concatenate([np.asarray(fit.error)[used, ..., None], _by_parameter(fit)[used]], axis=3)),
        in_time(weight[used] > 0),
        np.repeat(np.arange(len(logs)), [own.size for own in logs]),
        np.concatenate([np.zeros((len(problem.model.motion_states), used.size)), off[used].T]),
        np.diag(_freedom(problem.model, read, rms, off[weight.any(axis=1)]) ** 2),
        np.array([max(float(np.std(torque[own, :, 0])), 1e-300) for own in logs]),
    )


def _by_parameter(fit: Fit) -> Float[np.ndarray, "segments samples outputs parameters"]:
    """Derivatives of the error by the parameters. Under process noise the filter determines parameters better than
    simulations, so that it takes a step of its own."""
    found = linearise(fit.problem, fit.unknowns)
    segments, samples, outputs = fit.error.shape
    rows = np.asarray(found.by_parameter)[:, : samples * outputs].reshape(segments, samples, outputs, -1)
    return np.linalg.solve(np.asarray(fit.problem.whitening), rows)


def _hidden_gaps(
    problem: Problem, states: Float[np.ndarray, "segments knots states"]
) -> Float[np.ndarray, "segments hidden"]:
    """Expected minus fitted hidden initial states. They are expected as the segment before ends, or in steady state.

    A fitted hidden state depends on the whole segment; if the filter began with it, memory would seem to predict noise.
    """
    motion = len(problem.model.motion_states)
    begin, before = states[:, 0], np.roll(states[:, -1, motion:], 1, axis=0)
    settled = np.asarray(with_hidden_states(problem.model, begin[:, :motion]))[:, motion:]
    goes_on = np.asarray(problem.segments.goes_on)[:, None]
    return np.where(goes_on, before, settled) - begin[:, motion:]


def _freedom(
    model: Model, read: np.ndarray, rms: np.ndarray, gaps: Float[np.ndarray, "segments hidden"]
) -> Float[np.ndarray, " states"]:
    """By how much each state may be off where a segment begins: an angle by what its own output or its rate's shows; a
    side that no output shows, by as much as the other one; a hidden state by as much as it is off the segment before.
    """
    angles, omega_0 = len(model.motion_states) // 2, float(model.drive.omega_0)
    sides = np.array([float(model.drive.N), 1.0]) if isinstance(model, TwoInertiaModel) else np.ones(angles)
    shown = np.abs(read[0, 0][:, : 2 * angles]).reshape(-1, 2, angles)
    # Outputs that show angles; where there is none, rates.
    shown = shown[:, 0] if shown[:, 0].any() else omega_0 * shown[:, 1]
    angle = _FREE * np.max(np.where(shown > 0, rms[:, None] / np.where(shown > 0, shown, 1.0), 0.0), axis=0)
    angle = np.where(angle > 0, angle, sides * np.max(angle / sides))
    return np.concatenate([angle, angle * omega_0, np.sqrt(np.mean(gaps**2, axis=0))])


def _size_and_colour(innovations: Float[np.ndarray, "segments samples outputs"], valid: float) -> tuple[float, float]:
    """Largest rms of an output over the valid samples, where innovations are not zero; and the sum of squared
    autocorrelations minus its expectation for white noise."""
    square, lags = np.sum(innovations**2, axis=(0, 1)), min(_LAGS, innovations.shape[1] - 1)
    correlation = [
        np.sum(innovations[:, lag:] * innovations[:, :-lag], axis=(0, 1)) / square for lag in range(1, lags + 1)
    ]
    count = innovations.shape[0] * innovations.shape[1]
    colour = np.max(np.sum(np.square(correlation), axis=0)) - lags / count
    return float(np.sqrt(np.max(square) / max(valid, 1.0))), max(0.0, float(colour))


def spread_by_torque(problem: Problem, unknowns: Unknowns, std: float) -> Float[np.ndarray, "segments samples"]:
    """Standard deviation of the last output due to torque noise along each segment.

    Args:
        problem: the segments.
        unknowns: supply their initial states.
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
