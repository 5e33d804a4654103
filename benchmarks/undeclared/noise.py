"""What encoders add: white or coloured noise, and the steps of their scale."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import toeplitz
from scipy.signal import lfilter


@dataclass(frozen=True)
class Encoders:
    """Two encoders. Angles in rad, motor first.

    Attributes:
        noise: rms of the noise before quantisation.
        step: of the scale; 0 where it is too fine to matter.
        memory: correlation of neighbouring samples of the noise's coloured part; 0 is white.
        white: share of the power that is white beside that part.
    """

    noise: tuple[float, float]
    step: tuple[float, float]
    memory: float
    white: float = 1 / 3

    @property
    def rms(self) -> tuple[float, float]:
        """Rms of noise and quantisation."""
        motor, load = (float(np.hypot(n, s / np.sqrt(12))) for n, s in zip(self.noise, self.step, strict=True))
        return motor, load

    def covariances(self, count: int) -> np.ndarray:
        """Covariance of the noise and quantisation of samples in succession, of each encoder (2, count, count)."""
        coloured = (1 - self.white) * self.memory ** np.arange(count) if self.memory else np.zeros(count)
        coloured[0] = 1.0
        alone = np.arange(count) == 0
        return np.stack(
            [toeplitz(n**2 * coloured + s**2 / 12 * alone) for n, s in zip(self.noise, self.step, strict=True)]
        )

    def read(self, readings: np.ndarray, random: np.random.Generator) -> np.ndarray:
        """Recorded readings (samples, 2) of noiseless ones."""
        recorded = np.empty_like(readings)
        for i in range(2):
            noisy = readings[:, i] + self.noise[i] * self._unit_noise(len(readings), random)
            recorded[:, i] = np.round(noisy / self.step[i]) * self.step[i] if self.step[i] else noisy
        return recorded

    def _unit_noise(self, count: int, random: np.random.Generator) -> np.ndarray:
        white = random.normal(size=count)
        if not self.memory:
            return white
        pushed = np.sqrt(1 - self.memory**2) * random.normal(size=count + 500)
        return np.sqrt(self.white) * white + np.sqrt(1 - self.white) * lfilter([1.0], [1.0, -self.memory], pushed)[500:]


def draw_encoders(random: np.random.Generator, *, colour: bool, remembering: bool = False) -> Encoders:
    """A motor encoder with 3e-6 to 2e-5 rad of noise and a load encoder with 0.5e-6 to 2e-6 rad; a third of them with a
    scale of 18 and 22 bit.

    Args:
        random: what is drawn from.
        colour: whether two thirds of the noise have a memory, of 1.4 to 20 samples.
        remembering: whether all of it has one, of 4.5 to 50 samples.
    """
    noise = tuple(float(np.exp(random.uniform(np.log(a), np.log(b)))) for a, b in ((3e-6, 2e-5), (5e-7, 2e-6)))
    step = (2 * np.pi / 2**18, 2 * np.pi / 2**22) if random.uniform() < 1 / 3 else (0.0, 0.0)
    if remembering:
        return Encoders((noise[0], noise[1]), step, float(random.uniform(0.8, 0.98)), white=0.0)
    return Encoders((noise[0], noise[1]), step, float(random.uniform(0.5, 0.95)) if colour else 0.0)
