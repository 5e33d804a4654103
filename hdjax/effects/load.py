"""Unlogged torques on the load: gravity and external torques."""

from itertools import combinations
from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import Effect, LoadSideEffect, Motion, Scales
from hdjax.effects.ripple import amplitude_and_phase, ripple
from hdjax.parameters import Scalar, parameter

# Number of strongest lines that are tried in pairs.
_PAIRED = 4


class GravityLoad(LoadSideEffect):
    """An unbalanced mass on the output: `-(m g r) sin(theta_l + phi)`, kept as sine and cosine parts."""

    family: ClassVar[str] = "gravity_load"
    name: ClassVar[str] = "gravity_load"
    drawn_against: ClassVar[str | None] = "theta_l"
    one_shape_of: ClassVar[str | None] = "theta_l"

    sine: Scalar = parameter(0.0, unit="N m", doc="m g r cos(phi)", source="EFFECTS", role="strength")
    cosine: Scalar = parameter(0.0, unit="N m", doc="m g r sin(phi)", source="EFFECTS", role="strength")

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        assert motion.theta_l is not None
        return -ripple(motion.theta_l, 1, self.cosine, self.sine)

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return {
            "m_g_r": (jnp.hypot(self.sine, self.cosine), "N m"),
            "phi": (jnp.arctan2(self.cosine, self.sine), "rad"),
        }


class ConstantLoad(LoadSideEffect):
    """A torque `constant` on the load."""

    family: ClassVar[str] = "load_disturbance"
    name: ClassVar[str] = "constant_load"
    drawn_against: ClassVar[str | None] = None

    constant: Scalar = parameter(0.0, unit="N m", doc="along +theta_l", source="EFFECTS", role="strength")

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return self.constant


class LoadDisturbance(LoadSideEffect):
    """A torque `constant + cosine cos(omega t) + sine sin(omega t)` on the load, independent of the shafts.

    The time counts from each log's start, and cosine and sine are common to all logs of a drive. For a disturbance that
    continues between logs, the clocks of all but one must be shifted until it is in phase.
    """

    family: ClassVar[str] = "load_disturbance"
    name: ClassVar[str] = "load_disturbance"
    drawn_against: ClassVar[str | None] = None

    constant: Scalar = parameter(0.0, unit="N m", doc="constant part", source="EFFECTS", role="strength")
    cosine: Scalar = parameter(0.0, unit="N m", doc="cosine", source="EFFECTS", role="strength")
    sine: Scalar = parameter(0.0, unit="N m", doc="sine", source="EFFECTS", role="strength")
    omega: Scalar = parameter(unit="rad/s", doc="angular frequency", source="EFFECTS", bounds=(0.0, 1e6), role="shape")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(omega=omega) for omega in scales.residual_frequencies)

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return self.constant + ripple(_time(motion, self.name), self.omega, self.cosine, self.sine)

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        frequency = {"frequency": (self.omega / (2 * jnp.pi), "Hz")}
        return frequency | amplitude_and_phase(self.cosine, self.sine, "N m")


class TwoLineDisturbance(LoadSideEffect):
    """A constant torque and two sinusoids on the load; time and limits as in [`LoadDisturbance`][]."""

    family: ClassVar[str] = "load_disturbance"
    name: ClassVar[str] = "two_line_disturbance"
    drawn_against: ClassVar[str | None] = None

    constant: Scalar = parameter(0.0, unit="N m", doc="constant part", source="EFFECTS", role="strength")
    cos_1: Scalar = parameter(0.0, unit="N m", doc="cosine, first line", source="EFFECTS", role="strength")
    sin_1: Scalar = parameter(0.0, unit="N m", doc="sine, first line", source="EFFECTS", role="strength")
    cos_2: Scalar = parameter(0.0, unit="N m", doc="cosine, second line", source="EFFECTS", role="strength")
    sin_2: Scalar = parameter(0.0, unit="N m", doc="sine, second line", source="EFFECTS", role="strength")
    omega_1: Scalar = parameter(unit="rad/s", doc="first line", source="EFFECTS", bounds=(0.0, 1e6), role="shape")
    omega_2: Scalar = parameter(unit="rad/s", doc="second line", source="EFFECTS", bounds=(0.0, 1e6), role="shape")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(omega_1=a, omega_2=b) for a, b in combinations(scales.residual_frequencies[:_PAIRED], 2))

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        t = _time(motion, self.name)
        first = ripple(t, self.omega_1, self.cos_1, self.sin_1)
        return self.constant + first + ripple(t, self.omega_2, self.cos_2, self.sin_2)

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        lines = (self.omega_1, self.cos_1, self.sin_1), (self.omega_2, self.cos_2, self.sin_2)
        found = {f"frequency_{i}": (omega / (2 * jnp.pi), "Hz") for i, (omega, _, _) in enumerate(lines, start=1)}
        for i, (_, cosine, sine) in enumerate(lines, start=1):
            found |= amplitude_and_phase(cosine, sine, "N m", f"_{i}")
        return found


def _time(motion: Motion, name: str) -> Array:
    if motion.time is None:
        raise ValueError(f"`{name}` needs the time, which must be given to the equations")
    return motion.time
