"""The fit of one torque-twist curve to the blocks of quasi-static logs.

Both axes are noisy, so that both ordinary regressions are biased: twist on torque makes the drive too stiff, torque on
twist too soft. Each block's misfit is weighted by the noise of both axes, the torque's through the local slope
(effective variance; York 1966, Fuller 1987 section 3.2).
"""

import itertools
import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from fitting.quasi_static.differences import slopes
from fitting.quasi_static.torque_twist import MEMORIES, Blocks, Curve, Shape, branch

# Least share of the largest torque that both signs must reach for the curve's centre to be determined.
_BOTH_SIGNS = 0.3
# Least number of full cycles to separate a drift with time from hysteresis.
_CYCLES_FOR_DRIFT = 2
# Starting values of knees, over the torque's amplitude.
_KNEES: dict[Shape, list[tuple[float, ...]]] = {
    "linear": [()],
    "cubic": [()],
    "two slopes": [(0.15,), (0.35,), (0.6,)],
    "three slopes": [(0.1, 0.35), (0.2, 0.6), (0.35, 0.7), (0.5, 0.8)],
}
# Starting values of memory lengths: finely spaced, since only the few blocks after a reversal determine it, with
# several minima.
_REACHES = np.geomspace(0.02, 0.45, 12)


@dataclass(frozen=True, eq=False)
class CurveFit:
    """A curve with its fitted parameters.

    Attributes:
        curve: Its form.
        parameters: In the order of `curve.names`.
        residual: Measured less fitted twist over its noise, (n,).
        jacobian: Of the residual, (n, parameters).
        misfit: Measured less fitted twist [rad], (n,).
        excess: Standard deviation [rad] of the misfit beyond noise; part of the weights.
    """

    curve: Curve
    parameters: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    misfit: np.ndarray
    excess: float


def best_fit(blocks: Blocks, shape: Shape, hysteresis: bool) -> CurveFit:
    """The best fit among the forms of one shape that the logs may determine, from several starts.

    Args:
        blocks: The data.
        shape: Of the curve; its forms differ in their hysteresis.
        hysteresis: Whether the way there and back may differ.
    """
    low, high = float(np.min(blocks.torque)), float(np.max(blocks.torque))
    biased = shape != "linear" and min(-low, high) > _BOTH_SIGNS * max(-low, high)
    drifting = min(blocks.reversals) >= 2 * _CYCLES_FOR_DRIFT
    memories = MEMORIES if hysteresis and max(blocks.reversals) > 0 else (None,)
    curves = [Curve(shape, memory, biased, drifting, len(blocks.names)) for memory in memories]
    found = [fit_curve(blocks, curve, start) for curve in curves for start in starts(blocks, curve)]
    return min(found, key=lambda fit: float(np.mean(fit.misfit**2)))


def fit_curve(blocks: Blocks, curve: Curve, start: np.ndarray) -> CurveFit:
    """The curve of least misfit near a starting point, with weights that include the curve's own error.

    Where the misfit exceeds the noise, weights from noise alone would favour steep curves, under which the torque's
    noise counts most. The excess is an error of the equation (Fuller 1987 section 3.1.2), ascribed to the twist.
    """
    fit = polish(blocks, curve, start, _excess(blocks, curve, start))
    for _ in range(3):
        excess = _excess(blocks, curve, fit.parameters)
        if abs(excess - fit.excess) <= 0.05 * math.hypot(fit.excess, blocks.twist_noise):
            break
        fit = polish(blocks, curve, fit.parameters, excess)
    return fit


def _excess(blocks: Blocks, curve: Curve, parameters: np.ndarray) -> float:
    predicted, slope = curve.predict(parameters, blocks)
    noise_variance = blocks.twist_noise**2 + (slope * blocks.torque_noise) ** 2
    return math.sqrt(max(0.0, float(np.mean((blocks.twist - predicted) ** 2 - noise_variance))))


def starts(blocks: Blocks, curve: Curve) -> list[np.ndarray]:
    """The best starting points of a grid over knees, bias and memory length, with different knees; the other parameters
    are linear."""
    size, middle = blocks.amplitude, 0.5 * float(np.max(blocks.torque) + np.min(blocks.torque))
    zeros = [(blocks.log == i).astype(float) for i in range(curve.logs)]
    zeros += [zero * blocks.centred_time for zero in zeros] if curve.drifting else []
    reaches = (size * _REACHES).tolist() if curve.memory else [None]
    tried = []
    for reach, bias, knee in itertools.product(reaches, {0.0, middle} if curve.biased else {0.0}, _KNEES[curve.shape]):
        knees = [share * size for share in knee]
        path = [branch(curve.memory, blocks, reach, (0.0,) * curve.logs)] if curve.memory and reach else []
        torque = blocks.torque - bias
        edges = [np.zeros_like(torque), *(np.clip(torque, -one, one) for one in knees), torque]
        # Columns whose combination is the curve, to first order for the cubic.
        basis = [torque, torque**3] if curve.shape == "cubic" else np.diff(edges, axis=0)
        matrix = np.column_stack([*basis, *zeros, *path])
        solution, *_ = np.linalg.lstsq(matrix, blocks.twist, rcond=None)
        cost = float(np.sum((blocks.twist - matrix @ solution) ** 2))
        tried.append((cost, knees, _parameters(blocks, curve, solution, bias, knees, reach)))
    tried.sort(key=lambda t: t[0])
    other = next(([t] for t in tried if t[1] != tried[0][1]), [])
    return [start for *_, start in (tried[0], *other)]


