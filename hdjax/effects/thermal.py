"""Temperature dependence of stiffness, mesh damping and motor friction."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive, restoring
from hdjax.effects.dry import DryMotorFriction, motor_rate
from hdjax.effects.effect import Effect, MeshTorqueEffect, Motion, Scales
from hdjax.parameters import Scalar, parameter

_WOLF = "Wolf and Iskandar: viscous friction falls exponentially with temperature"


class _Thermal(Effect):
    """An effect of the drive's temperature."""

    family: ClassVar[str] = "temperature"

    @property
    def needs_temperature(self) -> bool:
        return True


class ThermalStiffness(_Thermal, MeshTorqueEffect):
    """Torque `k_T (T - T_0) K f(x)`: the stiffness is `K (1 + k_T (T - T_0))`."""

    name: ClassVar[str] = "thermal_stiffness"

    k_T: Scalar = parameter(
        0.0,
        unit="1/K",
        doc="relative stiffness change per kelvin",
        source="EFFECTS: 1e-4 to 1e-3 per kelvin",
        plausible=(1e-4, 1e-3),
        role="strength",
    )
    T_0: Scalar = parameter(293.15, unit="K", doc="temperature at which K is meant", bounds=(0.0, 1e4))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(T_0=T_0) for T_0 in _reference(scales))

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        warmer = _temperature(motion, self.name) - self.T_0
        return self.k_T * warmer * drive.stiffness * restoring(motion.x, drive.alpha)


class ThermalDamping(_Thermal, MeshTorqueEffect):
    """The mesh damping is `B_sp exp(-kappa (T - T_0))`."""

    name: ClassVar[str] = "thermal_damping"
    drawn_against: ClassVar[str | None] = "v"

    kappa: Scalar = parameter(0.0, unit="1/K", doc="decay of the damping per kelvin", source=_WOLF, role="strength")
    T_0: Scalar = parameter(293.15, unit="K", doc="temperature at which B_sp is meant", bounds=(0.0, 1e4))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(T_0=T_0) for T_0 in _reference(scales))

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        warmer = _temperature(motion, self.name) - self.T_0
        damping = drive.mesh_torque(jnp.zeros_like(motion.x), motion.v)
        return damping * jnp.expm1(-self.kappa * warmer)


class ThermalMotorFriction(_Thermal, DryMotorFriction):
    """Motor friction that falls with temperature: `(T - T_0) (T_c_T sgn(omega_m) + b_T omega_m)` with the motor.

    The change only, to first order in the temperature, for any law of the friction itself.
    """

    name: ClassVar[str] = "thermal_motor_friction"

    T_c_T: Scalar = parameter(0.0, unit="N m/K", doc="fall of the Coulomb torque per kelvin", role="strength")
    b_T: Scalar = parameter(
        0.0, unit="N m s/(rad K)", doc="fall of the viscous friction per kelvin", source=_WOLF, role="strength"
    )
    transition: Scalar = parameter(unit="rad/s", doc="rate over which the sign turns", bounds=(0.0, 1e4), role="shape")
    T_0: Scalar = parameter(293.15, unit="K", doc="temperature at which the friction is meant", bounds=(0.0, 1e4))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(transition=0.01 * scales.omega_m, T_0=T_0) for T_0 in _reference(scales))

    def level(self, motion: Motion, drive: Drive | ReducedDrive) -> Array:
        return -self.T_c_T * self._warmer(motion)

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return super().torque(motion, drive, state) + self.b_T * self._warmer(motion) * motor_rate(motion)

    def _warmer(self, motion: Motion) -> Array:
        return _temperature(motion, self.name) - self.T_0


def _reference(scales: Scales) -> tuple[float, ...]:
    """The temperature to measure from, if the logs hold a temperature that changes."""
    return (scales.temperature,) if scales.temperature is not None and scales.temperature_change > 0 else ()


def _temperature(motion: Motion, name: str) -> Array:
    if motion.temperature is None:
        raise ValueError(f"`{name}` needs the drive's temperature, which must be given to the simulation")
    return motion.temperature
