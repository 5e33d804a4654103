"""Vendors' figures of a fitted torque-twist curve: slopes, knees, lost motion, hysteresis width."""

import math
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
from scipy.special import stdtrit

from fitting.quasi_static.curve_fit import CurveFit, ranges
from fitting.quasi_static.intervals import Figure, Known, scatter
from fitting.quasi_static.stretches import correlation_length, stretches
from fitting.quasi_static.torque_twist import MEMORIES, Blocks, Curve, Memory, Shape, loop

LOST_MOTION_SHARE = 0.04
# Memory lengths that are tried for the width, over the torque's amplitude.
_REACHES = (0.02, 0.04, 0.08, 0.16, 0.32)
_STIFFNESSES: dict[Shape, tuple[str, ...]] = {
    "linear": ("stiffness",),
    "cubic": ("stiffness at zero twist",),
    "two slopes": ("stiffness up to T1", "stiffness from T1 on"),
    "three slopes": ("stiffness up to T1", "stiffness from T1 on to T2", "stiffness beyond T2"),
}
_LOST_MOTION = (("lost_motion", "middle of the loop"), ("lost_motion_outer", "outer branches of the loop"))


def figures(fit: CurveFit, blocks: Blocks, rated_torque: float | None) -> dict[str, Known]:
    """All figures of one fitted curve.

    Args:
        fit: The fit.
        blocks: The fitted data.
        rated_torque: [N m], or None; without it the figures that vendors define by it are unknown.

    Returns:
        By name: K or K1, K2, K3 with T1, T2, alpha, torque_bias, drift, hysteresis_torque, hysteresis_width,
        hysteresis_loss, lost_motion and lost_motion_outer, where the curve has them.
    """
    found = scatter(fit.jacobian, fit.residual, stretches(fit.residual, blocks.log))
    steps = 1e-4 * ranges(blocks, fit.curve)[2]
    formulas = (*_slopes(fit.curve), *_shifts(fit.curve, blocks), *_loop(fit.curve, blocks, rated_torque))
    known = {one.name: one.known(fit.parameters, steps, found) for one in formulas}
    if fit.curve.memory is not None:
        known["hysteresis_width"] = _width(fit, blocks, known["hysteresis_width"])
    return known


def _slopes(curve: Curve) -> Iterator[Figure]:
    """Stiffnesses and knees."""
    at, lines = curve.places, "slopes" in curve.shape
    for i, text in enumerate(_STIFFNESSES[curve.shape]):
        yield Figure(f"K{i + 1}" if lines else "K", lambda p, i=i: math.exp(p[i]), "N m/rad", text, True)
    knees = [at[name] for name in ("log T1", "log gap") if name in at]
    for i, text in zip(range(len(knees)), ("first", "second"), strict=False):
        yield Figure(f"T{i + 1}", partial(_knee, knees[: i + 1]), "N m", f"torque at the {text} knee", True)
    if curve.shape == "cubic":
        yield Figure("alpha", lambda p: p[1], "rad^-2", "cubic coefficient, tau = K (x + alpha x^3)")


def _knee(gaps: list[int], parameters: np.ndarray) -> float:
    return float(np.sum(np.exp(parameters[gaps])))


def _shifts(curve: Curve, blocks: Blocks) -> Iterator[Figure]:
    """Bias and drift."""
    if curve.biased:
        yield Figure("torque_bias", lambda p: curve.value("torque_bias", p), "N m", "torque at the centre of the curve")
    for i, log in enumerate(blocks.names if curve.drifting else ()):
        name = "drift" if curve.logs == 1 else f"drift.{log}"
        yield Figure(name, lambda p, i=i: curve.value(f"drift {i}", p), "rad/s", f"drift of the twist in {log}")


