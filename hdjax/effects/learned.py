"""Nonparametric terms: a torque, or an error of an angle, as a learned function of one or two quantities.

The function is linear in its coefficients, so that all coefficients at zero are the base model exactly.
"""

import math
from collections.abc import Iterable
from dataclasses import replace
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.dry import DryFriction
from hdjax.effects.effect import (
    Effect,
    LoadSideEffect,
    MeshGeometryEffect,
    MeshTorqueEffect,
    Motion,
    MotorSideEffect,
    Scales,
    SensorEffect,
)
from hdjax.effects.learned_axes import ANGLES, Axis, PeriodicAxis, SignAxis, combined, functions
from hdjax.parameters import Scalar, parameter

FAMILY = "unknown"
SOURCE = "learned from data"


def _coefficients(unit: str) -> Any:
    return parameter(unit=unit, doc="coefficient of the learned function", source=SOURCE, role="strength", several=True)


class Learned(Effect):
    """A learned function at some place.

    Attributes:
        axes: its variables.
        mixing: combination of the axes' functions for each coefficient.
        c: coefficients.
    """

    family: ClassVar[str] = FAMILY

    axes: tuple[Axis, ...]
    mixing: Float[Array, "functions coefficients"] = eqx.field(converter=jnp.asarray)
    c: tuple[Scalar, ...] = _coefficients("N m")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        """None: its variables are selected from data."""
        return ()

    @classmethod
    def made_of(cls, axes: tuple[Axis, ...], mixing: Array | np.ndarray, c: Iterable[Scalar | float]) -> "Learned":
        """A function of these axes at this place."""
        return cls(axes=axes, mixing=mixing, c=tuple(c))

    @classmethod
    def may_depend_on(cls, variable: str) -> bool:
        """Whether it may be a function of a quantity of `UNITS`."""
        return variable != "T_m"

    @classmethod
    def may_jump_with(cls, variable: str) -> bool:
        """Whether it may jump where a rate changes its sign, as dry friction does: only with the rate of its place."""
        return False

    @property
    def needs_temperature(self) -> bool:
        return any(axis.variable == "temperature" for axis in self.axes)

    @property
    def follows_torque(self) -> bool:
        return any(axis.variable == "T_m" for axis in self.axes)

    @property
    def angles(self) -> frozenset[str]:
        return frozenset(axis.variable for axis in self.axes if axis.variable in ANGLES)

    def value(self, motion: Motion) -> Array:
        """The function, at one instant."""
        return functions(self.axes, motion) @ self.mixing @ jnp.stack(self.c)


class LearnedTorque(Learned):
    """A learned torque."""

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        """The torque [N m], along the positive direction of its place."""
        return combined(self.axes, self.mixing, self.c, motion)

    @classmethod
    def made_of(cls, axes: tuple[Axis, ...], mixing: Array | np.ndarray, c: Iterable[Scalar | float]) -> "Learned":
        first = axes[0] if axes else None
        if isinstance(first, SignAxis):
            return _RUBBING[cls](axes=axes, mixing=mixing, c=tuple(c), transition=first.corner)
        if isinstance(first, PeriodicAxis):
            return _PERIODIC[cls](axes=axes, mixing=mixing, c=tuple(c), omega=first.omega)
        return super().made_of(axes, mixing, c)

    @classmethod
    def may_jump_with(cls, variable: str) -> bool:
        return variable == _RUBBING[cls].opposes


class LearnedMeshTorque(LearnedTorque, MeshTorqueEffect):
    """Learned torque in the mesh."""

    name: ClassVar[str] = "learned_mesh_torque"


class LearnedMotorTorque(LearnedTorque, MotorSideEffect):
    """Learned torque on the motor."""

    name: ClassVar[str] = "learned_motor_torque"

    @classmethod
    def may_depend_on(cls, variable: str) -> bool:
        return True


class LearnedLoadTorque(LearnedTorque, LoadSideEffect):
    """Learned torque on the load."""

    name: ClassVar[str] = "learned_load_torque"


class LearnedFriction(LearnedTorque, DryFriction):
    """A learned torque that jumps where the rate at its place changes its sign. Its first axis is a `SignAxis`.

    The size of the jump may depend on the other axes.

    Attributes:
        transition: rate over which the sign turns [rad/s].
    """

    # The mesh torque along its positive direction opposes the twist; what acts on a shaft drives it.
    _drives: ClassVar[bool] = True

    transition: Scalar = parameter(
        unit="rad/s", doc="rate over which the sign turns", source=SOURCE, bounds=(0.0, 1e4), role="shape"
    )

    @property
    def corner(self) -> Scalar:
        return self.transition

    def value(self, motion: Motion) -> Array:
        sign = eqx.tree_at(lambda s: s.corner, self._sign, self.transition)
        return functions((sign, *self.axes[1:]), motion) @ self.mixing @ jnp.stack(self.c)

    def level(self, motion: Motion, drive: Drive | ReducedDrive) -> Array:
        along = combined(self.axes[1:], self.mixing[: self._jumps], self.c, motion)
        return -along if self._drives else along

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        dry = self.dry(motion, drive)
        dry = -dry if self._drives else dry
        beside = self._sign.beside
        if beside is None:
            return dry
        return dry + combined((beside, *self.axes[1:]), self.mixing[self._jumps :], self.c, motion)

    @property
    def _sign(self) -> SignAxis:
        sign = self.axes[0]
        assert isinstance(sign, SignAxis)
        return sign

    @property
    def _jumps(self) -> int:
        """Number of functions, the first ones, with the sign."""
        return math.prod(axis.count for axis in self.axes[1:])


