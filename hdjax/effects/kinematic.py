"""Kinematic error: tooth and wave-generator errors locked to the motor angle."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import Effect, MeshGeometryEffect, Scales
from hdjax.parameters import Scalar, parameter

SOURCE = "Ghorbel, Gandhi, Alpeter 2001; vendors: 1.5e-4 to 5.8e-4 rad peak to peak"


class KinematicError(MeshGeometryEffect):
    """`e(theta_m) = sum over n = 1, 2, 4 of cos_n cos(n theta_m) + sin_n sin(n theta_m)`.

    Two cycles per motor revolution lead, since the wave generator has two lobes.
    """

    family: ClassVar[str] = "kinematic_error"
    name: ClassVar[str] = "kinematic_error"
    orders: ClassVar[tuple[int, ...]] = (1, 2, 4)

    cos_1: Scalar = parameter(0.0, unit="rad", doc="cosine, order 1", source=SOURCE, role="strength")
    sin_1: Scalar = parameter(0.0, unit="rad", doc="sine, order 1", source=SOURCE, role="strength")
    cos_2: Scalar = parameter(0.0, unit="rad", doc="cosine, order 2", source=SOURCE, role="strength")
    sin_2: Scalar = parameter(0.0, unit="rad", doc="sine, order 2", source=SOURCE, role="strength")
    cos_4: Scalar = parameter(0.0, unit="rad", doc="cosine, order 4", source=SOURCE, role="strength")
    sin_4: Scalar = parameter(0.0, unit="rad", doc="sine, order 4", source=SOURCE, role="strength")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return (cls(),)

    @property
    def _terms(self) -> tuple[tuple[int, Array, Array], ...]:
        return (
            (1, self.cos_1, self.sin_1),
            (2, self.cos_2, self.sin_2),
            (4, self.cos_4, self.sin_4),
        )

    def error(self, theta_m: Array) -> Array:
        return sum(
            (a * jnp.cos(n * theta_m) + b * jnp.sin(n * theta_m) for n, a, b in self._terms),
            start=jnp.zeros_like(theta_m),
        )

    def slope(self, theta_m: Array) -> Array:
        return sum(
            (n * (b * jnp.cos(n * theta_m) - a * jnp.sin(n * theta_m)) for n, a, b in self._terms),
            start=jnp.zeros_like(theta_m),
        )

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        amplitudes = {f"amplitude_{n}": (jnp.hypot(a, b), "rad") for n, a, b in self._terms}
        return amplitudes | {f"phase_{n}": (jnp.arctan2(-b, a), "rad") for n, a, b in self._terms}
