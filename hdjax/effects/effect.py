"""Base classes of effects: additional physics at exactly one place of the equations of motion."""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.signals import PiecewisePolynomial

_ONE_LAW = frozenset(("motor_friction", "load_friction"))
"""Families of which a model has one form: a shaft has one law of friction."""

_ANGLES = frozenset(("theta_m", "theta_l"))


class Rubbing(eqx.Module):
    """Dry friction against a rate during one step of an explicit solver.

    Attributes:
        sign: of the rate, averaged over the step [1].
        reach: possible change of the rate in the step, by friction and all else [rad/s].
    """

    sign: Array
    reach: Array


class Motion(eqx.Module):
    """The instantaneous motion, as the input of effects.

    A reduced drive has no separate motor and load: there the angles and rates are None.

    Attributes:
        x: mesh twist [rad], `theta_m/N + e(theta_m) - theta_l`.
        v: its rate [rad/s].
        theta_m: motor angle [rad].
        omega_m: motor rate [rad/s].
        theta_l: load angle [rad].
        omega_l: load rate [rad/s].
        time: since the log's start [s], or None where it is not known.
        temperature: of the drive [K], or None where it is not known.
        rubbing: dry friction over a step against each rate, by the rate's name here; None to use the law at every
            instant.
        T_m: incoming motor torque [N m], or None where it is not known.
    """

    x: Array
    v: Array
    theta_m: Array | None = None
    omega_m: Array | None = None
    theta_l: Array | None = None
    omega_l: Array | None = None
    time: Array | None = None
    temperature: Array | None = None
    rubbing: dict[str, Rubbing] | None = None
    T_m: Array | None = None


class Conditions(eqx.Module):
    """External conditions of a drive, for effects that depend on them.

    Attributes:
        time: since the log's start [s]; the clock of the torque's signal.
        temperature: of the drive [K].
        rubbing: see [`Motion`][].
        T_m: likewise; the equations of a drive with a motor set it to their torque.
    """

    time: Array | None = None
    temperature: Array | None = None
    rubbing: dict[str, Rubbing] | None = None
    T_m: Array | None = None


class Scales(eqx.Module):
    """Orders of magnitude of a measured motion, for proposals of shape parameters.

    Attributes:
        x: rms twist [rad].
        x_max: largest twist [rad].
        v: rms twist rate [rad/s].
        omega_m: rms motor rate [rad/s].
        omega_l: rms load rate [rad/s].
        time_step: median sampling interval [s].
        duration: of the longest log [s].
        reduction_ratio: of the drive.
        omega_0: natural frequency of the dynamic error [rad/s]; from the motion where None.
        temperature: mean temperature of the first log [K], or None where a log has no such channel.
        temperature_change: rms distance from it over all logs [K].
        residual_frequencies: strongest lines of the current model's residual [rad/s], strongest first.
        load_late: time by which the load's sensors seem to be read later than the motor's, in whole rows [s].
    """

    x: float
    x_max: float
    v: float
    omega_m: float
    omega_l: float
    time_step: float
    duration: float = 1.0
    reduction_ratio: float = 1.0
    omega_0: float | None = None
    temperature: float | None = None
    temperature_change: float = 0.0
    residual_frequencies: tuple[float, ...] = ()
    load_late: float = 0.0

    @property
    def natural_frequency(self) -> float:
        """Natural frequency of the dynamic error [rad/s], at worst the mean frequency of its motion."""
        return self.v / self.x if self.omega_0 is None else self.omega_0


class Effect(eqx.Module):
    """Additional physics with its own parameters and, if it has memory, hidden states.

    Attributes:
        family: name in reports, from the catalogue.
        name: of the form, prefix of its parameters' dotted paths.
        states: names of its hidden states.
        needs_motor: whether it needs the motion of motor and load, which a reduced log lacks.
        named_for: the strengths that its name refers to, if it has others as well: without them it is another effect.
        drawn_against: the quantity, a field of [`Motion`][], that it is plotted over; None where no single one is
            suitable.
        one_shape_of: the quantity that it is a specific function of; another function would be another effect.
        corrects: the parameter of the drive whose stated value it corrects.
        contains: names of the forms that it contains, with the same symbols.
        imperfection: possible rms error of its law, as a share of the error that it removes: no form is exact.
    """

    family: ClassVar[str]
    name: ClassVar[str]
    states: ClassVar[tuple[str, ...]] = ()
    needs_motor: ClassVar[bool] = False
    named_for: ClassVar[tuple[str, ...]] = ()
    drawn_against: ClassVar[str | None] = None
    one_shape_of: ClassVar[str | None] = None
    corrects: ClassVar[str | None] = None
    contains: ClassVar[tuple[str, ...]] = ()
    imperfection: ClassVar[float] = 3e-3

    @classmethod
    def proposals(cls, scales: Scales) -> "tuple[Effect, ...]":
        """The effect at zero strength, with shape parameters for a motion of these scales.

        Several proposals are starting points of the same form; none where it is not observable in such a log.
        One with its default values where not stated.
        """
        return (cls(),)

    @classmethod
    def typical(cls, scales: Scales) -> tuple["Effect", ...]:
        """The effect at typical nonzero strengths: further starting points of a fit.

        For forms for which the first-order estimate from zero strength can mislead.
        """
        return ()

    @classmethod
    def imitated(cls, drive: Drive | ReducedDrive, scales: Scales) -> tuple[tuple[dict[str, Array], "Effect"], ...]:
        """The effect that a drive with implausible parameters may imitate, with matching values of those parameters.
        Further starting points of a fit, far from the first-order estimate; none where the drive is plausible.
        """
        return ()

    @classmethod
    def replaces(cls, other: "Effect") -> bool:
        """Whether it takes the place of another effect of a model: of a form that it contains, or of another law of the
        same friction."""
        return other.name in cls.contains or (cls.family in _ONE_LAW and other.family == cls.family)

    @property
    def needs_temperature(self) -> bool:
        """Whether it depends on the drive's temperature."""
        return False

    @property
    def follows_torque(self) -> bool:
        """Whether it is a function of the motor torque, so that accelerations are not linear in it."""
        return False

    @property
    def angles(self) -> frozenset[str]:
        """The angles, fields of [`Motion`][], whose position matters to it and not only their rate or twist."""
        return _ANGLES & {self.drawn_against}

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        """Derived quantities for reports, as name -> (value, unit)."""
        return {}

    def initial_state(self, motion: Motion | None = None) -> Float[Array, " states"]:
        """Hidden states in steady state with a motion; after long unloaded rest where None."""
        raise ValueError(f"`{self.name}` has no internal states")

    def state_rates(self, motion: Motion, state: Array) -> Array:
        """Rates of the hidden states."""
        raise ValueError(f"`{self.name}` has no internal states")

    def state_scale(self) -> Array:
        """Standard deviation of each hidden initial state: its prior."""
        raise ValueError(f"`{self.name}` has no internal states")


