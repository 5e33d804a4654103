"""Backlash: a dead zone in the mesh."""

import math
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive, restoring
from hdjax.effects.effect import Effect, MeshTorqueEffect, Motion, Scales
from hdjax.parameters import Scalar, parameter

# Share of the half-width over which damping sets in beyond the edge; and what makes the share one without a zone.
_ONSET, _NOTHING = 0.02, 1e-30
# Implausible alpha x^2 at the largest twist, where the spring is four times as stiff as in the middle: vendors' tables
# give 1.2 to 1.6 times.
_HARDEST = 1.0


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
    def imitated(cls, drive: Drive | ReducedDrive, scales: Scales) -> tuple[tuple[dict[str, Array], Effect], ...]:
        """The dead zone beyond which a linear spring has the torque and slope of a strongly hardening one."""
        if not float(drive.alpha) * scales.x_max**2 > _HARDEST:
            return ()
        found = []
        for x in (math.sqrt(2.0) * scales.x, scales.x_max):
            hardening = 1.0 + 3.0 * drive.alpha * x**2
            stiff = (
                {"K": drive.K * hardening} if isinstance(drive, Drive) else {"omega_0": drive.omega_0 * hardening**0.5}
            )
            width = x - restoring(jnp.asarray(x), drive.alpha) / hardening
            found.append((stiff | {"alpha": jnp.zeros_like(drive.alpha)}, cls(b=width)))
        return tuple(found)

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        x = motion.x
        # Not `x - clip(x, -b, b)`: where b is zero, that has no derivative by b on either side of the middle.
        engaged = jnp.sign(x) * jnp.maximum(jnp.abs(x) - self.b, 0.0)
        return drive.stiffness * (restoring(engaged, drive.alpha) - restoring(x, drive.alpha))


class UndampedBacklash(Backlash):
    """The same dead zone, within which the mesh does not damp either.

    Damping sets in over a fiftieth of the zone's half-width beyond its edge, so that it has a derivative.
    """

    name: ClassVar[str] = "undamped_backlash"

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        beyond = jnp.maximum(jnp.abs(motion.x) - self.b, 0.0)
        part = jnp.minimum((beyond + _NOTHING) / (_ONSET * self.b + _NOTHING), 1.0)
        engaged = part * part * (3.0 - 2.0 * part)
        damping = drive.mesh_torque(jnp.zeros_like(motion.x), motion.v)
        return super().torque(motion, drive, state) - (1.0 - engaged) * damping
