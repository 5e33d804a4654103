"""What an effect is: extra physics that enters the equations of motion at exactly one place."""

import abc
from typing import ClassVar

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.signals import PiecewisePolynomial


class Rubbing(eqx.Module):
    """How dry friction acts on a rate during one step of an explicit solver.

    Attributes:
        sign: of the rate, averaged over the step [1].
        reach: by how much the friction and all else can change the rate in the step [rad/s].
    """

    sign: Array
    reach: Array


class Motion(eqx.Module):
    """The instantaneous motion that an effect may look at.

    A reduced drive has no motor and no load of its own: there the angles and rates are None.

    Attributes:
        x: twist that the mesh sees [rad], `theta_m/N + e(theta_m) - theta_l`.
        v: its rate [rad/s].
        theta_m: motor angle [rad].
        omega_m: motor rate [rad/s].
        theta_l: load angle [rad].
        omega_l: load rate [rad/s].
        time: since the log's start [s], or None where it is not known.
        temperature: of the drive [K], or None where it is not known.
        rubbing: how dry friction acts on each rate that it opposes, by the rate's name here; None where it follows its
            law at every instant.
        T_m: torque that comes in at the motor [N m], or None where it is not known.
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
    """What surrounds a drive: it acts on the effects that ask for it.

    Attributes:
        time: since the log's start [s]; the clock of the torque's signal.
        temperature: of the drive [K].
        rubbing: see [`Motion`][].
        T_m: likewise; the equations of a drive with a motor fill in the torque that they are given.
    """

    time: Array | None = None
    temperature: Array | None = None
    rubbing: dict[str, Rubbing] | None = None
    T_m: Array | None = None


class Scales(eqx.Module):
    """Orders of magnitude of a measured motion, from which an effect proposes its shape parameters.

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
        residual_frequencies: strongest lines of what the current model leaves over [rad/s], strongest first.
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

    @property
    def natural_frequency(self) -> float:
        """Natural frequency of the dynamic error [rad/s], at worst the mean frequency of its motion."""
        return self.v / self.x if self.omega_0 is None else self.omega_0


class Effect(eqx.Module):
    """Extra physics with its own parameters and, where it has memory, its own states.

    Attributes:
        family: the name that reports use, from the catalogue.
        name: the form's own name, prefix of its parameters' dotted paths.
        states: names of its internal states.
        needs_motor: whether it needs the motor's and load's own motion, which a reduced log lacks.
        named_for: the strengths that its name speaks of, where it has others as well: without them it is something
            else.
        drawn_against: the quantity, a field of [`Motion`][], that what it does is best drawn against; None where no
            single one shows it.
        one_shape_of: the quantity that it is a function of, where another function of that would be something else.
        imperfection: share (rms) of what it removes of an error that its law may get wrong itself: no form is exact.
    """

    family: ClassVar[str]
    name: ClassVar[str]
    states: ClassVar[tuple[str, ...]] = ()
    needs_motor: ClassVar[bool] = False
    named_for: ClassVar[tuple[str, ...]] = ()
    drawn_against: ClassVar[str | None] = None
    one_shape_of: ClassVar[str | None] = None
    imperfection: ClassVar[float] = 3e-3

    @classmethod
    @abc.abstractmethod
    def proposals(cls, scales: Scales) -> "tuple[Effect, ...]":
        """The effect at zero strength, with shape parameters that suit a motion of these scales.

        Several proposals are starting points of the same form; none where a log of these scales can't show it.
        """

    @classmethod
    def typical(cls, scales: Scales) -> tuple["Effect", ...]:
        """The effect as catalogues describe it, at strengths off zero: further starting points of a fit.

        For forms whose shape decides so much that the first-order view from zero strength can mislead.
        """
        return ()

    @classmethod
    def imitated(cls, drive: Drive | ReducedDrive, scales: Scales) -> tuple[tuple[dict[str, Array], "Effect"], ...]:
        """What a drive whose parameters no real one has may stand for: the effect, with values of those parameters
        that go with it. Further starting points of a fit, from which the first-order view is far off; none where the
        drive is plausible.
        """
        return ()

    @property
    def needs_temperature(self) -> bool:
        """Whether it depends on the drive's temperature."""
        return False

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        """Further quantities that a reader expects, as name -> (value, unit)."""
        return {}

    def initial_state(self, motion: Motion | None = None) -> Float[Array, " states"]:
        """Internal states of a drive that has long moved like this; that has rested unloaded where None."""
        raise ValueError(f"`{self.name}` has no internal states")

    def state_rates(self, motion: Motion, state: Array) -> Array:
        """Rates of the internal states."""
        raise ValueError(f"`{self.name}` has no internal states")

    def state_scale(self) -> Array:
        """How far each internal state can be from its initial value: the prior of an unknown initial state."""
        raise ValueError(f"`{self.name}` has no internal states")


class ShaftEffect(Effect):
    """Adds a torque to the equation of a shaft, and may have some of its inertia."""

    needs_motor: ClassVar[bool] = True

    @abc.abstractmethod
    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        """Torque on the shaft, along its positive direction [N m]."""

    def inertia_taken(self, drive: Drive) -> Array:
        """Inertia that is not on the shaft, although the drive's J_m or J_l counts it [kg m^2]."""
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
        """Torque on the motor, along +theta_m, beside the mesh torque over N [N m]: what a spring whose energy depends
        on the motor's angle puts there."""
        return jnp.zeros_like(motion.x)

    @classmethod
    def reacts(cls) -> bool:
        """Whether there is such a torque."""
        return cls.reaction is not MeshTorqueEffect.reaction


class MeshGeometryEffect(Effect):
    """Makes the mesh see `x_s = x + e(theta_m)` while the encoders see x, and loads the motor through e'."""

    needs_motor: ClassVar[bool] = True

    @abc.abstractmethod
    def error(self, theta_m: Array) -> Array:
        """The error e [rad, output side]."""

    @abc.abstractmethod
    def slope(self, theta_m: Array) -> Array:
        """Its derivative e' with respect to the motor angle [1]."""


class SensorEffect(Effect):
    """Changes what the encoders read, and no force."""

    needs_motor: ClassVar[bool] = True

    @abc.abstractmethod
    def reading(self, theta_m: Array, theta_l: Array, omega_m: Array, omega_l: Array) -> tuple[Array, Array]:
        """What the motor's and the load's encoder read [rad] at the true angles [rad] and rates [rad/s]."""

    def load_delay(self) -> Array | None:
        """Time by which the load's sensors are read later than the motor's [s]; None where they are read together."""
        return None


class ActuatorEffect(Effect):
    """Changes the logged torque (or forcing) on its way to the drive."""

    @abc.abstractmethod
    def actuate(self, logged: PiecewisePolynomial) -> PiecewisePolynomial:
        """The torque that acts, from the torque that was logged."""
