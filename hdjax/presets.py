"""Drives with published parameters, each number with its source."""

from hdjax.drive import Drive

TORQUE_AMPLITUDE = 10.0
"""Motor torque amplitude of the seed's Table 1 [N m]."""


def hdc_40_050() -> Drive:
    """The seed document's example, HDC-40-050 (Table 1).

    Its alpha of 0.1 rad^-2 causes no visible nonlinearity within the drive's rated twist; vendor tables imply 1e5 to
    4.5e5 rad^-2. With these numbers omega_0 is 385.545 rad/s, where the seed prints 122.5.
    """
    return Drive(N=50.0, J_m=5.26e-4, J_l=5.0e-2, K=7160.0, alpha=0.1, B_sp=0.017)


PRESETS = {"HDC-40-050": hdc_40_050}
"""Functions that create drives with published parameters, by name."""
