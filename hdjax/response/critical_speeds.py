"""Which motor speeds to avoid: where the kinematic error's cycles meet the drive's natural frequency.

The wave generator has two lobes, so that vendors count two error cycles per input revolution (Harmonic Drive, CSG/CSF
catalogue): the first speed to avoid is half the natural frequency.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdjax.drive import Drive
from hdjax.fourier import FourierSeries
from hdjax.response.continuation import Branch

ORDERS = (1, 2, 4)


@dataclasses.dataclass(frozen=True)
class CriticalSpeed:
    """A motor speed at which an error's cycles excite a resonance of the drive at small amplitude.

    Attributes:
        speed: motor rate [rad/s].
        order: error cycles per motor revolution.
        kind: `"primary"`, `"super-harmonic"` (a third of it) or `"sub-harmonic"` (three times it).
    """

    speed: float
    order: int
    kind: str


@dataclasses.dataclass(frozen=True)
class SpeedBand:
    """A band of motor speeds in which the dynamic error is too large.

    Attributes:
        start: motor rate [rad/s].
        end: motor rate [rad/s].
        speed_at_peak: where the error is largest [rad/s].
        amplitude: its largest swing about the mean there [rad].
        order: the harmonic of the motor revolution that is largest there.
    """

    start: float
    end: float
    speed_at_peak: float
    amplitude: float
    order: int


def critical_speeds(drive: Drive, orders: Sequence[int] = ORDERS) -> list[CriticalSpeed]:
    """Speeds at which error cycles meet the natural frequency, its third or its triple, rising.

    Args:
        drive: with the motor free to swing; a motor that a servo holds stiffly has `sqrt(K/J_l)` in omega_0's place.
        orders: error cycles per motor revolution.
    """
    omega_0 = float(drive.omega_0)
    kinds = (("super-harmonic", 1 / 3), ("primary", 1.0), ("sub-harmonic", 3.0))
    found = [CriticalSpeed(f * omega_0 / n, n, kind) for n in orders for kind, f in kinds]
    return sorted(found, key=lambda c: c.speed)


def swing(branch: Branch) -> Float[Array, " points"]:
    """Largest distance of the dynamic error from its mean, by row [rad]."""

    def of_one(x: FourierSeries) -> Array:
        return FourierSeries(x.omega, jnp.zeros_like(x.mean), x.cosine, x.sine).largest()

    return jax.vmap(of_one)(branch.steady_states.x)


def speeds_to_avoid(branch: Branch, limit: float) -> list[SpeedBand]:
    """Bands of speed in which a steady motion swings further than a limit.

    Of a motor under a periodic forcing only stable motions count. Where the motor rotates every motion does: past the
    resonance a free motor at constant torque can't hold its speed (Sommerfeld), but a servo can.

    Args:
        branch: `frequency_response(model, None, slow, fast, rotating=True)` of a drive with kinematic error; or of any
            periodic forcing, where speed stands for its frequency.
        limit: of the dynamic error's swing about its mean [rad].
    """
    rotating = branch.system.rotating
    keep = np.asarray(branch.valid if rotating else branch.valid & branch.stable)
    order = np.argsort(np.asarray(branch.omega)[keep], kind="stable")
    speed, size, amplitudes = (
        np.asarray(a)[keep][order] for a in (branch.omega, swing(branch), branch.steady_states.x.amplitudes)
    )
    beyond = np.flatnonzero(size > limit)
    bands = []
    for group in np.split(beyond, np.flatnonzero(np.diff(beyond) > 1) + 1):
        if group.size:
            top = group[np.argmax(size[group])]
            bands.append(
                SpeedBand(
                    float(speed[group[0]]),
                    float(speed[group[-1]]),
                    float(speed[top]),
                    float(size[top]),
                    int(np.argmax(amplitudes[top])) + 1,
                )
            )
    return bands
