"""Residual diagnostics: spectrum, orders of the motor angle, autocorrelation, dependence on other quantities."""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

from fitting.estimation.estimate import Fit
from fitting.estimation.whiteness import autocorrelation, left_over
from fitting.first_order.linearised_fit import motion_states
from fitting.uncertainty.normal_law import NORMAL_95
from fitting.validation.welch import density
from hdjax import TwoInertiaModel

_BINS = 40
_ORDERS = np.arange(0.25, 10.01, 0.05)
# Largest relative difference of equal sample intervals.
_SAME_RATE = 0.01


class Dependence(eqx.Module):
    """Mean residual against a quantity, in bins.

    Attributes:
        centre: bin centres.
        mean: mean residual in each.
        standard_error: of that mean.
    """

    centre: Float[np.ndarray, " bins"]
    mean: Float[np.ndarray, " bins"]
    standard_error: Float[np.ndarray, " bins"]


class ResidualDiagnostics(eqx.Module):
    """Diagnostics of the residual of a fit's principal output, in its unit.

    Attributes:
        frequency: of the spectrum [Hz].
        spectral_density: of the residual, in its unit squared per Hz.
        order: cycles per motor revolution; empty without a motor angle or where the motor hardly turns.
        order_amplitude: amplitude of the residual locked to each order.
        autocorrelation: at lags 0, 1, 2, ... samples.
        white_limit: 95 % limit of a white residual's autocorrelation.
        dependence: on `x`, `v`, `motor angle`, `motor speed`, by name.
        rms: of the residual.
    """

    frequency: Float[np.ndarray, " frequencies"]
    spectral_density: Float[np.ndarray, " frequencies"]
    order: Float[np.ndarray, " orders"]
    order_amplitude: Float[np.ndarray, " orders"]
    autocorrelation: Float[np.ndarray, " lags"]
    white_limit: float
    dependence: dict[str, Dependence]
    rms: float


def diagnose(fit: Fit) -> ResidualDiagnostics:
    """Diagnostics of a fit's residual."""
    weight = np.asarray(fit.problem.segments.weight)[: fit.pieces.sum()] > 0
    residual = left_over(fit)
    frequency, power = _spectrum(fit)
    states = motion_states(fit)[:, :-1][weight].T
    order = amplitude = np.zeros(0)
    if isinstance(fit.model, TwoInertiaModel):
        N, (theta_m, theta_l, omega_m, omega_l) = float(fit.model.drive.N), states[:4]
        quantities = {"x": theta_m / N - theta_l, "v": omega_m / N - omega_l}
        quantities |= {"motor angle": np.mod(theta_m, 2 * np.pi), "motor speed": omega_m}
        if np.ptp(theta_m) > 4 * np.pi:
            order, amplitude = _ORDERS, order_amplitude(residual, theta_m, _ORDERS)
    else:
        quantities = dict(zip(("x", "v"), states, strict=False))
    return ResidualDiagnostics(
        frequency=frequency,
        spectral_density=power,
        order=order,
        order_amplitude=amplitude,
        autocorrelation=autocorrelation(fit, min(200, residual.size // 4)),
        white_limit=NORMAL_95 / np.sqrt(residual.size),
        dependence={name: _dependence(residual, q) for name, q in quantities.items()},
        rms=float(np.sqrt(np.mean(residual**2))),
    )


def at_first_rate(fit: Fit) -> Bool[np.ndarray, " stretches"]:
    """Which stretches have the sample rate of the first one."""
    steps = np.array([stretch.experiment.time_step for stretch in fit.stretches])
    return np.abs(steps / steps[0] - 1.0) < _SAME_RATE


def _spectrum(fit: Fit) -> tuple[Float[np.ndarray, " frequencies"], Float[np.ndarray, " frequencies"]]:
    """Frequency [Hz] and spectral density of the residual of the stretches with the first one's sample rate."""
    errors = fit.by_stretch(np.asarray(fit.error)[..., -1])
    weights = fit.by_stretch(np.asarray(fit.problem.segments.weight))
    of_rate = zip(errors, weights, at_first_rate(fit), strict=True)
    residual = np.concatenate([error[weight > 0] for error, weight, same in of_rate if same])
    step = fit.stretches[0].experiment.time_step
    return density(residual, step=step, window=min(2048, residual.size))


def order_amplitude(residual: np.ndarray, angle: np.ndarray, orders: np.ndarray) -> np.ndarray:
    """Amplitude of the least-squares harmonic of an angle at each order.

    Args:
        residual: of samples.
        angle: at the same samples [rad].
        orders: cycles per revolution, evenly spaced.
    """
    amplitude = np.empty(orders.size)
    turn, rotation = (np.exp(1j * factor * angle) for factor in (orders[0], orders[1] - orders[0]))
    for i in range(orders.size):
        basis = np.stack([turn.real, turn.imag])
        amplitude[i] = np.hypot(*np.linalg.pinv(basis @ basis.T, hermitian=True) @ (basis @ residual))
        turn *= rotation
    return amplitude


def _dependence(residual: np.ndarray, quantity: np.ndarray) -> Dependence:
    """Mean residual in bins of equal sample count."""
    edges = np.unique(np.quantile(quantity, np.linspace(0, 1, _BINS + 1)))
    bins = np.clip(np.searchsorted(edges, quantity, side="right") - 1, 0, max(edges.size - 2, 0))
    count = np.bincount(bins)
    safe = np.maximum(count, 1)
    mean = np.bincount(bins, residual) / safe
    variance = np.maximum(np.bincount(bins, residual**2) / safe - mean**2, 0.0)
    centre = np.bincount(bins, quantity) / safe
    return Dependence(centre, mean, np.sqrt(variance / safe))
