"""Design studies by gradient: objectives and constraints of a drive, its best design, and the proof by brute force."""

from hdjax.design.case import Case as Case
from hdjax.design.case import Excitation as Excitation
from hdjax.design.confirm import Confirmation as Confirmation
from hdjax.design.confirm import confirm as confirm
from hdjax.design.measure import Measure as Measure
from hdjax.design.measures import MEASURES as MEASURES
from hdjax.design.optimise import Optimised as Optimised
from hdjax.design.optimise import Optimum as Optimum
from hdjax.design.optimise import Outcome as Outcome
from hdjax.design.optimise import optimise as optimise
from hdjax.design.robustness import Draws as Draws
from hdjax.design.study import Limit as Limit
from hdjax.design.study import Maker as Maker
from hdjax.design.study import Replaced as Replaced
from hdjax.design.study import Study as Study
from hdjax.design.study import Term as Term
from hdjax.design.variables import Variable as Variable
