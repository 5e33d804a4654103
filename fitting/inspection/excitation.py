"""Excitation of a log: ranges of signals, band of the torque, and band of coherent response."""

from dataclasses import dataclass

import numpy as np
import scipy.signal

from fitting.inspection.inspection import Inspection
from fitting.inspection.resonances import COHERENT, Resonances, resonances
from fitting.logs.channels import SI

_POWER = (0.05, 0.95)  # shares of a torque's power that limit its band
_SEGMENTS = 16
# How many times a side that turns freely integrates the torque: what drifts would hide what follows.
_ORDER = {"motor_angle": 2, "load_angle": 2, "motor_velocity": 1}
_FEWEST = 256


@dataclass(frozen=True)
class Excitation:
    """Excitation and response of one log.

    Attributes:
        ranges: Lowest and highest value of each signal, and its unit, by name.
        driver: The torque or forcing, or None.
        response: The responding signal, or None.
        band: Hz, limits of 90 % of the driver's power, or None.
        coherent: Hz, the widest band of coherent response, or None.
        twist: Range of the twist from both angles [rad], or None.
        shows: What the response of the motor to its torque shows; None without a motor-side signal.
    """

    ranges: dict[str, tuple[float, float, str]]
    driver: str | None
    response: str | None
    band: tuple[float, float] | None
    coherent: tuple[float, float] | None
    twist: float | None
    shows: Resonances | None = None


def excitation(inspection: Inspection, log: int = 0) -> Excitation:
    """Excitation and response of a log.

    Args:
        inspection: The guesses.
        log: Number of the log.
    """
    signals = inspection.joint.signals
    ranges = {name: _range(inspection, name, log) for name in signals if len(inspection.samples(name, log)[1])}
    driver = next((s for s in ("motor_torque", "motor_current", "forcing", "joint_torque") if s in signals), None)
    twist = _twist(inspection, log)
    names = ("dynamic_error", "twist", "load_angle", "motor_angle", "motor_velocity")
    response = "both angles" if twist is not None else next((s for s in names if s in signals), None)
    rate = inspection.rates[log]
    band = coherent = shows = None
    if driver is not None and rate is not None:
        torque = _even(*inspection.samples(driver, log), rate)
        answer = twist if twist is not None or response is None else _even(*inspection.samples(response, log), rate)
        if len(torque) >= _FEWEST and np.ptp(torque) > 0:
            band = _band(torque, rate)
            if answer is not None and len(answer) >= _FEWEST and np.ptp(answer) > 0:
                coherent = _coherent(torque, np.diff(answer, n=_ORDER.get(response or "", 0)), rate, band)
            motor = next((s for s in ("motor_angle", "motor_velocity") if s in signals), None)
            if motor is not None and driver.startswith("motor"):
                turned = _even(*inspection.samples(motor, log), rate)
                shows = resonances(torque, np.diff(turned, n=_ORDER[motor]), rate)
    spread = None if twist is None else float(np.ptp(twist))
    return Excitation(ranges, driver, response, band, coherent, spread, shows)


def _range(inspection: Inspection, signal: str, log: int) -> tuple[float, float, str]:
    _, values = inspection.samples(signal, log)
    guess = inspection.joint.signals[signal]
    unit = SI.get(signal, "A" if signal == "motor_current" else "")
    if not guess.is_read:
        unit = guess.unit or "as logged"
    return float(values.min()), float(values.max()), unit


def _twist(inspection: Inspection, log: int) -> np.ndarray | None:
    """theta_m/N - theta_l [rad] without its mean, evenly sampled, if both angles and the ratio are known."""
    joint, rate = inspection.joint, inspection.rates[log]
    both = {"motor_angle", "load_angle"} <= set(joint.signals)
    if not both or rate is None or joint.ratio is None or not joint.ratio.sure:
        return None
    if not all(joint.signals[side].is_read for side in ("motor_angle", "load_angle")):
        return None
    motor, load = (_even(*inspection.samples(s, log), rate) for s in ("motor_angle", "load_angle"))
    count = min(len(motor), len(load))
    twist = motor[:count] / joint.ratio.value - load[:count]
    return twist - twist.mean()


def _even(time: np.ndarray, values: np.ndarray, rate: float) -> np.ndarray:
    """A channel on an even grid."""
    if len(time) < 2:
        return values
    count = min(int((time[-1] - time[0]) * rate) + 1, 4 * len(time))
    return np.interp(time[0] + np.arange(count) / rate, time, values)


def _band(values: np.ndarray, rate: float) -> tuple[float, float]:
    frequencies, power = scipy.signal.periodogram(values, rate, detrend="constant")
    share = np.cumsum(power) / np.sum(power)
    low, high = (float(frequencies[int(np.searchsorted(share, level))]) for level in _POWER)
    return low, high


def _coherent(
    driver: np.ndarray, response: np.ndarray, rate: float, band: tuple[float, float]
) -> tuple[float, float] | None:
    count = min(len(driver), len(response))
    length = count // _SEGMENTS * 2
    if length < 32:
        return None
    frequencies, share = scipy.signal.coherence(driver[:count], response[:count], rate, nperseg=length)
    driven = (frequencies >= band[0]) & (frequencies <= band[1])
    follows = np.concatenate(([False], (share >= COHERENT) & driven, [False]))
    edges = np.flatnonzero(np.diff(follows.astype(int)))
    starts, stops = edges[::2], edges[1::2]
    if len(starts) == 0:
        return None
    widest = int(np.argmax(stops - starts))
    return float(frequencies[starts[widest]]), float(frequencies[stops[widest] - 1])
