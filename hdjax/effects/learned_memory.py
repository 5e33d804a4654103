"""Nonparametric terms with memory: a learned torque with hidden states.

A function of the present motion ([`hdjax.effects.learned`][]) can't represent a dependence on the past. Two general
laws can. One is linear: a lagging torque with two further states, oscillating or creeping. The other is
rate-independent hysteresis: a torque that depends on the path since the last reversal, not on time.
"""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import (
    Effect,
    LoadSideEffect,
    MeshTorqueEffect,
    Motion,
    MotorSideEffect,
    Scales,
    ShaftEffect,
)
from hdjax.effects.learned import FAMILY, SOURCE
from hdjax.parameters import Scalar, parameter
from hdjax.where import where

DUHEM = "Oh, Bernstein 2005: the rate-independent Duhem model"

# Limit of z in reaches: beyond it the torque returns, and a long step would diverge.
_FAR = 3.0


class LearnedMemory(Effect):
    """A torque against the motion of one angle, with memory, at some place.

    Attributes:
        angle: what it follows, a field of [`hdjax.effects.Motion`][].
        rate: the angle's rate, likewise.
        against: sign of a torque that opposes the angle's motion, in the positive direction of its place.
    """

    family: ClassVar[str] = FAMILY
    angle: ClassVar[str] = "x"
    rate: ClassVar[str] = "v"
    against: ClassVar[float] = 1.0

    @classmethod
    def _moves(cls, motion: Motion) -> Array:
        """Rate of the angle."""
        rate = getattr(motion, cls.rate)
        assert rate is not None
        return rate


class Lagging(LearnedMemory):
    """Torque `k (u - y) + b (u' - y')` against an angle u that y lags behind:

        y'' = omega^2 (u - y) + 2 zeta omega (u' - y')

    States: `y - u`, which stays small on a shaft that turns, and y'.
    """

    states: ClassVar[tuple[str, ...]] = ("lag", "rate")
    # No single quantity is a suitable abscissa.
    drawn_against: ClassVar[str | None] = None

    k: Scalar = parameter(0.0, unit="N m/rad", doc="torque by how far it lags", source=SOURCE, role="strength")
    b: Scalar = parameter(0.0, unit="N m s/rad", doc="torque by how fast the lag grows", source=SOURCE, role="strength")
    omega: Scalar = parameter(
        unit="rad/s", doc="natural frequency of what lags", source=SOURCE, bounds=(0.0, 1e6), role="shape"
    )
    zeta: Scalar = parameter(0.1, unit="1", doc="its damping ratio", source=SOURCE, bounds=(0.0, 1e4), role="shape")
    lag_span: Scalar = parameter(unit="rad", doc="lag that it may start with", bounds=(0.0, 1e9))
    rate_span: Scalar = parameter(unit="rad/s", doc="rate of the lag that it may start with", bounds=(0.0, 1e9))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        base = scales.natural_frequency
        swinging = [(omega, 0.1) for omega in (*scales.residual_frequencies, *(base * 1.25**k for k in range(-7, 8)))]
        # Overdamped proposals. Slower than the longest log it would act as a stiffness.
        creeping = [(base / 3.0**k, 2.0) for k in range(12) if base / 3.0**k * scales.duration > 1.0]
        span = 10.0 * scales.x * base * (scales.reduction_ratio if cls.angle == "theta_m" else 1.0)
        return tuple(
            cls(omega=omega, zeta=zeta, lag_span=span / omega, rate_span=span) for omega, zeta in swinging + creeping
        )

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return -self.against * (self.k * state[0] + self.b * (state[1] - self._moves(motion)))

    def initial_state(self, motion: Motion | None = None) -> Float[Array, "2"]:
        nothing = jnp.zeros_like(self.omega)
        return jnp.stack([nothing, nothing if motion is None else self._moves(motion)])

    def state_rates(self, motion: Motion, state: Array) -> Float[Array, "2"]:
        growth = state[1] - self._moves(motion)
        return jnp.stack([growth, -(self.omega**2) * state[0] - 2 * self.zeta * self.omega * growth])

    def state_scale(self) -> Float[Array, "2"]:
        return jnp.stack([self.lag_span, self.rate_span])

    def stiffness(self, omega: Array, drive: Drive | ReducedDrive) -> Array:
        """Torque against the angle, over the angle, at an angular frequency [N m/rad]; a complex number."""
        own = jax.lax.complex(self.omega**2 - omega**2, 2 * self.zeta * self.omega * omega)
        force = jax.lax.complex(-self.k * omega**2, -self.b * omega**3)
        return force / own


class LaggingMeshTorque(Lagging, MeshTorqueEffect):
    """Torque in the mesh that lags behind the twist."""

    name: ClassVar[str] = "lagging_mesh_torque"


