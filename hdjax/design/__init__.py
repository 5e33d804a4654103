"""Design studies by gradient: objectives and constraints of a drive, its optimum, and confirmation by a sweep."""

from hdjax.design.case import Case, Excitation
from hdjax.design.catalogue_gear import CatalogueGear
from hdjax.design.closed_measures import Bistability, MotorSpeed, MotorTorque, ResonanceDistance, StaticTwist
from hdjax.design.confirm import Confirmation, confirm
from hdjax.design.identification import IdentificationTime, LargestTwist
from hdjax.design.measure import Measure
from hdjax.design.measures import MEASURES
from hdjax.design.optimise import Optimised, Optimum, Outcome, optimise
from hdjax.design.response_measures import FoldDistance, Loss, MeshTorque, PeakError
from hdjax.design.robustness import Draws
from hdjax.design.settling import SettlingTime
from hdjax.design.study import Limit, Maker, Replaced, Study, Term, appraise
from hdjax.design.variables import Variable

__all__ = [
    "Bistability",
    "Case",
    "CatalogueGear",
    "Confirmation",
    "Draws",
    "Excitation",
    "FoldDistance",
    "IdentificationTime",
    "LargestTwist",
    "Limit",
    "Loss",
    "MEASURES",
    "Maker",
    "Measure",
    "MeshTorque",
    "MotorSpeed",
    "MotorTorque",
    "Optimised",
    "Optimum",
    "Outcome",
    "PeakError",
    "Replaced",
    "ResonanceDistance",
    "SettlingTime",
    "StaticTwist",
    "Study",
    "Term",
    "Variable",
    "appraise",
    "confirm",
    "optimise",
]
