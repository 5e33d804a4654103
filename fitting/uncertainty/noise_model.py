"""Noise model: white or exponentially correlated noise of the sensors, and noise of the logged torque.

The acting torque differs from the logged one by noise. The drive responds to it, so that residuals exceed the sensors'
noise although no effect is missing. The deviation from a fitted motion is linear and driven by that noise. Under the
right variances the innovations of a Kalman filter are white, and their likelihood is largest.
"""

from collections.abc import Callable

import equinox as eqx
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.special import expit

from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit, segments_of_logs
from fitting.estimation.linear_response import follow
from fitting.estimation.residual import RUNAWAY, Problem, Unknowns
from fitting.uncertainty.input_noise import torque_pushes
from hdjax import Model, TwoInertiaModel

# Prior standard deviation of a segment's initial state, in units of the residual.
_FREE = 10.0
# Lead-in samples of a segment in which the filter converges.
_LEAD = 12
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


class SensorNoise(eqx.Module):
    """Noise of the outputs, in combinations with independent noise.

    Each is the sum of a white part and an exponentially correlated (slow) part.

    Attributes:
        combined: the outputs as combinations of independent ones of unit variance.
        white: variance of each one's white part.
        slow: variance of each one's slow part.
        correlation: of neighbouring samples of the slow part.
    """

    combined: Float[np.ndarray, "outputs outputs"]
    white: Float[np.ndarray, "*settings outputs"]
    slow: Float[np.ndarray, "*settings outputs"]
    correlation: Float[np.ndarray, "*settings outputs"]

    @property
    def covariance(self) -> Float[np.ndarray, "outputs outputs"]:
        """Covariance of the outputs' noise."""
        return self.combined @ np.diag(self.white + self.slow) @ self.combined.T

    def memory(self, time_step: float) -> float | None:
        """Correlation time [s] of the slow part of the last output's noise; None without one."""
        slow = self.combined[-1] ** 2 * self.slow
        return -time_step / float(np.log(slow @ self.correlation / slow.sum())) if slow.any() else None


def white_noise(covariance: Float[np.ndarray, "outputs outputs"]) -> SensorNoise:
    """White noise of the outputs."""
    one = np.ones(len(covariance))
    return SensorNoise(np.linalg.cholesky(covariance), one, 0.0 * one, 0.0 * one)


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


class _Steps(eqx.Module):
    """The linearised motion of several segments, sample by sample.

    Attributes:
        transition: of the state's deviation over a sample interval.
        push: its change by a unit of torque.
        readout: of the outputs.
        error: of the outputs, and its derivatives by the free parameters.
        counts: whether a sample is valid.
        log: of each segment.
        prior: covariance of the initial states.
        torque: rms torque of each log.
        lead: lead-in samples of the filter, which the likelihood omits.
    """

    transition: Float[np.ndarray, "samples segments states states"]
    push: Float[np.ndarray, "samples segments states"]
    readout: Float[np.ndarray, "samples segments outputs states"]
    error: Float[np.ndarray, "samples segments outputs columns"]
    counts: Bool[np.ndarray, "samples segments"]
    log: Int[np.ndarray, " segments"]
    prior: Float[np.ndarray, "states states"]
    torque: Float[np.ndarray, " logs"]
    lead: int = eqx.field(static=True, default=_LEAD)

    def fewer(self, segments: int) -> "_Steps":
        """The same for at most so many segments, evenly spaced."""
        chosen = _spread(self.log.size, segments)
        places = (self.transition, self.push, self.readout, self.error, self.counts)
        fewer = (*(place[:, chosen] for place in places), self.log[chosen])
        return eqx.tree_at(lambda s: (s.transition, s.push, s.readout, s.error, s.counts, s.log), self, fewer)


def noise_model(
    fit: Fit, outputs: Float[Array | np.ndarray, "outputs outputs"], *, predictable: float
) -> NoiseModel | None:
    """Estimate the noise model of a fit's residual; None where the model diverges.

    Each log has its own torque noise, since its torque sensor may have another range. The sensors' white noise is at
    most the estimate from short pieces, which includes torque noise. Correlated sensor noise is added only where
    innovations are predictable without it.

    Args:
        fit: of a model that is assumed complete, over short horizons.
        outputs: covariance of the measurement noise, estimated from short pieces.
        predictable: share of the innovations' variance that is negligible.

    References:
        Ljung (1999), System Identification, 2nd edition, sections 7.3 and 16.6.
    """
    steps = _steps(fit)
    if not np.all(np.abs(steps.transition) < RUNAWAY):
        return None
    known = white_noise(np.asarray(outputs))
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