class LaggingShaftTorque(Lagging, ShaftEffect):
    """A lagging torque on a shaft, which may have a share of the shaft's inertia and its own friction: with `- drag
    u'`, any linear torque with two states without a static stiffness.
    """

    against: ClassVar[float] = -1.0

    drag: Scalar = parameter(0.0, unit="N m s/rad", doc="viscous friction beside it", source=SOURCE, role="strength")
    share: Scalar = parameter(
        0.0, unit="1", doc="share of the shaft's inertia that lags", source=SOURCE, role="strength"
    )

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return super().torque(motion, drive, state) - self.drag * self._moves(motion)

    def stiffness(self, omega: Array, drive: Drive | ReducedDrive) -> Array:
        assert isinstance(drive, Drive)
        own = jax.lax.complex(self.inertia_taken(drive) * omega**2, self.drag * omega)
        return super().stiffness(omega, drive) + own


class LaggingMotorTorque(LaggingShaftTorque, MotorSideEffect):
    """Torque on the motor that lags behind its angle."""

    name: ClassVar[str] = "lagging_motor_torque"
    angle: ClassVar[str] = "theta_m"
    rate: ClassVar[str] = "omega_m"

    def inertia_taken(self, drive: Drive) -> Array:
        return self.share * drive.J_m


class LaggingLoadTorque(LaggingShaftTorque, LoadSideEffect):
    """Torque on the load that lags behind its angle."""

    name: ClassVar[str] = "lagging_load_torque"
    angle: ClassVar[str] = "theta_l"
    rate: ClassVar[str] = "omega_l"

    def inertia_taken(self, drive: Drive) -> Array:
        return self.share * drive.J_l


class Yielding(LearnedMemory):
    """Torque `k z` against an angle u, with `z' = u' f(z)` for motion away from zero and `z' = u' f(-z)` for motion
    back.

    With s the deflection z over `reach`, `f = 1 - (1 - bow) s - bow s^2` on the way out, so that z saturates at
    `reach`, and `f = 1 + back |s| + back_bow s^2` on the way back. With `bow = 0, back = 1` it is Dahl's friction, with
    `bow = 0` Bouc-Wen's n = 1, and with `bow = 1, back = 0` its n = 2.
    """

    states: ClassVar[tuple[str, ...]] = ("z",)

    k: Scalar = parameter(0.0, unit="N m/rad", doc="stiffness before it yields", source=DUHEM, role="strength")
    reach: Scalar = parameter(unit="rad", doc="where z saturates", source=DUHEM, bounds=(0.0, 1e3), role="shape")
    bow: Scalar = parameter(0.3, unit="1", doc="how late it yields", source=DUHEM, role="shape")
    back: Scalar = parameter(0.3, unit="1", doc="how much stiffer it is on the way back", source=DUHEM, role="shape")
    back_bow: Scalar = parameter(0.0, unit="1", doc="likewise, by the square", source=DUHEM, role="shape")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        swings = {"x": scales.x, "theta_m": scales.omega_m, "theta_l": scales.omega_l}
        swing = swings[cls.angle] / (1.0 if cls.angle == "x" else scales.natural_frequency)
        return tuple(cls(reach=share * swing) for share in (0.3, 1.0, 3.0, 0.1))

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        return self.against * self.k * state[0]

    def initial_state(self, motion: Motion | None = None) -> Float[Array, "1"]:
        return jnp.zeros_like(self.k)[None]

    def state_rates(self, motion: Motion, state: Array) -> Float[Array, "1"]:
        moves = self._moves(motion)
        s = jnp.clip(jnp.sign(moves) * state[0] / self.reach, -_FAR, _FAR)
        out = 1.0 - (1.0 - self.bow) * s - self.bow * s**2
        back = 1.0 - self.back * s + self.back_bow * s**2
        return (moves * where(s > 0.0, out, back))[None]

    def state_scale(self) -> Float[Array, "1"]:
        return self.reach[None]


class YieldingMeshTorque(Yielding, MeshTorqueEffect):
    """Torque in the mesh that yields to the twist."""

    name: ClassVar[str] = "yielding_mesh_torque"


class YieldingMotorTorque(Yielding, MotorSideEffect):
    """Torque on the motor that yields to its angle."""

    name: ClassVar[str] = "yielding_motor_torque"
    angle: ClassVar[str] = "theta_m"
    rate: ClassVar[str] = "omega_m"
    against: ClassVar[float] = -1.0


class YieldingLoadTorque(Yielding, LoadSideEffect):
    """Torque on the load that yields to its angle."""

    name: ClassVar[str] = "yielding_load_torque"
    angle: ClassVar[str] = "theta_l"
    rate: ClassVar[str] = "omega_l"
    against: ClassVar[float] = -1.0


LEARNED_WITH_MEMORY: tuple[type[LearnedMemory], ...] = (
    LaggingMeshTorque,
    LaggingMotorTorque,
    LaggingLoadTorque,
    YieldingMeshTorque,
    YieldingMotorTorque,
    YieldingLoadTorque,
)
"""All learned forms with memory."""
