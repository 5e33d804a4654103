"""The figures that vendors state of a fitted torque-twist curve: slopes, knees, lost motion, width of the loop."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.special import stdtrit

from fitting.quasi_static.curve_fit import CurveFit, ranges
from fitting.quasi_static.intervals import Figure, Known, scatter
from fitting.quasi_static.stretches import correlation_length, stretches
from fitting.quasi_static.torque_twist import MEMORIES, Blocks, Curve, Memory, loop

LOST_MOTION_SHARE = 0.04
# Reaches that are tried for the width, over the torque's amplitude.
_REACHES = (0.02, 0.04, 0.08, 0.16, 0.32)
_KNEE_LEAST = 5


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
    found = scatter(fit.jacobian, fit.residual, stretches(fit.residual, blocks.log))
    steps = 1e-4 * ranges(blocks, fit.curve)[2]
    formulas = (*_slopes(fit.curve), *_shifts(fit.curve, blocks), *_loop(fit.curve, blocks, rated_torque))
    known = {one.name: one.known(fit.parameters, steps, found) for one in formulas}
    size = np.abs(blocks.torque - fit.curve.value("torque_bias", fit.parameters))
    for knee, beyond in (("T1", "K2"), ("T2", "K3")):
        if knee in known and np.sum(size > (known[knee].value or 0.0)) < _KNEE_LEAST:
            why = f"the torque reaches {np.max(size):.3g} N m, hardly beyond the knee {knee}"
            known[beyond] = replace(known[beyond], value=None, std=None, ci95=None, identifiable=False, reason=why)
            known[knee] = replace(known[knee], identifiable=False, reason=why)
    if fit.curve.memory is not None:
        known["hysteresis_width"] = _width(fit, blocks, known["hysteresis_width"])
    return known


def _slopes(curve: Curve) -> Iterator[Figure]:
    """Stiffnesses and knees."""
    at = curve.places
    if curve.shape in ("linear", "cubic"):
        text = "stiffness" + (" at zero twist" if curve.shape == "cubic" else "")
        yield Figure("K", lambda p: math.exp(p[0]), "N m/rad", text, True)
    else:
        texts = (
            "stiffness up to T1",
            "stiffness from T1 on" + (" to T2" if "log K3" in at else ""),
            "stiffness beyond T2",
        )
        for i, text in enumerate(texts[: 3 if "log K3" in at else 2]):
            yield Figure(f"K{i + 1}", lambda p, i=i: math.exp(p[i]), "N m/rad", text, True)
        yield Figure("T1", lambda p: math.exp(p[at["log T1"]]), "N m", "torque at the first knee", True)
    if "log gap" in at:
        knees = [at["log T1"], at["log gap"]]
        yield Figure("T2", lambda p: float(np.sum(np.exp(p[knees]))), "N m", "torque at the second knee", True)
    if curve.shape == "cubic":
        yield Figure("alpha", lambda p: p[1], "rad^-2", "cubic coefficient, tau = K (x + alpha x^3)")


def _shifts(curve: Curve, blocks: Blocks) -> Iterator[Figure]:
    """Bias and drift."""
    if curve.biased:
        yield Figure("torque_bias", lambda p: curve.value("torque_bias", p), "N m", "torque at the centre of the curve")
    for i, log in enumerate(blocks.names if curve.drifting else ()):
        name = "drift" if curve.logs == 1 else f"drift.{log}"
        yield Figure(name, lambda p, i=i: curve.value(f"drift {i}", p), "rad/s", f"drift of the twist in {log}")


def _loop(curve: Curve, blocks: Blocks, rated_torque: float | None) -> Iterator[Figure]:
    """What the loop is like, and what vendors define by the rated torque."""
    size, looped = blocks.amplitude, curve.memory is not None
    if looped:
        text = "friction torque behind the loop, half of its width along the torque"
        yield Figure("hysteresis_torque", lambda p: curve.value("friction", p), "N m", text)
        text = f"width of the loop at zero torque, for torque cycles of +-{size:.3g} N m"
        yield Figure("hysteresis_width", lambda p: _open(curve, p, size), "rad", text)
    small = LOST_MOTION_SHARE * (rated_torque or math.inf)
    if small <= size:
        text = f"twist between -{small:.3g} and +{small:.3g} N m (4 % of rated torque)"
        name, middle = "lost_motion", f"{text}, middle of the loop"
        yield Figure(name, lambda p: _between(curve, p, size, small)[0], "rad", middle, True)
        if looped:
            name, outer = "lost_motion_outer", f"{text}, outer branches of the loop"
            yield Figure(name, lambda p: _between(curve, p, size, small)[1], "rad", outer, True)
    if looped and rated_torque and size >= 0.9 * rated_torque:
        text = "width of the loop at zero torque, for cycles of rated torque"
        yield Figure("hysteresis_loss", lambda p: _open(curve, p, rated_torque), "rad", text)


def _open(curve: Curve, parameters: np.ndarray, amplitude: float) -> float:
    """Width of the closed loop at zero torque [rad]."""
    torque, rising, falling = loop(curve, parameters, amplitude)
    middle = len(torque) // 2
    return float(falling[middle] - rising[middle])


def _between(curve: Curve, parameters: np.ndarray, amplitude: float, torque: float) -> tuple[float, float]:
    """Twist from -torque to +torque [rad], along the middle of the loop and between its outer branches."""
    at, rising, falling = loop(curve, parameters, amplitude)
    up, down = (np.interp([-torque, torque], at, branch) for branch in (rising, falling))
    return float(np.diff(0.5 * (up + down))[0]), float(down[1] - up[0])


def _width(fit: CurveFit, blocks: Blocks, local: Known) -> Known:
    """The width with an interval that holds for every law and reach of the memory that the logs do not rule out.

    Without hysteresis the reach means nothing and the search has picked the one that fits noise best; the interval
    around that one alone would miss zero too often (Davies 1987).
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
    reason = "" if identifiable else f"it could be told from zero only above {max(-low, high):.2g} rad"
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
