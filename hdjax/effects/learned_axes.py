"""Basis of learned functions: functions of one quantity of the motion each, and their products."""

import abc
from collections.abc import Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.effects.effect import Motion
from hdjax.elementary import cosines_and_sines
from hdjax.parameters import Scalar, as_scalar

UNITS = {
    "x": "rad",
    "v": "rad/s",
    "theta_m": "rad",
    "omega_m": "rad/s",
    "theta_l": "rad",
    "omega_l": "rad/s",
    "T_m": "N m",
    "time": "s",
    "temperature": "K",
}
"""What a learned function may depend on, with its unit."""

ANGLES = {"theta_m": 6, "theta_l": 3}
"""Angles of a shaft, each with its highest order."""

DRIFTS = ("time", "temperature")
"""Variables other than motion, which cause drift."""

# Highest multiple of the frequency of a periodic function of time.
_HARMONICS = 3
_RATES = ("v", "omega_m", "omega_l")
# Share of the largest rate within which the knots are even, and initial width of a sign's reversal.
_NEAR_STANDSTILL = 0.005


class Axis(eqx.Module):
    """Functions of one quantity of the motion.

    Attributes:
        variable: the quantity, a field of [`hdjax.effects.Motion`][].
        count: number of functions.
    """

    variable: eqx.AbstractVar[str]

    @property
    @abc.abstractmethod
    def count(self) -> int:
        """Number of functions."""

    @abc.abstractmethod
    def functions(self, value: Array) -> Float[Array, " functions"]:
        """The functions at one value of the quantity."""


class SplineAxis(Axis):
    """Cubic B-splines on even knots; linear beyond the data.

    Attributes:
        variable: the quantity.
        low: smallest value in the data.
        high: largest value.
        bend: where given, the knots are even in `asinh(value / bend)`: dense near zero, where friction turns.
        intervals: number of intervals between knots.
    """

    variable: str = eqx.field(static=True)
    low: Scalar = eqx.field(converter=as_scalar)
    high: Scalar = eqx.field(converter=as_scalar)
    bend: Scalar | None = eqx.field(converter=lambda b: None if b is None else as_scalar(b), default=None)
    intervals: int = eqx.field(static=True, default=9)

    @property
    def count(self) -> int:
        return self.intervals + 3

    def _stretched(self, value: Array) -> Array:
        return value if self.bend is None else jnp.arcsinh(value / self.bend)

    def functions(self, value: Array) -> Float[Array, " functions"]:
        low, high = self._stretched(self.low), self._stretched(self.high)
        place = (self._stretched(value) - low) / (high - low) * self.intervals
        inside = jnp.clip(place, 0.0, self.intervals)
        distance = inside - jnp.arange(-1.0, self.intervals + 2.0)
        near, far = jnp.maximum(1.0 - jnp.abs(distance), 0.0), jnp.maximum(2.0 - jnp.abs(distance), 0.0)
        slope = jnp.sign(distance) * (2.0 * near**2 - 0.5 * far**2)
        return (far**3 - 4.0 * near**3) / 6.0 + (place - inside) * slope


class PowerAxis(Axis):
    """Powers of a quantity, also beyond the data.

    Attributes:
        variable: the quantity.
        largest: its largest size in the data.
    """

    variable: str = eqx.field(static=True)
    largest: Scalar = eqx.field(converter=as_scalar)

    @property
    def count(self) -> int:
        return 5

    def functions(self, value: Array) -> Float[Array, " functions"]:
        share = value / self.largest
        return jnp.stack([jnp.ones_like(share), share, share * jnp.abs(share), share**2, share**3])


class LinearAxis(Axis):
    """The quantity itself.

    Attributes:
        variable: the quantity.
    """

    variable: str = eqx.field(static=True)

    @property
    def count(self) -> int:
        return 1

    def functions(self, value: Array) -> Float[Array, " functions"]:
        return value[None]


class SignAxis(Axis):
    """The sign of a rate, and beside it further functions of the same rate.

    Attributes:
        variable: the rate.
        corner: rate over which the sign reverses, initially; a fit may change it (see [`LearnedFriction`][]) [rad/s].
        beside: the further functions; None where there are none.
    """

    variable: str = eqx.field(static=True)
    corner: Scalar = eqx.field(converter=as_scalar)
    beside: Axis | None = None

    @property
    def count(self) -> int:
        return 1 if self.beside is None else 1 + self.beside.count

    def functions(self, value: Array) -> Float[Array, " functions"]:
        sign = jnp.tanh(value / self.corner)[None]
        return sign if self.beside is None else jnp.concatenate([sign, self.beside.functions(value)])


class AngleAxis(Axis):
    """One, and cosine and sine of the whole orders of an angle.

    Attributes:
        variable: the angle.
        orders: the highest order.
    """

    variable: str = eqx.field(static=True)
    orders: int = eqx.field(static=True)

    @property
    def count(self) -> int:
        return 1 + 2 * self.orders

    def functions(self, value: Array) -> Float[Array, " functions"]:
        turned = cosines_and_sines(value, tuple(range(1, self.orders + 1)))
        return jnp.stack([jnp.ones_like(value), *(part for pair in turned for part in pair)])


class PeriodicAxis(Axis):
    """One, and cosine and sine of the whole multiples of an angular frequency.

    Attributes:
        variable: the time.
        omega: the initial frequency; a fit may change it (see [`LearnedPeriodic`][]) [rad/s].
        orders: the highest multiple.
    """

    variable: str = eqx.field(static=True)
    omega: Scalar = eqx.field(converter=as_scalar)
    orders: int = eqx.field(static=True, default=_HARMONICS)

    @property
    def count(self) -> int:
        return 1 + 2 * self.orders

    def functions(self, value: Array) -> Float[Array, " functions"]:
        return AngleAxis(self.variable, self.orders).functions(self.omega * value)


