"""Dry friction, with a differentiable law and a sign that is stable in a solver's steps."""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import Effect, LoadSideEffect, MeshTorqueEffect, Motion, MotorSideEffect
from hdjax.parameters import Scalar

# Corner over reach (the change of the rate in a step) at which half of the sign is its mean. The stages then see a
# damper with at most 2.1 in a step; the stability limit of RK4 is 2.78.
_RESOLVED = 1.0 / 3.0
# Smallest corner in a stage, as a share of the reach.
_SHARPEST = 1.0 / 16.0


class DryFriction(Effect):
    """The dry part of an effect: friction `level tanh(rate / corner)` against a rate.

    Near rest this is a damper with the time constant `corner / (level mobility)`, and an explicit solver with longer
    steps would be unstable. In such steps the friction is the level times the sign's mean over the step, which is known
    at its start (see `hdjax.rubbing`): with it a drive stops within a step, sticks, or turns back, and all else keeps
    the solver's order. Shorter steps follow the law at each of their stages.

    Attributes:
        opposes: the rate, a field of [`Motion`][].
    """

    opposes: ClassVar[str]
    # What happens near rest is not specified: a hyperbolic tangent and bristles are two of many laws.
    imperfection: ClassVar[float] = 1e-2

    @property
    @abc.abstractmethod
    def corner(self) -> Scalar:
        """Rate over which the sign turns [rad/s]."""

    @abc.abstractmethod
    def level(self, motion: Motion, drive: Drive | ReducedDrive) -> Array:
        """Magnitude of the torque far from rest [N m]."""

    def dry(self, motion: Motion, drive: Drive | ReducedDrive) -> Array:
        """The torque that opposes the rate [N m]."""
        rate, level = getattr(motion, self.opposes), self.level(motion, drive)
        if motion.rubbing is None:
            return level * jnp.tanh(rate / self.corner)
        held = motion.rubbing[self.opposes]
        sign = jnp.tanh(rate / jnp.maximum(self.corner, _SHARPEST * held.reach))
        corner, reach = self.corner**2, (_RESOLVED * jnp.maximum(held.reach, 0.0)) ** 2
        resolved, unresolved = (corner / (corner + reach)) ** 4, (reach / (corner + reach)) ** 4
        return level * (sign + unresolved / (resolved + unresolved) * (held.sign - sign))


class DryMeshFriction(DryFriction, MeshTorqueEffect):
    """Dry friction between the mesh's two sides."""

    opposes: ClassVar[str] = "v"
    drawn_against: ClassVar[str | None] = "v"

    v_0: eqx.AbstractVar[Scalar]

    @property
    def corner(self) -> Scalar:
        return self.v_0

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return self.dry(motion, drive)


class DryMotorFriction(DryFriction, MotorSideEffect):
    """Dry friction against the motor."""

    opposes: ClassVar[str] = "omega_m"

    transition: eqx.AbstractVar[Scalar]

    @property
    def corner(self) -> Scalar:
        return self.transition

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return -self.dry(motion, drive)


class DryLoadFriction(DryFriction, LoadSideEffect):
    """Dry friction against the load, and viscous friction beside it."""

    opposes: ClassVar[str] = "omega_l"
    contains: ClassVar[tuple[str, ...]] = ("viscous_load_friction",)

    transition: eqx.AbstractVar[Scalar]
    b: eqx.AbstractVar[Scalar]

    @property
    def corner(self) -> Scalar:
        return self.transition

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return -self.dry(motion, drive) - self.b * load_rate(motion)


def dissipative(level: Array) -> Array:
    """A friction's level [N m] where it is positive, and zero elsewhere: friction never drives the motion.

    Args:
        level: mean and ripple of the law.
    """
    # A selection: the slope of a maximum is halved at zero, where screening needs it.
    return jnp.where(level >= 0.0, level, 0.0)


def load_rate(motion: Motion) -> Array:
    """The load's rate, which a reduced drive lacks."""
    assert motion.omega_l is not None
    return motion.omega_l


def motor_rate(motion: Motion) -> Array:
    """The motor's rate, which a reduced drive lacks."""
    assert motion.omega_m is not None
    return motion.omega_m
