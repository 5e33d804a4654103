"""What the encoders make of the angles: an eccentric disc, a delay."""

from typing import ClassVar

from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import Effect, Scales, SensorEffect
from hdjax.effects.ripple import amplitude_and_phase, ripple
from hdjax.parameters import Scalar, parameter

SOURCE = "EFFECTS: 10 um on a disc of 25 to 50 mm are 40 to 80 arcsec"
_PLAUSIBLE = (1.9e-4, 3.9e-4)


class MotorEncoderEccentricity(SensorEffect):
    """The motor's encoder reads `theta_m + cosine cos(n theta_m) + sine sin(n theta_m)`; no force changes."""

    family: ClassVar[str] = "encoder_eccentricity"
    name: ClassVar[str] = "motor_encoder_eccentricity"

    cosine: Scalar = parameter(
        0.0, unit="rad", doc="cosine, motor side", source=SOURCE, plausible=_PLAUSIBLE, role="strength"
    )
    sine: Scalar = parameter(
        0.0, unit="rad", doc="sine, motor side", source=SOURCE, plausible=_PLAUSIBLE, role="strength"
    )
    n: Scalar = parameter(1.0, unit="1", doc="cycles in a motor revolution", bounds=(0.0, 1e3))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(n=n) for n in (1.0, 2.0))

    def reading(self, theta_m: Array, theta_l: Array, omega_m: Array, omega_l: Array) -> tuple[Array, Array]:
        return theta_m + ripple(theta_m, self.n, self.cosine, self.sine), theta_l

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return amplitude_and_phase(self.cosine, self.sine, "rad")


class LoadEncoderEccentricity(SensorEffect):
    """The load's encoder reads `theta_l + cosine cos(n theta_l) + sine sin(n theta_l)`; no force changes."""

    family: ClassVar[str] = "encoder_eccentricity"
    name: ClassVar[str] = "load_encoder_eccentricity"

    cosine: Scalar = parameter(
        0.0, unit="rad", doc="cosine, load side", source=SOURCE, plausible=_PLAUSIBLE, role="strength"
    )
    sine: Scalar = parameter(
        0.0, unit="rad", doc="sine, load side", source=SOURCE, plausible=_PLAUSIBLE, role="strength"
    )
    n: Scalar = parameter(1.0, unit="1", doc="cycles in a load revolution", bounds=(0.0, 1e3))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(n=n) for n in (1.0, 2.0))

    def reading(self, theta_m: Array, theta_l: Array, omega_m: Array, omega_l: Array) -> tuple[Array, Array]:
        return theta_m, theta_l + ripple(theta_l, self.n, self.cosine, self.sine)

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return amplitude_and_phase(self.cosine, self.sine, "rad")


class _EncoderDelay(SensorEffect):
    """One encoder is read later than the other, by a filter or its way over a bus.

    To first order in the delay, `theta(t - delay) = theta - delay theta'`: an oscillation at `w` is wrong by
    `(w delay)^2 / 2` of itself. What both encoders are late by is an `input_delay`.
    """

    family: ClassVar[str] = "sensor_delay"

    delay: Scalar = parameter(
        0.0,
        unit="s",
        doc="by which the reading is older than its stamp says",
        source="assumed: up to a cycle of a bus or of a filter at 1 kHz",
        bounds=(0.0, 0.1),
        plausible=(1e-5, 1e-3),
        role="strength",
    )

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return (cls(),)


class MotorEncoderDelay(_EncoderDelay):
    """The motor's encoder reads `theta_m(t - delay)`, to first order in the delay."""

    name: ClassVar[str] = "motor_encoder_delay"

    def reading(self, theta_m: Array, theta_l: Array, omega_m: Array, omega_l: Array) -> tuple[Array, Array]:
        return theta_m - self.delay * omega_m, theta_l


class LoadEncoderDelay(_EncoderDelay):
    """The load's encoder reads `theta_l(t - delay)`, to first order in the delay."""

    name: ClassVar[str] = "load_encoder_delay"

    def reading(self, theta_m: Array, theta_l: Array, omega_m: Array, omega_l: Array) -> tuple[Array, Array]:
        return theta_m, theta_l - self.delay * omega_l
