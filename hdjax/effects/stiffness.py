"""Stiffness shapes beyond the cubic: quadratic, quintic, three slopes, one smooth knee."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import Effect, MeshTorqueEffect, Motion, Scales
from hdjax.parameters import Scalar, parameter


class QuadraticStiffness(MeshTorqueEffect):
    """Torque `K k2 x^2`: the mesh is stiffer one way than the other."""

    family: ClassVar[str] = "stiffness_shape"
    name: ClassVar[str] = "quadratic_stiffness"

    k2: Scalar = parameter(0.0, unit="1/rad", doc="quadratic stiffness over K", source="EFFECTS", role="strength")

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return drive.stiffness * self.k2 * motion.x**2


class QuinticStiffness(MeshTorqueEffect):
    """Torque `K k5 x^5`: the next odd term after the cubic."""

    family: ClassVar[str] = "stiffness_shape"
    name: ClassVar[str] = "quintic_stiffness"

    k5: Scalar = parameter(0.0, unit="rad^-4", doc="quintic stiffness over K", source="EFFECTS", role="strength")

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return drive.stiffness * self.k5 * motion.x**5


class ThreeSlopeStiffness(MeshTorqueEffect):
    """The vendors' three straight slopes K1, K2, K3 with knees at the twists `x1` and `x1 + gap`.

    Adds `K (stiffening_2 d(x, x1) + stiffening_3 d(x, x1 + gap))`, where `d(x, k) = x - clip(x, -k, k)`. K1 is the
    drive's K; the cubic remains free beside it, and is near zero if three slopes are the true law.
    """

    family: ClassVar[str] = "stiffness_shape"
    name: ClassVar[str] = "three_slope_stiffness"

    stiffening_2: Scalar = parameter(
        0.0,
        unit="1",
        doc="(K2 - K1)/K1",
        source="vendor catalogues: 0.2 to 0.6",
        plausible=(0.2, 0.6),
        role="strength",
    )
    stiffening_3: Scalar = parameter(0.0, unit="1", doc="(K3 - K2)/K1", source="vendor catalogues", role="strength")
    x1: Scalar = parameter(unit="rad", doc="twist at the first knee", bounds=(0.0, 0.1), role="shape")
    gap: Scalar = parameter(unit="rad", doc="from the first knee to the second", bounds=(0.0, 0.1), role="shape")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        fractions = ((0.25, 0.35), (0.5, 0.25), (0.12, 0.25), (0.35, 0.3))
        return tuple(cls(x1=a * scales.x_max, gap=b * scales.x_max) for a, b in fractions)

    @classmethod
    def typical(cls, scales: Scales) -> tuple[Effect, ...]:
        # Vendors: K2/K1 near 1.4, K3/K1 near 1.8, and T2 about 3.5 times T1.
        fractions = ((0.25, 0.35), (0.15, 0.3), (0.4, 0.3))
        return tuple(
            cls(stiffening_2=0.4, stiffening_3=0.4, x1=a * scales.x_max, gap=b * scales.x_max) for a, b in fractions
        )

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        beyond = _beyond(motion.x, self.x1) * self.stiffening_2
        beyond += _beyond(motion.x, self.x1 + self.gap) * self.stiffening_3
        return drive.stiffness * beyond

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        K1 = drive.stiffness
        K2 = K1 * (1 + self.stiffening_2)
        T1 = K1 * self.x1
        return {
            "K1": (K1, "N m/rad"),
            "K2": (K2, "N m/rad"),
            "K3": (K2 + K1 * self.stiffening_3, "N m/rad"),
            "T1": (T1, "N m"),
            "T2": (T1 + K2 * self.gap, "N m"),
        }


class SmoothKneeStiffness(MeshTorqueEffect):
    """One knee that is round: the slope goes from K to `K (1 + stiffening)` around the twist `knee`, within `width`.

    One parameter fewer than three slopes, and smooth. The torque is `stiffening K (h(x - knee) - h(-x - knee))` with
    the hyperbola `h(u) = (u + sqrt(u^2 + width^2)) / 2`, which rises to u.
    """

    family: ClassVar[str] = "stiffness_shape"
    name: ClassVar[str] = "smooth_knee_stiffness"

    stiffening: Scalar = parameter(
        0.0,
        unit="1",
        doc="relative rise of the slope",
        source="vendor catalogues: 0.2 to 0.6",
        plausible=(0.2, 0.6),
        role="strength",
    )
    knee: Scalar = parameter(unit="rad", doc="twist at the knee", bounds=(0.0, 0.1), role="shape")
    width: Scalar = parameter(unit="rad", doc="half-width of the knee", bounds=(0.0, 0.1), role="shape")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(knee=f * scales.x_max, width=0.1 * scales.x_max) for f in (0.25, 0.5, 0.75))

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        x = motion.x
        beyond = self._rise(x - self.knee) - self._rise(-x - self.knee)
        return drive.stiffness * self.stiffening * beyond

    def _rise(self, u: Array) -> Array:
        return 0.5 * (u + jnp.sqrt(u * u + self.width**2))

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return {"K2": (drive.stiffness * (1 + self.stiffening), "N m/rad")}


def _beyond(x: Array, knee: Array) -> Array:
    """Signed distance of `x` beyond the knee; zero inside."""
    return x - jnp.clip(x, -knee, knee)
