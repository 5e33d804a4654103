"""The catalogue: all forms of effects, one line each."""

from collections.abc import Sequence

from hdjax.effects.actuation import InputDelay, InputLag, LoggedTorqueLag, TorqueBias, TorqueGain
from hdjax.effects.backlash import Backlash, UndampedBacklash
from hdjax.effects.cogging import Cogging, SingleOrderCogging
from hdjax.effects.creep import Creep
from hdjax.effects.damping import CubicDamping, DisplacementDamping, QuadraticDamping
from hdjax.effects.effect import Effect, Scales
from hdjax.effects.friction import (
    CoulombFriction,
    LoadDependentFriction,
    LoadFriction,
    MotorFriction,
    StribeckLoadFriction,
    StribeckMotorFriction,
    ViscousLoadFriction,
    ViscousMotorFriction,
)
from hdjax.effects.hysteresis import BoucWen, Dahl, MaxwellSlip, SharpBoucWen
from hdjax.effects.inertia import LoadInertiaError, MotorInertiaError
from hdjax.effects.kinematic import KinematicError, KinematicHarmonic, KinematicSidebands
from hdjax.effects.load import ConstantLoad, GravityLoad, LoadDisturbance, TwoLineDisturbance
from hdjax.effects.position import (
    ConservativePositionDependentStiffness,
    PositionDependentMeshFriction,
    PositionDependentMotorFriction,
    PositionDependentStiffness,
    RipplingMotorFriction,
)
from hdjax.effects.presliding import DahlMotorFriction, LuGreLoadFriction, LuGreMeshFriction, LuGreMotorFriction
from hdjax.effects.resonance import ExtraResonance, ResonanceBesideLoad
from hdjax.effects.sensing import (
    EncoderOffset,
    JointTorqueBias,
    JointTorqueDelay,
    LoadEncoderDelay,
    LoadEncoderEccentricity,
    LoadEncoderLag,
    MotorEncoderDelay,
    MotorEncoderEccentricity,
)
from hdjax.effects.stiffness import QuadraticStiffness, QuinticStiffness, SmoothKneeStiffness, ThreeSlopeStiffness
from hdjax.effects.thermal import ThermalDamping, ThermalMotorFriction, ThermalStiffness

CATALOGUE: tuple[type[Effect], ...] = (
    QuadraticStiffness,
    QuinticStiffness,
    ThreeSlopeStiffness,
    SmoothKneeStiffness,
    QuadraticDamping,
    CubicDamping,
    DisplacementDamping,
    CoulombFriction,
    LoadDependentFriction,
    LuGreMeshFriction,
    MotorFriction,
    ViscousMotorFriction,
    StribeckMotorFriction,
    DahlMotorFriction,
    LuGreMotorFriction,
    LoadFriction,
    ViscousLoadFriction,
    StribeckLoadFriction,
    LuGreLoadFriction,
    KinematicError,
    KinematicHarmonic,
    KinematicSidebands,
    TorqueBias,
    TorqueGain,
    JointTorqueBias,
    MotorInertiaError,
    LoadInertiaError,
    InputDelay,
    InputLag,
    LoggedTorqueLag,
    MotorEncoderDelay,
    LoadEncoderDelay,
    LoadEncoderLag,
    JointTorqueDelay,
    GravityLoad,
    ConstantLoad,
    LoadDisturbance,
    TwoLineDisturbance,
    Backlash,
    UndampedBacklash,
    BoucWen,
    SharpBoucWen,
    Dahl,
    MaxwellSlip,
    Creep,
    Cogging,
    SingleOrderCogging,
    PositionDependentStiffness,
    ConservativePositionDependentStiffness,
    PositionDependentMotorFriction,
    RipplingMotorFriction,
    PositionDependentMeshFriction,
    ExtraResonance,
    ResonanceBesideLoad,
    ThermalStiffness,
    ThermalDamping,
    ThermalMotorFriction,
    EncoderOffset,
    MotorEncoderEccentricity,
    LoadEncoderEccentricity,
)

"""All forms. Of two with equal gain, the earlier one is preferred."""

BY_NAME: dict[str, type[Effect]] = {form.name: form for form in CATALOGUE}
"""The forms by their names."""
FAMILIES: tuple[str, ...] = tuple(dict.fromkeys(form.family for form in CATALOGUE))
"""The families, each once."""


def applicable(
    catalogue: Sequence[type[Effect]], scales: Scales, *, has_motor: bool
) -> dict[type[Effect], tuple[Effect, ...]]:
    """The forms that are observable in logs of these scales, each with its proposals.

    Omitted are forms that need the motor's motion on a reduced drive, a changing temperature, or a line in the
    residual, where these are missing.

    Args:
        catalogue: forms to choose from.
        scales: of the measured motion.
        has_motor: whether the model has the motion of motor and load, unlike a reduced one.
    """
    found = {form: form.proposals(scales) for form in catalogue if has_motor or not form.needs_motor}
    return {form: proposals for form, proposals in found.items() if proposals}
