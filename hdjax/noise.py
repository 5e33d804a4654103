"""Random torques on motor and load."""

import abc

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float, PRNGKeyArray

from hdjax.drive import Drive, ReducedDrive
from hdjax.parameters import Scalar, parameter


class Noise(eqx.Module):
    """Random torque on motor and load, independent of one another.

    Each is a Gaussian process; the two channels are (motor, load) everywhere. A reduced drive takes the first as
    part of its forcing and, as everywhere, no load torque.
    """

    @abc.abstractmethod
    def start(self, key: PRNGKeyArray) -> Float[Array, " own"]:
        """The noise's states at the start, drawn from their stationary distribution."""

    @abc.abstractmethod
    def torques(self, own: Float[Array, " own"]) -> Float[Array, "2"]:
        """The part of the torques given by the noise's states [N m]."""

    @abc.abstractmethod
    def rates(self, own: Float[Array, " own"]) -> Float[Array, " own"]:
        """Time derivative of the noise's states without the random part."""

    @abc.abstractmethod
    def diffusion(self, acceleration: Float[Array, "states 2"]) -> Float[Array, "all 2"]:
        """Diffusion matrix: influence of unit white noise on each channel on the model's states and the noise's states.

        Args:
            acceleration: rate of the model's states per unit of torque on each channel.
        """


class WhiteNoise(Noise):
    """White torque noise, `<w(t) w(t')> = S delta(t - t')`.

    S is the two-sided spectral density per hertz: a one-sided density, as most analysers show, is 2 S, and a
    two-sided one per rad/s is `S/(2 pi)`. Independent samples of variance `sigma^2`, each held for h, have
    `S = sigma^2 h` at frequencies far below 1/h. For a reduced drive the forcing's unit takes the place of N m.
    """

    intensity: Scalar = parameter(0.0, unit="(N m)^2 s", doc="intensity S of the motor torque's noise", role="strength")
    load_intensity: Scalar = parameter(
        0.0, unit="(N m)^2 s", doc="intensity S of the load torque's noise", role="strength"
    )

    def __check_init__(self):
        _refuse_negative("intensity", self.intensity)
        _refuse_negative("load_intensity", self.load_intensity)

    def error_intensity(self, drive: Drive | ReducedDrive) -> Scalar:
        """Intensity of the noise in the forcing of the dynamic error [rad^2/s^3].

        `S_m (k_T/(N J_m))^2 + S_l/J_l^2`, or `gain^2 S_m` of a reduced drive: independent torques add in power.
        """
        motor, load = _error_gains(drive)
        return motor**2 * self.intensity + load**2 * self.load_intensity

    def start(self, key: PRNGKeyArray) -> Float[Array, "0"]:
        return jnp.zeros(0)

    def torques(self, own: Float[Array, "0"]) -> Float[Array, "2"]:
        return jnp.zeros(2)

    def rates(self, own: Float[Array, "0"]) -> Float[Array, "0"]:
        return own

    def diffusion(self, acceleration: Float[Array, "states 2"]) -> Float[Array, "states 2"]:
        return acceleration * root(jnp.stack([self.intensity, self.load_intensity]))[None, :]


class ColouredNoise(Noise):
    """Exponentially correlated torque noise (Ornstein-Uhlenbeck), `<w(t) w(t')> = rms^2 exp(-|t -
    t'|/correlation_time)`.

    White noise of intensity `2 rms^2 correlation_time` through a first-order lag; the torques are two more states.
    For a reduced drive the forcing's unit takes the place of N m.
    """

    rms: Scalar = parameter(0.0, unit="N m", doc="root mean square of the motor torque's noise", role="strength")
    load_rms: Scalar = parameter(0.0, unit="N m", doc="root mean square of the load torque's noise", role="strength")
    correlation_time: Scalar = parameter(unit="s", doc="correlation time", bounds=(0.0, 1e9), role="shape")

    def __check_init__(self):
        _refuse_negative("rms", self.rms)
        _refuse_negative("load_rms", self.load_rms)
        if not isinstance(self.correlation_time, Tracer) and not self.correlation_time > 0.0:
            raise ValueError(f"`correlation_time` must be above zero, but is {self.correlation_time} s")

    @property
    def white(self) -> WhiteNoise:
        """Equivalent white noise for a drive much slower than `correlation_time`."""
        twice = 2.0 * self.correlation_time
        return WhiteNoise(intensity=twice * self.rms**2, load_intensity=twice * self.load_rms**2)

    def error_rms(self, drive: Drive | ReducedDrive) -> Scalar:
        """Root mean square of the noise in the forcing of the dynamic error [rad/s^2]."""
        motor, load = _error_gains(drive)
        return root((motor * self.rms) ** 2 + (load * self.load_rms) ** 2)

    def start(self, key: PRNGKeyArray) -> Float[Array, "2"]:
        return self._strengths * jax.random.normal(key, (2,))

    def torques(self, own: Float[Array, "2"]) -> Float[Array, "2"]:
        return own

    def rates(self, own: Float[Array, "2"]) -> Float[Array, "2"]:
        return -own / self.correlation_time

    def diffusion(self, acceleration: Float[Array, "states 2"]) -> Float[Array, "all 2"]:
        onto_own = jnp.diag(self._strengths * jnp.sqrt(2.0 / self.correlation_time))
        return jnp.concatenate([jnp.zeros_like(acceleration), onto_own])

    @property
    def _strengths(self) -> Float[Array, "2"]:
        return jnp.stack([self.rms, self.load_rms])


def _refuse_negative(name: str, value: Array) -> None:
    if not isinstance(value, Tracer) and not value >= 0.0:
        raise ValueError(f"`{name}` must not be negative, but is {value}")


def root(x: Float[Array, "..."]) -> Float[Array, "..."]:
    """Square root with zero slope at zero and below, to avoid NaN without noise."""
    positive = x > 0.0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, x, 1.0)), 0.0)


def _error_gains(drive: Drive | ReducedDrive) -> tuple[Array, Array]:
    """Magnitude of the forcing of the dynamic error per unit of torque on motor and load."""
    if isinstance(drive, ReducedDrive):
        return drive.gain, jnp.zeros_like(drive.gain)
    return drive.k_T / (drive.N * drive.J_m), 1.0 / drive.J_l
