"""How far the true equations themselves go astray in a free run whose start is told by a few noisy samples.

A motion that rattles in a gap forgets its start within a second; no model, the true one included, predicts the rest of
the log. An error of a free run means something only beside that.
"""

import numpy as np
from numpy.random import Generator

from undeclared.equations import integrate
from undeclared.mechanism import Mechanism, read_encoders
from undeclared.noise import Encoders

WINDOW = 50
"""Samples of a free run whose readings may be used, for its start."""

_DRAWS = 4
# Steps of the differences by motor angle and rate, load angle and rate.
_STEPS = np.array([1e-6, 1e-4, 1e-8, 1e-6])


def own_error(
    mechanism: Mechanism,
    start: np.ndarray,
    torque: np.ndarray,
    encoders: Encoders,
    random: Generator,
    *,
    dt: float,
    substeps: int,
    brake: np.ndarray,
    warm: np.ndarray,
) -> float:
    """Rms [rad] by which the dynamic error of the true equations is off, from starts as uncertain as the noise of the
    first WINDOW samples leaves them; the memory of the mechanism is known. Median of a few draws.

    Args:
        mechanism: the drive with what is hidden.
        start: true motor angle, motor rate, load angle, load rate.
        torque: as logged; nothing follows a reference here.
        encoders: their noise.
        random: where the draws come from.
        dt: sampling interval [s].
        substeps: solver steps in each.
        brake: torque on the load [N m].
        warm: kelvin above the reference.
    """

    def readings(from_here: np.ndarray, count: int) -> np.ndarray:
        states, _ = integrate(
            mechanism,
            from_here,
            torque[:count],
            dt=dt,
            substeps=substeps,
            brake=brake[:count],
            warm=warm[:count],
        )
        return np.column_stack(read_encoders(mechanism, states))

    ways = np.diag(_STEPS)
    rows = np.stack([(readings(start + way, WINDOW) - readings(start - way, WINDOW)).ravel() for way in ways], axis=1)
    rows /= 2 * np.tile(encoders.rms, WINDOW)[:, None]
    # In units of the steps, which are small beside what the window leaves open.
    spread = np.linalg.pinv(rows)
    weights = np.array([1 / mechanism.ratio, -1.0])
    truth = readings(start, torque.size) @ weights
    errors = []
    for _ in range(_DRAWS):
        drawn = start + _STEPS * (spread @ random.normal(size=len(rows)))
        errors.append(np.sqrt(np.mean((readings(drawn, torque.size) @ weights - truth)[WINDOW:] ** 2)))
    return float(np.median(errors))
