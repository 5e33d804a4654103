"""Antiresonance and resonance in the motor's response to its torque, without a model."""

from dataclasses import dataclass

import numpy as np
import scipy.signal
from jaxtyping import Float

COHERENT = 0.9
"""Coherence above which a response counts as linear in its input; assumed."""

# Windows that fill a log, beside those between them: fewer would resolve a close dip and peak better, but be noisier.
_WINDOWS = 4
_FEWEST_SAMPLES = 64
# Least height of a peak or dip over its surroundings [dB]: noise of the response alone made 5.8 dB at most in 120
# simulated logs.
_PROMINENT = 6.0
# Power of the torque over that of its strongest line, above which a line is excited and not leakage (Harris 1978).
_EXCITED = 1e-4


@dataclass(frozen=True)
class Resonances:
    """What the acceleration of the motor by its torque shows in the excited lines.

    Attributes:
        antiresonance: Frequency of its dip [Hz], or None.
        resonance: Frequency of its peak [Hz], or None.
    """

    antiresonance: float | None
    resonance: float | None


def resonances(
    torque: Float[np.ndarray, " n"], acceleration: Float[np.ndarray, " m"], rate: float
) -> Resonances | None:
    """What shows in the frequency response from torque to acceleration.

    Args:
        torque: evenly sampled.
        acceleration: likewise, in any unit.
        rate: samples per second [Hz].

    Returns:
        The most prominent peak, and the most prominent dip below it or in the whole band; None for too short a log.
    """
    count = min(len(torque), len(acceleration))
    length = count // _WINDOWS
    if length < _FEWEST_SAMPLES:
        return None
    u, y = torque[:count], acceleration[:count]
    frequency, S_uy = scipy.signal.csd(u, y, rate, nperseg=length)
    S_uu, S_yy = (scipy.signal.welch(own, rate, nperseg=length)[1] for own in (u, y))
    follows = np.abs(S_uy) ** 2 > COHERENT * S_uu * S_yy
    kept = follows & (S_uu > _EXCITED * np.max(S_uu))
    frequency, level = frequency[kept], 20.0 * np.log10(np.abs(S_uy[kept]) / S_uu[kept])
    peak = _most_prominent(level)
    dip = _most_prominent(-level[:peak])
    return Resonances(*(None if k is None else float(frequency[k]) for k in (dip, peak)))


def _most_prominent(level: Float[np.ndarray, " lines"]) -> int | None:
    places, told = scipy.signal.find_peaks(level, prominence=_PROMINENT)
    return int(places[np.argmax(told["prominences"])]) if len(places) else None
