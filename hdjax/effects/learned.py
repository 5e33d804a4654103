"""An effect that no formula is known for: a torque that is some smooth function of one or two quantities.

The function is linear in its coefficients, so that all coefficients at zero are the base model exactly.
"""

import abc
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.dry import DryFriction
from hdjax.effects.effect import (
    Effect,
    LoadSideEffect,
    MeshGeometryEffect,
    MeshTorqueEffect,
    Motion,
    MotorSideEffect,
    Scales,
)
from hdjax.elementary import cosines_and_sines
from hdjax.parameters import Scalar, as_scalar, parameter

FAMILY = "unknown"
SOURCE = "learned from data"


class Axis(eqx.Module):
    """Functions of one quantity of the motion.

    Attributes:
        variable: the quantity, a field of [`hdjax.effects.Motion`][].
        count: how many functions there are.
    """

    variable: eqx.AbstractVar[str]

    @property
    @abc.abstractmethod
    def count(self) -> int:
        """How many functions there are."""

    @abc.abstractmethod
    def functions(self, value: Array) -> Float[Array, " functions"]:
        """The functions at one value of the quantity."""


class SplineAxis(Axis):
    """Cubic B-splines on even knots; a straight line beyond the data.

    Attributes:
        variable: the quantity.
        low: smallest value that the data have.
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
    """Powers of a quantity, which go on beyond the data as they do within.

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
        corner: rate over which the sign turns, for a look; a fit may move it (see [`LearnedFriction`][]) [rad/s].
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


def functions(axes: tuple[Axis, ...], motion: Motion) -> Float[Array, " functions"]:
    """All products of one function of each axis, at one instant of a motion."""
    return _products([axis.functions(v) for axis, v in zip(axes, _values(axes, motion), strict=True)])


def combined(axes: tuple[Axis, ...], mixing: Array, c: tuple[Array, ...], motion: Motion) -> Array:
    """The function of the axes that coefficients stand for, at one instant of a motion."""
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
    """By hand, so that what is alike for all directions is not computed again for each: a fit has dozens."""
    (values, c), axes, mixing = primals
    (moved, c_moved), *_ = tangents
    both = [jax.jvp(axis.functions, (v,), (jnp.ones_like(v),)) for axis, v in zip(axes, values, strict=True)]
    found, weights = [f for f, _ in both], mixing @ c
    by_coefficient = _products(found) @ mixing
    tangent = jnp.zeros_like(weights[0])
    if c_moved is not None:
        tangent = tangent + by_coefficient @ c_moved
    for i, ((_, slopes), moves) in enumerate(zip(both, moved, strict=True)):
        if moves is not None:
            tangent = tangent + _products([*found[:i], slopes, *found[i + 1 :]]) @ weights * moves
    return by_coefficient @ c, tangent


def _products(found: Sequence[Array]) -> Float[Array, " functions"]:
    """All products of one entry of each."""
    whole = jnp.ones(1)
    for one in found:
        whole = (whole[:, None] * one[None, :]).reshape(-1)
    return whole


def _coefficients(unit: str) -> Any:
    return parameter(unit=unit, doc="coefficient of the learned function", source=SOURCE, role="strength", several=True)


class Learned(Effect):
    """A learned function, somewhere.

    Attributes:
        axes: what it depends on.
        mixing: which combination of the axes' functions each coefficient multiplies.
        c: coefficients.
    """

    family: ClassVar[str] = FAMILY

    axes: tuple[Axis, ...]
    mixing: Float[Array, "functions coefficients"] = eqx.field(converter=jnp.asarray)
    c: tuple[Scalar, ...] = _coefficients("N m")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        """None: what it may depend on is for the data to say."""
        return ()

    @classmethod
    def made_of(cls, axes: tuple[Axis, ...], mixing: Array | np.ndarray, c: Iterable[Scalar | float]) -> "Learned":
        """A function of these axes at this place."""
        return cls(axes=axes, mixing=mixing, c=tuple(c))

    @classmethod
    def may_depend_on(cls, variable: str) -> bool:
        """Whether it may be a function of a quantity of `UNITS`."""
        return variable != "T_m"

    @classmethod
    def may_jump_with(cls, variable: str) -> bool:
        """Whether it may jump where a rate changes its sign, as dry friction does: only with the rate of its place."""
        return False

    @property
    def needs_temperature(self) -> bool:
        return any(axis.variable == "temperature" for axis in self.axes)

    def value(self, motion: Motion) -> Array:
        """The function, at one instant."""
        return functions(self.axes, motion) @ self.mixing @ jnp.stack(self.c)


