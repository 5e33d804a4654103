"""Logs without faults and a drive file for the tests of checks."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from fitting.logs.drive_file import ColumnMap, DriveFile
from fitting.logs.findings import Finding
from fitting.logs.log import Log

N = 50.0


ROWS = 4000


STEP = 5e-4


def drive_file(ratio: float | None = N, columns: dict[str, ColumnMap] | None = None) -> DriveFile:
    return DriveFile(Path("drive.toml"), "rig", ratio, 5e-4, 5e-2, "zero-order", None, columns or {})


def drive_log(swing: float = 0.3) -> Log:
    """Log of a free drive: a slow swing [rad] common to both sides, and a twist of 0.3 mrad."""
    rng = np.random.default_rng(5)
    time = np.arange(ROWS) * STEP
    twist = 3e-4 * np.sin(2 * np.pi * 40 * time + 0.3) + 1e-6 * rng.normal(size=ROWS)
    load = swing * np.sin(2 * np.pi * 0.8 * time) + swing * 0.2 * time
    load += 1e-7 * rng.normal(size=ROWS)
    return Log(
        name="log",
        path=Path("log.csv"),
        kind="drive",
        time=time,
        motor_angle=N * (load + twist),
        load_angle=load,
        motor_torque=rng.normal(size=ROWS),
        load_torque=None,
        temperature=None,
        dynamic_error=twist,
        forcing=None,
        units={"dynamic_error": "rad"},
    )


def reduced_log() -> Log:
    rng = np.random.default_rng(6)
    time = np.arange(ROWS) * STEP
    return replace(
        drive_log(),
        kind="reduced",
        motor_angle=None,
        load_angle=None,
        motor_torque=None,
        dynamic_error=np.sin(90 * time) + 1e-3 * rng.normal(size=ROWS),
        forcing=rng.normal(size=ROWS),
        units={"dynamic_error": "V", "forcing": "V"},
    )


def angles(log: Log) -> tuple[np.ndarray, np.ndarray]:
    assert log.motor_angle is not None and log.load_angle is not None
    return log.motor_angle, log.load_angle


def only_finding(findings: tuple[Finding, ...], severity: str, *words: str) -> Finding:
    assert len(findings) == 1, [str(finding) for finding in findings]
    assert findings[0].severity == severity
    for word in words:
        assert word in str(findings[0])
    return findings[0]
