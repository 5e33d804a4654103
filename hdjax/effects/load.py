"""Torques on the load that the log does not contain."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import Effect, LoadSideEffect, Motion, Scales
from hdjax.parameters import Scalar, parameter


class GravityLoad(LoadSideEffect):
    """An unbalanced mass on the output: `-(m g r) sin(theta_l + phi)`, kept as sine and cosine parts."""

    family: ClassVar[str] = "gravity_load"
    name: ClassVar[str] = "gravity_load"

    sine: Scalar = parameter(0.0, unit="N m", doc="m g r cos(phi)", source="EFFECTS", role="strength")
    cosine: Scalar = parameter(0.0, unit="N m", doc="m g r sin(phi)", source="EFFECTS", role="strength")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return (cls(),)

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        assert motion.theta_l is not None
        return -self.sine * jnp.sin(motion.theta_l) - self.cosine * jnp.cos(motion.theta_l)

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return {
            "m_g_r": (jnp.hypot(self.sine, self.cosine), "N m"),
            "phi": (jnp.arctan2(self.cosine, self.sine), "rad"),
        }
