"""A torque that is another in each segment of a log: what a fit takes out to see what moves faster."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.drive import Drive
from hdjax.effects import Effect, LoadSideEffect, Motion, MotorSideEffect, Scales
from hdjax.effects.effect import ShaftEffect
from hdjax.parameters import Scalar, parameter


class SteadyTorque(ShaftEffect):
    """A constant torque on a shaft; a state, and thus fitted to each segment on its own."""

    states: ClassVar[tuple[str, ...]] = ("share",)
    drawn_against: ClassVar[str | None] = None

    reach: Scalar = parameter(unit="N m", doc="torque that it may well have", bounds=(0.0, 1e9))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return ()

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return self.reach * state[0]

    def initial_state(self, motion: Motion | None = None) -> Float[Array, "1"]:
        return jnp.zeros_like(self.reach)[None]

    def state_rates(self, motion: Motion, state: Array) -> Float[Array, "1"]:
        return jnp.zeros_like(self.reach)[None]

    def state_scale(self) -> Float[Array, "1"]:
        return jnp.ones_like(self.reach)[None]


class SteadyLoad(SteadyTorque, LoadSideEffect):
    """On the load."""

    family: ClassVar[str] = "load_disturbance"
    name: ClassVar[str] = "steady_load"


class SteadyMotorTorque(SteadyTorque, MotorSideEffect):
    """On the motor, beside what was logged."""

    family: ClassVar[str] = "motor_friction"
    name: ClassVar[str] = "steady_motor_torque"
