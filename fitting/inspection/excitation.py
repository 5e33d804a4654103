"""How a log moves its drive: ranges, the band of the torque, and where the response follows it."""

from dataclasses import dataclass

import numpy as np
import scipy.signal

from fitting.inspection.inspection import Inspection
from fitting.logs.channels import SI

COHERENT = 0.9
"""Coherence from which a response is said to follow its input; assumed."""

_POWER = (0.05, 0.95)  # of a torque, between these shares lies its band
_SEGMENTS = 16
_FEWEST = 256


@dataclass(frozen=True)
class Excitation:
    """How one log moves its drive.

    Attributes:
        ranges: Lowest and highest value of each signal, and its unit, by name.
        driver: The torque or forcing that was looked at, or None.
        response: What follows it, or None.
        band: Hz, between which 90 % of the driver's power lies, or None.
        coherent: Hz, the widest band in which the response follows the driver, or None.
        twist: Range of what both angles do not share [rad], or None.
    """

    ranges: dict[str, tuple[float, float, str]]
    driver: str | None
    response: str | None
    band: tuple[float, float] | None
    coherent: tuple[float, float] | None
    twist: float | None


def excitation(inspection: Inspection, log: int = 0) -> Excitation:
    """How a log moves its drive.

    Args:
        inspection: What was guessed.
        log: Number of the log.
    """
    signals = inspection.joint.signals
    ranges = {name: _range(inspection, name, log) for name in signals}
    driver = next((s for s in ("motor_torque", "motor_current", "forcing", "joint_torque") if s in signals), None)
    twist = _twist(inspection, log)
    names = ("dynamic_error", "twist", "load_angle", "motor_angle", "motor_velocity")
    response = "both angles" if twist is not None else next((s for s in names if s in signals), None)
    rate = inspection.rates[log]
    band = coherent = None
    if driver is not None and rate is not None:
        torque = _even(inspection, inspection.values(driver, log), log)
        answer = twist if twist is not None else None if response is None else inspection.values(response, log)
        if len(torque) >= _FEWEST and np.ptp(torque) > 0:
            band = _band(torque, rate)
            if answer is not None:
                coherent = _coherent(torque, _even(inspection, answer, log), rate)
    spread = None if twist is None else float(np.nanmax(twist) - np.nanmin(twist))
    return Excitation(ranges, driver, response, band, coherent, spread)


def _range(inspection: Inspection, signal: str, log: int) -> tuple[float, float, str]:
    values = inspection.values(signal, log)
    guess = inspection.joint.signals[signal]
    unit = SI.get(signal, "A" if signal == "motor_current" else "")
    if guess.unit is None and signal.endswith("_angle"):
        unit = "as logged"
    return float(np.nanmin(values)), float(np.nanmax(values)), unit


def _twist(inspection: Inspection, log: int) -> np.ndarray | None:
    """theta_m/N - theta_l [rad] where both angles and the ratio are known."""
    joint = inspection.joint
    both = {"motor_angle", "load_angle"} <= set(joint.signals)
    if not both or joint.ratio is None or not joint.ratio.sure:
        return None
    if joint.signals["load_angle"].unit is None or inspection.tables[log].columns[0].time is not None:
        return None
    twist = inspection.values("motor_angle", log) / joint.ratio.value - inspection.values("load_angle", log)
    return twist - np.nanmean(twist)


def _even(inspection: Inspection, values: np.ndarray, log: int) -> np.ndarray:
    """A channel on an even grid of the median step."""
    time = inspection.clocks[log].base.time
    if len(time) != len(values):
        return values[np.isfinite(values)]
    known = np.isfinite(values)
    step = float(np.median(np.diff(time)))
    count = min(int((time[-1] - time[0]) / step) + 1, 4 * len(time))
    return np.interp(time[0] + step * np.arange(count), time[known], values[known])


def _band(values: np.ndarray, rate: float) -> tuple[float, float]:
    frequencies, power = scipy.signal.periodogram(values, rate, detrend="constant")
    share = np.cumsum(power) / np.sum(power)
    low, high = (float(frequencies[int(np.searchsorted(share, level))]) for level in _POWER)
    return low, high


def _coherent(driver: np.ndarray, response: np.ndarray, rate: float) -> tuple[float, float] | None:
    count = min(len(driver), len(response))
    length = count // _SEGMENTS * 2
    if length < 32:
        return None
    frequencies, share = scipy.signal.coherence(driver[:count], response[:count], rate, nperseg=length)
    follows = np.concatenate(([False], share[1:] >= COHERENT, [False]))
    edges = np.flatnonzero(np.diff(follows.astype(int)))
    starts, stops = edges[::2], edges[1::2]
    if len(starts) == 0:
        return None
    widest = int(np.argmax(stops - starts))
    return float(frequencies[starts[widest] + 1]), float(frequencies[stops[widest]])
