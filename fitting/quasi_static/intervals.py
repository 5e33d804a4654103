"""What a quasi-static fit knows: the figures that vendors state, with intervals that allow for coloured residuals.

Residuals of a torque-twist curve are coloured by whatever the curve lacks, so that the number of samples says little.
The log is cut into stretches that hardly know of each other, and how the estimates change when one stretch is left out
gives the variance (jackknife over clusters, CR3: Bell and McCaffrey 2002). Quantiles are Student's with the effective
number of clusters (Carter, Schnepel and Steigerwald 2017): a figure that a single stretch decides gets a wide interval.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtrit

from fitting.quasi_static.curve_fit import CurveFit, scales
from fitting.quasi_static.stretches import correlation_length, stretches
from fitting.quasi_static.torque_twist import (
    MEMORIES,
    SHAPE_NAMES,
    Blocks,
    Curve,
    Memory,
    loop,
    positive,
)

LOST_MOTION_SHARE = 0.04
_RIDGE = 1e-10
_BLIND = 1e-6
# As for every positive parameter of a fit, whose logarithm has a standard error below 0.5: half of its 95 % interval.
_VAGUE = 0.98
# Beyond a factor of a thousand an interval says nothing.
_NOT_AT_ALL = math.log(1e3)
# Reaches that are tried for the width, over the torque's amplitude.
_REACHES = (0.02, 0.04, 0.08, 0.16, 0.32)
_KNEE_LEAST = 5

Formula = Callable[[np.ndarray], float]


@dataclass(frozen=True)
class Known:
    """One figure.

    Attributes:
        value: In `unit`; None where the logs say nothing about it.
        std: Standard error, robust against coloured residuals, or None.
        ci95: 95 % interval, or None.
        unit: SI unit.
        identifiable: Whether the logs tell it from zero or, if it must be positive, know it to a factor of about two.
        description: What it is.
        reason: Why it is not identifiable; empty where it is.
    """

    value: float | None
    std: float | None
    ci95: tuple[float, float] | None
    unit: str
    identifiable: bool
    description: str
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Scatter:
    """How the parameters of a fit scatter.

    Attributes:
        changes: Of the parameters when a cluster is left out, (clusters, parameters).
        classical: Covariance if residuals were white.
        shares: Of each cluster, how the estimates move with its rows, (rows, parameters).
    """

    changes: np.ndarray
    classical: np.ndarray
    shares: list[np.ndarray]

    def std(self, slope: np.ndarray) -> float:
        """Standard error of a figure whose derivative with respect to the parameters is `slope`."""
        count = len(self.changes)
        robust = (count - 1) / count * float(np.sum((self.changes @ slope) ** 2))
        # Clusters under-estimate where they are few; the larger of the two is the honest one.
        return math.sqrt(max(robust, float(slope @ self.classical @ slope), 0.0))

    def quantile(self, slope: np.ndarray) -> float:
        """Student's 97.5 % point with the number of clusters that have a say in the figure."""
        weight = np.array([float(np.sum((share @ slope) ** 2)) for share in self.shares])
        total = float(np.sum(weight))
        effective = total**2 / float(np.sum(weight**2)) if total > 0 else 1.0
        return float(stdtrit(max(1.0, effective - 1.0), 0.975))


def scatter(jacobian: np.ndarray, residual: np.ndarray, cluster: np.ndarray) -> Scatter:
    """The scatter of a fit's parameters over clusters of rows.

    Args:
        jacobian: Of the residual, (n, parameters).
        residual: Of the fit, (n,).
        cluster: Number of the cluster of each row, (n,).
    """
    # A column that the data do not see would make the scale infinite.
    norms = np.linalg.norm(jacobian, axis=0)
    scale = 1.0 / np.where(norms > 0, norms, 1.0)
    scaled = jacobian * scale
    information = scaled.T @ scaled
    inverse = _inverse(information)
    changes, shares = [], []
    for number in range(int(cluster[-1]) + 1):
        own = cluster == number
        part = scaled[own]
        # What no other cluster sees stays where it is; its effective number of clusters is one.
        without = np.linalg.pinv(information - part.T @ part, rcond=_BLIND, hermitian=True)
        changes.append(scale * (without @ (part.T @ residual[own])))
        shares.append(part @ inverse * scale)
    freedom = max(1, len(residual) - int(np.sum(norms > 0)))
    variance = float(residual @ residual) / freedom
    return Scatter(np.array(changes), variance * inverse * np.outer(scale, scale), shares)


def _inverse(information: np.ndarray) -> np.ndarray:
    """Inverse of a scaled information; directions that the data do not see get a huge variance."""
    values, vectors = np.linalg.eigh(information)
    return (vectors / np.maximum(values, _RIDGE)) @ vectors.T


