"""Creep: relaxation of a part of the stiffness."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import Effect, MeshTorqueEffect, Motion, Scales
from hdjax.parameters import Scalar, parameter


class Creep(MeshTorqueEffect):
    """Torque `k (x - z)` with `tau z' = x - z`: the standard linear solid.

    K is the stiffness after a long time, `K + k` that at once. After a step of the torque the twist goes its last `k /
    (K + k)` with the time constant `tau (1 + k / K)`. With k as a share of K, the well-determined sum K + k would be a
    curved valley, which a fit follows in small steps.
    """

    family: ClassVar[str] = "creep"
    name: ClassVar[str] = "creep"
    states: ClassVar[tuple[str, ...]] = ("z",)
    drawn_against: ClassVar[str | None] = None

    k: Scalar = parameter(
        0.0,
        unit="N m/rad",
        doc="stiffness that relaxes",
        source="EFFECTS: percent of the twist",
        bounds=(0.0, 1e12),
        role="strength",
    )
    tau: Scalar = parameter(
        unit="s", doc="relaxation time", source="EFFECTS: minutes to hours", bounds=(0.0, 1e7), role="shape"
    )
    span: Scalar = parameter(unit="rad", doc="twist from which z may start away", bounds=(0.0, 1e9))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        # Faster than a few periods it would be damping, slower than a few logs a stiffness.
        slowest, fastest = 3.0 * scales.duration, 10.0 / scales.natural_frequency
        times = [slowest / 3.0**k for k in range(12)]
        return tuple(cls(tau=t, span=scales.x) for k, t in enumerate(times) if k == 0 or t > fastest)

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return self.k * (motion.x - state[0])

    def initial_state(self, motion: Motion | None = None) -> Float[Array, "1"]:
        return (jnp.zeros_like(self.tau) if motion is None else motion.x)[None]

    def state_rates(self, motion: Motion, state: Array) -> Float[Array, "1"]:
        return ((motion.x - state[0]) / self.tau)[None]

    def state_scale(self) -> Float[Array, "1"]:
        return self.span[None]

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return {"share": (self.k / drive.stiffness, "1")}