def _loop(curve: Curve, blocks: Blocks, rated_torque: float | None) -> Iterator[Figure]:
    """Figures of the loop, and those that vendors define by the rated torque."""
    size, looped = blocks.amplitude, curve.memory is not None
    if looped:
        text = "friction torque behind the loop, half of its width along the torque"
        yield Figure("hysteresis_torque", lambda p: curve.value("friction", p), "N m", text)
        text = f"width of the loop at zero torque, for torque cycles of +-{size:.3g} N m"
        yield Figure("hysteresis_width", lambda p: _open(curve, p, size), "rad", text)
    small = LOST_MOTION_SHARE * (rated_torque or math.inf)
    text = f"twist between -{small:.3g} and +{small:.3g} N m (4 % of rated torque)"
    for i, (name, where) in enumerate(_LOST_MOTION[: 1 + looped] if small <= size else ()):
        yield Figure(name, partial(_between, curve, size, small, i > 0), "rad", f"{text}, {where}", True)
    if looped and rated_torque and size >= 0.9 * rated_torque:
        text = "width of the loop at zero torque, for cycles of rated torque"
        yield Figure("hysteresis_loss", lambda p: _open(curve, p, rated_torque), "rad", text)


def _open(curve: Curve, parameters: np.ndarray, amplitude: float) -> float:
    """Width of the closed loop at zero torque [rad]."""
    torque, rising, falling = loop(curve, parameters, amplitude)
    middle = len(torque) // 2
    return float(falling[middle] - rising[middle])


def _between(curve: Curve, amplitude: float, torque: float, outer: bool, parameters: np.ndarray) -> float:
    """Twist from -torque to +torque [rad], along the middle of the loop or between its outer branches."""
    at, rising, falling = loop(curve, parameters, amplitude)
    up, down = (np.interp([-torque, torque], at, branch) for branch in (rising, falling))
    return float(down[1] - up[0] if outer else 0.5 * np.sum(np.diff([up, down])))


def _width(fit: CurveFit, blocks: Blocks, local: Known) -> Known:
    """The width with an interval valid for all laws and memory lengths that the logs do not exclude.

    Without hysteresis the memory length is undefined, and the search selects the one that fits noise best. Its interval
    alone would exclude zero too often (Davies 1987).
    """
    assert local.ci95 is not None
    curve, cluster = fit.curve, stretches(fit.residual, blocks.log)
    free = len(blocks.torque) / correlation_length(fit.residual)
    worst = 1.0 + stdtrit(max(1.0, free - 1.0), 0.975) ** 2 / free
    widths = list(local.ci95)
    for memory in MEMORIES:
        for share in _REACHES:
            moved = fit.parameters.copy()
            moved[curve.places["log reach"]] = math.log(share * blocks.amplitude)
            other = _with_memory(fit, blocks, memory, moved)
            if float(other.residual @ other.residual) > worst * float(fit.residual @ fit.residual):
                continue
            direction = np.eye(len(other.parameters))[-1]
            half = scatter(other.jacobian, other.residual, cluster).half_width(direction)
            for friction in (other.parameters[-1] - half, other.parameters[-1] + half):
                moved[curve.places["friction"]] = friction
                widths.append(_open(replace(curve, memory=memory), moved, blocks.amplitude))
    low, high = min(widths), max(widths)
    identifiable = not low <= 0.0 <= high
    reason = "" if identifiable else f"it would be significantly nonzero only above {max(-low, high):.2g} rad"
    return replace(local, ci95=(low, high), identifiable=identifiable, reason=reason)


def _with_memory(fit: CurveFit, blocks: Blocks, memory: Memory, moved: np.ndarray) -> CurveFit:
    """The fit with another law of memory, to first order in all other parameters; the friction is the last."""
    curve = fit.curve
    kept = [i for i, name in enumerate(curve.names) if not name.startswith(("friction", "log reach", "start"))]
    changed = replace(curve, memory=memory).branch(moved, blocks)
    _, slope = curve.predict(fit.parameters, blocks)
    weighed = slope / np.hypot(math.hypot(blocks.twist_noise, fit.excess), slope * blocks.torque_noise)
    matrix = np.column_stack([fit.jacobian[:, kept], weighed * changed])
    friction = curve.value("friction", fit.parameters)
    without = fit.residual - friction * weighed * curve.branch(fit.parameters, blocks)
    solution, *_ = np.linalg.lstsq(matrix, -without, rcond=None)
    return replace(fit, parameters=solution, residual=without + matrix @ solution, jacobian=matrix)
