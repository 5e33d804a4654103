"""Test data at angles or temperatures that were not fitted."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import joints
from fitting.estimation.experiment import Stretch, experiment_from_log, whole
from fitting.estimation.free_run import FreeRun
from fitting.estimation.reach import Quantity, ranges
from fitting.report.summary import summary_of_extrapolation
from fitting.validation.account import Account
from fitting.validation.extrapolation import BEYOND, extrapolations
from hdjax import Drive, TwoInertiaModel, sampled
from hdjax.effects.cogging import Cogging
from hdjax.effects.friction import ViscousMotorFriction
from hdjax.effects.load import GravityLoad
from hdjax.effects.thermal import ThermalStiffness

JOINT = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, rms=0.05)
DRIVE = Drive(N=JOINT.N, J_m=JOINT.J_m, J_l=JOINT.J_l, K=JOINT.K, B_sp=JOINT.B_sp)
NOTHING = np.zeros(3)
SAME: dict[Quantity, float] = {"twist": 1.0, "speed": 1.0, "torque": 1.0}


def beyond(condition: Any, fitted: tuple[float, float], *test: tuple[float, float]) -> list[tuple[float, float]]:
    """What is told of a range, as pairs of fitted and test."""
    runs = [FreeRun("log", NOTHING, NOTHING, NOTHING, reach=SAME, ranges={condition: r}) for r in (fitted, *test)]
    account = SimpleNamespace(training=tuple(runs[:1]), selection=(), test=tuple(runs[1:]))
    return [(one.fitted, one.test) for one in extrapolations(cast(Account, account)) if one.quantity == condition]


@given(st.floats(280.0, 300.0), st.floats(1.0, 30.0), st.floats(0.0, 0.99 * BEYOND), st.floats(1.01 * BEYOND, 3.0))
def test_a_temperature_outside_the_fitted_range_is_told_at_its_end(low: float, span: float, little: float, much: float):
    high = low + span
    assert beyond("temperature", (low, high), (low - little * span, high + little * span)) == []
    assert beyond("temperature", (low, high), (low, high + much * span)) == [(high, high + much * span)]
    colder, warmer = low - much * span, high + much * span
    assert beyond("temperature", (low, high), (colder, low), (high, warmer)) == [(low, colder), (high, warmer)]


@given(st.integers(-3, 3))
def test_an_angle_repeats_after_a_revolution(turns: int):
    away = 2.0 * np.pi * turns
    assert beyond("output angle", (0.0, 1.0), (away, away + 1.0)) == []
    assert beyond("output angle", (0.0, 1.0), (away, away + 1.5)) == [(1.0, pytest.approx(1.5))]
    assert beyond("motor angle", (0.0, 6.3), (away, away + 20.0)) == []


def test_only_what_matters_to_the_model_has_a_range():
    log = joints.log_of(JOINT, count=1000)
    experiment = experiment_from_log(log, hold="zero-order", N=JOINT.N)
    warm = sampled(experiment.time, 300.0 + experiment.time, hold="linear")
    (plain,) = whole([experiment])
    warmed = Stretch(replace(experiment, temperature=warm), 0, 500)
    motor, load = log.motor_angle, log.load_angle
    assert motor is not None and load is not None
    effects = (Cogging(), GravityLoad(), ViscousMotorFriction(), ThermalStiffness())
    found = ranges(warmed, TwoInertiaModel(DRIVE, effects))
    # The twist is negligible.
    span = pytest.approx((motor[:500].min() / JOINT.N, motor[:500].max() / JOINT.N), abs=np.ptp(motor / JOINT.N - load))
    assert found["output angle"] == span and found["motor angle"] == pytest.approx(
        (motor[:500].min(), motor[:500].max())
    )
    assert found["temperature"] == pytest.approx((300.0, 300.0 + experiment.time[499]))
    assert set(ranges(plain, TwoInertiaModel(DRIVE, effects))) == {"output angle", "motor angle"}
    assert ranges(warmed, TwoInertiaModel(DRIVE, (ViscousMotorFriction(),))) == {}


def test_the_summary_says_to_which_end():
    one = {"quantity": "temperature", "unit": "K", "fitted": 293.6, "test": 293.1}
    assert "temperature down to 293.1 K (fitted down to 293.6 K)" in summary_of_extrapolation([one])
