"""Measures in closed form."""

from typing import ClassVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

from hdjax.design.case import Case
from hdjax.design.measure import Measure, SpeedRange, number
from hdjax.design.response_measures import outside
from hdjax.drive import Drive, restoring
from hdjax.noise import root
from hdjax.parameters import Scalar
from hdjax.where import where

_STEPS = 40


class StaticTwist(Measure):
    """Twist under a steady torque, the root of `K f(x) = torque` [rad]; NaN where a softening drive has no
    equilibrium."""

    name: ClassVar[str] = "static_twist"
    unit: ClassVar[str] = "rad"
    says: ClassVar[str] = "twist under a steady torque"
    torque: Scalar = number()

    def __call__(self, case: Case) -> Array:
        return static_twist(case.drive, self.torque)


def static_twist(drive: Drive, torque: Scalar) -> Array:
    """Root of `K (x + alpha x^3) = torque` next to zero, with gradients; NaN where there is none."""
    still = jax.lax.stop_gradient(drive)

    def step(_: Array, x: Array) -> Array:
        slope = still.K * (1.0 + 3.0 * still.alpha * x**2)
        return x - (still.K * restoring(x, still.alpha) - torque) / slope

    # From zero, Newton's method overshoots once for a hardening spring and then decreases; for a softening one it
    # increases.
    x = jax.lax.fori_loop(0, _STEPS, step, jnp.zeros_like(still.K))
    slope = still.K * (1.0 + 3.0 * still.alpha * x**2)
    left = drive.K * restoring(x, drive.alpha) - torque
    solved = (jnp.abs(left) <= 1e-9 * jnp.abs(torque)) & (slope > 0.0)
    return where(solved, x - left / where(solved, slope, 1.0), jnp.nan)


class MotorTorque(Measure):
    """Motor torque that moves the load at an acceleration against a torque, `N J_m a + (J_l a + T)/N` [N m]."""

    name: ClassVar[str] = "motor_torque"
    unit: ClassVar[str] = "N m"
    says: ClassVar[str] = "motor torque for a load acceleration against a load torque"
    acceleration: Scalar = number()
    load_torque: Scalar = number(0.0)

    def __call__(self, case: Case) -> Array:
        d, a = case.drive, self.acceleration
        return d.N * d.J_m * a + (d.J_l * a + self.load_torque) / d.N


class MotorSpeed(Measure):
    """Motor speed at a speed of the load, `N omega_l` [rad/s]."""

    name: ClassVar[str] = "motor_speed"
    unit: ClassVar[str] = "rad/s"
    says: ClassVar[str] = "motor speed at a load speed"
    load_speed: Scalar = number()

    def __call__(self, case: Case) -> Array:
        return case.drive.N * self.load_speed


class ResonanceDistance(SpeedRange):
    """Distance of the natural frequency from `order` times a range of speeds, `|log|` of the ratio; negative where a
    speed of the range excites it.

    Over the load's speed where `at_load` is set: the motor, and its orders, then turn N times as fast.
    """

    name: ClassVar[str] = "resonance_distance"
    unit: ClassVar[str] = "1"
    says: ClassVar[str] = "logarithmic distance of the resonance from order times slow to order times fast"
    slow: Scalar = number()
    fast: Scalar = number()
    order: Scalar = number(1.0)
    held: bool = False
    at_load: bool = False

    def refuse(self, case: Case) -> None:
        super().refuse(case)
        if not self.order > 0.0:
            raise ValueError(f"`resonance_distance` must have an order above zero, but has {self.order:g}")

    def __call__(self, case: Case) -> Array:
        d = case.drive
        # With a stiff servo on the motor, the load oscillates on the spring.
        own = jnp.sqrt(d.K / d.J_l) if self.held else d.omega_0
        return outside(own / self.order / (d.N if self.at_load else 1.0), self.slow, self.fast)


class Bistability(Measure):
    """Forcing over the least one at which two stable motions coexist at some frequency, to first order of multiple
    scales; below 1 there are no folds.

    `A_c^2 = 32 mu^3 omega_0 / (9 sqrt(3) |alpha|)` (Nayfeh and Mook 1979, section 4.1, where the response curve first
    has a vertical tangent). Smooth where folds are born, which [`FoldDistance`][] is not. Zero for a linear drive,
    where its infinite slope by alpha counts as zero.
    """

    name: ClassVar[str] = "bistability"
    unit: ClassVar[str] = "1"
    says: ClassVar[str] = "forcing over that at which the response begins to jump"

    def __call__(self, case: Case) -> Array:
        d, torques = case.drive, case.excitation
        A = d.error_forcing(torques.amplitude, torques.load_amplitude)
        least = 32.0 * d.mu**3 * d.omega_0 / (9.0 * jnp.sqrt(3.0))
        return jnp.abs(A) * root(jnp.abs(d.alpha) / least)

    def refuse(self, case: Case) -> None:
        if not case.drive.mu > 0.0:
            raise ValueError(f"`bistability` needs damping, but B_sp is {case.drive.B_sp:g}: any forcing would do")
