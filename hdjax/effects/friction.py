"""Friction that needs no state: in the mesh, on the motor, on the load."""

import abc
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive, restoring
from hdjax.effects.dry import DryLoadFriction, DryMeshFriction, DryMotorFriction, load_rate, motor_rate
from hdjax.effects.effect import Effect, LoadSideEffect, Motion, MotorSideEffect, Scales, ShaftEffect
from hdjax.elementary import exponential
from hdjax.parameters import Scalar, parameter


class CoulombFriction(DryMeshFriction):
    """Torque `T_c sgn(v)` between the mesh's two sides, with the sign smoothed over v_0."""

    family: ClassVar[str] = "coulomb_friction"
    name: ClassVar[str] = "coulomb_friction"

    T_c: Scalar = parameter(
        0.0,
        unit="N m",
        doc="Coulomb torque at the output",
        source="EFFECTS: 0.1 to 5 N m",
        bounds=(0.0, 1e3),
        plausible=(0.1, 5.0),
        role="strength",
    )
    v_0: Scalar = parameter(unit="rad/s", doc="transition rate", bounds=(0.0, 1e3), role="shape")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(v_0=fraction * scales.v) for fraction in (0.03, 0.2))

    def level(self, motion: Motion, drive: Drive | ReducedDrive) -> Array:
        return self.T_c


class LoadDependentFriction(DryMeshFriction):
    """Torque `(T_c + share |K f(x)|) sgn(v)`: friction that grows with the transmitted torque.

    In the literature's `T_c (1 + k |tau|)` k is `share / T_c`.
    """

    family: ClassVar[str] = "coulomb_friction"
    name: ClassVar[str] = "load_dependent_friction"

    T_c: Scalar = parameter(
        0.0,
        unit="N m",
        doc="Coulomb torque at the output, unloaded",
        source="EFFECTS: 0.1 to 5 N m",
        bounds=(0.0, 1e3),
        plausible=(0.1, 5.0),
        role="strength",
    )
    share: Scalar = parameter(0.0, unit="1", doc="friction torque over transmitted torque", role="strength")
    v_0: Scalar = parameter(unit="rad/s", doc="transition rate", bounds=(0.0, 1e3), role="shape")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(v_0=fraction * scales.v) for fraction in (0.03, 0.2))

    def level(self, motion: Motion, drive: Drive | ReducedDrive) -> Array:
        return self.T_c + self.share * jnp.abs(drive.stiffness * restoring(motion.x, drive.alpha))


class _Viscous(ShaftEffect):
    """Friction torque `b omega` against a shaft."""

    b: Scalar = parameter(0.0, unit="N m s/rad", doc="viscous friction", source="EFFECTS", role="strength")

    @staticmethod
    @abc.abstractmethod
    def rate_of(motion: Motion) -> Array:
        """Rate of the shaft [rad/s]."""

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return -self.b * self.rate_of(motion)


class ViscousMotorFriction(_Viscous, MotorSideEffect):
    """Friction torque `b omega_m` against the motor."""

    family: ClassVar[str] = "motor_friction"
    name: ClassVar[str] = "viscous_motor_friction"

    @staticmethod
    def rate_of(motion: Motion) -> Array:
        return motor_rate(motion)


class MotorFriction(DryMotorFriction):
    """Friction torque `T_c sgn(omega_m) + b omega_m` against the motor, its sign smoothed over `transition`."""

    family: ClassVar[str] = "motor_friction"
    name: ClassVar[str] = "motor_friction"
    contains: ClassVar[tuple[str, ...]] = ("viscous_motor_friction",)

    T_c: Scalar = parameter(
        0.0,
        unit="N m",
        doc="Coulomb torque at the motor",
        source="EFFECTS",
        bounds=(0.0, 1e3),
        role="strength",
    )
    b: Scalar = parameter(0.0, unit="N m s/rad", doc="viscous friction", source="EFFECTS", role="strength")
    transition: Scalar = parameter(unit="rad/s", doc="rate over which the sign turns", bounds=(0.0, 1e4), role="shape")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return (cls(transition=0.01 * scales.omega_m),)

    def level(self, motion: Motion, drive: Drive | ReducedDrive) -> Array:
        return self.T_c

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return super().torque(motion, drive, state) - self.b * motor_rate(motion)