class LearnedMeshFriction(LearnedFriction, LearnedMeshTorque):
    """Learned torque in the mesh that jumps with the twist's rate."""

    opposes: ClassVar[str] = "v"
    _drives: ClassVar[bool] = False


class LearnedMotorFriction(LearnedFriction, LearnedMotorTorque):
    """Learned torque on the motor that jumps with its rate."""

    opposes: ClassVar[str] = "omega_m"


class LearnedLoadFriction(LearnedFriction, LearnedLoadTorque):
    """Learned torque on the load that jumps with its rate."""

    opposes: ClassVar[str] = "omega_l"


class LearnedPeriodic(LearnedTorque):
    """A learned torque that is periodic in time, independently of the drive. Its axis is a `PeriodicAxis`.

    The time counts from each log's start, as in [`hdjax.effects.load.LoadDisturbance`][].

    Attributes:
        omega: angular frequency [rad/s].
    """

    omega: Scalar = parameter(unit="rad/s", doc="angular frequency", source=SOURCE, bounds=(0.0, 1e6), role="shape")

    def value(self, motion: Motion) -> Array:
        return super().value(self._in_step(motion))

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return super().torque(self._in_step(motion), drive, state)

    def _in_step(self, motion: Motion) -> Motion:
        """The motion, with time scaled to the frequency of the axis."""
        (axis,) = self.axes
        assert isinstance(axis, PeriodicAxis) and motion.time is not None
        return replace(motion, time=motion.time * (self.omega / axis.omega))


class LearnedMeshPeriodic(LearnedPeriodic, LearnedMeshTorque):
    """Learned torque in the mesh that is periodic in time."""


class LearnedMotorPeriodic(LearnedPeriodic, LearnedMotorTorque):
    """Learned torque on the motor that is periodic in time."""


class LearnedLoadPeriodic(LearnedPeriodic, LearnedLoadTorque):
    """Learned torque on the load that is periodic in time."""


_RUBBING: dict[type[LearnedTorque], type[LearnedFriction]] = {
    LearnedMeshTorque: LearnedMeshFriction,
    LearnedMotorTorque: LearnedMotorFriction,
    LearnedLoadTorque: LearnedLoadFriction,
}
_PERIODIC: dict[type[LearnedTorque], type[LearnedPeriodic]] = {
    LearnedMeshTorque: LearnedMeshPeriodic,
    LearnedMotorTorque: LearnedMotorPeriodic,
    LearnedLoadTorque: LearnedLoadPeriodic,
}


class LearnedMeshError(Learned, MeshGeometryEffect):
    """Learned error of the mesh's angle, over the motor's. A torque over the angle is not equivalent, since the force
    of the error also grows with the speed."""

    name: ClassVar[str] = "learned_mesh_error"

    c: tuple[Scalar, ...] = _coefficients("rad")

    @classmethod
    def may_depend_on(cls, variable: str) -> bool:
        return variable == "theta_m"

    def error(self, theta_m: Array) -> Array:
        nothing = jnp.zeros_like(theta_m)
        return combined(self.axes, self.mixing, self.c, Motion(x=nothing, v=nothing, theta_m=theta_m))

    def slope(self, theta_m: Array) -> Array:
        return jax.jvp(self.error, (theta_m,), (jnp.ones_like(theta_m),))[1]


class LearnedReading(Learned, SensorEffect):
    """Learned error of an encoder's reading, over that angle: it causes no force, so that it is not amplified at
    resonance, unlike an error of the mesh."""

    c: tuple[Scalar, ...] = _coefficients("rad")

    _reads: ClassVar[str]

    @classmethod
    def may_depend_on(cls, variable: str) -> bool:
        return variable == cls._reads

    def _error(self, angle: Array) -> Array:
        nothing = jnp.zeros_like(angle)
        motion = replace(Motion(x=nothing, v=nothing), **{self._reads: angle})
        return combined(self.axes, self.mixing, self.c, motion)


class LearnedMotorReading(LearnedReading):
    """Learned error of the motor's encoder."""

    name: ClassVar[str] = "learned_motor_reading"
    _reads: ClassVar[str] = "theta_m"

    def reading(self, theta_m: Array, theta_l: Array, omega_m: Array, omega_l: Array) -> tuple[Array, Array]:
        return theta_m + self._error(theta_m), theta_l


class LearnedLoadReading(LearnedReading):
    """Learned error of the load's encoder."""

    name: ClassVar[str] = "learned_load_reading"
    _reads: ClassVar[str] = "theta_l"

    def reading(self, theta_m: Array, theta_l: Array, omega_m: Array, omega_l: Array) -> tuple[Array, Array]:
        return theta_m, theta_l + self._error(theta_l)


LEARNED_TORQUES: tuple[type[LearnedTorque], ...] = (LearnedMeshTorque, LearnedMotorTorque, LearnedLoadTorque)
"""A learned torque at each place where it can enter."""

LEARNED_READINGS: tuple[type[LearnedReading], ...] = (LearnedMotorReading, LearnedLoadReading)
"""A learned error of each encoder."""

LEARNED: tuple[type[Learned], ...] = (*LEARNED_TORQUES, LearnedMeshError, *LEARNED_READINGS)
"""All learned forms."""
