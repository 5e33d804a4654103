"""The catalogue: every form of every effect that the loop may find, one line each."""

from hdjax.effects.actuation import InputDelay, TorqueBias, TorqueGain
from hdjax.effects.backlash import Backlash
from hdjax.effects.damping import DisplacementDamping, QuadraticDamping
from hdjax.effects.effect import Effect
from hdjax.effects.friction import CoulombFriction, MotorFriction, StribeckMotorFriction
from hdjax.effects.hysteresis import BoucWen
from hdjax.effects.kinematic import KinematicError
from hdjax.effects.load import GravityLoad
from hdjax.effects.stiffness import QuadraticStiffness, QuinticStiffness, ThreeSlopeStiffness

CATALOGUE: tuple[type[Effect], ...] = (
    QuadraticStiffness,
    QuinticStiffness,
    ThreeSlopeStiffness,
    QuadraticDamping,
    DisplacementDamping,
    CoulombFriction,
    MotorFriction,
    StribeckMotorFriction,
    KinematicError,
    TorqueBias,
    TorqueGain,
    InputDelay,
    GravityLoad,
    Backlash,
    BoucWen,
)

BY_NAME: dict[str, type[Effect]] = {form.name: form for form in CATALOGUE}
FAMILIES: tuple[str, ...] = tuple(dict.fromkeys(form.family for form in CATALOGUE))
