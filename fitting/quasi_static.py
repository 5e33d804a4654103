"""The fit of quasi-static logs: twist against joint torque, without inertia.

Both axes are noisy, so that neither the regression of twist on torque nor the reverse is right: the first makes the
drive too stiff, the second too soft. Means over short blocks shrink both noises, and each block's misfit is weighed by
the noise of both axes, the torque's through the local slope (effective variance; York 1966, Fuller 1987 section 3.2).
The noise of either axis is measured in the log itself, from what third differences leave of a smooth course.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from fitting.logs import Log
from fitting.torque_twist import MEMORIES, SHAPES, Blocks, Curve, Shape, centred_time, remembered

# Assumed: fine enough to place a knee to a few per cent, coarse enough to average noise away.
BLOCKS_PER_CYCLE = 100
MOST_BLOCKS = 1500
# A swing back by less than this share of the torque's range leaves the branch as it is, nearly.
_REVERSAL = 0.05
# Both signs of torque must reach this share of the largest before the curve's symmetry can show its centre.
_BOTH_SIGNS = 0.3
# Full cycles before a drift with time can be told from the way there and back.
_CYCLES_FOR_DRIFT = 2
_FOLDS = 5
_MEDIAN_TO_STD = 1.4826
_THIRD_DIFFERENCE = math.sqrt(20.0)


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


@dataclass(frozen=True, eq=False)
class QuasiStaticFit:
    """The fits of all shapes, and which of them held-out stretches ask for.

    Attributes:
        blocks: What was fitted.
        fits: By shape.
        held_out: Held-out misfit [rad] of each block, by shape.
        stretch: Number of the stretch that each block was held out with, (n,).
        chosen: The simplest shape that predicts held-out stretches about as well as the best one.
    """

    blocks: Blocks
    fits: dict[Shape, CurveFit]
    held_out: dict[Shape, np.ndarray]
    stretch: np.ndarray
    chosen: Shape

    @property
    def best(self) -> CurveFit:
        """The chosen shape's fit."""
        return self.fits[self.chosen]


def fit_quasi_static(logs: Sequence[Log], *, hysteresis: bool = True) -> QuasiStaticFit:
    """Fit all shapes of torque-twist curve to quasi-static logs of one drive, and choose one.

    Args:
        logs: Of kind "quasi-static", checked by the health gate. All share the curve and the torque bias; each has
            its own twist zero and drift.
        hysteresis: Whether the way there and back may differ; a joint that turns one way all the time shows no such
            thing, since the direction of its friction follows the motion.

    Returns:
        The fits.
    """
    blocks = average(logs)
    fits = {shape: _best_of(blocks, candidates) for shape, candidates in _candidates(blocks, hysteresis).items()}
    # One law of memory for all shapes: that of the most flexible one, which blames the memory for least.
    memory = fits["three slopes"].curve.memory
    for shape in SHAPES:
        curve = replace(fits[shape].curve, memory=memory)
        if curve != fits[shape].curve:
            fits[shape] = _best_of(blocks, [curve])
    stretch = stretches(fits["three slopes"].residual, blocks.log)
    held_out = {shape: hold_out(blocks, fit, stretch) for shape, fit in fits.items()}
    chosen = _simplest(held_out, stretch)
    return QuasiStaticFit(blocks, fits, held_out, stretch, chosen)


