"""The fit of one torque-twist curve to the blocks of quasi-static logs.

Both axes are noisy, so that neither the regression of twist on torque nor the reverse is right: the first makes the
drive too stiff, the second too soft. Each block's misfit is weighed by the noise of both axes, the torque's through the
local slope (effective variance; York 1966, Fuller 1987 section 3.2).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from fitting.quasi_static.differences import slopes
from fitting.quasi_static.torque_twist import MEMORIES, Blocks, Curve, Shape, branch

# Both signs of torque must reach this share of the largest before the curve's symmetry can show its centre.
_BOTH_SIGNS = 0.3
# Full cycles before a drift with time can be told from the way there and back.
_CYCLES_FOR_DRIFT = 2


@dataclass(frozen=True, eq=False)
class CurveFit:
    """A curve with the parameters that fit best.

    Attributes:
        curve: Its form.
        parameters: In the order of `curve.names`.
        residual: Measured less fitted twist over its noise, (n,).
        jacobian: Of the residual, (n, parameters).
        misfit: Measured less fitted twist [rad], (n,).
        excess: Standard deviation [rad] of what noise does not explain of the misfit; part of the weights.
    """

    curve: Curve
    parameters: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray
    misfit: np.ndarray
    excess: float


def candidates(blocks: Blocks, shape: Shape, hysteresis: bool) -> list[Curve]:
    """The forms of one shape that the logs can tell something about; they differ in their memory."""
    low, high = float(np.min(blocks.torque)), float(np.max(blocks.torque))
    biased = shape != "linear" and min(-low, high) > _BOTH_SIGNS * max(-low, high)
    drifting = min(blocks.reversals) >= 2 * _CYCLES_FOR_DRIFT
    memories = MEMORIES if hysteresis and max(blocks.reversals) > 0 else (None,)
    return [Curve(shape, memory, biased, drifting, len(blocks.names)) for memory in memories]


def best_of(blocks: Blocks, curves: Sequence[Curve], simpler: CurveFit | None = None) -> CurveFit:
    """The best fit among several forms, from several starting points.

    Args:
        blocks: To be fitted.
        curves: The forms.
        simpler: A fit that one of the forms contains; it is a starting point, so that more freedom never fits worse.
    """
    found = [fit_curve(blocks, curve, start) for curve in curves for start in starts(blocks, curve)]
    if simpler is not None:
        same = [curve for curve in curves if curve.memory == simpler.curve.memory]
        found += [fit_curve(blocks, curve, _grown(simpler, curve, blocks)) for curve in same]
    return min(found, key=lambda fit: float(np.mean(fit.misfit**2)))


def _grown(fit: CurveFit, curve: Curve, blocks: Blocks) -> np.ndarray:
    """Parameters with which a more flexible curve equals a fitted one."""
    known = dict(zip(fit.curve.names, fit.parameters, strict=True))
    stiffest = known.get("log K2", known["log K1"])
    knee = math.log(0.35 * blocks.amplitude)
    new = {"log K2": stiffest, "log K3": stiffest, "log T1": knee, "log gap": knee}
    return np.array([known.get(name, new.get(name, 0.0)) for name in curve.names])


def fit_curve(blocks: Blocks, curve: Curve, start: np.ndarray) -> CurveFit:
    """The curve of least misfit near a starting point, with weights that know how far the curve itself is off.

    Where a curve errs by more than the noise, weights of the noise alone would favour the steepest curve, under which
    the torque's noise excuses most. The excess is an error of the equation (Fuller 1987 section 3.1.2), ascribed to the
    twist.
    """
    misfit, slope = _misfit(blocks, curve, start)
    excess = _excess(blocks, misfit, slope)
    fit = polish(blocks, curve, start, excess)
    for _ in range(3):
        misfit, slope = _misfit(blocks, curve, fit.parameters)
        before, excess = excess, _excess(blocks, misfit, slope)
        if abs(excess - before) <= 0.05 * math.hypot(before, blocks.twist_noise):
            break
        fit = polish(blocks, curve, fit.parameters, excess)
    return fit


def _misfit(blocks: Blocks, curve: Curve, parameters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    predicted, slope = curve.predict(parameters, blocks)
    return blocks.twist - predicted, slope


def _excess(blocks: Blocks, misfit: np.ndarray, slope: np.ndarray) -> float:
    noise_variance = blocks.twist_noise**2 + (slope * blocks.torque_noise) ** 2
    return math.sqrt(max(0.0, float(np.mean(misfit**2 - noise_variance))))


def starts(blocks: Blocks, curve: Curve) -> list[np.ndarray]:
    """The best starting points of a grid over knees, bias and reach, no two with the same knees; the rest is linear."""
    size, middle = blocks.amplitude, 0.5 * float(np.max(blocks.torque) + np.min(blocks.torque))
    knees = {
        "linear": [()],
        "cubic": [()],
        "two slopes": [(0.15,), (0.35,), (0.6,)],
        "three slopes": [(0.1, 0.35), (0.2, 0.6), (0.35, 0.7), (0.5, 0.8)],
    }[curve.shape]
    # Finely, since only the few blocks after a reversal know the reach, and it has local minima between them.
    reaches = list(size * np.geomspace(0.02, 0.45, 12)) if curve.memory else [None]
    columns = _zero_columns(blocks, curve)
    tried = []
    for reach in reaches:
        path = [branch(curve.memory, blocks, reach, (0.0,) * curve.logs)] if curve.memory and reach else []
        for bias in {0.0, middle} if curve.biased else {0.0}:
            for knee in knees:
                basis = _basis(curve.shape, blocks.torque - bias, [share * size for share in knee])
                matrix = np.column_stack([*basis, *columns, *path])
                solution, *_ = np.linalg.lstsq(matrix, blocks.twist, rcond=None)
                rest = blocks.twist - matrix @ solution
                tried.append((float(rest @ rest), solution, bias, [share * size for share in knee], reach))
    tried.sort(key=lambda t: t[0])
    best, other = tried[0], next((t for t in tried if t[3] != tried[0][3]), None)
    return [_parameters(blocks, curve, *t[1:]) for t in (best, other) if t is not None]


def _zero_columns(blocks: Blocks, curve: Curve) -> list[np.ndarray]:
    own = [(blocks.log == i).astype(float) for i in range(curve.logs)]
    return own + ([column * blocks.centred_time for column in own] if curve.drifting else [])


def _basis(shape: Shape, torque: np.ndarray, knees: list[float]) -> list[np.ndarray]:
    """Columns whose combination is the curve, to first order for the cubic."""
    if shape == "cubic":
        return [torque, torque**3]
    edges = [np.clip(torque, -knee, knee) for knee in knees]
    return [after - before for before, after in zip([0.0, *edges], [*edges, torque], strict=True)]


def _parameters(
    blocks: Blocks, curve: Curve, solution: np.ndarray, bias: float, knees: list[float], reach: float | None
) -> np.ndarray:
    """Parameters of the curve from the coefficients of its columns."""
    size = blocks.amplitude
    largest = 0.5 * float(np.ptp(blocks.twist))
    softest, stiffest = 5.0 * largest / size, 0.02 * largest / size
    slopes = len(knees) + 1
    compliances = np.clip(solution[:slopes], stiffest, softest)
    shape = list(-np.log(compliances))
    used = slopes
    if curve.shape == "cubic":
        used = 2
        shape.append(np.clip(-solution[1] / compliances[0] ** 3, -0.2 / largest**2, 5.0 / largest**2))
    shape += list(np.log(np.diff([0.0, *knees])))
    zeros = curve.logs * (2 if curve.drifting else 1)
    rest = list(solution[used : used + zeros])
    if reach is not None:
        rest += [-solution[-1] / compliances[0], math.log(reach), *[0.0] * curve.logs]
    return np.array([*shape, *([bias] if curve.biased else []), *rest], dtype=float)


def polish(
    blocks: Blocks, curve: Curve, start: np.ndarray, excess: float, weights: np.ndarray | None = None, *, most: int = 40
) -> CurveFit:
    """The curve of least weighed misfit near a starting point.

    Args:
        blocks: To be fitted.
        curve: The form.
        start: Parameters.
        excess: Standard deviation of what noise does not explain [rad].
        weights: Of the blocks, (n,), or None for one each; zero leaves a block out, though it still moves the memory.
        most: Evaluations.

    Returns:
        The fit; residual and Jacobian carry the weights.
    """
    weights = np.ones_like(blocks.torque) if weights is None else weights
    steps = 1e-5 * scales(blocks, curve)
    blocks = replace(blocks, twist_noise=math.hypot(blocks.twist_noise, excess))

    def residual(parameters: np.ndarray) -> np.ndarray:
        misfit, slope = _misfit(blocks, curve, parameters)
        return weights * misfit / np.hypot(blocks.twist_noise, slope * blocks.torque_noise)

    low, high = _bounds(blocks, curve)
    inside = np.clip(start, low + 10 * steps, high - 10 * steps)
    found = least_squares(
        residual,
        inside,
        jac=lambda at: slopes(residual, at, steps),  # pyright: ignore[reportArgumentType]
        bounds=(low, high),
        x_scale=1e5 * steps,
        xtol=1e-7,
        ftol=1e-8,
        max_nfev=most,
    )
    misfit, _ = _misfit(blocks, curve, found.x)
    return CurveFit(curve, found.x, found.fun, found.jac, misfit, excess)


def scales(blocks: Blocks, curve: Curve) -> np.ndarray:
    """What counts as a large change of each parameter."""
    twist = 0.5 * float(np.ptp(blocks.twist))
    duration = float(np.ptp(blocks.time)) or 1.0
    known = {"alpha": 1.0 / twist**2, "torque_bias": blocks.amplitude, "friction": blocks.amplitude}
    by_word = {"offset": twist, "drift": twist / duration}
    return np.array([known.get(name) or by_word.get(name.split()[0], 1.0) for name in curve.names])


def _bounds(blocks: Blocks, curve: Curve) -> tuple[np.ndarray, np.ndarray]:
    """Where each parameter may be; beyond lie only curves that the logs can't tell from a simpler one."""
    size, twist = blocks.amplitude, 0.5 * float(np.ptp(blocks.twist))
    step = float(np.median(np.abs(np.diff(blocks.torque)))) or 1e-3 * size
    # A branch that took longer to change would be a second stiffness.
    reach = math.log(min(step, 0.1 * size)), math.log(0.5 * size)
    stiff = math.log(size / twist)
    known = {"alpha": (-0.15 / twist**2, 30.0 / twist**2), "log reach": reach}
    known |= {name: (math.log(0.02 * size), math.log(2.0 * size)) for name in ("log T1", "log gap")}
    by_word = {"start": (-1.0 - 1e-3, 1.0 + 1e-3), "log": (stiff - 7.0, stiff + 7.0)}
    pairs = [known.get(name) or by_word.get(name.split()[0], (-np.inf, np.inf)) for name in curve.names]
    low, high = np.array(pairs, dtype=float).T
    return low, high
