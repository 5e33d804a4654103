"""Hysteresis with memory: Bouc-Wen."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import Effect, MeshTorqueEffect, Motion, Scales
from hdjax.parameters import Scalar, parameter

SOURCE = "Dhaouadi, Ghorbel, Gandhi 2003; Ruderman"


class BoucWen(MeshTorqueEffect):
    """Torque `k z` with `z' = v - beta |v| |z|^(n-1) z - gamma v |z|^n`.

    Kept in the terms that a log determines well: `beta = share / yield_twist^n` and
    `gamma = (1 - share) / yield_twist^n`, so that |z| saturates at the yield twist whatever n and share are. It
    dissipates for share >= 1/2.
    """

    family: ClassVar[str] = "hysteresis"
    name: ClassVar[str] = "bouc_wen"
    states: ClassVar[tuple[str, ...]] = ("z",)

    k: Scalar = parameter(0.0, unit="N m/rad", doc="stiffness of the hysteretic part", source=SOURCE, role="strength")
    yield_twist: Scalar = parameter(unit="rad", doc="where z saturates", source=SOURCE, bounds=(0.0, 0.1), role="shape")
    share: Scalar = parameter(
        0.6, unit="1", doc="beta / (beta + gamma)", source=SOURCE, bounds=(0.0, 1e2), role="shape"
    )
    n: Scalar = parameter(1.0, unit="1", doc="sharpness of the yield", source=SOURCE, bounds=(0.0, 1e2))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(yield_twist=fraction * scales.x) for fraction in (0.3, 1.0))

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return self.k * state[0]

    def initial_state(self) -> Float[Array, "1"]:
        return jnp.zeros_like(self.k)[None]

    def state_rates(self, motion: Motion, state: Array) -> Float[Array, "1"]:
        z = state[0] / self.yield_twist
        # |z|^(n-1) has no derivative at 0 where n = 1; the offset is far below any z that matters.
        power = (z * z + 1e-30) ** (0.5 * (self.n - 1.0))
        bent = self.share * jnp.abs(motion.v) * z + (1.0 - self.share) * motion.v * jnp.abs(z)
        return (motion.v - power * bent)[None]

    def state_scale(self) -> Float[Array, "1"]:
        return self.yield_twist[None]

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        total = self.yield_twist**-self.n
        return {
            "beta": (self.share * total, "rad^-n"),
            "gamma": ((1.0 - self.share) * total, "rad^-n"),
        }