class ShaftEffect(Effect):
    """Adds a torque to the equation of a shaft, and may have some of its inertia."""

    needs_motor: ClassVar[bool] = True

    @abc.abstractmethod
    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        """Torque on the shaft, along its positive direction [N m]."""

    def inertia_taken(self, drive: Drive) -> Array:
        """Part of the drive's J_m or J_l that is not rigidly on the shaft [kg m^2]."""
        return jnp.zeros_like(drive.J_l)

    @classmethod
    def takes_inertia(cls) -> bool:
        """Whether there is such inertia."""
        return cls.inertia_taken is not ShaftEffect.inertia_taken


class MotorSideEffect(ShaftEffect):
    """Adds a torque to the motor's equation."""

    drawn_against: ClassVar[str | None] = "omega_m"


class LoadSideEffect(ShaftEffect):
    """Adds a torque to the load's equation."""

    drawn_against: ClassVar[str | None] = "omega_l"


class MeshTorqueEffect(Effect):
    """Adds to the torque that the mesh transmits.

    On a reduced drive, whose inertia is not known, the torque is an acceleration: stiffness is omega_0^2.
    """

    drawn_against: ClassVar[str | None] = "x"

    @abc.abstractmethod
    def torque(self, motion: Motion, drive: Drive | ReducedDrive, state: Array) -> Array:
        """Torque to add to `K f(x) + B_sp v` [N m]."""

    def reaction(self, motion: Motion, drive: Drive) -> Array:
        """Further torque on the motor, along +theta_m, beside the mesh torque over N [N m]: from a spring whose energy
        depends on the motor's angle."""
        return jnp.zeros_like(motion.x)

    @classmethod
    def reacts(cls) -> bool:
        """Whether there is such a torque."""
        return cls.reaction is not MeshTorqueEffect.reaction


class MeshGeometryEffect(Effect):
    """Changes the mesh twist to `x_s = x + e(theta_m)` while the encoders measure x, and loads the motor through e'."""

    needs_motor: ClassVar[bool] = True

    @property
    def angles(self) -> frozenset[str]:
        return frozenset(("theta_m",))

    @abc.abstractmethod
    def error(self, theta_m: Array) -> Array:
        """The error e [rad, output side]."""

    @abc.abstractmethod
    def slope(self, theta_m: Array) -> Array:
        """Its derivative e' with respect to the motor angle [1]."""


class SensorEffect(Effect):
    """Changes the sensors' readings, and no force."""

    needs_motor: ClassVar[bool] = True

    def reading(self, theta_m: Array, theta_l: Array, omega_m: Array, omega_l: Array) -> tuple[Array, Array]:
        """Readings of the motor's and the load's encoder [rad] at the true angles [rad] and rates [rad/s]."""
        return theta_m, theta_l

    def torque_reading(self, tau: Array) -> Array:
        """Reading of the joint torque's sensor [N m] at the true torque [N m]."""
        return tau

    def load_delay(self) -> Array | None:
        """Time by which the load's encoder is read later than the motor's [s]; None where they are read together."""
        return None

    def load_lag(self) -> Array | None:
        """Time constant of a filter of the load's encoder [s], a part of its delay; None without one."""
        return None

    def torque_delay(self) -> Array | None:
        """Time by which the sensor of the joint torque is read later than the motor's encoder [s]; None likewise."""
        return None


class ActuatorEffect(Effect):
    """Changes the logged torque (or forcing) on its way to the drive.

    Attributes:
        takes_numpy: whether `actuate` also takes many signals of numpy at once, and parameters with an imaginary part,
            so that outside JAX programs nothing is compiled for it.
    """

    takes_numpy: ClassVar[bool] = False

    @abc.abstractmethod
    def actuate(self, logged: PiecewisePolynomial) -> PiecewisePolynomial:
        """The acting torque, from the logged torque."""
