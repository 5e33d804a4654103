"""hdjax: the dynamic error of harmonic drives, simulated in JAX."""

import os
import sys

# `python -m hdjax` loads JAX here, before the command line can silence XLA (`fitting.commands.start`).
if sys.argv[0] == "-m":
    os.environ.setdefault("TF_CPP_MIN_LOG_LEVEL", "3")

from hdjax.drive import Drive, ReducedDrive
from hdjax.dynamics import Model, ReducedModel, TwoInertiaModel
from hdjax.forcing import Chirp, Harmonic, MultiHarmonic, random_phase_multisine
from hdjax.fourier import FourierSeries, fourier_series, harmonic_series
from hdjax.one_side import LoadDrivenModel, MotorDrivenModel, OneSideModel
from hdjax.presets import PRESETS, hdc_40_050
from hdjax.results import Ending, SimulationError
from hdjax.signals import HOLDS, Hold, PiecewisePolynomial, sampled
from hdjax.simulate import Trajectory, simulate

__all__ = [
    "Chirp",
    "Drive",
    "Ending",
    "FourierSeries",
    "HOLDS",
    "Harmonic",
    "Hold",
    "LoadDrivenModel",
    "Model",
    "MotorDrivenModel",
    "MultiHarmonic",
    "OneSideModel",
    "PRESETS",
    "PiecewisePolynomial",
    "ReducedDrive",
    "ReducedModel",
    "SimulationError",
    "Trajectory",
    "TwoInertiaModel",
    "fourier_series",
    "harmonic_series",
    "hdc_40_050",
    "random_phase_multisine",
    "sampled",
    "simulate",
]
