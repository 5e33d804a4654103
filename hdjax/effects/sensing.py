"""Errors of the sensors: zero offset, eccentric disc, delay."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import ActuatorEffect, Effect, Scales, SensorEffect
from hdjax.effects.ripple import amplitude_and_phase, ripple
from hdjax.parameters import Scalar, as_scalar, parameter
from hdjax.signals import PiecewisePolynomial

SOURCE = "EFFECTS: 10 um on a disc of 25 to 50 mm are 40 to 80 arcsec"
_PLAUSIBLE = (1.9e-4, 3.9e-4)


class EncoderOffset(SensorEffect):
    """The load's encoder reads `theta_l + offset`: the two encoders were not zeroed with the spring relaxed; no force
    changes."""

    family: ClassVar[str] = "encoder_offset"
    name: ClassVar[str] = "encoder_offset"

    offset: Scalar = parameter(
        0.0,
        unit="rad",
        doc="reading of the load's encoder where the spring is relaxed and the motor at zero",
        role="strength",
    )

    def reading(self, theta_m: Array, theta_l: Array, omega_m: Array, omega_l: Array) -> tuple[Array, Array]:
        return theta_m, theta_l + self.offset


class JointTorqueBias(SensorEffect):
    """The sensor of the joint torque has a zero offset: it reads `tau + bias`."""

    family: ClassVar[str] = "torque_sensor"
    name: ClassVar[str] = "joint_torque_bias"

    bias: Scalar = parameter(0.0, unit="N m", doc="reading of the sensor without a torque", role="strength")

    def torque_reading(self, tau: Array) -> Array:
        return tau + self.bias


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

    @property
    def angles(self) -> frozenset[str]:
        return frozenset(("theta_m",))

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

    @property
    def angles(self) -> frozenset[str]:
        return frozenset(("theta_l",))

    def reading(self, theta_m: Array, theta_l: Array, omega_m: Array, omega_l: Array) -> tuple[Array, Array]:
        return theta_m, theta_l + ripple(theta_l, self.n, self.cosine, self.sine)

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return amplitude_and_phase(self.cosine, self.sine, "rad")


class SensorDelay(SensorEffect):
    """A sensor is read later than the others, by a filter or its way over a bus.

    What all are late by is an `input_delay`.

    Attributes:
        of_load: whether the delay makes the load's encoder later than the motor's, 1, or earlier, -1; else 0.
        of_torque: likewise of the joint torque's sensor.
        moved: the part of the delay by which a log's readings have been moved already [s]; the law spans the rest.
    """

    family: ClassVar[str] = "sensor_delay"
    of_load: ClassVar[int]
    of_torque: ClassVar[int]

    delay: Scalar = parameter(
        0.0,
        unit="s",
        doc="by which the reading is older than its stamp says",
        source="assumed: up to a cycle of a bus or of a filter at 1 kHz",
        bounds=(0.0, 0.1),
        plausible=(1e-5, 1e-3),
        role="strength",
    )
    moved: Scalar = eqx.field(default=0.0, converter=as_scalar, kw_only=True)

    @classmethod
    def typical(cls, scales: Scales) -> tuple[Effect, ...]:
        """Half a row: to first order in it, far too little of a delay may be seen."""
        return (cls(delay=0.5 * scales.time_step),)

    @classmethod
    def imitated(cls, drive: Drive | ReducedDrive, scales: Scales) -> tuple[tuple[dict[str, Array], Effect], ...]:
        """A delay of whole rows between the sides."""
        late = cls.of_load * scales.load_late
        return (({}, cls(delay=late)),) if late > 0.0 else ()

    def load_delay(self) -> Array | None:
        return self.of_load * (self.delay - self.moved) if self.of_load else None

    def torque_delay(self) -> Array | None:
        return self.of_torque * (self.delay - self.moved) if self.of_torque else None


class MotorEncoderDelay(SensorDelay, ActuatorEffect):
    """The motor's sensors read `theta_m(t - delay)`.

    The simulation's time is that of the motor's reading: the torque is as late, and all else is read ahead.
    """

    name: ClassVar[str] = "motor_encoder_delay"
    of_load: ClassVar[int] = -1
    of_torque: ClassVar[int] = -1
    takes_numpy: ClassVar[bool] = True

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        # At exactly zero the delayed sample changes its interval, and the slope is taken on the wrong side.
        return (cls(delay=1e-9 * scales.time_step),)

    def actuate(self, logged: PiecewisePolynomial) -> PiecewisePolynomial:
        return logged.delayed(self.delay)


class LoadEncoderDelay(SensorDelay):
    """The load's sensors read `theta_l(t - delay)`."""

    name: ClassVar[str] = "load_encoder_delay"
    of_load: ClassVar[int] = 1
    of_torque: ClassVar[int] = 0


class LoadEncoderLag(LoadEncoderDelay):
    """The load's sensors read `y` of `delay y' + y = theta_l`, as behind a filter: slow motions are read late by
    `delay`, fast ones are weakened as well."""

    name: ClassVar[str] = "load_encoder_lag"

    def load_lag(self) -> Array | None:
        return self.delay


class JointTorqueDelay(SensorDelay):
    """The sensor of the joint torque reads `tau(t - delay)`."""

    name: ClassVar[str] = "joint_torque_delay"
    of_load: ClassVar[int] = 0
    of_torque: ClassVar[int] = 1
