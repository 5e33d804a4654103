"""Inertias that differ from the stated ones."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import LoadSideEffect, Motion, MotorSideEffect, ShaftEffect
from hdjax.parameters import Scalar, parameter


class _InertiaError(ShaftEffect):
    family: ClassVar[str] = "inertia_error"
    drawn_against: ClassVar[str | None] = None

    error: Scalar = parameter(
        0.0,
        unit="1",
        doc="relative error of the stated inertia",
        bounds=(-1.0, 10.0),
        plausible=(0.0, 0.5),
        role="strength",
    )

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return jnp.zeros_like(drive.J_l)

    def inertia_taken(self, drive: Drive) -> Array:
        return -self.error * self._stated(drive)

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return {"inertia": ((1.0 + self.error) * self._stated(drive), "kg m^2")}

    def _stated(self, drive: Drive | ReducedDrive) -> Array:
        assert self.corrects is not None
        return getattr(drive, self.corrects)


class MotorInertiaError(_InertiaError, MotorSideEffect):
    """The motor's inertia is `(1 + error) J_m`, where J_m is the stated one."""

    name: ClassVar[str] = "motor_inertia_error"
    corrects: ClassVar[str | None] = "J_m"


class LoadInertiaError(_InertiaError, LoadSideEffect):
    """The load's inertia is `(1 + error) J_l`, where J_l is the stated one."""

    name: ClassVar[str] = "load_inertia_error"
    corrects: ClassVar[str | None] = "J_l"
