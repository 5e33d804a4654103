"""Residual diagnostics: spectrum, orders of the motor angle, autocorrelation, dependence on other quantities."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from fitting.estimation.estimate import Fit
from fitting.estimation.linear_response import follow
from fitting.estimation.whiteness import autocorrelation, left_over
from fitting.validation.welch import density
from hdjax import TwoInertiaModel

_BINS = 40
_ORDERS = np.arange(0.25, 10.01, 0.05)


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
    """Diagnostics of a fit's residual dynamic error.

    Attributes:
        frequency: of the spectrum [Hz].
        spectral_density: of the residual [rad^2/Hz].
        order: cycles per motor revolution; empty without a motor angle or where the motor hardly turns.
        order_amplitude: amplitude of the residual locked to each order [rad].
        autocorrelation: at lags 0, 1, 2, ... samples.
        white_limit: 95 % limit of a white residual's autocorrelation.
        dependence: on `x`, `v`, `motor angle`, `motor speed`, by name.
        rms: of the residual [rad].
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
    segments = fit.problem.segments
    weight = np.asarray(segments.weight) > 0
    residual = left_over(fit)
    simulated = (np.asarray(segments.measured) - np.asarray(fit.error))[weight]
    step = fit.stretches[0].experiment.time_step
    frequency, power = density(residual, step=step, window=min(2048, residual.size))
    x = _simulated(fit, "dynamic_error", simulated, weight)
    quantities = {"x": x, "v": np.gradient(x, step)}
    order = amplitude = np.zeros(0)
    if isinstance(fit.model, TwoInertiaModel):
        theta_m = _simulated(fit, "motor_turn", simulated, weight) * float(fit.model.drive.N)
        speed = np.gradient(theta_m, step)
        # The simulated motion jumps at segment borders.
        speed = np.clip(speed, *np.quantile(speed, [0.001, 0.999]))
        quantities |= {"motor angle": np.mod(theta_m, 2 * np.pi), "motor speed": speed}
        if np.ptp(theta_m) > 4 * np.pi:
            order, amplitude = _ORDERS, order_amplitude(residual, theta_m, _ORDERS)
    quantities["v"] = np.clip(quantities["v"], *np.quantile(quantities["v"], [0.001, 0.999]))
    return ResidualDiagnostics(
        frequency=frequency,
        spectral_density=power,
        order=order,
        order_amplitude=amplitude,
        autocorrelation=autocorrelation(fit, min(200, residual.size // 4)),
        white_limit=1.96 / np.sqrt(residual.size),
        dependence={name: _dependence(residual, q) for name, q in quantities.items()},
        rms=float(np.sqrt(np.mean(residual**2))),
    )


def _simulated(fit: Fit, output: str, simulated: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Simulated values of an output, measured or not, at valid samples."""
    model = fit.model
    if output in model.measured:
        return simulated[:, model.measured.index(output)]
    assert isinstance(model, TwoInertiaModel)
    states = follow(fit.at_solution, fit.unknowns).states[:, :-1][weight]
    turn = states[:, 0] / float(model.drive.N)
    return turn if output == "motor_turn" else turn - states[:, 1]


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
