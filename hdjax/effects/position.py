"""Stiffness and friction that depend on the motor angle."""

import abc
from typing import ClassVar

from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive, restoring
from hdjax.effects.dry import DryMeshFriction, DryMotorFriction, dissipative
from hdjax.effects.effect import Effect, MeshTorqueEffect, Motion, Scales
from hdjax.effects.ripple import Term, amplitude_and_phase, amplitudes_and_phases, ripple, ripple_slope, ripples
from hdjax.parameters import Scalar, parameter

_ORDERS = (1.0, 2.0, 4.0)


class PositionDependentStiffness(MeshTorqueEffect):
    """Torque `K f(x) (cosine cos(n theta_m) + sine sin(n theta_m))`: a stiffness with a ripple over the motor angle.

    As in the literature, without the small torque of such a spring on the motor.
    """

    family: ClassVar[str] = "position_dependent_stiffness"
    name: ClassVar[str] = "position_dependent_stiffness"
    needs_motor: ClassVar[bool] = True
    drawn_against: ClassVar[str | None] = "theta_m"

    cosine: Scalar = parameter(
        0.0,
        unit="1",
        doc="relative stiffness ripple, cosine",
        source="EFFECTS: 1e-3 to 1e-1",
        plausible=(1e-3, 1e-1),
        role="strength",
    )
    sine: Scalar = parameter(
        0.0,
        unit="1",
        doc="relative stiffness ripple, sine",
        source="EFFECTS: 1e-3 to 1e-1",
        plausible=(1e-3, 1e-1),
        role="strength",
    )
    n: Scalar = parameter(2.0, unit="1", doc="cycles in a motor revolution", bounds=(0.0, 1e3))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(n=n) for n in _ORDERS)

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        assert motion.theta_m is not None
        share = ripple(motion.theta_m, self.n, self.cosine, self.sine)
        return drive.stiffness * restoring(motion.x, drive.alpha) * share

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return amplitude_and_phase(self.cosine, self.sine, "1")


class ConservativePositionDependentStiffness(PositionDependentStiffness):
    """The same ripple r(theta_m) of a conservative spring.

    With the energy `K F(x) r(theta_m)`, where `F' = f`, there is a torque `-K F(x) r'(theta_m)` on the motor. It is
    about `n N x / 2` times the ripple's mesh torque there.
    """

    name: ClassVar[str] = "conservative_position_dependent_stiffness"

    def reaction(self, motion: Motion, drive: Drive) -> Array:
        assert motion.theta_m is not None
        x_squared = motion.x * motion.x
        stored = drive.stiffness * x_squared * (0.5 + 0.25 * drive.alpha * x_squared)
        return -stored * ripple_slope(motion.theta_m, self.n, self.cosine, self.sine)


class _MotorFrictionOverAngle(DryMotorFriction):
    """Friction `max(T_c + ripple(theta_m), 0) sgn(omega_m)` against the motor.

    The ripple changes its sign with the direction, unlike cogging.
    """

    family: ClassVar[str] = "position_dependent_friction"
    drawn_against: ClassVar[str | None] = "theta_m"

    T_c: Scalar = parameter(
        0.0,
        unit="N m",
        doc="mean Coulomb torque at the motor",
        source="Tuttle 1992",
        bounds=(0.0, 1e3),
        role="strength",
    )

    @abc.abstractmethod
    def _ripple(self, theta_m: Array) -> Array:
        """Angle-dependent part of the Coulomb torque [N m]."""

    def level(self, motion: Motion, drive: Drive | ReducedDrive) -> Array:
        assert motion.theta_m is not None
        return dissipative(self.T_c + self._ripple(motion.theta_m))


