"""Friction with memory: bristles that bend before they slide."""

import abc
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.bristle import SETTLING, SETTLING_SHARE, bristle_rate
from hdjax.effects.dry import DryFriction, load_rate, motor_rate
from hdjax.effects.effect import Effect, LoadSideEffect, MeshTorqueEffect, Motion, MotorSideEffect, Scales
from hdjax.elementary import exponential
from hdjax.parameters import Scalar, parameter

SOURCE = "Canudas de Wit, Olsson, Astrom, Lischinsky 1995"
# Bend of the bristles over the shaft's motion in a radian of a period: from well resolved to nearly Coulomb.
_BENDS = (0.1, 0.02, 0.5)
# Stribeck rates: as a share of the shaft's, and at the output [rad/s], from the upper part of EFFECTS' 1e-3 to 0.1.
# From below, the excess grows without limit in place of the rate.
_SHARE_OF_RATE, _AT_OUTPUT = 0.2, (0.1, 0.03)
# Damping of the bristles over their stiffness, times the natural frequency of the dynamic error. It is
# 2 zeta sqrt(J / sigma_0), so in weak friction bristles resist mostly by damping, hardly by their bend.
_DAMPING, _MOSTLY_DAMPING = 0.3, 100.0


class DahlMotorFriction(MotorSideEffect):
    """Friction `T_c z / bend + b omega_m` against the motor, with `z' = omega_m (1 - sgn(omega_m) z / bend)`.

    A Coulomb torque that builds up over the angle `bend`. The stiffness sigma_0 is `T_c / bend`.
    """

    family: ClassVar[str] = "motor_friction"
    name: ClassVar[str] = "dahl_motor_friction"
    contains: ClassVar[tuple[str, ...]] = ("viscous_motor_friction",)
    states: ClassVar[tuple[str, ...]] = ("z",)
    imperfection: ClassVar[float] = DryFriction.imperfection

    T_c: Scalar = parameter(
        0.0, unit="N m", doc="Coulomb torque at the motor", source="Dahl", bounds=(0.0, 1e3), role="strength"
    )
    b: Scalar = parameter(0.0, unit="N m s/rad", doc="viscous friction", source="EFFECTS", role="strength")
    bend: Scalar = parameter(unit="rad", doc="motor angle within which it slides", bounds=(0.0, 10.0), role="shape")
    settling: Scalar = parameter(unit="s", doc=SETTLING, bounds=(0.0, 1e3))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(
            cls(bend=bend, settling=SETTLING_SHARE * scales.time_step) for bend in _bends(scales.omega_m, scales)
        )

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return -self.T_c * state[0] / self.bend - self.b * motor_rate(motion)

    def initial_state(self, motion: Motion | None = None) -> Float[Array, "1"]:
        return _bent(self.bend, None if motion is None else motor_rate(motion))

    def state_rates(self, motion: Motion, state: Array) -> Float[Array, "1"]:
        return bristle_rate(motor_rate(motion), state[0], self.bend, self.settling)[None]

    def state_scale(self) -> Float[Array, "1"]:
        return self.bend[None]

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return {"sigma_0": (self.T_c / self.bend, "N m/rad")}


class _LuGre(Effect):
    """LuGre friction `sigma_0 z + sigma_1 z'` against a rate omega (Canudas de Wit et al. 1995), where
    `z' = omega - sigma_0 |omega| z / g`.

    `g = T_c (1 + excess exp(-(omega / omega_s)^2))`, `sigma_0 = T_c / bend` and `sigma_1 = sigma_0 tau`, so that the
    bristles saturate at `bend` times the Stribeck level for any T_c, and vanish without it.
    """

    states: ClassVar[tuple[str, ...]] = ("z",)
    imperfection: ClassVar[float] = DryFriction.imperfection

    T_c: Scalar = parameter(
        0.0, unit="N m", doc="Coulomb torque against the rate", source=SOURCE, bounds=(0.0, 1e4), role="strength"
    )
    excess: Scalar = parameter(
        0.5,
        unit="1",
        doc="static torque above Coulomb, over Coulomb",
        source="EFFECTS: 0.2 to 1",
        bounds=(0.0, 100.0),
        plausible=(0.2, 1.0),
        role="shape",
    )
    omega_s: Scalar = parameter(
        unit="rad/s",
        doc="Stribeck rate",
        source="EFFECTS: 1e-3 to 0.1 rad/s at the output",
        bounds=(0.0, 1e4),
        role="shape",
    )
    bend: Scalar = parameter(unit="rad", doc="angle within which it slides", bounds=(0.0, 10.0), role="shape")
    tau: Scalar = parameter(
        0.0, unit="s", doc="damping of the bristles over their stiffness", bounds=(0.0, 1e3), role="shape"
    )
    settling: Scalar = parameter(unit="s", doc=SETTLING, bounds=(0.0, 1e3))

    @staticmethod
    @abc.abstractmethod
    def rate_of(motion: Motion) -> Array:
        """The rate that it opposes."""

    @classmethod
    def at_rates(cls, rate: float, ratio: float, scales: Scales) -> tuple[Effect, ...]:
        """Proposals (starting values) at such rates [rad/s], `ratio` times the output's."""
        settling, bends = SETTLING_SHARE * scales.time_step, _bends(rate, scales)
        slow = (_SHARE_OF_RATE * rate, *(ratio * omega_s for omega_s in _AT_OUTPUT))
        shapes = [(omega_s, bend, _DAMPING) for omega_s in slow for bend in bends]
        shapes.append((slow[0], bends[0], _MOSTLY_DAMPING))
        return tuple(
            cls(bend=bend, omega_s=omega_s, tau=damping / scales.natural_frequency, settling=settling)
            for omega_s, bend, damping in shapes
        )

    def bristles(self, motion: Motion, state: Array) -> Array:
        """The torque of the bristles [N m]."""
        (slipping,) = self.state_rates(motion, state)
        return self.T_c * (state[0] + self.tau * slipping) / self.bend

    def _level(self, motion: Motion) -> Array:
        return 1.0 + self.excess * exponential(-((self.rate_of(motion) / self.omega_s) ** 2))

    def initial_state(self, motion: Motion | None = None) -> Float[Array, "1"]:
        if motion is None:
            return _bent(self.bend, None)
        return _bent(self.bend * self._level(motion), self.rate_of(motion))

    def state_rates(self, motion: Motion, state: Array) -> Float[Array, "1"]:
        limit = self.bend * self._level(motion)
        return bristle_rate(self.rate_of(motion), state[0], limit, self.settling)[None]

    def state_scale(self) -> Float[Array, "1"]:
        return self.bend[None]

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return {
            "sigma_0": (self.T_c / self.bend, "N m/rad"),
            "sigma_1": (self.tau * self.T_c / self.bend, "N m s/rad"),
            "T_s": (self.T_c * (1.0 + self.excess), "N m"),
        }


