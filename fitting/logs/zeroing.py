"""Zero of the twist, in a log whose two sensors were not zeroed together."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal

import numpy as np

from fitting.logs.drive_file import DriveFile
from fitting.logs.findings import Finding
from fitting.logs.log import Log

_Severity = Literal["note", "warning"]

LARGEST_TWIST = 0.02  # rad, more than any gear's twist, assumed
_OFFSET = 3.0  # standard deviations, assumed
_NO_MEAN = 0.1  # standard deviations of an input, assumed
_WIDTHS = (16, 32, 64, 128, 256)
_EVEN = 0.2
_FEWEST = 25

_OWN_ZERO = Finding(
    "note",
    "the zero of the dynamic error is not known from other logs",
    "dynamic_error",
    "the free run refines it together with its initial state",
)


def zeroed(log: Log, drive_file: DriveFile, *, zeros: Sequence[float] = ()) -> Log:
    """The log with its dynamic error relative to the relaxed spring.

    A mean twist needs a mean torque, and no gear twists by more than a degree. An offset that neither explains is due
    to the sensors, and is subtracted. A smaller one may be a load's as well, and is kept.

    Where only the first outputs are known, they tell little of the zero without a model. If the other logs do not tell
    it either, because they differ or theirs does not suit, the log has a zero of its own, which a free run estimates.

    Args:
        log: as read and masked.
        drive_file: for the load's inertia.
        zeros: those of other logs of the drive; the first one that explains the offset is taken.

    Returns:
        The log with its `zero`, and a finding if it was shifted.
    """
    if log.dynamic_error is None:
        return log
    found = _zeroed(log, drive_file, zeros)
    others = {*zeros} or {0.0}
    if log.outputs_until is None or others == {found.zero}:
        return found
    return replace(found, has_own_zero=True, findings=(*found.findings, _OWN_ZERO))


def _zeroed(log: Log, drive_file: DriveFile, zeros: Sequence[float]) -> Log:
    likely = [zero for zero in (*zeros, 0.0) if _objection(log, zero, drive_file) is None]
    if likely:
        return _shifted(log, likely[0], "note", ", as from another log") if likely[0] else log
    relaxed = _relaxed(log, drive_file.load_inertia)
    if _objection(log, 0.0, drive_file) == "note":
        return _shifted(log, relaxed, "note", "")
    aside = "; a constant load has the same effect, so that alpha may be that around this point"
    return _shifted(log, relaxed, "warning", aside)


def counted_from(log: Log, zero: float) -> Log:
    """The log with its dynamic error, if any, relative to a zero."""
    return log if log.dynamic_error is None else replace(log, dynamic_error=log.dynamic_error - zero, zero=zero)


def _objection(log: Log, zero: float, drive_file: DriveFile) -> _Severity | None:
    """Why a value is not the zero of the dynamic error: "note" where nothing explains the mean from there, "warning"
    where only a constant load does; None where it may be."""
    with np.errstate(all="ignore"):
        middle, spread = _middle_and_spread(log)
        off = abs(middle - zero)
        balanced = abs(float(np.mean(log.input))) < _NO_MEAN * float(np.std(log.input)) and log.load_torque is None
        if balanced and off > _OFFSET * spread > 0 and log.outputs_until is None:
            return "note"
        impossible = log.kind == "drive" and off > max(drive_file.largest_twist or LARGEST_TWIST, _OFFSET * spread)
        return "warning" if impossible else None


def _shifted(log: Log, zero: float, severity: _Severity, aside: str) -> Log:
    """The log relative to a zero, with a finding."""
    middle, spread = _middle_and_spread(log)
    unit = log.units["dynamic_error"]
    finding = Finding(
        severity,
        f"the dynamic error is {middle:.4g} {unit} off zero on average and varies by {spread:.3g} {unit} rms",
        "dynamic_error",
        f"the sensors were not zeroed together, so that {zero:.7g} {unit} was subtracted{aside}",
    )
    return replace(counted_from(log, zero), findings=(*log.findings, finding))


def _middle_and_spread(log: Log) -> tuple[float, float]:
    """Median and standard deviation of the dynamic error, where it is known."""
    known = slice(log.outputs_until) if log.trusted is None else log.trusted[: log.outputs_until]
    x = log.twist[: log.outputs_until][known]
    return float(np.median(x)), float(np.std(x))


@np.errstate(all="ignore")
def _relaxed(log: Log, load_inertia: float | None) -> float:
    """The twist at which the spring's torque vanishes: the root of a cubic that is fitted with the equation of motion.

    Weak form as for the starting values: the load's equation J_l theta_l'' = p(x) + B x', or that of the reduced drive
    with b u on its right, multiplied by test functions and integrated by parts.
    """
    middle, _ = _middle_and_spread(log)
    best, root = np.inf, middle
    x = log.twist - middle
    for width in _WIDTHS:
        windows = _windows(log, width)
        if len(windows) < _FEWEST:
            continue
        # Few windows do not separate a cubic from a line.
        powers = 4 if log.outputs_until is None else 2
        s = (np.arange(width) + 0.5) / width * 2 - 1
        half = 0.5 * width * float(np.median(np.diff(log.time)))
        bump, slope = (1 - s**2) ** 4, -8 * s * (1 - s**2) ** 3 / half
        curvature = 8 * (1 - s**2) ** 2 * (7 * s**2 - 1) / half**2

        def against(signal: np.ndarray, shape: np.ndarray, windows: np.ndarray = windows, width: int = width):
            return np.lib.stride_tricks.sliding_window_view(signal, width)[windows] @ shape

        spring = [against(x**k, bump) for k in range(powers)]
        if log.kind == "drive":
            assert log.motor_angle is not None and log.load_angle is not None
            rows = [*spring, -against(x, slope)]
            right = (load_inertia or 1.0) * against(log.load_angle - log.load_angle[0], curvature)
        else:
            rows = [*spring, -against(x, slope), -against(log.input, bump)]
            right = -against(x, curvature)
        matrix = np.stack(rows, axis=1)
        norm = np.linalg.norm(matrix, axis=0)
        norm[norm == 0] = 1.0
        if not (np.isfinite(matrix).all() and np.isfinite(right).all()):
            continue
        found = np.linalg.lstsq(matrix / norm, right, rcond=1e-9)[0]
        missed = float(np.linalg.norm(matrix / norm @ found - right) / np.linalg.norm(right))
        found = found / norm
        relaxed = _root(found[:powers], float(np.ptp(x[: log.outputs_until])))
        if missed < best and found[1] > 0 and relaxed is not None:
            best, root = missed, middle + relaxed
    return root if best < 0.5 else middle


def _windows(log: Log, width: int) -> np.ndarray:
    """First rows of windows, overlapping by three quarters, with even sampling and valid outputs."""
    step = np.diff(log.time)
    good = np.concatenate((np.abs(step / np.median(step) - 1) < _EVEN, [True]))[: log.outputs_until]
    if log.trusted is not None:
        good &= log.trusted[: log.outputs_until]
    bad = np.concatenate(([0], np.cumsum(~good)))
    first = np.arange(0, len(good) - width + 1, max(1, min(width // 4, len(good) // 50)))
    return first[bad[first + width] == bad[first]]


def _root(cubic: np.ndarray, span: float) -> float | None:
    """The real root closest to zero, if within the motion."""
    if not np.isfinite(cubic).all():
        return None
    roots = np.roots(cubic[::-1])
    real = roots.real[np.abs(roots.imag) <= 1e-9 * np.abs(roots)]
    return float(real[np.argmin(np.abs(real))]) if len(real) and np.min(np.abs(real)) < span else None
