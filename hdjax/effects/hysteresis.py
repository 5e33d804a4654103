"""Hysteresis with memory in the mesh: Bouc-Wen, Dahl, Maxwell slip."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.bristle import SETTLING, SETTLING_SHARE, bristle_rate, kept_within, slip_rate
from hdjax.effects.effect import Effect, MeshTorqueEffect, Motion, Scales
from hdjax.elementary import power
from hdjax.parameters import Scalar, parameter

SOURCE = "Dhaouadi, Ghorbel, Gandhi 2003; Ruderman"
SLIP = "Tjahjowidodo, Al-Bender, Van Brussel 2013: slip at 1e-4 to 1e-3 rad"


# Limit of z in memory twists: beyond it z returns, and with n > 1 a long step would diverge.
_FAR = 3.0


class BoucWen(MeshTorqueEffect):
    """Torque `k z` with `z' = v - beta |v| |z|^(n-1) z - gamma v |z|^n`.

    Kept as `beta = memory_twist^-n` and `gamma = ratio beta`. It dissipates for |ratio| <= 1. Above -1 it yields: |z|
    saturates at `memory_twist (1 + ratio)^(-1/n)`. Below, a branch bends the other way, as in the benchmark of Noel and
    Schoukens (2016), and nothing bounds z.
    """

    family: ClassVar[str] = "hysteresis"
    name: ClassVar[str] = "bouc_wen"
    states: ClassVar[tuple[str, ...]] = ("z",)

    k: Scalar = parameter(
        0.0, unit="N m/rad", doc="stiffness of the hysteretic part", source=SOURCE, bounds=(0.0, 1e12), role="strength"
    )
    memory_twist: Scalar = parameter(
        unit="rad",
        doc="twist within which z forgets where it came from",
        source=SOURCE,
        bounds=(0.0, 0.1),
        plausible=(1e-4, 2e-3),
        role="shape",
    )
    ratio: Scalar = parameter(2.0 / 3.0, unit="1", doc="gamma / beta", source=SOURCE, bounds=(-1e2, 1e2), role="shape")
    n: Scalar = parameter(1.0, unit="1", doc="sharpness of the yield", source=SOURCE, bounds=(0.0, 1e2))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(memory_twist=fraction * scales.x) for fraction in (0.5, 1.5, 0.15))

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return self.k * state[0]

    def initial_state(self, motion: Motion | None = None) -> Float[Array, "1"]:
        return jnp.zeros_like(self.k)[None]

    def state_rates(self, motion: Motion, state: Array) -> Float[Array, "1"]:
        z = state[0] / self.memory_twist
        # |z|^(n-1) has no derivative at 0 where n = 1; the offset is far below any z that matters.
        magnitude = power(jnp.minimum(z * z, _FAR**2) + 1e-30, 0.5 * (self.n - 1.0))
        bent = jnp.abs(motion.v) * z + self.ratio * motion.v * jnp.abs(z)
        return (motion.v - magnitude * bent)[None]

    def state_scale(self) -> Float[Array, "1"]:
        return self.memory_twist[None]

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        beta = self.memory_twist**-self.n
        return {"beta": (beta, "rad^-n"), "gamma": (self.ratio * beta, "rad^-n")}


class SharpBoucWen(BoucWen):
    """[`BoucWen`][] with the exponent n free: it says how sharply the spring yields."""

    name: ClassVar[str] = "sharp_bouc_wen"

    n: Scalar = parameter(2.0, unit="1", doc="sharpness of the yield", source=SOURCE, bounds=(0.0, 1e2), role="shape")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(memory_twist=fraction * scales.x) for fraction in (1.5, 0.5))


class Dahl(MeshTorqueEffect):
    """Torque `k z` with `z' = v (1 - sgn(v) z / yield_twist)`: z follows the twist and saturates.

    Bouc-Wen with n = 1 and gamma = 0, in two parameters.
    """

    family: ClassVar[str] = "hysteresis"
    name: ClassVar[str] = "dahl"
    states: ClassVar[tuple[str, ...]] = ("z",)

    k: Scalar = parameter(
        0.0, unit="N m/rad", doc="stiffness of the hysteretic part", source="Dahl", bounds=(0.0, 1e12), role="strength"
    )
    yield_twist: Scalar = parameter(
        unit="rad",
        doc="where z saturates",
        source=SLIP,
        bounds=(0.0, 0.1),
        plausible=(1e-4, 1e-3),
        role="shape",
    )
    settling: Scalar = parameter(unit="s", doc=SETTLING, bounds=(0.0, 1e3))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(
            cls(yield_twist=fraction * scales.x, settling=SETTLING_SHARE * scales.time_step)
            for fraction in (0.3, 1.0, 0.1)
        )

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return self.k * state[0]

    def initial_state(self, motion: Motion | None = None) -> Float[Array, "1"]:
        return jnp.zeros_like(self.k)[None]

    def state_rates(self, motion: Motion, state: Array) -> Float[Array, "1"]:
        return bristle_rate(motion.v, state[0], self.yield_twist, self.settling)[None]

    def state_scale(self) -> Float[Array, "1"]:
        return self.yield_twist[None]

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return {"T_c": (self.k * self.yield_twist, "N m")}


# Of a sampling interval. What a slipping spring errs by grows with its square; a step of an interval resolves it still.
_SETTLING = 0.5
_SHARE = "yield twist over that of the spring that slips last"


class MaxwellSlip(MeshTorqueEffect):
    """Torque `k_1 z_1 + k_2 z_2 + k_3 z_3`: springs that slip, each at its own twist.

    Each z follows the twist until it is its yield twist away, and then slips. The last one slips at
    `yield_twist`, the others at shares of it.
    """

    family: ClassVar[str] = "hysteresis"
    name: ClassVar[str] = "maxwell_slip"
    states: ClassVar[tuple[str, ...]] = ("z_1", "z_2", "z_3")

    k_1: Scalar = parameter(
        0.0, unit="N m/rad", doc="spring that slips last", source=SLIP, bounds=(0.0, 1e12), role="strength"
    )
    k_2: Scalar = parameter(
        0.0, unit="N m/rad", doc="spring that slips second", source=SLIP, bounds=(0.0, 1e12), role="strength"
    )
    k_3: Scalar = parameter(
        0.0, unit="N m/rad", doc="spring that slips first", source=SLIP, bounds=(0.0, 1e12), role="strength"
    )
    yield_twist: Scalar = parameter(
        unit="rad",
        doc="where the last spring slips",
        source=SLIP,
        bounds=(0.0, 0.1),
        plausible=(1e-4, 1e-3),
        role="shape",
    )
    share_2: Scalar = parameter(0.5, unit="1", doc=_SHARE, source=SLIP, bounds=(0.0, 1e2), role="shape")
    share_3: Scalar = parameter(0.25, unit="1", doc=_SHARE, source=SLIP, bounds=(0.0, 1e2), role="shape")
    settling: Scalar = parameter(
        unit="s", doc="within which what runs ahead of a slipping spring comes back", bounds=(0.0, 1e3)
    )

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        settling = _SETTLING * scales.time_step
        return tuple(cls(yield_twist=fraction * scales.x, settling=settling) for fraction in (0.5, 1.5, 0.2))

    @property
    def _yields(self) -> Float[Array, "3"]:
        return jnp.stack([self.yield_twist, self.share_2 * self.yield_twist, self.share_3 * self.yield_twist])

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        z_1, z_2, z_3 = (kept_within(z, d) for z, d in zip(state, self._yields, strict=True))
        return self.k_1 * z_1 + self.k_2 * z_2 + self.k_3 * z_3

    def initial_state(self, motion: Motion | None = None) -> Float[Array, "3"]:
        return jnp.zeros_like(self._yields)

    def state_rates(self, motion: Motion, state: Array) -> Float[Array, "3"]:
        # Element by element: each is one contiguous row of lanes.
        rates = [slip_rate(motion.v, z, d, self.settling) for z, d in zip(state, self._yields, strict=True)]
        return jnp.stack(rates)

    def state_scale(self) -> Float[Array, "3"]:
        return self._yields