class PositionDependentMotorFriction(_MotorFrictionOverAngle):
    """Friction `max(T_c + cosine cos(n theta_m) + sine sin(n theta_m), 0) sgn(omega_m)` against the motor: one n."""

    name: ClassVar[str] = "position_dependent_motor_friction"
    named_for: ClassVar[tuple[str, ...]] = ("cosine", "sine")

    cosine: Scalar = parameter(0.0, unit="N m", doc="ripple, cosine", source="Tuttle 1992", role="strength")
    sine: Scalar = parameter(0.0, unit="N m", doc="ripple, sine", source="Tuttle 1992", role="strength")
    n: Scalar = parameter(2.0, unit="1", doc="cycles in a motor revolution", bounds=(0.0, 1e3))
    transition: Scalar = parameter(unit="rad/s", doc="rate over which the sign turns", bounds=(0.0, 1e4), role="shape")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(n=n, transition=0.01 * scales.omega_m) for n in _ORDERS)

    def _ripple(self, theta_m: Array) -> Array:
        return ripple(theta_m, self.n, self.cosine, self.sine)

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return amplitude_and_phase(self.cosine, self.sine, "N m")


class RipplingMotorFriction(_MotorFrictionOverAngle):
    """Friction `max(T_c + sum over n of cos_n cos(n theta_m) + sin_n sin(n theta_m), 0) sgn(omega_m)`, n = 1, 2, 4."""

    name: ClassVar[str] = "rippling_motor_friction"
    named_for: ClassVar[tuple[str, ...]] = ("cos_1", "sin_1", "cos_2", "sin_2", "cos_4", "sin_4")

    cos_1: Scalar = parameter(0.0, unit="N m", doc="cosine, order 1", source="Tuttle 1992", role="strength")
    sin_1: Scalar = parameter(0.0, unit="N m", doc="sine, order 1", source="Tuttle 1992", role="strength")
    cos_2: Scalar = parameter(0.0, unit="N m", doc="cosine, order 2", source="Tuttle 1992", role="strength")
    sin_2: Scalar = parameter(0.0, unit="N m", doc="sine, order 2", source="Tuttle 1992", role="strength")
    cos_4: Scalar = parameter(0.0, unit="N m", doc="cosine, order 4", source="Tuttle 1992", role="strength")
    sin_4: Scalar = parameter(0.0, unit="N m", doc="sine, order 4", source="Tuttle 1992", role="strength")
    transition: Scalar = parameter(unit="rad/s", doc="rate over which the sign turns", bounds=(0.0, 1e4), role="shape")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return (cls(transition=0.01 * scales.omega_m),)

    @property
    def _terms(self) -> tuple[Term, ...]:
        return (1, self.cos_1, self.sin_1), (2, self.cos_2, self.sin_2), (4, self.cos_4, self.sin_4)

    def _ripple(self, theta_m: Array) -> Array:
        return ripples(theta_m, self._terms)

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return amplitudes_and_phases(self._terms, "N m")


class PositionDependentMeshFriction(DryMeshFriction):
    """Friction `max(T_c + cosine cos(n theta_m) + sine sin(n theta_m), 0) sgn(v)` between the mesh's two sides."""

    family: ClassVar[str] = "position_dependent_friction"
    name: ClassVar[str] = "position_dependent_mesh_friction"
    named_for: ClassVar[tuple[str, ...]] = ("cosine", "sine")
    needs_motor: ClassVar[bool] = True
    drawn_against: ClassVar[str | None] = "theta_m"

    T_c: Scalar = parameter(
        0.0,
        unit="N m",
        doc="mean Coulomb torque at the output",
        source="EFFECTS: 0.1 to 5 N m",
        bounds=(0.0, 1e3),
        plausible=(0.1, 5.0),
        role="strength",
    )
    cosine: Scalar = parameter(0.0, unit="N m", doc="ripple, cosine", plausible=(0.0, 5.0), role="strength")
    sine: Scalar = parameter(0.0, unit="N m", doc="ripple, sine", plausible=(0.0, 5.0), role="strength")
    n: Scalar = parameter(2.0, unit="1", doc="cycles in a motor revolution", bounds=(0.0, 1e3))
    v_0: Scalar = parameter(unit="rad/s", doc="transition rate", bounds=(0.0, 1e3), role="shape")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(n=n, v_0=0.03 * scales.v) for n in _ORDERS)

    def level(self, motion: Motion, drive: Drive | ReducedDrive) -> Array:
        assert motion.theta_m is not None
        return dissipative(self.T_c + ripple(motion.theta_m, self.n, self.cosine, self.sine))

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return amplitude_and_phase(self.cosine, self.sine, "N m")
