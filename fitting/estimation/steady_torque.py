"""A torque that is constant in each segment of a log, to remove slow disturbances from a fit."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.drive import Drive
from hdjax.effects import Effect, LoadSideEffect, Motion, MotorSideEffect, Scales
from hdjax.effects.effect import ShaftEffect
from hdjax.parameters import Scalar, parameter


class SteadyTorque(ShaftEffect):
    """A constant torque on a shaft; it is a state, and thus fitted to each segment separately."""

    states: ClassVar[tuple[str, ...]] = ("share",)
    drawn_against: ClassVar[str | None] = None

    reach: Scalar = parameter(unit="N m", doc="typical size of the torque", bounds=(0.0, 1e9))

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
    """A constant torque on the load."""

    family: ClassVar[str] = "load_disturbance"
    name: ClassVar[str] = "steady_load"


class SteadyMotorTorque(SteadyTorque, MotorSideEffect):
    """A constant torque on the motor, in addition to the logged one."""

    family: ClassVar[str] = "motor_friction"
    name: ClassVar[str] = "steady_motor_torque"
