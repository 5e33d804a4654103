"""Logs as the baselines read them: the same files, columns and torque that the loop gets."""

import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.signal import savgol_filter

from undeclared.drawing import LOGS


@dataclass(frozen=True)
class Table:
    """One log.

    Attributes:
        columns: by name, as recorded.
        ratio: N.
        motor_inertia: J_m [kg m^2].
        load_inertia: J_l [kg m^2].
        dt: sampling interval [s].
    """

    columns: dict[str, np.ndarray]
    ratio: float
    motor_inertia: float
    load_inertia: float
    dt: float

    @property
    def x(self) -> np.ndarray:
        """Measured dynamic error [rad]."""
        return self.columns["motor_angle"] / self.ratio - self.columns["load_angle"]

    @property
    def forcing(self) -> np.ndarray:
        """F of x'' + mu x' + ... = F [rad/s^2]."""
        brake = self.columns.get("load_torque", np.zeros_like(self.x))
        return self.columns["motor_torque"] / (self.ratio * self.motor_inertia) - brake / self.load_inertia


def read_tables(folder: Path) -> list[Table]:
    """The three logs of a folder, in the order of LOGS."""
    drive = tomllib.loads((folder / "drive.toml").read_text(encoding="utf-8"))["drive"]
    found = []
    for name in LOGS:
        data = np.genfromtxt(folder / f"{name}.csv", delimiter=",", names=True)
        assert data.dtype.names is not None
        columns = {column: data[column] for column in data.dtype.names}
        dt = float(columns["time"][1] - columns["time"][0])
        found.append(Table(columns, drive["reduction_ratio"], drive["motor_inertia"], drive["load_inertia"], dt))
    return found


def rate(signal: np.ndarray, dt: float, span: float) -> np.ndarray:
    """Smoothed derivative of a signal over windows of a length in time."""
    window = max(5, 2 * int(span / dt / 2) + 1)
    return savgol_filter(signal, window, 3, deriv=1, delta=dt)
