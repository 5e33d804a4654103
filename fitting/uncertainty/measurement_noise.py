"""Measurement noise of the outputs, independent of model discrepancy."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.engines import linearise, with_engine
from fitting.estimation.estimate import REWEIGHTINGS, Fit, zeros_like
from fitting.estimation.experiment import Stretch
from fitting.estimation.problem import initial_states, natural_frequency, on_all_devices
from fitting.estimation.residual import RUNAWAY, Blocks, Problem, Unknowns
from fitting.estimation.scales import of_twist, scales
from fitting.estimation.segments import cut
from fitting.estimation.solve import FIRST_DAMPING, solve
from fitting.estimation.weighing import Shown, weighed

# This many samples determine the noise to 2 %; a covariance that changes less between two passes has converged.
_SAMPLES = 2500
_SETTLED = 0.02
_STEPS = 30
# Least relative decrease of the sum of squares over a few steps.
_LEAST_PROGRESS = 1e-3
# Degrees of the polynomials in time that describe, within a piece, a sensor's error or the motion due to an unmodelled
# force; the largest one that leaves enough residual degrees of freedom is used.
_DEGREES = (3, 2)
# They reduce the rms of noise less than so many times if its neighbouring samples correlate by 0.5 at most. A larger
# reduction is due to motion, or to slow noise, which [`fitting.uncertainty.noise_model`][] describes.
_MOTION = 1.5
# Upper bound of the relative solver error (see `STEP_ANGLE`); encoder noise is far larger.
_EXACT = 1e-6
# Least share of residual degrees of freedom for powers of time to be removed.
_LEAST_LEFT = 0.25


class _Pieces(eqx.Module):
    """Residual of the pieces of some segments.

    Attributes:
        squares: sum over the outputs' squared errors.
        samples: their number.
        freedom: number of fitted values.
    """

    squares: Float[np.ndarray, "outputs outputs"]
    samples: float = 0.0
    freedom: float = 0.0

    def and_more(self, squares: np.ndarray, samples: float, freedom: float) -> "_Pieces":
        """With further pieces."""
        return _Pieces(self.squares + squares, self.samples + samples, self.freedom + freedom)

    @property
    def left(self) -> float:
        """Residual degrees of freedom over the number of measured values; zero without samples."""
        rows = self.samples * len(self.squares)
        return 1.0 - self.freedom / rows if rows else 0.0

    @property
    def covariance(self) -> Float[np.ndarray, "outputs outputs"]:
        """Covariance of the noise, corrected for the fitted values."""
        return self.squares / self.samples / self.left


class MeasurementNoise(eqx.Module):
    """The noise of the measured outputs, from the fit with the smallest residual.

    Each fit's residual contains at least the noise; a poor fit's is larger.

    Attributes:
        covariance: of the outputs.
        asked: the fits that were used; each estimate takes as long as a fit.
    """

    covariance: Float[Array, "outputs outputs"]
    asked: tuple[Fit, ...]

    def and_beside(self, found: Fit) -> "MeasurementNoise":
        """The same with an estimate from one more fit."""
        if any(found is fit for fit in self.asked):
            return self
        other = _noise_beside(found)
        least = min(self.covariance, other, key=lambda c: float(np.linalg.slogdet(np.asarray(c))[1]))
        return MeasurementNoise(least, (*self.asked, found))


def measurement_noise(found: Fit) -> MeasurementNoise:
    """The noise estimated from one fit."""
    return MeasurementNoise(_noise_beside(found), (found,))


def excess(fit: Fit, noise: Float[Array, "outputs outputs"]) -> Float[np.ndarray, " outputs"]:
    """Rms residual of each output over its measurement noise; 1 for pure noise."""
    return np.sqrt(np.diag(np.asarray(fit.covariance)) / np.diag(np.asarray(noise)))


def _noise_beside(found: Fit) -> Float[Array, "outputs outputs"]:
    """Covariance of the outputs' measurement noise: the residual when each short piece of the log has a free initial
    state.

    Within half a period an initial state explains most smooth motion, missing physics included, so that little but
    noise remains. A strong missing force or a sensor's error adds a polynomial in time within a piece: even a constant,
    since the initial twist follows from the motion that it causes. It is removed as well where it exceeds what noise
    explains. Corrected for the number of fitted values.

    Args:
        found: a fit; its parameters are fixed, and its compiled program is used.
    """
    count, length = found.problem.segments.weight.shape
    slowest = max(stretch.experiment.time_step for stretch in found.stretches)
    half_period = np.pi / natural_frequency(found.model, found.stretches) / slowest
    # In valid samples: a slow channel leaves few rows in which all outputs were measured.
    every = 1.0 / np.mean(np.concatenate([s.weight for s in found.stretches]))
    piece = min(length, int(np.round(np.clip(half_period, 6 * every, 24 * every))))
    held = eqx.tree_at(lambda p: p.active, found.problem, zeros_like(found.problem.active))
    swing = float(scales(found.stretches, found.model).x)
    shown = Shown.of(found.problem.model, swing * of_twist(found.model)[-1])
    anew = smoothed = _Pieces(np.zeros(found.covariance.shape))
    # A piece is the first part of a segment; other cuts of the data give other pieces.
    for offset in range(0, length - piece + 1, piece):
        shifted = [Stretch(s.experiment, s.start + offset, s.stop) for s in found.stretches if len(s) >= offset + piece]
        if not shifted or anew.samples >= _SAMPLES:
            break
        segments = cut(shifted, length, halo=held.segments.halo, count=count)
        weight = np.asarray(segments.weight)
        head = weight * (np.arange(length) < piece)[None]
        head = head * (np.sum(head, axis=1, keepdims=True) >= np.floor(piece / every))
        if not head.any():
            continue
        # The logs that are left may lack a torque on the load.
        part = with_engine(replace(held, segments=replace(segments, weight=jnp.asarray(head))))
        unknowns = Unknowns(found.unknowns.parameters, initial_states(found.model, segments))
        part, unknowns = on_all_devices(part, unknowns)
        covariance, before, damping = found.covariance, np.full(len(found.covariance), np.inf), FIRST_DAMPING
        for _ in range(REWEIGHTINGS):
            part = weighed(part, covariance, shown)
            solution = solve(part, unknowns, _STEPS, damping, least_progress=_LEAST_PROGRESS)
            unknowns, covariance, damping = solution.unknowns, solution.left_over.covariance, solution.damping
            now = np.sqrt(np.diag(covariance))
            if np.all(np.abs(now - before) <= _SETTLED * now):
                break
            before = now
        seen = linearise(part, unknowns)
        anew = anew.and_more(covariance * head.sum(), float(head.sum()), _states_freedom(part, seen))
        smoothed = smoothed.and_more(*_smoothed(part, seen, piece))
    if not anew.samples:
        return found.covariance
    # The residual of logs simulated without noise is the solver's error.
    return jnp.asarray(_of_both(anew, smoothed) + np.diag((_EXACT * swing * of_twist(found.model)) ** 2))


def _of_both(anew: _Pieces, smoothed: _Pieces) -> Float[np.ndarray, "outputs outputs"]:
    if smoothed.left < _LEAST_LEFT:
        return anew.covariance
    less = np.sqrt(np.diag(anew.covariance) / np.diag(smoothed.covariance))
    return smoothed.covariance if np.max(less) > _MOTION else anew.covariance


def _states_freedom(problem: Problem, seen: Blocks) -> float:
    """Effective number of fitted initial-state entries; an entry that its prior constrains counts partly."""
    by_state = np.asarray(seen.by_state)
    outputs = by_state[:, : problem.segments.measured[0].size]
    measured, all_rows = (np.einsum("sri,srj->sij", rows, rows) for rows in (outputs, by_state))
    scale = np.sqrt(np.einsum("sii->si", all_rows))
    scale = np.where(scale > 0, scale, 1.0)
    units = scale[:, :, None] * scale[:, None, :]
    inverse = np.linalg.pinv(all_rows / units, rcond=1e-12, hermitian=True)
    return float(np.einsum("sij,sji->", inverse, measured / units))


def _smoothed(problem: Problem, seen: Blocks, piece: int) -> tuple[Float[np.ndarray, "outputs outputs"], float, float]:
    """Residual of pieces after fitting a polynomial in time to each output: squares, samples, and number of fitted
    values. Pieces whose simulation diverges are omitted."""
    outputs = problem.segments.measured.shape[2]
    rows = np.asarray(seen.residual)[:, : piece * outputs]
    weight = np.asarray(problem.segments.weight)[:, :piece]
    kept = weight.any(axis=1) & (np.abs(rows) < RUNAWAY).all(axis=1)
    polynomials = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, piece), 1 + max(_DEGREES), increasing=True))[0]
    by_state = np.asarray(seen.by_state)[kept, : rows.shape[1]]
    measured = np.repeat(weight[kept], outputs, axis=1)
    for degree in _DEGREES:
        moves = np.kron(polynomials[:, : 1 + degree], np.eye(outputs)) * measured[:, :, None]
        columns = np.concatenate([by_state, moves], axis=2)
        size = np.linalg.norm(columns, axis=1, keepdims=True)
        directions, sizes, _ = np.linalg.svd(columns / np.where(size > 0, size, 1.0), full_matrices=False)
        directions = directions * (sizes > 1e-9 * sizes[:, :1])[:, None, :]
        freedom = float(np.sum(directions**2))
        if freedom <= (1.0 - _LEAST_LEFT) * np.sum(measured):
            break
    white = rows[kept]
    white = white - np.einsum("srd,sd->sr", directions, np.einsum("srd,sr->sd", directions, white))
    error = white.reshape(-1, outputs) @ np.linalg.inv(np.asarray(problem.whitening)).T
    return error.T @ error, float(np.sum(weight[kept])), freedom
