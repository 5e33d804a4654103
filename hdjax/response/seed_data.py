"""Printed values of the seed document's Tables 1 to 4 and Figure 1."""

from typing import NamedTuple


class PrintedCase(NamedTuple):
    """A row of the seed's Table 2."""

    kind: str
    omega: float
    analytical: float
    numerical: float
    error: float


TABLE_2 = (
    PrintedCase("off-resonance", 100.0, 4.75e-3, 4.80e-3, 1.04),
    PrintedCase("off-resonance", 300.0, 3.20e-3, 3.25e-3, 1.54),
    PrintedCase("primary", 122.5, 1.50e-2, 1.55e-2, 3.23),
    PrintedCase("super-harmonic", 40.83, 9.80e-3, 1.02e-2, 3.92),
    PrintedCase("sub-harmonic", 367.5, 8.50e-3, 8.70e-3, 2.30),
)
"""Frequencies [rad/s], amplitudes [rad], relative error [%]."""

OMEGA_0 = 122.5
"""Natural frequency stated for Table 1, used in Tables 2 and 3 and in the figure [rad/s]."""

FIGURE_1 = (0.05, 122.5, 0.1, 0.01)
"""mu [1/s], omega_0 [rad/s], alpha [rad^-2] and x(0) [rad] of the phase portrait."""


class PrintedDamping(NamedTuple):
    """A row of the seed's Table 3."""

    mu: float
    peak: float
    bandwidth: float
    shift: float


TABLE_3 = (
    PrintedDamping(0.01, 2.10e-2, 0.015, 0.12),
    PrintedDamping(0.05, 1.20e-2, 0.075, 0.10),
    PrintedDamping(0.10, 8.50e-3, 0.150, 0.08),
)
"""Damping [1/s], peak amplitude [rad], half-power bandwidth and nonlinear shift [rad/s]."""


class PrintedSource(NamedTuple):
    """A row of the seed's Table 4, with what is known of the source from elsewhere."""

    source: str
    effect: str
    low: float
    high: float
    known: str


TABLE_4 = (
    PrintedSource(
        "tooth meshing friction", "Coulomb damping", 1e-3, 1e-2, "0.1 to 5 N m over K are 1.4e-5 to 7.0e-4 rad"
    ),
    PrintedSource("flexspline deformation", "cubic stiffness", 1e-4, 1e-3, "alpha x^3 at Table 2's largest amplitude"),
    PrintedSource("assembly imperfections", "periodic forcing", 1e-5, 1e-4, "no published range"),
    PrintedSource(
        "wave generator eccentricity", "harmonic excitation", 1e-4, 1e-3, "vendors: 1.5e-4 to 5.8e-4 rad peak to peak"
    ),
)
"""Magnitudes [rad]."""
