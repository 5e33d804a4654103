"""hdjax: the dynamic error of harmonic drives, simulated in JAX."""

from hdjax.drive import Drive as Drive
from hdjax.drive import ReducedDrive as ReducedDrive
from hdjax.dynamics import (
    Model as Model,
)
from hdjax.dynamics import (
    MotorDrivenModel as MotorDrivenModel,
)
from hdjax.dynamics import (
    ReducedModel as ReducedModel,
)
from hdjax.dynamics import (
    TwoInertiaModel as TwoInertiaModel,
)
from hdjax.forcing import (
    Chirp as Chirp,
)
from hdjax.forcing import (
    Harmonic as Harmonic,
)
from hdjax.forcing import (
    MultiHarmonic as MultiHarmonic,
)
from hdjax.forcing import (
    random_phase_multisine as random_phase_multisine,
)
from hdjax.fourier import (
    FourierSeries as FourierSeries,
)
from hdjax.fourier import (
    fourier_series as fourier_series,
)
from hdjax.fourier import (
    harmonic_series as harmonic_series,
)
from hdjax.presets import PRESETS as PRESETS
from hdjax.presets import hdc_40_050 as hdc_40_050
from hdjax.results import Ending as Ending
from hdjax.results import SimulationError as SimulationError
from hdjax.signals import (
    HOLDS as HOLDS,
)
from hdjax.signals import (
    Hold as Hold,
)
from hdjax.signals import (
    PiecewisePolynomial as PiecewisePolynomial,
)
from hdjax.signals import (
    sampled as sampled,
)
from hdjax.simulate import Trajectory as Trajectory
from hdjax.simulate import simulate as simulate
