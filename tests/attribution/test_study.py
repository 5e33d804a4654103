"""Effects that a model may lack although screening does not show them."""

from typing import Any

import pytest

from fitting.attribution.study import Setting, Study
from fitting.estimation.problem import Segmentation
from hdjax import Drive, LoadDrivenModel, MotorDrivenModel, TwoInertiaModel
from hdjax.effects import (
    Effect,
    GravityLoad,
    LoadEncoderDelay,
    LoadInertiaError,
    MotorFriction,
    ViscousLoadFriction,
    ViscousMotorFriction,
)

DRIVE = Drive(N=50.0, J_m=4e-5, J_l=0.2, K=300.0)


class _Side:
    """Of a fit, only its model counts."""

    def __init__(self, model: Any) -> None:
        self.model = model


@pytest.mark.parametrize(
    ("side", "friction", "own"),
    [
        (MotorDrivenModel, ViscousMotorFriction(), ViscousLoadFriction()),
        (LoadDrivenModel, ViscousLoadFriction(), ViscousMotorFriction()),
    ],
)
def test_equation_that_leaves_only_noise_leaves_friction_of_the_other_side(side: type, friction: Effect, own: Effect):
    fit: Any = _Side(side(DRIVE))
    study, model = Study({}, Setting(Segmentation(64)), side=fit), TwoInertiaModel(DRIVE)
    assert study.suspects(friction, model)
    assert not study.suspects(own, model) and not study.suspects(GravityLoad(), model)
    assert study.suspects(LoadEncoderDelay(), model)
    assert study.suspects(LoadInertiaError(), model) is (side is MotorDrivenModel)
    # One law of a family is enough, and beside a late encoder the equation says nothing.
    assert not study.suspects(friction, model.with_effects(type(friction)(b=1.0)))
    assert not study.suspects(friction, model.with_effects(LoadEncoderDelay(delay=1e-4)))
    assert not Study({}, Setting(Segmentation(64))).suspects(friction, model)
    if side is MotorDrivenModel:
        assert study.suspects(MotorFriction(transition=0.1), model)
