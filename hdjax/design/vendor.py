"""Gears from a vendor's table: stiffness as a smooth function of size.

Harmonic Drive's CSF, CSG and HFUC catalogues give the torsional stiffness of each size in three slopes, K1 up to the
torque T1, K2 up to T2, and K3. Higher ratios than 50 are stiffer there; the table of ratio 50 is conservative.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

SOURCE = "Harmonic Drive CSF/CSG/HFUC catalogues, torsional stiffness, ratio 50"
SIZES = (14, 17, 20, 25, 32, 40, 50, 65)
RATIOS = (50, 80, 100, 120, 160)
"""Reduction ratios that most sizes are sold with (same catalogues)."""

_T1 = np.array([2.0, 3.9, 7.0, 14.0, 29.0, 54.0, 108.0, 235.0])
_T2 = np.array([6.9, 12.0, 25.0, 48.0, 108.0, 196.0, 382.0, 843.0])
_K1 = 1e4 * np.array([0.34, 0.81, 1.3, 2.5, 5.4, 10.0, 20.0, 44.0])
_K2 = 1e4 * np.array([0.47, 1.1, 1.8, 3.4, 7.8, 14.0, 28.0, 61.0])
# Cubic from the slopes: K1 is the slope at zero, and the torque at T2 is equal.
_TWIST_2 = _T1 / _K1 + (_T2 - _T1) / _K2
_ALPHA = (_T2 / (_K1 * _TWIST_2) - 1.0) / _TWIST_2**2


class Gear(NamedTuple):
    """A gear of the table, or between two of them.

    Attributes:
        K: stiffness at zero twist, the table's K1 [N m/rad].
        alpha: cubic coefficient with which the torque at T2 is met [rad^-2].
        rated: T2, up to which the cubic represents the table [N m].
    """

    K: Array
    alpha: Array
    rated: Array


def gear(size: ArrayLike) -> Gear:
    """The gear of a size; between sizes, and beyond the last, by straight lines of logarithms.

    A size between two of the table is not for sale: it only indicates a direction.

    Args:
        size: nominal size, 14 to 65.
    """
    at = jnp.log(jnp.asarray(size, dtype=float))
    sizes = np.log(np.array(SIZES, dtype=float))

    def between(column: np.ndarray) -> Array:
        return jnp.exp(jnp.interp(at, sizes, np.log(column), left="extrapolate", right="extrapolate"))

    return Gear(between(_K1), between(_ALPHA), between(_T2))