class StribeckMotorFriction(DryMotorFriction):
    """Motor friction whose Coulomb part is larger near standstill.

    `(T_c + T_excess exp(-(omega/omega_s)^2)) sgn(omega) + b omega`, with static torque T_s = T_c + T_excess.
    """

    family: ClassVar[str] = "motor_friction"
    name: ClassVar[str] = "stribeck_motor_friction"
    contains: ClassVar[tuple[str, ...]] = ("viscous_motor_friction", "motor_friction")

    T_c: Scalar = parameter(
        0.0,
        unit="N m",
        doc="Coulomb torque at the motor",
        source="EFFECTS",
        bounds=(0.0, 1e3),
        role="strength",
    )
    # Not negative: friction below zero near standstill would supply energy.
    T_excess: Scalar = parameter(
        0.0,
        unit="N m",
        doc="static torque above Coulomb",
        source="EFFECTS",
        bounds=(0.0, 1e3),
        role="strength",
    )
    b: Scalar = parameter(0.0, unit="N m s/rad", doc="viscous friction", source="EFFECTS", role="strength")
    transition: Scalar = parameter(unit="rad/s", doc="rate over which the sign turns", bounds=(0.0, 1e4), role="shape")
    omega_s: Scalar = parameter(
        unit="rad/s",
        doc="Stribeck rate",
        source="EFFECTS: 1e-3 to 0.1 rad/s at the output",
        bounds=(0.0, 1e4),
        role="shape",
    )

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        fractions = (0.2, 0.05, 0.6)
        return tuple(cls(transition=0.01 * scales.omega_m, omega_s=f * scales.omega_m) for f in fractions)

    def level(self, motion: Motion, drive: Drive | ReducedDrive) -> Array:
        return self.T_c + self.T_excess * exponential(-((motor_rate(motion) / self.omega_s) ** 2))

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return super().torque(motion, drive, state) - self.b * motor_rate(motion)


class ViscousLoadFriction(_Viscous, LoadSideEffect):
    """Friction torque `b omega_l` against the load."""

    family: ClassVar[str] = "load_friction"
    name: ClassVar[str] = "viscous_load_friction"

    @staticmethod
    def rate_of(motion: Motion) -> Array:
        return load_rate(motion)


class LoadFriction(DryLoadFriction):
    """Friction torque `T_c sgn(omega_l) + b omega_l` against the load, its sign smoothed over `transition`."""

    family: ClassVar[str] = "load_friction"
    name: ClassVar[str] = "load_friction"

    T_c: Scalar = parameter(
        0.0, unit="N m", doc="Coulomb torque at the load", source="EFFECTS", bounds=(0.0, 1e4), role="strength"
    )
    b: Scalar = parameter(0.0, unit="N m s/rad", doc="viscous friction", source="EFFECTS", role="strength")
    transition: Scalar = parameter(unit="rad/s", doc="rate over which the sign turns", bounds=(0.0, 1e3), role="shape")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return (cls(transition=0.01 * scales.omega_l),)

    def level(self, motion: Motion, drive: Drive | ReducedDrive) -> Array:
        return self.T_c


class StribeckLoadFriction(DryLoadFriction):
    """Load friction whose Coulomb part is larger near standstill: bearings and seals that stick before they slide.

    `(T_c + T_excess exp(-(omega_l/omega_s)^2)) sgn(omega_l) + b omega_l`, with static torque T_s = T_c + T_excess.
    """

    family: ClassVar[str] = "load_friction"
    name: ClassVar[str] = "stribeck_load_friction"
    contains: ClassVar[tuple[str, ...]] = ("viscous_load_friction", "load_friction")

    T_c: Scalar = parameter(
        0.0, unit="N m", doc="Coulomb torque at the load", source="EFFECTS", bounds=(0.0, 1e4), role="strength"
    )
    T_excess: Scalar = parameter(
        0.0, unit="N m", doc="static torque above Coulomb", source="EFFECTS", bounds=(0.0, 1e4), role="strength"
    )
    b: Scalar = parameter(0.0, unit="N m s/rad", doc="viscous friction", source="EFFECTS", role="strength")
    transition: Scalar = parameter(unit="rad/s", doc="rate over which the sign turns", bounds=(0.0, 1e3), role="shape")
    omega_s: Scalar = parameter(
        unit="rad/s",
        doc="Stribeck rate",
        source="EFFECTS: 1e-3 to 0.1 rad/s at the output",
        bounds=(0.0, 1e3),
        role="shape",
    )

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        fractions = (0.2, 0.05, 0.6)
        return tuple(cls(transition=0.01 * scales.omega_l, omega_s=f * scales.omega_l) for f in fractions)

    def level(self, motion: Motion, drive: Drive | ReducedDrive) -> Array:
        return self.T_c + self.T_excess * exponential(-((load_rate(motion) / self.omega_s) ** 2))
