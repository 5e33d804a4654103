"""Innovations of a Kalman filter along linearised segments, for given noise of torque and sensors."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

# Lead-in samples of a segment in which the filter converges.
_LEAD = 12
# Axes of matrices, for `numpy.matmul`.
_FIRST_TWO: list[Any] = [(0, 1)] * 3


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


class Steps(eqx.Module):
    """The linearised motion of several segments, sample by sample.

    Attributes:
        transition: of the state's deviation over a sample interval.
        push: its change by a unit of torque.
        readout: of the outputs.
        error: of the outputs, and its derivatives by the free parameters.
        counts: whether a sample is valid.
        log: of each segment.
        start: expected deviation of the initial states.
        prior: covariance of the initial states.
        torque: rms torque of each log.
        lead: lead-in samples of the filter, which the likelihood omits.
    """

    transition: Float[np.ndarray, "samples states states segments"]
    push: Float[np.ndarray, "samples states segments"]
    readout: Float[np.ndarray, "samples outputs states segments"]
    error: Float[np.ndarray, "samples outputs columns segments"]
    counts: Bool[np.ndarray, "samples segments"]
    log: Int[np.ndarray, " segments"]
    start: Float[np.ndarray, "states segments"]
    prior: Float[np.ndarray, "states states"]
    torque: Float[np.ndarray, " logs"]
    lead: int = eqx.field(static=True, default=_LEAD)

    def fewer(self, segments: int) -> "Steps":
        """The same for at most so many segments, evenly spaced."""
        chosen = spread_evenly(self.log.size, segments)
        places = (self.transition, self.push, self.readout, self.error, self.counts, self.log, self.start)
        fewer = tuple(place[..., chosen] for place in places)
        return eqx.tree_at(lambda s: (s.transition, s.push, s.readout, s.error, s.counts, s.log, s.start), self, fewer)


def spread_evenly(count: int, most: int) -> Int[np.ndarray, " chosen"]:
    """At most so many indices below a count, evenly spaced."""
    return np.unique(np.linspace(0, count - 1, min(most, count)).astype(int))


def filtered(
    steps: Steps, std: Float[np.ndarray, "settings logs"], sensors: SensorNoise
) -> tuple[
    Float[np.ndarray, "settings segments samples outputs"], Float[np.ndarray, "settings segments samples outputs"]
]:
    """Standardised innovations after the lead-in, at the parameters that minimise them, and logarithms of their
    standard deviations, for several noise settings at once."""
    errors, variances = _predicted(steps, np.square(std)[:, steps.log], sensors)
    errors, variances = errors[steps.lead :].transpose(3, 4, 0, 1, 2), variances[steps.lead :].transpose(2, 3, 0, 1)
    counts = steps.counts[steps.lead :].T[..., None]
    found = np.ascontiguousarray(errors * (counts / np.sqrt(variances))[..., None])
    used = found.reshape(len(std), -1, found.shape[-1])
    innovations, derivatives = used[..., :1], used[..., 1:]
    size = np.maximum(np.linalg.norm(derivatives, axis=1, keepdims=True), 1e-300)
    derivatives = derivatives / size
    across = np.swapaxes(derivatives, 1, 2)
    moved = np.linalg.pinv(across @ derivatives, hermitian=True) @ (across @ innovations)
    return (innovations - derivatives @ moved).reshape(found.shape[:-1]), 0.5 * counts * np.log(variances)


def _predicted(
    steps: Steps, torque: Float[np.ndarray, "settings segments"], sensors: SensorNoise
) -> tuple[
    Float[np.ndarray, "samples outputs columns settings segments"],
    Float[np.ndarray, "samples outputs settings segments"],
]:
    """Errors of a Kalman filter's predictions of each output, and their variances, for given variances of the torque.

    Outputs with independent noise are processed sequentially (Anderson and Moore 1979, section 6.4). The slow part of
    each one's noise is a further state. Segments are on the last axis, so that numpy's inner loops are long.
    """
    white, slow, correlation = (
        np.atleast_2d(v).T[..., None] for v in (sensors.white, sensors.slow, sensors.correlation)
    )
    apart = np.linalg.inv(sensors.combined)
    readout, error = (np.einsum("ij,tj...->ti...", apart, values) for values in (steps.readout, steps.error))
    samples, outputs, columns, segments = error.shape
    moving, remembers = steps.push.shape[1], outputs if slow.any() else 0
    slow, correlation = slow[:remembers], correlation[:remembers]
    size = moving + remembers
    own = np.arange(moving, size)
    # Covariance of the states, and beside it their means.
    known = np.zeros((size, size + columns, *torque.shape))
    spread = np.swapaxes(known[:, :size], 0, 1)
    known[:moving, size] = steps.start[:, None]
    spread[:moving, :moving] = steps.prior[..., None, None]
    spread[own, own] = slow
    read = np.zeros((samples, outputs, size, segments))
    read[:, :, :moving] = readout
    read[:, range(remembers), own] = 1.0
    errors = np.zeros((samples, outputs, columns, *torque.shape))
    variances = np.zeros((samples, outputs, *torque.shape))
    for i, (step, push, counts) in enumerate(zip(steps.transition, steps.push, steps.counts, strict=True)):
        for j in range(outputs):
            seen = np.einsum("is,ijbs->jbs", read[i, j], known)
            seen[size:] -= error[i, j][:, None]
            variances[i, j] = np.einsum("is,ibs->bs", read[i, j], seen[:size]) + white[j]
            known -= (counts * seen[:size] / variances[i, j])[:, None] * seen
            errors[i, j] = -seen[size:]
        for values in (known, spread):
            moved = np.matmul(step, values[:moving].reshape(moving, -1, segments), axes=_FIRST_TWO)
            values[:moving] = moved.reshape(values[:moving].shape)
            values[moving:] *= correlation[:, None]
        spread[:moving, :moving] += torque * (push[:, None] * push)[:, :, None]
        spread[own, own] += slow * (1.0 - correlation**2)
    return errors, variances
