"""Unwrapping of angles and overflowed integers; other signals are unchanged."""

from pathlib import Path

import numpy as np
import pytest

from fitting.logs.channels import channel
from fitting.logs.drive_file import drive_of
from fitting.logs.raw_table import RawColumn
from fitting.logs.unwrapping import unwrapped_angle, unwrapped_overflow

COUNT = 4000
TIME = np.arange(COUNT) * 5e-4
ANGLE = 15 * np.sin(3 * TIME) + 0.01 * np.random.default_rng(0).normal(size=COUNT)  # rad


def counts(bits: int) -> np.ndarray:
    return np.rint(ANGLE / (2 * np.pi) * 2.0**bits)


CASES = {
    "0 to 2 pi": (ANGLE, 2 * np.pi, 0.0, 2 * np.pi),
    "-pi to pi": (ANGLE, 2 * np.pi, -np.pi, 2 * np.pi),
    "degrees": (np.rad2deg(ANGLE), 360.0, 0.0, 360.0),
    "revolutions": (ANGLE / (2 * np.pi), 1.0, 0.0, 1.0),
    "single-turn counts": (counts(14), 2.0**14, 0.0, 2.0**14),
    "16 bits of a finer encoder": (counts(17), 2.0**16, 0.0, 2.0**17),
    "signed 16 bits": (counts(16), 2.0**16, -(2.0**15), 2.0**16),
}


@pytest.mark.parametrize(("running", "span", "low", "revolution"), CASES.values(), ids=CASES.keys())
def test_wrapped_angle_is_unwrapped(running: np.ndarray, span: float, low: float, revolution: float):
    wrapped = np.mod(running - low, span) + low
    found, told, rows = unwrapped_angle(wrapped, revolution)
    assert told == span
    np.testing.assert_allclose(np.diff(found), np.diff(running), atol=1e-12 * span)
    np.testing.assert_array_equal(rows, np.flatnonzero(np.abs(np.diff(wrapped)) > span / 2) + 1)


def test_wrapped_angle_with_blank_samples_is_unwrapped():
    wrapped = np.mod(ANGLE, 2 * np.pi)
    wrapped[::7] = np.nan
    found, _, rows = unwrapped_angle(wrapped, 2 * np.pi)
    known = np.isfinite(found)
    assert known.sum() == COUNT - len(wrapped[::7]) and len(rows)
    np.testing.assert_allclose(np.diff(found[known]), np.diff(ANGLE[known]), atol=1e-12)


@pytest.mark.parametrize("wrong", [0.0, 7.0, 100.0, -1.0])
def test_wrapped_angle_with_lone_wrong_samples_is_unwrapped(wrong: float):
    wrapped = np.mod(ANGLE, 2 * np.pi)
    rows = np.array([700, 1500, 2600])
    wrapped[rows] = wrong
    found, told, _ = unwrapped_angle(wrapped, 2 * np.pi)
    assert told == 2 * np.pi
    right = np.delete(np.arange(COUNT), rows)
    np.testing.assert_allclose(np.diff(found[right]), np.diff(ANGLE[right]), atol=1e-12)


@pytest.mark.parametrize(
    "values",
    [ANGLE, ANGLE / 20, np.random.default_rng(1).uniform(0, 2 * np.pi, COUNT), np.full(COUNT, np.nan), np.zeros(COUNT)],
    ids=["running", "small", "noise", "blank", "still"],
)
def test_angle_that_does_not_wrap_is_unchanged(values: np.ndarray):
    found, span, rows = unwrapped_angle(values, 2 * np.pi)
    np.testing.assert_array_equal(found, values)
    assert span == 0 and len(rows) == 0


TORQUE = 40 * np.sin(40 * TIME) + 0.1 * np.random.default_rng(2).normal(size=COUNT)


@pytest.mark.parametrize("unit", [1e-3, 1.0 / 1024])
def test_overflowed_torque_is_unwrapped(unit: float):
    whole = np.rint(TORQUE / unit)
    overflowed = np.mod(whole + 2**15, 2.0**16) - 2**15
    found, span, rows = unwrapped_overflow(overflowed * unit)
    assert span == pytest.approx(2**16 * unit, rel=1e-9) and len(rows)
    np.testing.assert_allclose(found, whole * unit, atol=1e-6)


@pytest.mark.parametrize(
    "values",
    [
        np.rint(TORQUE * 1e3),
        np.where(np.arange(COUNT) // 50 % 2, 3e4, -3e4),
        np.rint(1e4 * np.random.default_rng(3).normal(size=COUNT)),
        TORQUE,
    ],
    ids=["integers", "switched", "noise", "real numbers"],
)
def test_torque_that_does_not_overflow_is_unchanged(values: np.ndarray):
    found, span, _ = unwrapped_overflow(values)
    np.testing.assert_array_equal(found, values)
    assert span == 0


@pytest.mark.parametrize("signal", ["motor_torque", "load_torque", "joint_torque", "forcing"])
def test_integers_of_every_torque_are_unwrapped(signal: str):
    whole = np.rint(TORQUE * 1e3)
    overflowed = RawColumn(np.mod(whole + 2**15, 2.0**16) - 2**15)
    found = channel(Path("log.csv"), drive_of({}, Path("drive.toml")), signal, overflowed)
    np.testing.assert_array_equal(found.values, whole)
    assert [finding.severity for finding in found.findings] == ["warning"]