def axes_over(
    ranges: Mapping[str, tuple[float, float]],
    *,
    jumps_with: str | None = None,
    corner: float | None = None,
    lines: Sequence[float] = (),
) -> list[tuple[Axis, ...]]:
    """Possible axes of a function of one or two quantities, the simplest first.

    Of one quantity: a few powers, which extend beyond the data; any smooth function. Of two: one of them times any
    function of the other (a variable stiffness or damping); any smooth function of both. Each of the former two may
    jump where a rate changes its sign, and of two quantities the jump may depend on the other one (variable friction).

    A function of the load's angle is periodic, but a spring to the ground is not, so that it has powers as well. The
    motor's angle has none, nor have drifting quantities, which can't be extrapolated. A function of time may be
    periodic at a significant frequency.

    Args:
        ranges: of each quantity in the data.
        jumps_with: the rate, if any, whose sign the function may jump with.
        corner: rate over which that sign reverses, if known [rad/s].
        lines: possible frequencies of a periodic function of time [rad/s].
    """
    if len(ranges) == 1:
        ((variable, (low, high)),) = ranges.items()
        any_function = axis_over(variable, low, high)
        if variable == "theta_m" or variable in DRIFTS:
            periodic = (PeriodicAxis(variable, omega) for omega in lines if variable == "time")
            return [(any_function,), *((axis,) for axis in periodic)]
        smooth = (PowerAxis(variable, largest=max(abs(low), abs(high))), any_function)
        jumping = (_sign_over(variable, low, high, corner, beside) for beside in smooth if variable == jumps_with)
        return [(axis,) for axis in (*smooth, *jumping)]
    one, other = ranges
    scaled = [
        tuple(LinearAxis(n) if n == by else axis_over(n, *ranges[n]) for n in ranges)
        for by in ranges
        if by in ("x", "T_m", *_RATES)
    ]
    jumping = [
        (_sign_over(by, *ranges[by], corner), axis_over(on, *ranges[on]))
        for by, on in ((one, other), (other, one))
        if by == jumps_with
    ]
    both = (axis_over(one, *ranges[one], beside=other), axis_over(other, *ranges[other], beside=one))
    return [*scaled, *jumping, both]


def _sign_over(variable: str, low: float, high: float, corner: float | None, beside: Axis | None = None) -> SignAxis:
    return SignAxis(variable, corner or _NEAR_STANDSTILL * max(abs(low), abs(high)), beside)


def axis_over(variable: str, low: float, high: float, *, beside: str | None = None) -> Axis:
    """The axis for a quantity with a given range in the data.

    Args:
        variable: the quantity.
        low: smallest value.
        high: largest value.
        beside: the other quantity, if any: a product has fewer functions of each. Friction may depend on an angle, or
            drift, and a stiffness on speed; of two rates only smooth functions are used.
    """
    if variable in ANGLES:
        return AngleAxis(variable, ANGLES[variable] if beside is None else min(ANGLES[variable], 4))
    turns = variable in _RATES and beside not in _RATES
    bend = _NEAR_STANDSTILL * max(abs(low), abs(high)) if turns else None
    intervals = 17 if turns and beside is None else 9 if turns or beside is None else 5
    return SplineAxis(variable, low=low, high=high, bend=bend, intervals=intervals)


def functions(axes: tuple[Axis, ...], motion: Motion) -> Float[Array, " functions"]:
    """All products of one function of each axis, at one instant of a motion."""
    return _products([axis.functions(v) for axis, v in zip(axes, _values(axes, motion), strict=True)])


def combined(axes: tuple[Axis, ...], mixing: Array, c: tuple[Array, ...], motion: Motion) -> Array:
    """The function with given coefficients, at one instant of a motion."""
    return _sum((_values(axes, motion), jnp.stack(c)), axes, mixing)


def _values(axes: tuple[Axis, ...], motion: Motion) -> tuple[Array, ...]:
    values = tuple(getattr(motion, axis.variable) for axis in axes)
    missing = [axis.variable for axis, value in zip(axes, values, strict=True) if value is None]
    assert not missing, f"this motion has no {missing}"
    return values


@eqx.filter_custom_jvp
def _sum(at: tuple[tuple[Array, ...], Array], axes: tuple[Axis, ...], mixing: Array) -> Array:
    values, c = at
    return _products([axis.functions(v) for axis, v in zip(axes, values, strict=True)]) @ (mixing @ c)


@_sum.def_jvp
def _sum_jvp(primals, tangents):
    """Custom derivative, so that common parts of all directions are computed once: a fit has dozens."""
    (values, c), axes, mixing = primals
    (moved, c_moved), *_ = tangents
    both = [jax.jvp(axis.functions, (v,), (jnp.ones_like(v),)) for axis, v in zip(axes, values, strict=True)]
    found, weights = [f for f, _ in both], mixing @ c
    tangent = jnp.zeros_like(weights[0])
    if c_moved is not None:
        tangent = tangent + _products(found) @ mixing @ c_moved
    for i, ((_, slopes), moves) in enumerate(zip(both, moved, strict=True)):
        if moves is not None:
            tangent = tangent + _products([*found[:i], slopes, *found[i + 1 :]]) @ weights * moves
    return _products(found) @ weights, tangent


def _products(found: Sequence[Array]) -> Float[Array, " functions"]:
    """All products of one entry of each."""
    whole = jnp.ones(1)
    for one in found:
        whole = (whole[:, None] * one[None, :]).reshape(-1)
    return whole
