"""Kinematic error: tooth and wave-generator errors locked to the motor angle."""

from typing import ClassVar

from jax.core import Tracer
from jaxtyping import Array

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import Effect, MeshGeometryEffect, Scales
from hdjax.effects.ripple import (
    Term,
    amplitude_and_phase,
    amplitudes_and_phases,
    ripple,
    ripple_slope,
    ripple_slopes,
    ripples,
)
from hdjax.parameters import Scalar, parameter

SOURCE = "Ghorbel, Gandhi, Alpeter 2001; vendors: 1.5e-4 to 5.8e-4 rad peak to peak"
PLAUSIBLE = (0.0, 2.9e-4)
# Deviation of a stated order from a whole number (assumed).
_WHOLE = 1e-3


class KinematicError(MeshGeometryEffect):
    """`e(theta_m) = sum over n = 1, 2, 4 of cos_n cos(n theta_m) + sin_n sin(n theta_m)`.

    Two cycles per motor revolution dominate, since the wave generator has two lobes.
    """

    family: ClassVar[str] = "kinematic_error"
    name: ClassVar[str] = "kinematic_error"
    orders: ClassVar[tuple[int, ...]] = (1, 2, 4)

    cos_1: Scalar = parameter(
        0.0, unit="rad", doc="cosine, order 1", source=SOURCE, plausible=PLAUSIBLE, role="strength"
    )
    sin_1: Scalar = parameter(0.0, unit="rad", doc="sine, order 1", source=SOURCE, plausible=PLAUSIBLE, role="strength")
    cos_2: Scalar = parameter(
        0.0, unit="rad", doc="cosine, order 2", source=SOURCE, plausible=PLAUSIBLE, role="strength"
    )
    sin_2: Scalar = parameter(0.0, unit="rad", doc="sine, order 2", source=SOURCE, plausible=PLAUSIBLE, role="strength")
    cos_4: Scalar = parameter(
        0.0, unit="rad", doc="cosine, order 4", source=SOURCE, plausible=PLAUSIBLE, role="strength"
    )
    sin_4: Scalar = parameter(0.0, unit="rad", doc="sine, order 4", source=SOURCE, plausible=PLAUSIBLE, role="strength")

    @property
    def _terms(self) -> tuple[Term, ...]:
        return (
            (1, self.cos_1, self.sin_1),
            (2, self.cos_2, self.sin_2),
            (4, self.cos_4, self.sin_4),
        )

    def error(self, theta_m: Array) -> Array:
        return ripples(theta_m, self._terms)

    def slope(self, theta_m: Array) -> Array:
        return ripple_slopes(theta_m, self._terms)

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return amplitudes_and_phases(self._terms, "rad")


class KinematicHarmonic(MeshGeometryEffect):
    """`e(theta_m) = cosine cos(n theta_m) + sine sin(n theta_m)` of one order that [`KinematicError`][] lacks."""

    family: ClassVar[str] = "kinematic_error"
    name: ClassVar[str] = "kinematic_harmonic"

    cosine: Scalar = parameter(0.0, unit="rad", doc="cosine", source=SOURCE, plausible=PLAUSIBLE, role="strength")
    sine: Scalar = parameter(0.0, unit="rad", doc="sine", source=SOURCE, plausible=PLAUSIBLE, role="strength")
    n: Scalar = parameter(6.0, unit="1", doc="cycles in a motor revolution", bounds=(0.0, 1e3))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(n=n) for n in (6.0, 3.0, 8.0, 5.0, 10.0, 12.0))

    def repeats(self) -> bool:
        """Whether its order is whole, up to rounding in a file, so that it repeats with the motor's revolution. True
        inside a transformation, where the order is not known."""
        if isinstance(self.n, Tracer):
            return True
        return float(self.n) > 0.5 and abs(float(self.n) - round(float(self.n))) < _WHOLE

    def error(self, theta_m: Array) -> Array:
        return ripple(theta_m, self.n, self.cosine, self.sine)

    def slope(self, theta_m: Array) -> Array:
        return ripple_slope(theta_m, self.n, self.cosine, self.sine)

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        return amplitude_and_phase(self.cosine, self.sine, "rad")


class KinematicSidebands(MeshGeometryEffect):
    """Kinematic error of order n that comes and goes with the output's revolution: orders `n +- 1/ratio`.

    `e = sum over both of cos cos(order theta_m) + sin sin(order theta_m)`: the circular spline's own error moves the
    wave generator's by once an output revolution.
    """

    family: ClassVar[str] = "kinematic_error"
    name: ClassVar[str] = "kinematic_sidebands"

    cos_below: Scalar = parameter(
        0.0, unit="rad", doc="cosine, lower sideband", source=SOURCE, plausible=PLAUSIBLE, role="strength"
    )
    sin_below: Scalar = parameter(
        0.0, unit="rad", doc="sine, lower sideband", source=SOURCE, plausible=PLAUSIBLE, role="strength"
    )
    cos_above: Scalar = parameter(
        0.0, unit="rad", doc="cosine, upper sideband", source=SOURCE, plausible=PLAUSIBLE, role="strength"
    )
    sin_above: Scalar = parameter(
        0.0, unit="rad", doc="sine, upper sideband", source=SOURCE, plausible=PLAUSIBLE, role="strength"
    )
    n: Scalar = parameter(2.0, unit="1", doc="order between the sidebands", bounds=(0.0, 1e3))
    ratio: Scalar = parameter(unit="1", doc="motor revolutions in an output revolution", bounds=(0.0, 1e4))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        return tuple(cls(n=n, ratio=scales.reduction_ratio) for n in (2.0, 1.0))

    @property
    def angles(self) -> frozenset[str]:
        # It repeats after a revolution of the output only.
        return frozenset(("theta_l",))

    @property
    def _terms(self) -> tuple[Term, ...]:
        away = 1.0 / self.ratio
        return (self.n - away, self.cos_below, self.sin_below), (self.n + away, self.cos_above, self.sin_above)

    def error(self, theta_m: Array) -> Array:
        return ripples(theta_m, self._terms)

    def slope(self, theta_m: Array) -> Array:
        return ripple_slopes(theta_m, self._terms)
