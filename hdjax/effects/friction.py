"""Friction that needs no state: in the mesh, on the motor, on the load."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive, restoring
from hdjax.effects.effect import Effect, LoadSideEffect, MeshTorqueEffect, Motion, MotorSideEffect, Scales
from hdjax.elementary import exponential
from hdjax.parameters import Scalar, parameter

# Explicit Runge-Kutta steps follow a decay whose rate times the step is at most this: RK4 up to 2.78, Tsit5 up to 3.3.
_STABLE = 2.0


class CoulombFriction(MeshTorqueEffect):
    """Torque `T_c sgn(v)` between the mesh's two sides, with the sign smoothed over v_0."""

    family: ClassVar[str] = "coulomb_friction"
    name: ClassVar[str] = "coulomb_friction"
    drawn_against: ClassVar[str | None] = "v"

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

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return dry(self.T_c, motion.v, self.v_0, drive.c, motion)


class LoadDependentFriction(MeshTorqueEffect):
    """Torque `(T_c + share |K f(x)|) sgn(v)`: friction that grows with the torque that the mesh passes on.

    In the literature's `T_c (1 + k |tau|)` k is `share / T_c`.
    """

    family: ClassVar[str] = "coulomb_friction"
    name: ClassVar[str] = "load_dependent_friction"
    drawn_against: ClassVar[str | None] = "v"

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

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        transmitted = jnp.abs(drive.stiffness * restoring(motion.x, drive.alpha))
        return dry(self.T_c + self.share * transmitted, motion.v, self.v_0, drive.c, motion)


class MotorFriction(MotorSideEffect):
    """Friction torque `T_c sgn(omega_m) + b omega_m` against the motor, its sign smoothed over `transition`."""

    family: ClassVar[str] = "motor_friction"
    name: ClassVar[str] = "motor_friction"

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

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        omega = motor_rate(motion)
        return -dry(self.T_c, omega, self.transition, 1.0 / drive.J_m, motion) - self.b * omega


class StribeckMotorFriction(MotorSideEffect):
    """Motor friction whose Coulomb part is larger near standstill.

    `(T_c + T_excess exp(-(omega/omega_s)^2)) sgn(omega) + b omega`, with static torque T_s = T_c + T_excess.
    """

    family: ClassVar[str] = "motor_friction"
    name: ClassVar[str] = "stribeck_motor_friction"

    T_c: Scalar = parameter(
        0.0,
        unit="N m",
        doc="Coulomb torque at the motor",
        source="EFFECTS",
        bounds=(0.0, 1e3),
        role="strength",
    )
    T_excess: Scalar = parameter(0.0, unit="N m", doc="static torque above Coulomb", source="EFFECTS", role="strength")
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

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        omega = motor_rate(motion)
        level = self.T_c + self.T_excess * exponential(-((omega / self.omega_s) ** 2))
        return -dry(level, omega, self.transition, 1.0 / drive.J_m, motion) - self.b * omega


class LoadFriction(LoadSideEffect):
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

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        assert motion.omega_l is not None
        return -dry(self.T_c, motion.omega_l, self.transition, 1.0 / drive.J_l, motion) - self.b * motion.omega_l


def dry(level: Array, rate: Array, transition: Array, mobility: Array | float, motion: Motion) -> Array:
    """Dry friction `level sgn(rate)`, its sign turning over +-transition so that it has a gradient.

    About rest it is a damper that brings the rate down within `transition / (level mobility)`. An explicit solver whose
    step is longer than that rattles to and fro instead. So the corner is as sharp as the steps resolve (the root of the
    sum of squares of both widths, which a fit feels on either side), and finer steps bring back the law as stated.

    Args:
        level: of the torque [N m].
        rate: that it opposes [rad/s].
        transition: rate over which the sign turns [rad/s].
        mobility: acceleration of the rate by a unit of torque [1/(kg m^2)].
        motion: tells the solver's step, where it is fixed.
    """
    if motion.step is not None:
        transition = jnp.hypot(transition, level * mobility * motion.step / _STABLE)
    return level * jnp.tanh(rate / transition)


def motor_rate(motion: Motion) -> Array:
    """The motor's own rate, which a reduced drive lacks."""
    assert motion.omega_m is not None
    return motion.omega_m
