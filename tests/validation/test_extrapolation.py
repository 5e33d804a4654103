"""Detection of test data with larger twist, speed or torque than the fitted data."""

from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import joints
import rig
from fitting.estimation.experiment import Stretch, experiment_from_log, whole
from fitting.estimation.free_run import FreeRun
from fitting.estimation.reach import reach
from fitting.validation.account import Account
from fitting.validation.extrapolation import BEYOND, extrapolations
from hdjax import Drive, TwoInertiaModel

JOINT = joints.Joint(N=50.0, J_m=4e-5, J_l=0.2, K=300.0, B_sp=0.4, rms=0.05)
MODEL = TwoInertiaModel(Drive(N=JOINT.N, J_m=JOINT.J_m, J_l=JOINT.J_l, K=JOINT.K, B_sp=JOINT.B_sp))
SIZE = st.floats(1e-6, 1e6)


def run(twist: float, speed: float, torque: float, output: str = "dynamic_error") -> FreeRun:
    nothing = np.zeros(3)
    return FreeRun("log", nothing, nothing, nothing, output=output, reach=dict(twist=twist, speed=speed, torque=torque))


def beyond(fitted: Sequence[FreeRun], test: Sequence[FreeRun], selection: Sequence[FreeRun] = ()) -> dict[str, Any]:
    """Quantities in which test data exceed the fitted data, with both values."""
    account = SimpleNamespace(training=tuple(fitted), selection=tuple(selection), test=tuple(test))
    return {one.quantity: (one.fitted, one.test) for one in extrapolations(cast(Account, account))}


@given(SIZE, SIZE, SIZE, st.floats(0.0, 1.0 + 0.99 * BEYOND), st.floats(1.0 + 1.01 * BEYOND, 100.0))
def test_quantities_beyond_the_margin_are_reported_as_extrapolated(
    twist: float, speed: float, torque: float, little: float, much: float
):
    fitted = run(twist, speed, torque)
    assert beyond([fitted], [run(little * twist, little * speed, little * torque)]) == {}
    assert beyond([fitted], [run(twist, much * speed, torque)]) == {"speed": (speed, much * speed)}
    assert set(beyond([fitted], [run(much * twist, speed, torque), run(0.0, 0.0, much * torque)])) == {
        "twist",
        "torque",
    }


def test_selection_data_count_as_fitted():
    small, large = run(1.0, 1.0, 1.0), run(2.0, 2.0, 2.0)
    assert beyond([small], [large], [large]) == {} and beyond([small], []) == {}
    assert set(beyond([small], [large])) == {"twist", "speed", "torque"}


def test_unmeasured_twist_is_not_compared():
    fitted, test = (run(size, size, size, "motor_angle") for size in (1.0, 2.0))
    assert set(beyond([fitted], [test])) == {"speed", "torque"}


@pytest.fixture(scope="module")
def stretch() -> Stretch:
    log = joints.log_of(JOINT, count=3000)
    return whole([experiment_from_log(log, hold="zero-order", N=JOINT.N)])[0]


def test_reach_equals_the_largest_values_of_the_motion(stretch: Stretch):
    torque = joints.torque_of(JOINT, count=3000)
    motion = joints.motion_of(JOINT, torque)
    found = reach(stretch, MODEL)
    assert found["torque"] == np.max(np.abs(torque))
    # The encoders' noise is a thousandth of the twist; means over a tenth of a period are a few per cent smaller.
    assert found["twist"] == pytest.approx(np.max(np.abs(motion[:, 0] / JOINT.N - motion[:, 1])), rel=0.01)
    assert found["speed"] == pytest.approx(np.max(np.abs(motion[:, 2])), rel=0.05)


def test_reach_of_a_part_is_at_most_that_of_the_log(stretch: Stretch):
    whole_log, part = reach(stretch, MODEL), reach(Stretch(stretch.experiment, 0, 800), MODEL)
    assert all(part[quantity] <= whole_log[quantity] for quantity in whole_log)


def test_reach_of_a_reduced_log_uses_the_rate_of_the_dynamic_error():
    time = 1e-3 * np.arange(2000)
    x = 3.0 * np.sin(10.0 * time)
    log = rig.reduced_log(x, np.cos(time), noise=0.0, step=1e-3)
    found = reach(whole([experiment_from_log(log, hold="zero-order")])[0], rig.reduced_model(omega_0=40.0))
    assert found == pytest.approx({"twist": 3.0, "speed": 30.0, "torque": 1.0}, rel=0.01)