def average(logs: Sequence[Log]) -> Blocks:
    """Means over blocks so short that the torque is nearly straight, and so long that it outruns its noise.

    No block crosses a reversal of the torque, and the extreme that the torque reached there is kept beside the blocks:
    the hysteresis depends on it.
    """
    parts = [_average(log, MOST_BLOCKS // len(logs)) for log in logs]
    sizes = [len(part["torque"]) for part in parts]
    lengths = [len(part["path"]) for part in parts]
    before = np.repeat(np.cumsum([0, *lengths[:-1]]), sizes)
    whole = {key: np.concatenate([part[key] for part in parts]) for key in ("torque", "twist", "time", "path", "seat")}
    return Blocks(
        torque=whole["torque"],
        twist=whole["twist"],
        time=whole["time"],
        log=np.repeat(np.arange(len(logs)), sizes),
        path=whole["path"],
        path_log=np.repeat(np.arange(len(logs)), lengths),
        seat=whole["seat"] + before,
        names=tuple(log.name for log in logs),
        torque_noise=float(np.mean([part["noise"][0] for part in parts])),
        # Even exact numbers have rounding; without a floor their weights would be infinite.
        twist_noise=max(float(np.mean([part["noise"][1] for part in parts])), 1e-7 * float(np.ptp(whole["twist"]))),
        rows=tuple(round(len(log) / size) for log, size in zip(logs, sizes, strict=True)),
        reversals=tuple(len(part["path"]) - len(part["torque"]) for part in parts),
    )


def _average(log: Log, most: int) -> dict[str, np.ndarray]:
    torque = log.joint_torque
    assert torque is not None
    cycles = max(1.0, len(turns(torque, max(1, len(torque) // 1000))) / 2)
    most = min(most, round(BLOCKS_PER_CYCLE * cycles))
    size = max(1, round(len(log) / most))
    while len(log) / size > 0.4 * most and _moves_little(means(torque, size)):
        size = math.ceil(1.2 * size)
    branches = np.array([0, *turns(torque, size), len(log)])
    counts = np.maximum(1, np.rint(np.diff(branches) / size)).astype(int)
    edges = [np.linspace(a, b, n, endpoint=False) for a, b, n in zip(branches, branches[1:], counts, strict=False)]
    edge = np.append(np.rint(np.concatenate(edges)), len(log)).astype(int)
    columns = {"torque": torque, "twist": log.dynamic_error, "time": log.time}
    found = {key: np.add.reduceat(v, edge[:-1]) / np.diff(edge) for key, v in columns.items()}
    # Blocks of one size, whose centres are evenly spaced as third differences want them.
    found["noise"] = np.array([noise(means(values, size)) for values in (torque, log.dynamic_error)])
    firsts = np.cumsum(counts)[:-1]
    extremes = [_extreme(found["torque"], int(first)) for first in firsts]
    found["path"] = np.insert(found["torque"], firsts, extremes)
    found["seat"] = np.arange(len(edge) - 1) + np.searchsorted(firsts, np.arange(len(edge) - 1), side="right")
    return found


def _extreme(torque: np.ndarray, first: int) -> float:
    """The torque at the edge between two blocks of which the later is `first`, from the courses on both sides."""
    ends = [torque[max(first - 2, 0) : first], torque[first : first + 2][::-1]]
    return float(np.mean([end[-1] + 0.5 * (end[-1] - end[0]) for end in ends]))


def means(values: np.ndarray, size: int) -> np.ndarray:
    """Means over runs of `size` values; a shorter rest at the end is left out."""
    count = len(values) // size
    return values[: count * size].reshape(count, size).mean(axis=1)


def noise(values: np.ndarray) -> float:
    """Standard deviation of the noise on a smooth course, robustly from third differences."""
    differences = np.abs(np.diff(values, 3))
    typical = float(np.median(differences)) * _MEDIAN_TO_STD
    # More than half of the differences of a coarsely quantised channel may be zero.
    return (typical or float(np.sqrt(np.mean(differences**2)))) / _THIRD_DIFFERENCE


def _moves_little(torque: np.ndarray) -> bool:
    return float(np.median(np.abs(np.diff(torque)))) < 3.0 * noise(torque)


def turns(torque: np.ndarray, size: int) -> list[int]:
    """Rows at which the torque turns back by more than its noise and a small share of its range.

    Args:
        torque: In order of time, (n,).
        size: Rows over which it is averaged before one looks.
    """
    smooth = means(torque, size)
    least = max(_REVERSAL * float(np.ptp(smooth)), 8.0 * noise(smooth))
    values = smooth.tolist()
    low = high = 0
    direction, found = 0, []
    for i, value in enumerate(values):
        low, high = (i if value < values[low] else low), (i if value > values[high] else high)
        if direction >= 0 and value < values[high] - least:
            found += [high] if direction else []
            direction, low = -1, i
        elif direction <= 0 and value > values[low] + least:
            found += [low] if direction else []
            direction, high = 1, i
    return [_refined(torque, size, i) for i in found]


def _refined(torque: np.ndarray, size: int, i: int) -> int:
    """The row of an extreme from the averages around the one that is most extreme."""
    at = np.arange(max(0, (i - 1) * size), max(1, min(len(torque) - size, (i + 1) * size)) + 1)
    running = np.concatenate([[0.0], np.cumsum(torque[at[0] : at[-1] + size])])
    averages = running[size:] - running[:-size]
    inner = torque[i * size : (i + 1) * size].mean()
    outer = np.mean([torque[at[0] : at[0] + size].mean(), torque[at[-1] : at[-1] + size].mean()])
    best = np.argmax(averages) if inner >= outer else np.argmin(averages)
    return int(at[0] + best + size // 2)


def _candidates(blocks: Blocks, hysteresis: bool) -> dict[Shape, list[Curve]]:
    """The forms that the logs can tell something about, by shape."""
    low, high = float(np.min(blocks.torque)), float(np.max(blocks.torque))
    both_signs = min(-low, high) > _BOTH_SIGNS * max(-low, high)
    drifting = min(blocks.reversals) >= 2 * _CYCLES_FOR_DRIFT
    memories = MEMORIES if hysteresis and max(blocks.reversals) > 0 else (None,)
    logs = len(blocks.names)
    return {
        shape: [Curve(shape, memory, both_signs and shape != "linear", drifting, logs) for memory in memories]
        for shape in SHAPES
    }


def _best_of(blocks: Blocks, curves: Sequence[Curve]) -> CurveFit:
    found = [fit_curve(blocks, curve, start) for curve in curves for start in starts(blocks, curve)]
    return min(found, key=lambda fit: float(np.mean(fit.misfit**2)))


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
    """The two best starting points of a coarse grid over knees, bias and reach; the rest is linear there."""
    size, middle = blocks.amplitude, 0.5 * float(np.max(blocks.torque) + np.min(blocks.torque))
    knees = {
        "linear": [()],
        "cubic": [()],
        "two slopes": [(0.15,), (0.35,), (0.6,)],
        "three slopes": [(0.1, 0.35), (0.2, 0.6), (0.35, 0.7), (0.5, 0.8)],
    }[curve.shape]
    reaches = [0.03 * size, 0.12 * size, 0.4 * size] if curve.memory else [None]
    columns = _zero_columns(blocks, curve)
    tried = []
    for reach in reaches:
        path = []
        if reach is not None and curve.memory is not None:
            path = [_path(blocks, curve, reach)]
        for bias in {0.0, middle} if curve.biased else {0.0}:
            for knee in knees:
                basis = _basis(curve.shape, blocks.torque - bias, [share * size for share in knee])
                matrix = np.column_stack([*basis, *columns, *path])
                solution, *_ = np.linalg.lstsq(matrix, blocks.twist, rcond=None)
                rest = blocks.twist - matrix @ solution
                tried.append((float(rest @ rest), solution, bias, [share * size for share in knee], reach))
    tried.sort(key=lambda t: t[0])
    return [_parameters(blocks, curve, *t[1:]) for t in tried[:2]]


def _path(blocks: Blocks, curve: Curve, reach: float) -> np.ndarray:
    assert curve.memory is not None
    each = [remembered(curve.memory, blocks.path[blocks.path_log == i], reach, 0.0) for i in range(curve.logs)]
    return np.concatenate(each)[blocks.seat]


def _zero_columns(blocks: Blocks, curve: Curve) -> list[np.ndarray]:
    own = [(blocks.log == i).astype(float) for i in range(curve.logs)]
    return own + ([column * centred_time(blocks) for column in own] if curve.drifting else [])


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
        rest += [-2.0 * solution[-1], math.log(reach), *[0.0] * curve.logs]
    return np.array([*shape, *([bias] if curve.biased else []), *rest], dtype=float)


def polish(
    blocks: Blocks, curve: Curve, start: np.ndarray, excess: float, weights: np.ndarray | None = None
) -> CurveFit:
    """The curve of least weighed misfit near a starting point.

    Args:
        blocks: To be fitted.
        curve: The form.
        start: Parameters.
        excess: Standard deviation of what noise does not explain [rad].
        weights: Of the blocks, (n,), or None for one each; zero leaves a block out, though it still moves the memory.

    Returns:
        The fit; residual and Jacobian carry the weights.
    """
    weights = np.ones_like(blocks.torque) if weights is None else weights
    steps = 1e-5 * scales(blocks, curve)
    blocks = replace(blocks, twist_noise=math.hypot(blocks.twist_noise, excess))

    def residual(parameters: np.ndarray) -> np.ndarray:
        return weights * _residual(blocks, curve, parameters, curve.branch(parameters, blocks))

    def jacobian(parameters: np.ndarray) -> np.ndarray:
        return weights[:, None] * _jacobian(blocks, curve, parameters, steps)

    low, high = _bounds(blocks, curve)
    inside = np.clip(start, low + 10 * steps, high - 10 * steps)
    found = least_squares(
        residual, inside, jac=jacobian, bounds=(low, high), x_scale=1e5 * steps, xtol=1e-8, ftol=1e-9, max_nfev=60
    )
    misfit, _ = _misfit(blocks, curve, found.x)
    return CurveFit(curve, found.x, found.fun, found.jac, misfit, excess)


def _residual(blocks: Blocks, curve: Curve, parameters: np.ndarray, branch: np.ndarray) -> np.ndarray:
    x, slope = curve.without_memory(parameters, blocks)
    if curve.memory is not None:
        x = x - 0.5 * parameters[curve.place("width")] * branch
    return (blocks.twist - x) / np.hypot(blocks.twist_noise, slope * blocks.torque_noise)


def _jacobian(blocks: Blocks, curve: Curve, parameters: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Central differences; the branch is followed anew only for what moves it."""
    held = curve.branch(parameters, blocks)
    columns = []
    for i, (name, step) in enumerate(zip(curve.names, steps, strict=True)):
        ends = []
        for sign in (1.0, -1.0):
            moved = parameters.copy()
            moved[i] += sign * step
            branch = curve.branch(moved, blocks) if name.startswith(("log reach", "start")) else held
            ends.append(_residual(blocks, curve, moved, branch))
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    return np.column_stack(columns)


def scales(blocks: Blocks, curve: Curve) -> np.ndarray:
    """What counts as a large change of each parameter."""
    twist = 0.5 * float(np.ptp(blocks.twist))
    duration = float(np.ptp(blocks.time)) or 1.0
    known = {"alpha": 1.0 / twist**2, "torque_bias": blocks.amplitude, "width": twist}
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


def correlation_length(residual: np.ndarray) -> float:
    """Blocks over which residuals resemble each other: one and twice the sum of their autocorrelation."""
    centred = residual - np.mean(residual)
    size = len(centred)
    spectrum = np.abs(np.fft.rfft(centred, 2 * size)) ** 2
    covariance = np.fft.irfft(spectrum)[: size // 2]
    if covariance[0] <= 0:
        return 1.0
    rho = covariance / covariance[0]
    faded = np.flatnonzero(rho < 2.0 / math.sqrt(size))
    until = int(faded[0]) if len(faded) else len(rho)
    return max(1.0, 1.0 + 2.0 * float(np.sum(rho[1:until])))


def stretches(residual: np.ndarray, log: np.ndarray) -> np.ndarray:
    """Runs of blocks so long that residuals of different runs hardly know of each other.

    Args:
        residual: Of a fit, (n,).
        log: Number of the log of each block, (n,); no run crosses into another log.

    Returns:
        Number of the run of each block, (n,); at least `_FOLDS` runs.
    """
    length = math.ceil(max(4.0, 6.0 * correlation_length(residual)))
    numbers, count = np.zeros(len(residual), dtype=int), 0
    logs = int(log[-1]) + 1
    for i in range(logs):
        own = np.flatnonzero(log == i)
        runs = max(math.ceil(_FOLDS / logs), len(own) // length)
        numbers[own] = count + np.arange(len(own)) * runs // len(own)
        count += runs
    return numbers


def hold_out(blocks: Blocks, fit: CurveFit, stretch: np.ndarray) -> np.ndarray:
    """Misfit [rad] of each block by the curve that was fitted without its stretch, (n,).

    The torque of a stretch that is held out still moves the hysteresis, since it is an input; its twist is unseen.
    """
    count = int(stretch[-1]) + 1
    # Drawn, since a regular comb could leave the same torque out at every pass.
    fold = np.random.default_rng(0).permutation(np.arange(count) % _FOLDS)[stretch]
    misfit = np.empty_like(blocks.twist)
    for i in range(_FOLDS):
        kept = polish(blocks, fit.curve, fit.parameters, fit.excess, (fold != i).astype(float))
        misfit[fold == i] = kept.misfit[fold == i]
    return misfit


def _simplest(held_out: dict[Shape, np.ndarray], stretch: np.ndarray) -> Shape:
    """The first shape whose held-out error is not clearly above the least, in the order from simple to flexible."""
    least = min(SHAPES, key=lambda shape: float(np.mean(held_out[shape] ** 2)))
    return next(s for s in SHAPES if s == least or not worse(held_out[s], held_out[least], stretch))


def worse(one: np.ndarray, other: np.ndarray, stretch: np.ndarray) -> bool:
    """Whether the first held-out misfit is clearly above the second: by more than one standard error over stretches."""
    excess = np.bincount(stretch, one**2 - other**2)
    spread = float(np.std(excess, ddof=1)) * math.sqrt(len(excess))
    return float(np.sum(excess)) > spread
