"""Periodic functions of time as Fourier series: forcings and steady responses."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hdjax.parameters import as_scalar


class FourierSeries(eqx.Module):
    """`mean + sum_k cosine[k-1] cos(k omega t) + sine[k-1] sin(k omega t)`, k = 1 ... harmonics.

    A torque or forcing as a function of time, and the steady-state series `sum_k B_k cos(k omega t + psi_k)` of a
    response. Leading axes of `mean`, `cosine` and `sine` are coordinates.

    Attributes:
        omega: fundamental angular frequency [rad/s].
        mean: mean value.
        cosine: cosine coefficients.
        sine: sine coefficients.
    """

    omega: Array = eqx.field(converter=as_scalar)
    mean: Float[Array, "*coordinates"]
    cosine: Float[Array, "*coordinates harmonics"]
    sine: Float[Array, "*coordinates harmonics"]

    @property
    def harmonics(self) -> int:
        """The highest multiple of omega."""
        return self.cosine.shape[-1]

    @property
    def amplitudes(self) -> Float[Array, "*coordinates harmonics"]:
        """`B_k` of `B_k cos(k omega t + psi_k)`, k = 1 ... harmonics."""
        return jnp.hypot(self.cosine, self.sine)

    @property
    def phases(self) -> Float[Array, "*coordinates harmonics"]:
        """`psi_k` of `B_k cos(k omega t + psi_k)` [rad]; zero where B_k is."""
        # Where there is no wave, the derivative would be NaN, and with it a gradient of the others.
        there = (self.cosine != 0.0) | (self.sine != 0.0)
        return jnp.arctan2(jnp.where(there, -self.sine, 0.0), jnp.where(there, self.cosine, 1.0))

    def __call__(self, t: Array) -> Array:
        """The function at times of any shape; coordinates come last."""
        angles = jnp.tensordot(self.omega * t, jnp.arange(1.0, self.harmonics + 1.0), axes=0)
        waves = jnp.tensordot(jnp.cos(angles), self.cosine, axes=(-1, -1))
        waves += jnp.tensordot(jnp.sin(angles), self.sine, axes=(-1, -1))
        return waves + jnp.broadcast_to(self.mean, waves.shape)

    def derivative(self) -> "FourierSeries":
        """The series of the time derivative."""
        rates = jnp.broadcast_to(self.omega * jnp.arange(1.0, self.harmonics + 1.0), self.sine.shape)
        return FourierSeries(self.omega, jnp.zeros_like(self.mean), rates * self.sine, -rates * self.cosine)

    @eqx.filter_jit
    def largest(self) -> Float[Array, "*coordinates"]:
        """Largest magnitude over a period, between samples too."""

        def of_one(mean: Array, cosine: Array, sine: Array) -> Array:
            wave = FourierSeries(1.0, mean, cosine, sine)
            samples = wave.values(8 * (self.harmonics + 1))
            # From every sample: of two similar maxima, the higher may be further from its nearest sample.
            t = jnp.arange(float(samples.size)) * (2 * jnp.pi / samples.size)
            slope = wave.derivative()
            curvature = slope.derivative()
            # A maximum is within a step of a sample. With vanishing curvature Newton's method would diverge, and phases
            # would lose all digits.
            step = 2 * jnp.pi / samples.size
            for _ in range(3):
                bend = curvature(t)
                leap = jnp.where(bend == 0.0, 0.0, slope(t) / jnp.where(bend == 0.0, 1.0, bend))
                t = t - jnp.clip(leap, -step, step)
            # The slope is zero there, so the instant's derivative does not matter. Newton's method may move from a flat
            # maximum to a minimum.
            tops = jnp.concatenate([wave(jax.lax.stop_gradient(t)), samples])
            return jnp.max(jnp.abs(tops))

        flat = self.mean.reshape(-1), *(c.reshape(-1, self.harmonics) for c in (self.cosine, self.sine))
        return jax.vmap(of_one)(*flat).reshape(self.mean.shape)

    def padded(self, harmonics: int) -> "FourierSeries":
        """The same function, padded with zeros or truncated to `harmonics`."""
        missing = max(0, harmonics - self.harmonics)
        pad = [(0, 0)] * (self.cosine.ndim - 1) + [(0, missing)]
        cosine, sine = (jnp.pad(c, pad)[..., :harmonics] for c in (self.cosine, self.sine))
        return FourierSeries(self.omega, self.mean, cosine, sine)

    def values(self, samples: int) -> Float[Array, "*coordinates samples"]:
        """The function at `samples` equal steps of one period; the first is t = 0."""
        if samples <= 2 * self.harmonics:
            raise ValueError(f"`samples` must be above {2 * self.harmonics}, but is {samples}")
        first = self.mean[..., None]
        real = jnp.concatenate([first, 0.5 * self.cosine], axis=-1)
        imaginary = jnp.concatenate([jnp.zeros_like(first), -0.5 * self.sine], axis=-1)
        return jnp.fft.irfft(jax.lax.complex(real, imaginary) * samples, n=samples, axis=-1)


def harmonic_series(
    omega: ArrayLike,
    amplitudes: ArrayLike,
    phases: ArrayLike | None = None,
    mean: ArrayLike = 0.0,
) -> FourierSeries:
    """`mean + sum_n amplitudes[n-1] cos(n omega t + phases[n-1])`.

    Args:
        omega: fundamental angular frequency [rad/s].
        amplitudes: peak value of each harmonic, or a number for one alone.
        phases: of each harmonic [rad]; zero where not given.
        mean: mean value.
    """
    A = jnp.atleast_1d(jnp.asarray(amplitudes, dtype=float))
    psi = jnp.zeros_like(A) if phases is None else jnp.atleast_1d(jnp.asarray(phases, dtype=float))
    return FourierSeries(omega, as_scalar(mean), A * jnp.cos(psi), -A * jnp.sin(psi))


def fourier_series(
    omega: ArrayLike, samples: Float[Array | np.ndarray, "*coordinates n"], harmonics: int
) -> FourierSeries:
    """The series through samples of one period.

    Args:
        omega: fundamental angular frequency [rad/s].
        samples: the function at equal steps of one period; the first is t = 0.
        harmonics: the highest multiple of omega to keep; fewer than half the samples.
    """
    n = samples.shape[-1]
    if 2 * harmonics >= n:
        raise ValueError(f"`harmonics` must be below {n / 2}, half the samples, but is {harmonics}")
    spectrum = jnp.fft.rfft(jnp.asarray(samples), axis=-1) / n
    kept = 2.0 * spectrum[..., 1 : harmonics + 1]
    return FourierSeries(omega, spectrum[..., 0].real, kept.real, -kept.imag)
