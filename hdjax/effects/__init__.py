"""Physical effects that a harmonic drive's log can hide, each inside the equations of motion."""

from hdjax.effects.catalogue import BY_NAME as BY_NAME
from hdjax.effects.catalogue import CATALOGUE as CATALOGUE
from hdjax.effects.catalogue import FAMILIES as FAMILIES
from hdjax.effects.catalogue import applicable as applicable
from hdjax.effects.dry import (
    DryFriction as DryFriction,
)
from hdjax.effects.effect import (
    ActuatorEffect as ActuatorEffect,
)
from hdjax.effects.effect import (
    Conditions as Conditions,
)
from hdjax.effects.effect import (
    Effect as Effect,
)
from hdjax.effects.effect import (
    LoadSideEffect as LoadSideEffect,
)
from hdjax.effects.effect import (
    MeshGeometryEffect as MeshGeometryEffect,
)
from hdjax.effects.effect import (
    MeshTorqueEffect as MeshTorqueEffect,
)
from hdjax.effects.effect import (
    Motion as Motion,
)
from hdjax.effects.effect import (
    MotorSideEffect as MotorSideEffect,
)
from hdjax.effects.effect import (
    Rubbing as Rubbing,
)
from hdjax.effects.effect import (
    Scales as Scales,
)
from hdjax.effects.effect import (
    SensorEffect as SensorEffect,
)
from hdjax.effects.effect import (
    ShaftEffect as ShaftEffect,
)
