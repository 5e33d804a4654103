"""What the seed document prints in its Tables 1 to 4 and beside its Figure 1, typed from it."""

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
