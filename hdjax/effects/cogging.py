"""Cogging and torque ripple: torques on the motor that are locked to its angle, whatever the speed."""

from typing import ClassVar

from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import Effect, Motion, MotorSideEffect, Scales
from hdjax.effects.ripple import Term, amplitude_and_phase, amplitudes_and_phases, ripple, ripples
from hdjax.parameters import Scalar, parameter

SOURCE = "EFFECTS: percent of rated torque; Taghirad and Belanger"
# Low orders of rotor and sensor, then multiples of usual pole pairs and slots.
_SINGLE_ORDERS = (*range(1, 13), 14, 16, 18, 20, 22, 24, 28, 30, 36, 42, 48)


class Cogging(MotorSideEffect):
    """Torque `sum over n = 1, 2, 4 of cos_n cos(n theta_m) + sin_n sin(n theta_m)` on the motor."""

    family: ClassVar[str] = "cogging"
    name: ClassVar[str] = "cogging"
    orders: ClassVar[tuple[int, ...]] = (1, 2, 4)
    drawn_against: ClassVar[str | None] = "theta_m"

    cos_1: Scalar = parameter(0.0, unit="N m", doc="cosine, order 1", source=SOURCE, role="strength")
    sin_1: Scalar = parameter(0.0, unit="N m", doc="sine, order 1", source=SOURCE, role="strength")
    cos_2: Scalar = parameter(0.0, unit="N m", doc="cosine, order 2", source=SOURCE, role="strength")
    sin_2: Scalar = parameter(0.0, unit="N m", doc="sine, order 2", source=SOURCE, role="strength")
    cos_4: Scalar = parameter(0.0, unit="N m", doc="cosine, order 4", source=SOURCE, role="strength")
    sin_4: Scalar = parameter(0.0, unit="N m", doc="sine, order 4", source=SOURCE, role="strength")

    @property
    def _terms(self) -> tuple[Term, ...]:
        return (1, self.cos_1, self.sin_1), (2, self.cos_2, self.sin_2), (4, self.cos_4, self.sin_4)

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        assert motion.theta_m is not None
        return ripples(motion.theta_m, self._terms)

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return amplitudes_and_phases(self._terms, "N m")


class SingleOrderCogging(MotorSideEffect):
    """Torque `cosine cos(n theta_m) + sine sin(n theta_m)` on the motor, of one order: that of its poles and slots."""

    family: ClassVar[str] = "cogging"
    name: ClassVar[str] = "single_order_cogging"
    drawn_against: ClassVar[str | None] = "theta_m"

    cosine: Scalar = parameter(0.0, unit="N m", doc="cosine", source=SOURCE, role="strength")
    sine: Scalar = parameter(0.0, unit="N m", doc="sine", source=SOURCE, role="strength")
    n: Scalar = parameter(unit="1", doc="cycles in a motor revolution", bounds=(0.0, 1e3))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(n=float(n)) for n in _SINGLE_ORDERS)

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        assert motion.theta_m is not None
        return ripple(motion.theta_m, self.n, self.cosine, self.sine)

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return amplitude_and_phase(self.cosine, self.sine, "N m")
