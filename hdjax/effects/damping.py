"""Mesh damping that is not proportional to the twist rate."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import MeshTorqueEffect, Motion
from hdjax.parameters import Scalar, parameter


class QuadraticDamping(MeshTorqueEffect):
    """Torque `c2 v |v|`."""

    family: ClassVar[str] = "nonlinear_damping"
    name: ClassVar[str] = "quadratic_damping"
    drawn_against: ClassVar[str | None] = "v"

    c2: Scalar = parameter(0.0, unit="N m s^2/rad^2", doc="quadratic damping", source="EFFECTS", role="strength")

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return self.c2 * motion.v * jnp.abs(motion.v)


class CubicDamping(MeshTorqueEffect):
    """Torque `c3 v^3`."""

    family: ClassVar[str] = "nonlinear_damping"
    name: ClassVar[str] = "cubic_damping"
    drawn_against: ClassVar[str | None] = "v"

    c3: Scalar = parameter(0.0, unit="N m s^3/rad^3", doc="cubic damping", source="EFFECTS", role="strength")

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return self.c3 * motion.v**3


class DisplacementDamping(MeshTorqueEffect):
    """Torque `c_x x^2 v`: damping that grows with the twist."""

    family: ClassVar[str] = "nonlinear_damping"
    name: ClassVar[str] = "displacement_damping"
    drawn_against: ClassVar[str | None] = "v"

    c_x: Scalar = parameter(
        0.0,
        unit="N m s/rad^3",
        doc="displacement-dependent damping",
        source="EFFECTS",
        role="strength",
    )

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return self.c_x * motion.x**2 * motion.v