class LearnedTorque(Learned):
    """A learned torque."""

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        """The torque [N m], along the positive direction of its place."""
        return combined(self.axes, self.mixing, self.c, motion)

    @classmethod
    def made_of(cls, axes: tuple[Axis, ...], mixing: Array | np.ndarray, c: Iterable[Scalar | float]) -> "Learned":
        sign = axes[0] if axes else None
        if not isinstance(sign, SignAxis):
            return super().made_of(axes, mixing, c)
        return _RUBBING[cls](axes=axes, mixing=mixing, c=tuple(c), transition=sign.corner)

    @classmethod
    def may_jump_with(cls, variable: str) -> bool:
        return variable == _RUBBING[cls].opposes


class LearnedMeshTorque(LearnedTorque, MeshTorqueEffect):
    """Learned torque in the mesh."""

    name: ClassVar[str] = "learned_mesh_torque"


class LearnedMotorTorque(LearnedTorque, MotorSideEffect):
    """Learned torque on the motor."""

    name: ClassVar[str] = "learned_motor_torque"

    @classmethod
    def may_depend_on(cls, variable: str) -> bool:
        return True


class LearnedLoadTorque(LearnedTorque, LoadSideEffect):
    """Learned torque on the load."""

    name: ClassVar[str] = "learned_load_torque"


class LearnedFriction(LearnedTorque, DryFriction):
    """A learned torque that jumps where the rate at its place changes its sign. Its first axis is a `SignAxis`.

    How far it jumps may depend on the other axes.

    Attributes:
        transition: rate over which the sign turns [rad/s].
    """

    # The mesh torque along its positive direction opposes the twist; what acts on a shaft drives it.
    _drives: ClassVar[bool] = True

    transition: Scalar = parameter(
        unit="rad/s", doc="rate over which the sign turns", source=SOURCE, bounds=(0.0, 1e4), role="shape"
    )

    @property
    def corner(self) -> Scalar:
        return self.transition

    def value(self, motion: Motion) -> Array:
        sign = eqx.tree_at(lambda s: s.corner, self._sign, self.transition)
        return functions((sign, *self.axes[1:]), motion) @ self.mixing @ jnp.stack(self.c)

    def level(self, motion: Motion, drive: Drive | ReducedDrive) -> Array:
        along = combined(self.axes[1:], self.mixing[: self._jumps], self.c, motion)
        return -along if self._drives else along

    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        dry = self.dry(motion, drive)
        dry = -dry if self._drives else dry
        beside = self._sign.beside
        if beside is None:
            return dry
        return dry + combined((beside, *self.axes[1:]), self.mixing[self._jumps :], self.c, motion)

    @property
    def _sign(self) -> SignAxis:
        sign = self.axes[0]
        assert isinstance(sign, SignAxis)
        return sign

    @property
    def _jumps(self) -> int:
        """How many of the functions, the first ones, have the sign in them."""
        return math.prod(axis.count for axis in self.axes[1:])


class LearnedMeshFriction(LearnedFriction, LearnedMeshTorque):
    """Learned torque in the mesh that jumps with the twist's rate."""

    opposes: ClassVar[str] = "v"
    _drives: ClassVar[bool] = False