def _judged(steps: _Steps, shares: Float[np.ndarray, " logs"], sensors: SensorNoise) -> NoiseModel:
    """Innovation statistics under noise of given size."""
    innovations, logarithms = _filtered(steps, np.stack([shares, 0.0 * shares]) * steps.torque, sensors)
    std, share = (float(np.sqrt(np.mean(np.square(v)))) for v in (shares * steps.torque, shares))
    each = [_size_and_colour(innovations[0, steps.log == log]) for log in range(shares.size)]
    size, colour = np.max(each, axis=0)
    likelihood, without = -np.sum(0.5 * innovations**2 + logarithms, axis=(1, 2, 3))
    count = int(steps.counts[steps.lead :].sum()) * innovations.shape[3]
    return NoiseModel(std, share, sensors, float(size), float(colour), float(likelihood), float(without), count)


def _first_shares(steps: _Steps, sensors: SensorNoise) -> Float[np.ndarray, " logs"]:
    """The most likely starting value of torque noise for each log."""
    shares = np.geomspace(_LEAST, 1.0, _SHARES)
    innovations, logarithms = _filtered(steps, shares[:, None] * steps.torque, sensors)
    unlikely = np.sum(0.5 * innovations**2 + logarithms, axis=(2, 3))
    by_log = unlikely @ (steps.log[:, None] == np.arange(steps.torque.size))
    return shares[np.argmin(by_log, axis=0)]


