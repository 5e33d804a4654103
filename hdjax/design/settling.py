"""Settling time of a drive after the release of a torque."""

from typing import ClassVar

import diffrax as dfx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from hdjax.design.case import Case
from hdjax.design.closed_measures import static_twist
from hdjax.design.measure import Measure, number
from hdjax.dynamics import Model, ReducedModel
from hdjax.effects import ActuatorEffect
from hdjax.parameters import Scalar
from hdjax.signals import PiecewisePolynomial
from hdjax.simulate import march
from hdjax.where import where

_STEPS = 32
_SOFTNESS = 0.5
_NOTHING = 1e-12


class SettlingTime(Measure):
    """Time from the release of a constant mesh torque until the oscillation stays below a band [s].

    The energy of the twist, `v^2/(2 c) + K (x^2/2 + alpha x^4/4)`, decreases monotonically, and the oscillation stays
    below the band once it is below the energy of a static twist of the band's size. It decreases in steps, with
    plateaus at turning points, so that the crossing instant has no useful gradient. The mean over a smoothed crossing
    has one: `integral of sigmoid((log E - log E_band)/s) dt`, which is that instant exactly where E decays
    exponentially.

    Attributes:
        torque: released at the start [N m].
        band: of the dynamic error [rad].
        turns: simulated natural periods; later settling is extrapolated at the mean rate.
    """

    name: ClassVar[str] = "settling_time"
    unit: ClassVar[str] = "s"
    says: ClassVar[str] = "time until the swing after the release of a torque stays within a band"
    torque: Scalar = number()
    band: Scalar = number()
    turns: int = 100

    def refuse(self, case: Case) -> None:
        if not (self.torque != 0.0 and self.band > 0.0):
            raise ValueError(
                f"`settling_time` must have a torque and a positive band, but has {self.torque:g} and {self.band:g}"
            )
        if not (case.drive.mu > 0.0 or case.model.effects):
            raise ValueError(f"`settling_time` needs damping, but B_sp is {case.drive.B_sp:g}: it would swing for ever")
        if any(isinstance(e, ActuatorEffect) for e in case.model.effects):
            raise ValueError("`settling_time` can't carry an effect on the logged torque: nothing drives the motor")

    def __call__(self, case: Case) -> Array:
        drive = case.drive
        twist = static_twist(drive, self.torque)
        duration = self.turns * 2.0 * jnp.pi / drive.omega_0
        time = duration * jnp.linspace(0.0, 1.0, self.turns * _STEPS + 1)
        x, v = _released(case, twist, time)

        def elastic(x: Array) -> Array:
            return drive.K * (0.5 * x**2 + 0.25 * drive.alpha * x**4)

        energy = elastic(x) + 0.5 * v**2 / drive.c
        above = jnp.log(energy / elastic(self.band) + _NOTHING)
        inside = jax.nn.sigmoid(above / _SOFTNESS)
        settled = jnp.sum(0.5 * (inside[1:] + inside[:-1])) * (time[1] - time[0])
        later = duration * above[0] / (above[0] - above[-1])
        # Three smoothing widths below the band the integral has practically ended.
        found = where(above[-1] < -3.0 * _SOFTNESS, settled, later)
        return where(above[-1] < above[0], found, jnp.nan)


def _released(case: Case, twist: Array, time: Array) -> tuple[Array, Array]:
    """Twist of the mesh and its rate from rest at a twist, with no torque."""
    nothing = PiecewisePolynomial(time, jnp.zeros((time.size - 1, 1)))
    zero = jnp.zeros_like(twist)
    model: Model
    if case.model.effects:
        # The twist of the mesh, from which the dynamic error differs by the kinematic error.
        error = case.model.motion(jnp.zeros(4)).x
        model, motion = case.model, jnp.stack([zero, error - twist, zero, zero])
    else:
        model, motion = ReducedModel(case.drive.reduced()), jnp.stack([twist, zero])
    states, end = march(model, nothing, None, model.settled(motion), solver=dfx.Tsit5(), substeps=1)
    states = jnp.concatenate([states, end[None]])
    moving = jax.vmap(model.motion)(states)
    return moving.x, moving.v