class LearnedMotorFriction(LearnedFriction, LearnedMotorTorque):
    """Learned torque on the motor that jumps with its rate."""

    opposes: ClassVar[str] = "omega_m"


class LearnedLoadFriction(LearnedFriction, LearnedLoadTorque):
    """Learned torque on the load that jumps with its rate."""

    opposes: ClassVar[str] = "omega_l"


_RUBBING: dict[type[LearnedTorque], type[LearnedFriction]] = {
    LearnedMeshTorque: LearnedMeshFriction,
    LearnedMotorTorque: LearnedMotorFriction,
    LearnedLoadTorque: LearnedLoadFriction,
}


class LearnedMeshError(Learned, MeshGeometryEffect):
    """Learned error of the mesh's angle, over the motor's: what a torque of the angle can't stand for, since its force
    grows with the speed as well."""

    name: ClassVar[str] = "learned_mesh_error"

    c: tuple[Scalar, ...] = _coefficients("rad")

    @classmethod
    def may_depend_on(cls, variable: str) -> bool:
        return variable == "theta_m"

    def error(self, theta_m: Array) -> Array:
        nothing = jnp.zeros_like(theta_m)
        return combined(self.axes, self.mixing, self.c, Motion(x=nothing, v=nothing, theta_m=theta_m))

    def slope(self, theta_m: Array) -> Array:
        return jax.jvp(self.error, (theta_m,), (jnp.ones_like(theta_m),))[1]


LEARNED_TORQUES: tuple[type[LearnedTorque], ...] = (LearnedMeshTorque, LearnedMotorTorque, LearnedLoadTorque)
"""A learned torque at each place where it can enter."""

LEARNED: tuple[type[Learned], ...] = (*LEARNED_TORQUES, LearnedMeshError)
"""All that can be learned."""

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
"""Those that are angles of a shaft, each with the highest order that it is given."""

DRIFTS = ("time", "temperature")
"""Those that are no motion: what depends on them drifts."""

_RATES = ("v", "omega_m", "omega_l")
# Share of the largest rate within which the knots are even, and over which a sign turns at first.
_NEAR_STANDSTILL = 0.005


def axes_over(
    ranges: Mapping[str, tuple[float, float]], *, jumps_with: str | None = None, corner: float | None = None
) -> list[tuple[Axis, ...]]:
    """What a function of one or two quantities may be made of, the simplest first.

    Of one quantity: a few powers, which go on beyond the data; any smooth function. Of two: one of them times any
    function of the other (a stiffness or a damping that something changes); any smooth function of both. Each of the
    former two may jump where a rate changes its sign, and of two quantities the jump may depend on the other one
    (friction that something changes).

    The load's angle comes back after a turn, but what is tied to the load need not, so that it has powers as well. The
    motor's angle has none, nor has what drifts, of which nobody knows how it goes on.

    Args:
        ranges: between which values the data have each quantity.
        jumps_with: the rate, if any, whose sign the function may jump with.
        corner: rate over which that sign turns, where something is known of it [rad/s].
    """
    if len(ranges) == 1:
        ((variable, (low, high)),) = ranges.items()
        any_function = axis_over(variable, low, high)
        if variable == "theta_m" or variable in DRIFTS:
            return [(any_function,)]
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
    """The axis that suits a quantity which the data have between two values.

    Args:
        variable: the quantity.
        low: smallest value.
        high: largest value.
        beside: the other quantity, where there are two: a product must do with fewer functions of each. Friction may
            depend on an angle, or drift, and a stiffness on speed, but of two rates a smooth function must do.
    """
    if variable in ANGLES:
        return AngleAxis(variable, ANGLES[variable] if beside is None else min(ANGLES[variable], 4))
    turns = variable in _RATES and beside not in _RATES
    bend = _NEAR_STANDSTILL * max(abs(low), abs(high)) if turns else None
    intervals = 17 if turns and beside is None else 9 if turns or beside is None else 5
    return SplineAxis(variable, low=low, high=high, bend=bend, intervals=intervals)
