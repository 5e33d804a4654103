"""The response to harmonic forcing: analytic, by harmonic balance, and in the time domain.

Plots are in `hdjax.response.plots`, which imports matplotlib.
"""

from hdjax.response.amplitudes import AmplitudeCheck, AmplitudeRow, ErrorMap, check_amplitudes, error_map, settled
from hdjax.response.attractors import Attractor, Basins, attractors
from hdjax.response.coexisting import from_both_ends
from hdjax.response.continuation import Branch, follow, frequency_response
from hdjax.response.critical_speeds import CriticalSpeed, SpeedBand, can_persist, critical_speeds, speeds_to_avoid
from hdjax.response.floquet import is_stable, multipliers
from hdjax.response.fold import Folds, FoldTrack, folds, follow_fold
from hdjax.response.harmonic_balance import SteadyState, balance, solve
from hdjax.response.lyapunov import PhasePortrait, critical_energy, energy, in_basin_estimate, phase_portrait, saddle
from hdjax.response.multiple_scales import (
    PrimaryResonance,
    SteadyStates,
    SubharmonicResonance,
    SuperharmonicResonance,
    backbone_slope,
    first_order,
    second_order,
)
from hdjax.response.poincare import PoincareSection, bifurcation_diagram, period_of, poincare_section
from hdjax.response.resonance import Backbone, Peak, backbone, peak
from hdjax.response.several_harmonics import Combination, CombinationResonance, OffResonance, combination_resonances
from hdjax.response.shooting import PeriodicOrbit, shoot, steady_series
from hdjax.response.swept_sine import SweptSine, hysteresis_band, swept_sine

__all__ = [
    "AmplitudeCheck",
    "AmplitudeRow",
    "Attractor",
    "Backbone",
    "Basins",
    "Branch",
    "Combination",
    "CombinationResonance",
    "CriticalSpeed",
    "ErrorMap",
    "FoldTrack",
    "Folds",
    "OffResonance",
    "Peak",
    "PeriodicOrbit",
    "PhasePortrait",
    "PoincareSection",
    "PrimaryResonance",
    "SpeedBand",
    "SteadyState",
    "SteadyStates",
    "SubharmonicResonance",
    "SuperharmonicResonance",
    "SweptSine",
    "attractors",
    "backbone",
    "backbone_slope",
    "balance",
    "bifurcation_diagram",
    "can_persist",
    "check_amplitudes",
    "combination_resonances",
    "critical_energy",
    "critical_speeds",
    "energy",
    "error_map",
    "first_order",
    "folds",
    "follow",
    "follow_fold",
    "frequency_response",
    "from_both_ends",
    "hysteresis_band",
    "in_basin_estimate",
    "is_stable",
    "multipliers",
    "peak",
    "period_of",
    "phase_portrait",
    "poincare_section",
    "saddle",
    "second_order",
    "settled",
    "shoot",
    "solve",
    "speeds_to_avoid",
    "steady_series",
    "swept_sine",
]
