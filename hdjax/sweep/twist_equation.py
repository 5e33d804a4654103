"""The equation of the dynamic error, for drives without effects on motor or load."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.drive import Drive, ReducedDrive, restoring
from hdjax.dynamics import Model
from hdjax.effects import Effect, MeshTorqueEffect, Motion
from hdjax.effects.backlash import Backlash
from hdjax.effects.stiffness import QuadraticStiffness, QuinticStiffness, SmoothKneeStiffness, ThreeSlopeStiffness

SPRINGS: tuple[type[Effect], ...] = (
    *(QuadraticStiffness, QuinticStiffness, ThreeSlopeStiffness, SmoothKneeStiffness),
    Backlash,
)
"""Effects whose torque depends on the twist alone."""


class TwistEquation(eqx.Module):
    """`x'' = gain T_m - mu x' - omega_0^2 (x + alpha x^3) - per_torque (effects' torque)`.

    It is exact for two inertias with only the mesh between them.

    Attributes:
        drive: gives mu, omega_0 and alpha.
        effects: torques through the mesh, without memory.
        gain: acceleration of x per unit of forcing.
        per_torque: acceleration of x per unit of mesh torque.
    """

    drive: Drive | ReducedDrive
    effects: tuple[MeshTorqueEffect, ...]
    gain: Float[Array, "*lanes"]
    per_torque: Float[Array, "*lanes"]

    def kick(self, x: Float[Array, "..."]) -> Float[Array, "..."]:
        """Acceleration by the nonlinear part of the spring, if all effects are [`SPRINGS`][]."""
        return -(self.drive.omega_0**2 * (self.drive.alpha * x) * (x * x) + self._beside(x, jnp.zeros_like(x)))

    def acceleration(
        self, x: Float[Array, "..."], v: Float[Array, "..."], push: Float[Array, "..."]
    ) -> Float[Array, "..."]:
        """x'' under an acceleration `push` from outside."""
        spring = self.drive.omega_0**2 * restoring(x, self.drive.alpha)
        return push - self.drive.mu * v - spring - self._beside(x, v)

    def _beside(self, x: Array, v: Array) -> Array:
        """Deceleration by the effects."""
        total = jnp.zeros_like(x)
        for effect in self.effects:
            total = total + self.per_torque * effect.torque(Motion(x=x, v=v), self.drive, jnp.zeros(0, x.dtype))
        return total


def has_twist_equation(model: Model) -> bool:
    """Whether a model moves by [`TwistEquation`][]."""
    return all(isinstance(e, MeshTorqueEffect) and _of_twist(e, model.drive) for e in model.effects)


def _of_twist(effect: MeshTorqueEffect, drive: Drive | ReducedDrive) -> bool:
    """Whether an effect depends on the twist and its rate alone."""
    if effect.states:
        return False
    try:
        jax.eval_shape(lambda x: effect.torque(Motion(x=x, v=x), drive, jnp.zeros(0)), jnp.zeros(()))
    except (AssertionError, ValueError):
        # It needs an angle, the time or the temperature.
        return False
    return True


def twist_equation(model: Model) -> TwistEquation:
    """The equation of the dynamic error of a model that [`has_twist_equation`][]."""
    drive = model.drive
    effects = tuple(e for e in model.effects if isinstance(e, MeshTorqueEffect))
    if isinstance(drive, Drive):
        return TwistEquation(drive, effects, drive.k_T / (drive.N * drive.J_m), drive.c)
    return TwistEquation(drive, effects, drive.gain, jnp.ones_like(drive.gain))
