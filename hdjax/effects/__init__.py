"""Physical effects of harmonic drives, each inside the equations of motion."""

from hdjax.effects.actuation import InputDelay, InputLag, LoggedTorqueLag, TorqueBias, TorqueGain
from hdjax.effects.backlash import Backlash, UndampedBacklash
from hdjax.effects.catalogue import BY_NAME, CATALOGUE, FAMILIES, applicable
from hdjax.effects.cogging import Cogging, SingleOrderCogging
from hdjax.effects.creep import Creep
from hdjax.effects.damping import CubicDamping, DisplacementDamping, QuadraticDamping
from hdjax.effects.dry import DryFriction
from hdjax.effects.effect import (
    ActuatorEffect,
    Conditions,
    Effect,
    LoadSideEffect,
    MeshGeometryEffect,
    MeshTorqueEffect,
    Motion,
    MotorSideEffect,
    Rubbing,
    Scales,
    SensorEffect,
    ShaftEffect,
)
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

__all__ = [
    "ViscousLoadFriction",
    "ViscousMotorFriction",
    "ActuatorEffect",
    "BY_NAME",
    "Backlash",
    "BoucWen",
    "CATALOGUE",
    "Cogging",
    "Conditions",
    "ConservativePositionDependentStiffness",
    "ConstantLoad",
    "CoulombFriction",
    "Creep",
    "CubicDamping",
    "Dahl",
    "DahlMotorFriction",
    "DisplacementDamping",
    "DryFriction",
    "Effect",
    "EncoderOffset",
    "ExtraResonance",
    "FAMILIES",
    "GravityLoad",
    "InputDelay",
    "InputLag",
    "JointTorqueBias",
    "JointTorqueDelay",
    "KinematicError",
    "KinematicHarmonic",
    "KinematicSidebands",
    "LoadDependentFriction",
    "LoadDisturbance",
    "LoadEncoderDelay",
    "LoadEncoderEccentricity",
    "LoadEncoderLag",
    "LoadFriction",
    "LoadInertiaError",
    "LoadSideEffect",
    "LoggedTorqueLag",
    "LuGreLoadFriction",
    "LuGreMeshFriction",
    "LuGreMotorFriction",
    "MaxwellSlip",
    "MeshGeometryEffect",
    "MeshTorqueEffect",
    "Motion",
    "MotorEncoderDelay",
    "MotorEncoderEccentricity",
    "MotorFriction",
    "MotorInertiaError",
    "MotorSideEffect",
    "PositionDependentMeshFriction",
    "PositionDependentMotorFriction",
    "PositionDependentStiffness",
    "QuadraticDamping",
    "QuadraticStiffness",
    "QuinticStiffness",
    "ResonanceBesideLoad",
    "RipplingMotorFriction",
    "Rubbing",
    "Scales",
    "SensorEffect",
    "ShaftEffect",
    "SharpBoucWen",
    "SingleOrderCogging",
    "SmoothKneeStiffness",
    "StribeckLoadFriction",
    "StribeckMotorFriction",
    "ThermalDamping",
    "ThermalMotorFriction",
    "ThermalStiffness",
    "ThreeSlopeStiffness",
    "TorqueBias",
    "TorqueGain",
    "TwoLineDisturbance",
    "UndampedBacklash",
    "applicable",
]
