"""Effects between the logged and the acting torque: sensor gain and bias, delays, lags."""

from typing import ClassVar

from hdjax.effects.effect import ActuatorEffect, Effect, Scales
from hdjax.parameters import Scalar, parameter
from hdjax.signals import PiecewisePolynomial


class TorqueBias(ActuatorEffect):
    """The torque sensor has a zero offset: `T = T_logged + bias`."""

    family: ClassVar[str] = "torque_sensor"
    name: ClassVar[str] = "torque_bias"
    takes_numpy: ClassVar[bool] = True

    bias: Scalar = parameter(
        0.0,
        unit="N m",
        doc="torque that acts when the log says zero",
        source="EFFECTS: percent of rated torque",
        role="strength",
    )

    def actuate(self, logged: PiecewisePolynomial) -> PiecewisePolynomial:
        return logged.affine(1.0, self.bias)


class TorqueGain(ActuatorEffect):
    """The torque sensor has a scale error: `T = (1 + gain_error) T_logged`.

    A reduced drive's gain already is this factor, so there it does not apply.
    """

    family: ClassVar[str] = "torque_sensor"
    name: ClassVar[str] = "torque_gain"
    takes_numpy: ClassVar[bool] = True
    needs_motor: ClassVar[bool] = True
    one_shape_of: ClassVar[str | None] = "T_m"
    corrects: ClassVar[str | None] = "k_T"

    gain_error: Scalar = parameter(
        0.0,
        unit="1",
        doc="relative error of the torque's scale",
        source="EFFECTS: within 10 %",
        plausible=(0.0, 0.1),
        role="strength",
    )

    def actuate(self, logged: PiecewisePolynomial) -> PiecewisePolynomial:
        return logged.affine(1.0 + self.gain_error, 0.0)


class InputDelay(ActuatorEffect):
    """The torque acts later than logged: `T(t) = T_logged(t - delay)`; earlier where the log of the torque is late."""

    family: ClassVar[str] = "input_delay"
    name: ClassVar[str] = "input_delay"
    takes_numpy: ClassVar[bool] = True

    delay: Scalar = parameter(
        0.0,
        unit="s",
        doc="from the logged torque to the torque that acts",
        source="EFFECTS: 0.1 to 3 ms",
        bounds=(-0.1, 0.1),
        plausible=(1e-4, 3e-3),
        role="strength",
    )

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        # At exactly zero the delayed sample changes its interval, and the slope is taken on the wrong side.
        return (cls(delay=1e-9 * scales.time_step),)

    def actuate(self, logged: PiecewisePolynomial) -> PiecewisePolynomial:
        return logged.delayed(self.delay)


class _Lag(ActuatorEffect):
    """A first-order lag between the logged and the acting torque."""

    family: ClassVar[str] = "input_delay"
    takes_numpy: ClassVar[bool] = True

    lag: Scalar = parameter(
        0.0,
        unit="s",
        doc="time constant",
        source="EFFECTS: 0.1 to 3 ms",
        bounds=(0.0, 0.1),
        plausible=(1e-4, 3e-3),
        role="strength",
    )


class InputLag(_Lag):
    """The torque follows the logged one with a first-order lag: `lag T' + T = T_logged`, as a current loop does."""

    name: ClassVar[str] = "input_lag"

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        # At exactly zero the exponential has no derivative.
        return (cls(lag=1e-9 * scales.time_step),)

    def actuate(self, logged: PiecewisePolynomial) -> PiecewisePolynomial:
        return logged.lagged(self.lag)


class LoggedTorqueLag(_Lag):
    """The logged torque follows the one that acts with a first-order lag, as behind a filter:
    `T = T_logged + lag T_logged'`.

    Between the steps of a zero-order hold the logged torque has no rate; there it has no influence.
    """

    name: ClassVar[str] = "logged_torque_lag"

    def actuate(self, logged: PiecewisePolynomial) -> PiecewisePolynomial:
        return logged.unlagged(self.lag)