class LuGreMeshFriction(_LuGre, MeshTorqueEffect):
    """LuGre friction `sigma_0 z + sigma_1 z'` between the mesh's two sides, `z' = v - sigma_0 |v| z / g`.

    `g = T_c (1 + excess exp(-(v / omega_s)^2))`, `sigma_0 = T_c / bend`, `sigma_1 = sigma_0 tau`. Viscous friction of
    the mesh is B_sp.
    """

    family: ClassVar[str] = "coulomb_friction"
    name: ClassVar[str] = "lugre_mesh_friction"
    drawn_against: ClassVar[str | None] = "v"

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return cls.at_rates(scales.v, 1.0, scales)

    @staticmethod
    def rate_of(motion: Motion) -> Array:
        return motion.v

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return self.bristles(motion, state)


class _LuGreOfShaft(_LuGre):
    """LuGre friction `sigma_0 z + sigma_1 z' + b omega` against a shaft."""

    b: Scalar = parameter(0.0, unit="N m s/rad", doc="viscous friction", source=SOURCE, role="strength")

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return -self.bristles(motion, state) - self.b * self.rate_of(motion)


class LuGreMotorFriction(_LuGreOfShaft, MotorSideEffect):
    """LuGre friction `sigma_0 z + sigma_1 z' + b omega_m` against the motor, `z' = omega_m - sigma_0 |omega_m| z / g`.

    `g = T_c (1 + excess exp(-(omega_m / omega_s)^2))`, `sigma_0 = T_c / bend`, `sigma_1 = sigma_0 tau`.
    """

    family: ClassVar[str] = "motor_friction"
    name: ClassVar[str] = "lugre_motor_friction"
    contains: ClassVar[tuple[str, ...]] = ("viscous_motor_friction", "dahl_motor_friction")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return cls.at_rates(scales.omega_m, scales.reduction_ratio, scales)

    @staticmethod
    def rate_of(motion: Motion) -> Array:
        return motor_rate(motion)


class LuGreLoadFriction(_LuGreOfShaft, LoadSideEffect):
    """LuGre friction `sigma_0 z + sigma_1 z' + b omega_l` against the load, `z' = omega_l - sigma_0 |omega_l| z / g`.

    `g = T_c (1 + excess exp(-(omega_l / omega_s)^2))`, `sigma_0 = T_c / bend`, `sigma_1 = sigma_0 tau`.
    """

    family: ClassVar[str] = "load_friction"
    name: ClassVar[str] = "lugre_load_friction"
    contains: ClassVar[tuple[str, ...]] = ("viscous_load_friction",)

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return cls.at_rates(scales.omega_l, 1.0, scales)

    @staticmethod
    def rate_of(motion: Motion) -> Array:
        return load_rate(motion)


def _bends(rate: float, scales: Scales) -> tuple[float, ...]:
    """Angles, as shares of the shaft's motion within a radian of the natural oscillation."""
    return tuple(share * rate / scales.natural_frequency for share in _BENDS)


def _bent(bend: Array, rate: Array | None) -> Float[Array, "1"]:
    """Bristles of a shaft in steady rotation are bent in its direction, to where they slide."""
    return (jnp.zeros_like(bend) if rate is None else bend * jnp.sign(rate))[None]
