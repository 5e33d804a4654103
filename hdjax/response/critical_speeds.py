"""Motor speeds to avoid, at which the kinematic error excites the drive's natural frequency.

The wave generator has two lobes, so that vendors count two error cycles per input revolution (Harmonic Drive, CSG/CSF
catalogue): the first speed to avoid is half the natural frequency.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Array, Bool

from hdjax.drive import Drive
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
        amplitude: its largest deviation from the mean there [rad].
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
        drive: with a free motor; for a motor under a stiff servo use `sqrt(K/J_l)` instead of omega_0.
        orders: error cycles per motor revolution.
    """
    omega_0 = float(drive.omega_0)
    kinds = (("super-harmonic", 1 / 3), ("primary", 1.0), ("sub-harmonic", 3.0))
    found = [CriticalSpeed(f * omega_0 / n, n, kind) for n in orders for kind, f in kinds]
    return sorted(found, key=lambda c: c.speed)


def can_persist(branch: Branch) -> Bool[Array, " points"]:
    """Which motions of a branch can persist, by row.

    Under a periodic forcing the stable ones. With a rotating motor, all except those between two folds: past the
    resonance a free motor at constant torque can't hold its speed (Sommerfeld), but a servo can.
    """
    if branch.system.rotating:
        return branch.valid & (branch.tangents[:, -1] * branch.tangents[0, -1] > 0.0)
    return branch.valid & branch.stable


def speeds_to_avoid(*branches: Branch, limit: float) -> list[SpeedBand]:
    """Bands of speed in which a steady motion that can persist exceeds a limit.

    Args:
        *branches: `frequency_response(model, None, slow, fast, rotating=True)` of a drive with kinematic error, or
            those of [`hdjax.response.from_both_ends`][]; or of any periodic forcing, where speed stands for its
            frequency.
        limit: of the dynamic error's deviation from its mean [rad].
    """
    return _merged([band for branch in branches for band in _bands(branch, limit)])


def _bands(branch: Branch, limit: float) -> list[SpeedBand]:
    """Bands of one branch, a run of its rows each."""
    motions = branch.steady_states
    speed, size, amplitudes = (np.asarray(a) for a in (branch.omega, motions.swing, motions.x.amplitudes))
    lasting = np.asarray(can_persist(branch))
    beyond = np.flatnonzero(lasting & (size > limit))

    def crossing(inside: int, outside: int) -> float:
        """Speed at which the limit is crossed between neighbouring rows, if any."""
        if not 0 <= outside < size.size or not lasting[outside]:
            return float(speed[inside])
        return float(np.interp(limit, size[[outside, inside]], speed[[outside, inside]]))

    found = []
    for run in np.split(beyond, np.flatnonzero(np.diff(beyond) > 1) + 1):
        if not run.size:
            continue
        first, last, top = (int(i) for i in (run[0], run[-1], run[np.argmax(size[run])]))
        at = [crossing(first, first - 1), *speed[run], crossing(last, last + 1)]
        found.append(
            SpeedBand(
                start=float(min(at)),
                end=float(max(at)),
                speed_at_peak=float(speed[top]),
                amplitude=float(size[top]),
                order=int(np.argmax(amplitudes[top])) + 1,
            )
        )
    return found


def _merged(found: list[SpeedBand]) -> list[SpeedBand]:
    """Overlapping bands, merged: several motions coexist at a speed."""
    bands: list[SpeedBand] = []
    for band in sorted(found, key=lambda b: b.start):
        if bands and band.start <= bands[-1].end:
            before = bands.pop()
            larger = max(before, band, key=lambda b: b.amplitude)
            band = dataclasses.replace(larger, start=before.start, end=max(before.end, band.end))
        bands.append(band)
    return bands