def figures(fit: CurveFit, blocks: Blocks, rated_torque: float | None) -> dict[str, Known]:
    """All figures of one fitted curve.

    Args:
        fit: The fit.
        blocks: What was fitted.
        rated_torque: [N m], or None; without it the figures that vendors define by it are unknown.

    Returns:
        By name: K or K1, K2, K3 with T1, T2, alpha, torque_bias, drift, hysteresis_torque, hysteresis_width,
        hysteresis_loss, lost_motion and lost_motion_outer, as far as the curve has them.
    """
    curve = fit.curve
    found = scatter(fit.jacobian, fit.residual, stretches(fit.residual, blocks.log))
    known = {
        name: known_figure(
            formula(fit.parameters), _slope(formula, fit, blocks), found, unit, description, must_be_positive
        )
        for name, (formula, unit, description, must_be_positive) in _formulas(curve, blocks, rated_torque).items()
    }
    largest = _largest_torque(fit, blocks)
    for knee, beyond in (("T1", "K2"), ("T2", "K3")):
        if knee in known and np.sum(np.abs(_centred(fit, blocks)) > (known[knee].value or 0.0)) < _KNEE_LEAST:
            why = f"the torque reaches {largest:.3g} N m, hardly beyond the knee {knee}"
            known[beyond] = replace(known[beyond], value=None, std=None, ci95=None, identifiable=False, reason=why)
            known[knee] = replace(known[knee], identifiable=False, reason=why)
    if curve.memory is not None:
        known["hysteresis_width"] = _width(fit, blocks, known["hysteresis_width"])
    return known


def _centred(fit: CurveFit, blocks: Blocks) -> np.ndarray:
    return blocks.torque - fit.curve.value("torque_bias", fit.parameters)


def _largest_torque(fit: CurveFit, blocks: Blocks) -> float:
    return float(np.max(np.abs(_centred(fit, blocks))))


def _formulas(curve: Curve, blocks: Blocks, rated_torque: float | None) -> dict[str, tuple[Formula, str, str, bool]]:
    """Of each figure: formula, unit, description, and whether it must be positive."""
    found: dict[str, tuple[Formula, str, str, bool]] = {}
    names = SHAPE_NAMES[curve.shape]
    lines = curve.shape in ("two slopes", "three slopes")
    texts = (
        "stiffness up to T1",
        "stiffness from T1 on" + (" to T2" if "log K3" in names else ""),
        "stiffness beyond T2",
    )
    for i, text in enumerate(texts):
        if f"log K{i + 1}" in names:
            name = f"K{i + 1}" if lines else "K"
            text = text if lines else "stiffness" + (" at zero twist" if curve.shape == "cubic" else "")
            found[name] = (lambda p, i=i: float(positive(p[i])), "N m/rad", text, True)
    if lines:
        first = curve.places["log T1"]
        found["T1"] = (lambda p: float(positive(p[first])), "N m", "torque at the first knee", True)
    if "log gap" in names:
        gaps = slice(curve.places["log T1"], curve.places["log gap"] + 1)
        found["T2"] = (lambda p: float(np.sum(positive(p[gaps]))), "N m", "torque at the second knee", True)
    if curve.shape == "cubic":
        found["alpha"] = (lambda p: float(p[1]), "rad^-2", "cubic coefficient, tau = K (x + alpha x^3)", False)
    if curve.biased:
        at = curve.places["torque_bias"]
        found["torque_bias"] = (lambda p, at=at: float(p[at]), "N m", "torque at the centre of the curve", False)
    if curve.drifting:
        for i, name in enumerate(blocks.names):
            at = curve.places[f"drift {i}"]
            text = f"drift of the twist in {name}"
            found["drift" if curve.logs == 1 else f"drift.{name}"] = (
                lambda p, at=at: float(p[at]),
                "rad/s",
                text,
                False,
            )
    if curve.memory is not None:
        at, size = curve.places["friction"], blocks.amplitude
        text = "friction torque behind the loop, half of its width along the torque"
        found["hysteresis_torque"] = (lambda p, at=at: float(p[at]), "N m", text, False)
        text = f"width of the loop at zero torque, for torque cycles of +-{size:.3g} N m"
        found["hysteresis_width"] = (lambda p: _open(curve, p, size), "rad", text, False)
    return found | _by_rated_torque(curve, blocks, rated_torque)


def _by_rated_torque(
    curve: Curve, blocks: Blocks, rated_torque: float | None
) -> dict[str, tuple[Formula, str, str, bool]]:
    if rated_torque is None:
        return {}
    size, small = blocks.amplitude, LOST_MOTION_SHARE * rated_torque
    found: dict[str, tuple[Formula, str, str, bool]] = {}
    if small <= size:
        text = f"twist between -{small:.3g} and +{small:.3g} N m (4 % of rated torque)"
        found["lost_motion"] = (
            lambda p: _between(curve, p, size, small)[0],
            "rad",
            f"{text}, middle of the loop",
            True,
        )
        if curve.memory is not None:
            text = f"{text}, outer branches of the loop"
            found["lost_motion_outer"] = (lambda p: _between(curve, p, size, small)[1], "rad", text, True)
    if curve.memory is not None and size >= 0.9 * rated_torque:
        text = "width of the loop at zero torque, for cycles of rated torque"
        found["hysteresis_loss"] = (lambda p: _open(curve, p, rated_torque), "rad", text, False)
    return found