def _parameters(
    blocks: Blocks, curve: Curve, solution: np.ndarray, bias: float, knees: list[float], reach: float | None
) -> np.ndarray:
    """Parameters of the curve from the coefficients of its columns."""
    twist, count = 0.5 * float(np.ptp(blocks.twist)), len(knees) + 1
    compliances = np.clip(solution[:count], 0.02 * twist / blocks.amplitude, 5.0 * twist / blocks.amplitude)
    known = {f"log K{i + 1}": -math.log(one) for i, one in enumerate(compliances)}
    known |= dict(zip(("log T1", "log gap"), np.log(np.diff([0.0, *knees])).tolist(), strict=False))
    known |= {"torque_bias": bias, "friction": -solution[-1] / compliances[0], "log reach": math.log(reach or 1.0)}
    if curve.shape == "cubic":
        known["alpha"] = np.clip(-solution[1] / compliances[0] ** 3, -0.2 / twist**2, 5.0 / twist**2)
    zeros = [name for name in curve.names if name.startswith(("offset", "drift"))]
    first = 2 if curve.shape == "cubic" else count
    known |= dict(zip(zeros, solution[first:].tolist(), strict=False))
    return np.array([known.get(name, 0.0) for name in curve.names])


def polish(
    blocks: Blocks, curve: Curve, start: np.ndarray, excess: float, weights: np.ndarray | None = None, *, most: int = 40
) -> CurveFit:
    """The curve of least weighted misfit near a starting point.

    Args:
        blocks: The data.
        curve: The form.
        start: Parameters.
        excess: Standard deviation of the misfit beyond noise [rad].
        weights: Of the blocks, (n,), or None for one each. A block of weight zero still acts on the hysteresis.
        most: Largest number of evaluations.

    Returns:
        The fit; residual and Jacobian include the weights.
    """
    weights = np.ones_like(blocks.torque) if weights is None else weights
    twist_noise = math.hypot(blocks.twist_noise, excess)

    def residual(parameters: np.ndarray) -> np.ndarray:
        predicted, slope = curve.predict(parameters, blocks)
        return weights * (blocks.twist - predicted) / np.hypot(twist_noise, slope * blocks.torque_noise)

    low, high, scales = ranges(blocks, curve)
    steps = 1e-5 * scales
    found = least_squares(
        residual,
        np.clip(start, low + 10 * steps, high - 10 * steps),
        jac=lambda at: slopes(residual, at, steps),  # pyright: ignore[reportArgumentType]
        bounds=(low, high),
        x_scale=scales,
        xtol=1e-7,
        ftol=1e-8,
        max_nfev=most,
    )
    return CurveFit(curve, found.x, found.fun, found.jac, blocks.twist - curve.predict(found.x, blocks)[0], excess)


def ranges(blocks: Blocks, curve: Curve) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least and largest value of each parameter, and a large change of it.

    Curves beyond these limits are indistinguishable from simpler ones.
    """
    size, twist = blocks.amplitude, 0.5 * float(np.ptp(blocks.twist))
    step = float(np.median(np.abs(np.diff(blocks.torque)))) or 1e-3 * size
    stiff, knee = math.log(size / twist), (math.log(0.02 * size), math.log(2.0 * size), 1.0)
    known = {
        "alpha": (-0.15 / twist**2, 30.0 / twist**2, 1.0 / twist**2),
        "log T1": knee,
        "log gap": knee,
        # A branch that changes more slowly would act as a second stiffness.
        "log reach": (math.log(min(step, 0.1 * size)), math.log(0.5 * size), 1.0),
        "start": (-1.0 - 1e-3, 1.0 + 1e-3, 1.0),
        "offset": (-np.inf, np.inf, twist),
        "drift": (-np.inf, np.inf, twist / (float(np.ptp(blocks.time)) or 1.0)),
        "torque_bias": (-np.inf, np.inf, size),
        "friction": (-np.inf, np.inf, size),
        "log": (stiff - 7.0, stiff + 7.0, 1.0),
    }
    low, high, scale = np.array([known.get(name) or known[name.split()[0]] for name in curve.names]).T
    return low, high, scale
