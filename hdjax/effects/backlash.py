"""Backlash: a dead zone in the mesh."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive, restoring
from hdjax.effects.effect import Effect, MeshTorqueEffect, Motion, Scales
from hdjax.parameters import Scalar, parameter


class Backlash(MeshTorqueEffect):
    """The spring acts on `x - clip(x, -b, b)`: no stiffness within +-b of the middle."""

    family: ClassVar[str] = "backlash"
    name: ClassVar[str] = "backlash"

    b: Scalar = parameter(
        0.0,
        unit="rad",
        doc="half-width of the dead zone at the output",
        source="vendor catalogues: 6 to 60 arcsec",
        bounds=(0.0, 0.1),
        plausible=(2.9e-5, 2.9e-4),
        role="strength",
    )

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return (cls(),)

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        x = motion.x
        engaged = x - jnp.clip(x, -self.b, self.b)
        return drive.stiffness * (restoring(engaged, drive.alpha) - restoring(x, drive.alpha))
