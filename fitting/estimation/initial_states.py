"""Initial states of free runs, fitted to a short window; and the zero of a log that has its own."""

from collections.abc import Sequence
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.problem import Segmentation
from fitting.estimation.residual import slopes_by_zero
from hdjax import Model, TwoInertiaModel

WINDOW = 50
"""Samples of the initial-state window."""

# Window where the dynamic error was not measured: periods of the antiresonance, and largest share of a stretch, both
# assumed.
_PERIODS, _MOST = 1.0, 0.25

# 99 % point of chi-squared with as many degrees of freedom as there are rates (one or two).
_REST_LIMIT = {1: 6.63, 2: 9.21}

# Gauss-Newton steps to a log's own zero: the spring is nearly linear in it.
_PASSES = 3


def window(model: Model, stretches: Sequence[Stretch]) -> int:
    """Samples of the initial-state window: [`WINDOW`][], or more where the dynamic error was not measured."""
    if not isinstance(model, TwoInertiaModel) or "dynamic_error" in model.measured:
        return WINDOW
    fastest = min(stretch.experiment.time_step for stretch in stretches)
    period = 2 * np.pi * np.sqrt(float(model.drive.J_l / model.drive.K)) / fastest
    return int(np.clip(_PERIODS * period, WINDOW, max(WINDOW, _MOST * min(len(s) for s in stretches))))


def initial_states(
    model: Model,
    stretches: Sequence[Stretch],
    *,
    covariance: Float[Array, "outputs outputs"],
    halo: int,
    substeps: int,
    like: Fit | None = None,
) -> tuple[Float[Array, "stretches states"], Float[np.ndarray, " stretches"]]:
    """Initial states fitted to the first samples of each stretch; arguments as in
    [`fitting.estimation.free_run.free_run`][].

    A short window determines a rate poorly, and the error grows with time. Logs often begin at rest; where the window
    agrees with rest (1 % level), rest is assumed.

    Returns:
        The states; and the zero of the dynamic error, beyond that subtracted already, of each stretch whose log has a
        zero of its own.
    """
    samples = window(model, stretches)
    windows = [s.beginning(samples) for s in stretches]
    own = np.array([s.experiment.has_own_zero for s in stretches])
    states, zeros = jnp.zeros((0, 0)), np.zeros(len(stretches))
    for _ in range(_PASSES if own.any() else 1):
        seen = [replace(w, experiment=w.experiment.less(zero)) for w, zero in zip(windows, zeros.tolist(), strict=True)]
        starts = _fitted_states(model, seen, samples, covariance, halo, substeps, like)
        states, further = _at_rest_where_possible(model, starts, own)
        zeros = zeros + further
    return states, zeros


def _fitted_states(
    model: Model,
    windows: Sequence[Stretch],
    samples: int,
    covariance: Float[Array, "outputs outputs"],
    halo: int,
    substeps: int,
    like: Fit | None,
) -> Fit:
    paths, length, count = (), max(samples, *(len(w) for w in windows)), len(windows)
    if like is not None and _holds(like, count, length):
        paths, (count, length) = like.free.paths, like.problem.segments.weight.shape
    return fit(
        model,
        windows,
        paths,
        Segmentation(length, length, halo, substeps, count),
        start=Start(covariance),
        strategy=Strategy(reweigh=False, hold_parameters=True),
    )


def _holds(like: Fit, count: int, window: int) -> bool:
    segments, samples = like.problem.segments.weight.shape
    return segments >= count and samples >= window


def _at_rest_where_possible(model: Model, starts: Fit, own: Bool[np.ndarray, " lanes"]) -> tuple[Array, np.ndarray]:
    """Initial states, with rates set to zero where they are not significantly nonzero in the window; and the step to
    each lane's own zero, which is estimated together with its states."""
    found = linearise(starts.problem, starts.unknowns)
    residual, slopes = np.asarray(found.residual), np.asarray(found.by_state)
    by_zero = slopes_by_zero(starts.problem)
    rows = np.maximum(np.asarray(starts.problem.segments.weight).sum(1) * starts.covariance.shape[0], 1.0)
    rates = np.array([i for i, n in enumerate(model.motion_states) if n in ("omega_m", "omega_l", "v")])
    states, zeros = np.array(starts.unknowns.states)[: own.size], np.zeros(own.size)
    for lane, has_zero in enumerate(own):
        matrix = np.column_stack((slopes[lane], by_zero[lane])) if has_zero else slopes[lane]
        scale = 1.0 / np.maximum(np.linalg.norm(matrix, axis=0), 1e-150)
        covariance = np.linalg.pinv((matrix * scale).T @ (matrix * scale), hermitian=True) * np.outer(scale, scale)
        # The states are a minimum already, unless the zero moves.
        step = -covariance @ (matrix.T @ residual[lane]) if has_zero else np.zeros(matrix.shape[1])
        excess = max(float(np.sum((residual[lane] + matrix @ step) ** 2)) / rows[lane], 1.0)
        rate = states[lane, rates] + step[rates]
        # A rate that the window does not determine at all is set to zero.
        towards = np.linalg.pinv(covariance[np.ix_(rates, rates)] * excess, rcond=1e-12, hermitian=True) @ rate
        rests = rate @ towards < _REST_LIMIT[rates.size]
        if rests:
            step -= covariance[:, rates] @ towards * excess
        states[lane] += step[: states.shape[1]]
        states[lane, rates] = 0.0 if rests else states[lane, rates]
        zeros[lane] = np.sum(step[states.shape[1] :])
    return jnp.asarray(states), zeros
