"""All measures by name."""

from hdjax.design.closed_measures import Bistability, MotorSpeed, MotorTorque, ResonanceDistance, StaticTwist
from hdjax.design.identification import IdentificationTime, LargestTwist
from hdjax.design.measure import Measure
from hdjax.design.response_measures import FoldDistance, Loss, MeshTorque, PeakError
from hdjax.design.settling import SettlingTime

MEASURES: dict[str, type[Measure]] = {
    kind.name: kind
    for kind in (
        PeakError,
        MeshTorque,
        Loss,
        SettlingTime,
        FoldDistance,
        Bistability,
        ResonanceDistance,
        StaticTwist,
        MotorTorque,
        MotorSpeed,
        IdentificationTime,
        LargestTwist,
    )
}
"""The measures by their names in a design file."""