def _likeliest(
    steps: _Steps,
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
        innovations, logarithms = _filtered(steps, varied_shares * steps.torque, sensors)

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


def _steps(fit: Fit) -> _Steps:
    problem = fit.at_solution
    followed = follow(problem, fit.unknowns)
    weight = np.asarray(problem.segments.weight)
    logs = [np.flatnonzero(weight.any(axis=1) & own) for own in segments_of_logs(fit)]
    logs = [own for own in logs if own.size]
    logs = [logs[i] for i in _spread(len(logs), _LOGS)]
    logs = [own[_spread(own.size, _SEGMENTS)] for own in logs]
    used = np.concatenate(logs)
    read = followed.readout[used]
    rms = np.sqrt(np.diag(np.asarray(fit.covariance)))
    torque = np.asarray(problem.segments.torque.coefficients)

    def in_time(values: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(np.swapaxes(values, 0, 1))

    return _Steps(
        in_time(followed.transition[used]),
        in_time(torque_pushes(problem.model, followed)[used]),
        in_time(read),
        in_time(np.concatenate([np.asarray(fit.error)[used, ..., None], _by_parameter(fit)[used]], axis=3)),
        in_time(weight[used] > 0),
        np.repeat(np.arange(len(logs)), [own.size for own in logs]),
        np.diag(_freedom(problem.model, followed.states[used], read, rms) ** 2),
        np.array([max(float(np.std(torque[own, :, 0])), 1e-300) for own in logs]),
    )


def _by_parameter(fit: Fit) -> Float[np.ndarray, "segments samples outputs parameters"]:
    """Derivatives of the error by the parameters. Under process noise the filter determines parameters better than
    simulations, so that it takes a step of its own."""
    found = linearise(fit.problem, fit.unknowns)
    segments, samples, outputs = fit.error.shape
    rows = np.asarray(found.by_parameter)[:, : samples * outputs].reshape(segments, samples, outputs, -1)
    return np.linalg.solve(np.asarray(fit.problem.whitening), rows)


def _freedom(model: Model, states: np.ndarray, read: np.ndarray, rms: np.ndarray) -> Float[np.ndarray, " states"]:
    """By how much each state may be off where a segment begins: an angle by what its own output or its rate's shows; a
    side that no output shows, by as much as the other one."""
    angles, omega_0 = len(model.motion_states) // 2, float(model.drive.omega_0)
    sides = np.array([float(model.drive.N), 1.0]) if isinstance(model, TwoInertiaModel) else np.ones(angles)
    shown = np.abs(read[0, 0][:, : 2 * angles]).reshape(-1, 2, angles)
    # Outputs that show angles; where there is none, rates.
    shown = shown[:, 0] if shown[:, 0].any() else omega_0 * shown[:, 1]
    angle = _FREE * np.max(np.where(shown > 0, rms[:, None] / np.where(shown > 0, shown, 1.0), 0.0), axis=0)
    angle = np.where(angle > 0, angle, sides * np.max(angle / sides))
    hidden = np.std(states.reshape(-1, states.shape[-1]), axis=0)[2 * angles :]
    return np.concatenate([angle, angle * omega_0, hidden])


def _spread(count: int, most: int) -> np.ndarray:
    """At most so many indices below a count, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))


def _filtered(
    steps: _Steps, std: Float[np.ndarray, "settings logs"], sensors: SensorNoise
) -> tuple[
    Float[np.ndarray, "settings segments samples outputs"], Float[np.ndarray, "settings segments samples outputs"]
]:
    """Standardised innovations after the lead-in, at the parameters that minimise them, and logarithms of their
    standard deviations, for several noise settings at once.

    Outputs with independent noise are processed sequentially (Anderson and Moore 1979, section 6.4). The slow part of
    each one's noise is a further state.
    """
    variance = np.square(std)[:, steps.log, None, None]
    white, slow, correlation = (np.atleast_2d(v) for v in (sensors.white, sensors.slow, sensors.correlation))
    apart = np.linalg.inv(sensors.combined)
    readout, error = apart @ steps.readout, apart @ steps.error
    samples, segments, outputs, columns = error.shape
    settings, size = len(variance), steps.push.shape[2]
    remembers = outputs if slow.any() else 0
    own = np.arange(size, size + remembers)
    mean = np.zeros((settings, segments, size + remembers, columns))
    spread = np.zeros((settings, segments, size + remembers, size + remembers))
    spread[..., :size, :size] = steps.prior
    spread[..., own, own] = slow[:, None, :remembers]
    transition = np.zeros_like(spread)
    transition[..., own, own] = correlation[:, None, :remembers]
    fresh = (slow * (1.0 - correlation**2))[:, None, :remembers]
    found = np.zeros((settings, segments, samples, outputs, columns))
    logarithms, read = np.zeros(found.shape[:-1]), np.zeros((segments, size + remembers))
    for i in range(samples):
        counts = steps.counts[i][:, None]
        for j in range(outputs):
            read[:, :size], read[:, size:] = readout[i, :, j], np.arange(remembers) == j
            expected = (spread @ read[:, :, None])[..., 0]
            total = np.sum(expected * read, axis=-1) + white[:, None, j]
            new = error[i, :, j] - (read[:, None, :] @ mean)[..., 0, :]
            gain = counts * expected / total[..., None]
            mean += gain[..., None] * new[..., None, :]
            spread -= gain[..., None] * expected[..., None, :]
            found[:, :, i, j] = counts * new / np.sqrt(total)[..., None]
            logarithms[:, :, i, j] = 0.5 * counts[:, 0] * np.log(total)
        transition[..., :size, :size] = steps.transition[i]
        mean = transition @ mean
        spread = transition @ spread @ np.swapaxes(transition, 2, 3)
        push = steps.push[i]
        spread[..., :size, :size] += variance * (push[:, :, None] * push[:, None, :])
        spread[..., own, own] += fresh
    found, logarithms = found[:, :, steps.lead :], logarithms[:, :, steps.lead :]
    used = found.reshape(settings, -1, columns)
    derivatives = used[..., 1:]
    size_of = np.maximum(np.linalg.norm(derivatives, axis=1), 1e-300)
    derivatives = derivatives / size_of[:, None]
    across = np.swapaxes(derivatives, 1, 2)
    moved = np.linalg.pinv(across @ derivatives, hermitian=True) @ (across @ used[..., :1])
    moved = moved[..., 0] / size_of
    return found[..., 0] - (found[..., 1:] @ moved[:, None, None, :, None])[..., 0], logarithms


def _size_and_colour(innovations: Float[np.ndarray, "segments samples outputs"]) -> tuple[float, float]:
    """Largest rms of an output; and the sum of squared autocorrelations minus its expectation for white noise."""
    square, lags = np.sum(innovations**2, axis=(0, 1)), min(_LAGS, innovations.shape[1] - 1)
    correlation = [
        np.sum(innovations[:, lag:] * innovations[:, :-lag], axis=(0, 1)) / square for lag in range(1, lags + 1)
    ]
    count = innovations.shape[0] * innovations.shape[1]
    colour = np.max(np.sum(np.square(correlation), axis=0)) - lags / count
    return float(np.sqrt(np.max(square) / count)), max(0.0, float(colour))


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