def _open(curve: Curve, parameters: np.ndarray, amplitude: float) -> float:
    """Width of the closed loop at zero torque [rad]."""
    torque, rising, falling = loop(curve, parameters, amplitude)
    middle = len(torque) // 2
    return float(falling[middle] - rising[middle])


def _between(curve: Curve, parameters: np.ndarray, amplitude: float, torque: float) -> tuple[float, float]:
    """Twist from -torque to +torque [rad], along the middle of the loop and between its outer branches."""
    at, rising, falling = loop(curve, parameters, amplitude)
    ends = np.array([-torque, torque])
    low, high = 0.5 * (np.interp(ends, at, rising) + np.interp(ends, at, falling))
    outer = np.interp(torque, at, falling) - np.interp(-torque, at, rising)
    return float(high - low), float(outer)


def known_figure(
    value: float, slope: np.ndarray, found: Scatter, unit: str, description: str, must_be_positive: bool
) -> Known:
    """A figure with its interval.

    Args:
        value: At the fitted parameters.
        slope: Its derivative with respect to the parameters, (parameters,).
        found: How the parameters scatter.
        unit: SI unit.
        description: What it is.
        must_be_positive: Whether a negative value would be none; the interval is then one of its logarithm.
    """
    std, quantile = found.std(slope), found.quantile(slope)
    if must_be_positive and quantile * std > _NOT_AT_ALL * abs(value):
        return Known(value, std, None, unit, False, description, "the logs do not determine it at all")
    if must_be_positive and value > 0:
        factor = math.exp(quantile * std / value)
        ends, identifiable = (value / factor, value * factor), quantile * std < _VAGUE * value
        reason = "" if identifiable else f"the logs determine it only to within a factor of {factor:.2g}"
    else:
        ends = (value - quantile * std, value + quantile * std)
        identifiable = not ends[0] <= 0.0 <= ends[1]
        reason = "" if identifiable else f"it could be told from zero only above {quantile * std:.2g} {unit}"
    return Known(value, std, ends, unit, identifiable, description, reason)


def _slope(formula: Formula, fit: CurveFit, blocks: Blocks) -> np.ndarray:
    steps = 1e-4 * scales(blocks, fit.curve)
    moves = np.diag(steps)
    return np.array([(formula(fit.parameters + m) - formula(fit.parameters - m)) / (2 * np.sum(m)) for m in moves])


def _width(fit: CurveFit, blocks: Blocks, local: Known) -> Known:
    """The width with an interval that holds for every law and reach of the memory that the logs do not rule out.

    Without hysteresis the reach means nothing and the search has picked the one that fits noise best; the interval
    around that one alone would miss zero too often (Davies 1987).
    """
    assert local.ci95 is not None and local.value is not None
    curve = fit.curve
    free = len(blocks.torque) / correlation_length(fit.residual)
    best = float(fit.residual @ fit.residual)
    low, high = local.ci95
    for memory in MEMORIES:
        for share in _REACHES:
            reach = share * blocks.amplitude
            other = _with_memory(fit, blocks, memory, reach)
            cost = float(other.residual @ other.residual)
            if free * (cost / best - 1.0) > stdtrit(max(1.0, free - 1.0), 0.975) ** 2:
                continue
            found = scatter(other.jacobian, other.residual, stretches(fit.residual, blocks.log))
            direction = np.eye(len(other.parameters))[-1]
            half = found.quantile(direction) * found.std(direction)
            alone, moved = replace(curve, memory=memory), fit.parameters.copy()
            moved[curve.places["log reach"]] = math.log(reach)
            for friction in (other.parameters[-1] - half, other.parameters[-1] + half):
                moved[curve.places["friction"]] = friction
                opening = _open(alone, moved, blocks.amplitude)
                low, high = min(low, opening), max(high, opening)
    identifiable = not low <= 0.0 <= high
    reason = "" if identifiable else f"it could be told from zero only above {max(-low, high):.2g} rad"
    return replace(local, ci95=(low, high), identifiable=identifiable, reason=reason)


def _with_memory(fit: CurveFit, blocks: Blocks, memory: Memory, reach: float) -> CurveFit:
    """The fit with another law of memory, to first order in all other parameters; the friction is the last."""
    curve = fit.curve
    kept = [i for i, name in enumerate(curve.names) if not name.startswith(("friction", "log reach", "start"))]
    moved = fit.parameters.copy()
    moved[curve.places["log reach"]] = math.log(reach)
    changed = replace(curve, memory=memory).branch(moved, blocks)
    _, slope = curve.predict(fit.parameters, blocks)
    weighed = slope / np.hypot(math.hypot(blocks.twist_noise, fit.excess), slope * blocks.torque_noise)
    matrix = np.column_stack([fit.jacobian[:, kept], weighed * changed])
    friction = curve.value("friction", fit.parameters)
    without = fit.residual - friction * weighed * curve.branch(fit.parameters, blocks)
    solution, *_ = np.linalg.lstsq(matrix, -without, rcond=None)
    return replace(fit, parameters=solution, residual=without + matrix @ solution, jacobian=matrix)
