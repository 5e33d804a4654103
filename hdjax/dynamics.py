"""The equations of motion: a drive with its effects, as two inertias or as the dynamic error alone."""

import abc
import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any, ClassVar, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects import (
    ActuatorEffect,
    Conditions,
    Effect,
    LoadSideEffect,
    MeshGeometryEffect,
    MeshTorqueEffect,
    Motion,
    MotorSideEffect,
    SensorEffect,
    ShaftEffect,
)
from hdjax.parameters import ParameterInfo, as_scalar, own_parameters, own_value
from hdjax.signals import PiecewisePolynomial
from hdjax.taylor import taylor, time_derivative

State = Float[Array, " states"]

BOTH_ANGLES = ("motor_turn", "dynamic_error")
"""Outputs of a drive with an encoder on either side."""

JOINT_TORQUE = "joint_torque"
OUTPUTS = {
    "motor_turn": "rad",
    "motor_angle": "rad",
    "load_angle": "rad",
    "dynamic_error": "rad",
    "motor_velocity": "rad/s",
    "load_velocity": "rad/s",
    JOINT_TORQUE: "N m",
}
"""Possible outputs of sensors, with their units. `motor_turn` is theta_m/N, all else as DESIGN names it."""
_Kind = TypeVar("_Kind", bound=Effect)


class Inputs(eqx.Module):
    """Inputs of a model, at one instant or at many.

    Attributes:
        torque: motor torque [N m] after actuator effects, or the forcing.
        load_torque: on the output [N m].
        conditions: time and temperature.
    """

    torque: Float[Array, "*instants"]
    load_torque: Float[Array, "*instants"]
    conditions: Conditions


class Model(eqx.Module):
    """A drive and the effects inside its equations. States are a flat array: the motion, then effects' own states."""

    drive: eqx.AbstractVar[Drive | ReducedDrive]
    effects: eqx.AbstractVar[tuple[Effect, ...]]
    motion_states: eqx.AbstractClassVar[tuple[str, ...]]
    measured: eqx.AbstractVar[tuple[str, ...]]

    def __check_init__(self):
        # Hidden states are found by their effect's name.
        names = [effect.name for effect in self.effects if effect.states]
        if len(set(names)) < len(names):
            raise ValueError(f"effects with memory must have different names, but are {', '.join(names)}")

    @abc.abstractmethod
    def motion(self, state: State | Sequence[Array], conditions: Conditions = Conditions()) -> Motion:
        """The motion of a state, at the mesh."""

    @abc.abstractmethod
    def component_rates(
        self, state: Sequence[Array], torque: Array, load_torque: Array, conditions: Conditions = Conditions()
    ) -> list[Array]:
        """[`rates`][] of a state given as separate numbers, which is fastest in a vectorised program."""

    def rates(self, state: State, torque: Array, load_torque: Array, conditions: Conditions = Conditions()) -> State:
        """Time derivative of the state.

        Args:
            state: see `state_names`.
            torque: motor torque [N m] after actuator effects (or the forcing of a reduced drive).
            load_torque: torque on the load along +theta_l [N m]; ignored by a reduced drive.
            conditions: time and temperature, for effects that need them.

        Raises:
            ValueError: an effect needs a condition that is missing.
        """
        return jnp.stack(self.component_rates(tuple(state), torque, load_torque, conditions))

    @abc.abstractmethod
    def mobility(self, moved: str, opposed: str) -> Array | float:
        """Deceleration of one rate by a unit of friction torque against another, or against itself [1/(kg m^2)].

        Args:
            moved: the one rate, a field of [`hdjax.effects.Motion`][].
            opposed: likewise the other.
        """

    @abc.abstractmethod
    def outputs(self, state: State, inputs: Inputs | None = None) -> Float[Array, " outputs"]:
        """Outputs of the sensors: the quantities `measured`, of `OUTPUTS`; the last one is the principal output.

        Args:
            state: see `state_names`.
            inputs: just before the reading, for a sensor of the joint torque that is read late; none act where not
                given.
        """

    @property
    def state_names(self) -> tuple[str, ...]:
        """Names of the state's entries; hidden states contain their effect's name."""
        own = tuple(f"{e.name}.{s}" for e in self.effects for s in e.states)
        return self.motion_states + own

    def rest(self) -> State:
        """The state of a drive at rest, unloaded, at angle zero."""
        return self.settled(jnp.asarray(np.zeros(len(self.motion_states))))

    def settled(self, motion_state: Float[Array, " motion_states"]) -> State:
        """The state with hidden states in steady state with the motion."""
        motion = self.motion(motion_state)
        return jnp.concatenate([motion_state, *(e.initial_state(motion) for e in self.effects if e.states)])

    def actuate(self, logged: PiecewisePolynomial) -> PiecewisePolynomial:
        """The torque after actuator effects, from the logged torque."""
        for effect in self._of(ActuatorEffect):
            logged = effect.actuate(logged)
        return logged

    def with_effects(self, *effects: Effect) -> "Model":
        """The same model with further effects."""
        # Not `eqx.tree_at`, which would skip the check of what a reduced drive can carry.
        return dataclasses.replace(self, effects=self.effects + effects)

    def without_effect(self, name: str) -> "Model":
        """The same model without the effect of that name."""
        kept = tuple(e for e in self.effects if e.name != name)
        return eqx.tree_at(lambda m: m.effects, self, kept)

    def effect(self, name: str) -> Effect:
        """The effect of that name.

        Raises:
            ValueError: there is none.
        """
        for effect in self.effects:
            if effect.name == name:
                return effect
        raise ValueError(f"`{name}` is no effect of this model; there are {[e.name for e in self.effects]}")

    def parameters(self) -> dict[str, tuple[Array, ParameterInfo]]:
        """All parameters by dotted path: the drive's by their symbol, an effect's as `name.symbol`."""
        found = {name: (getattr(self.drive, name), i) for name, i in own_parameters(self.drive)}
        for e in self.effects:
            found |= {f"{e.name}.{n}": (own_value(e, n), i) for n, i in own_parameters(e)}
        return found

    def get(self, path: str) -> Array:
        """The parameter at a dotted path."""
        return self.values((path,))[0]

    def values(self, paths: Sequence[str]) -> list[Any]:
        """The parameters at dotted paths. In `eqx.tree_at` they are placeholders.

        Raises:
            ValueError: a path is not one of [`Model.parameters`][].
        """
        places = [path.rpartition(".") for path in paths]
        try:
            # Not `self.effect`: equinox makes a module of a method at each look-up.
            return [
                own_value(next(e for e in self.effects if e.name == of), name) if of else getattr(self.drive, name)
                for of, _, name in places
            ]
        except (AttributeError, IndexError, StopIteration, ValueError) as error:
            known = ", ".join(self.parameters())
            raise ValueError(f"{list(paths)} must be parameters of this model; there are {known}") from error

    def replace(self, values: Mapping[str, ArrayLike]) -> "Model":
        """The same model with other values at the given dotted paths."""
        paths = tuple(values)
        arrays = [as_scalar(values[p]) for p in paths]
        return eqx.tree_at(lambda m: m.values(paths), self, arrays)

    def _of(self, kind: type[_Kind]) -> tuple[_Kind, ...]:
        return tuple(e for e in self.effects if isinstance(e, kind))

    def _own_states(self, state: Sequence[Array]) -> dict[str, Array]:
        """Hidden states of each effect, by name."""
        start = len(self.motion_states)
        found = {}
        for effect in self.effects:
            own = state[start : start + len(effect.states)]
            found[effect.name] = jnp.stack(own) if own else jnp.zeros(0)
            start += len(effect.states)
        return found

    def _mesh_torque(self, motion: Motion, own: dict[str, Array]) -> Array:
        """Torque on the load through the mesh."""
        tau = self.drive.mesh_torque(motion.x, motion.v)
        for effect in self._of(MeshTorqueEffect):
            tau = tau + effect.torque(motion, self.drive, own[effect.name])
        return tau

    def _with_own_rates(self, motion: Motion, rates: list[Array], own: dict[str, Array]) -> list[Array]:
        """The state's rate: that of the motion, then of the hidden states."""
        return rates + [r for e in self.effects if e.states for r in e.state_rates(motion, own[e.name])]


class TwoInertiaModel(Model):
    """Motor and load inertia with the mesh between them.

        J_m theta_m'' = k_T T_m + tau_m - (1/N + e') tau        J_l theta_l'' = tau + T_l + tau_l

    with the mesh torque at `x_s = theta_m/N + e(theta_m) - theta_l`. States: theta_m, theta_l, omega_m, omega_l.
    """

    drive: Drive
    effects: tuple[Effect, ...] = ()
    measured: tuple[str, ...] = eqx.field(static=True, default=BOTH_ANGLES)
    motion_states: ClassVar[tuple[str, ...]] = ("theta_m", "theta_l", "omega_m", "omega_l")

    def __check_init__(self):
        if not self.measured or not set(self.measured) <= set(OUTPUTS):
            raise ValueError(f"`measured` must be among {', '.join(OUTPUTS)}, but is {self.measured}")

    def motion(self, state: State | Sequence[Array], conditions: Conditions = Conditions()) -> Motion:
        theta_m, theta_l, omega_m, omega_l = state[0], state[1], state[2], state[3]
        x = theta_m / self.drive.N - theta_l
        v = omega_m / self.drive.N - omega_l
        for effect in self._of(MeshGeometryEffect):
            x = x + effect.error(theta_m)
            v = v + effect.slope(theta_m) * omega_m
        return Motion(x, v, theta_m, omega_m, theta_l, omega_l, **vars(conditions))

    def component_rates(
        self, state: Sequence[Array], torque: Array, load_torque: Array, conditions: Conditions = Conditions()
    ) -> list[Array]:
        drive = self.drive
        motion = self.motion(state, dataclasses.replace(conditions, T_m=torque))
        own = self._own_states(state)
        tau = self._mesh_torque(motion, own)
        transmission = 1.0 / drive.N
        for effect in self._of(MeshGeometryEffect):
            transmission = transmission + effect.slope(state[0])
        on_motor = drive.k_T * torque - transmission * tau
        for effect in self._of(MeshTorqueEffect):
            if effect.reacts():
                on_motor = on_motor + effect.reaction(motion, drive)
        for effect in self._of(MotorSideEffect):
            on_motor = on_motor + effect.torque(motion, drive, own[effect.name])
        on_load = tau + load_torque
        for effect in self._of(LoadSideEffect):
            on_load = on_load + effect.torque(motion, drive, own[effect.name])
        rates = [state[2], state[3], on_motor / self._motor_inertia, on_load / self._load_inertia]
        return self._with_own_rates(motion, rates, own)

    def mobility(self, moved: str, opposed: str) -> Array | float:
        by_rate = {"omega_m": (1.0, 0.0), "omega_l": (0.0, 1.0), "v": (1.0 / self.drive.N, -1.0)}
        one, other = by_rate[moved], by_rate[opposed]
        return one[0] * other[0] / self._motor_inertia + one[1] * other[1] / self._load_inertia

    @property
    def _motor_inertia(self) -> Array:
        """The part of J_m that moves with the motor's rate."""
        return self.drive.J_m - self._inertia_taken(MotorSideEffect)

    @property
    def _load_inertia(self) -> Array:
        """The part of J_l that moves with the load's rate."""
        return self.drive.J_l - self._inertia_taken(LoadSideEffect)

    def _inertia_taken(self, kind: type[ShaftEffect]) -> Array:
        taken = (effect.inertia_taken(self.drive) for effect in self._of(kind))
        return sum(taken, jnp.zeros_like(self.drive.J_l))

    def outputs(self, state: State, inputs: Inputs | None = None) -> Float[Array, " outputs"]:
        theta_m, omega_m = state[0], state[2]
        theta_l, omega_l = self._load_as_read(state)
        for effect in self._of(SensorEffect):
            theta_m, theta_l = effect.reading(theta_m, theta_l, omega_m, omega_l)
        turn = theta_m / self.drive.N
        readings: dict[str, Callable[[], Array]] = {
            "motor_turn": lambda: turn,
            "motor_angle": lambda: theta_m,
            "load_angle": lambda: theta_l,
            "dynamic_error": lambda: turn - theta_l,
            "motor_velocity": lambda: omega_m,
            "load_velocity": lambda: omega_l,
            JOINT_TORQUE: lambda: self._torque_as_read(state, inputs),
        }
        return jnp.stack([readings[name]() for name in self.measured])

    def _load_as_read(self, state: State) -> tuple[Array, Array]:
        """The load's angle and rate when its sensors are read: Taylor's series to the third order in the delay, as the
        bare drive moves without a torque. What else moves the load counts to the first order.

        A filter's lag is a delay and, by its transfer function `exp(lag s) / (1 + lag s)`, terms from the second order
        on of the delayed motion."""
        ahead = _ahead(effect.load_delay() for effect in self._of(SensorEffect))
        theta_l, omega_l = state[1], state[3]
        if ahead is None:
            return theta_l, omega_l
        motion = self.motion(state)
        torque = self.drive.mesh_torque(motion.x, motion.v)
        slope = time_derivative(self.drive.mesh_torque)(motion.x, motion.v, -self._mesh_mobility * torque)
        moving = theta_l, omega_l, torque / self._load_inertia, slope / self._load_inertia
        theta_l, omega_l = taylor(moving, ahead), taylor(moving[1:], ahead)
        for effect in self._of(SensorEffect):
            if (lag := effect.load_lag()) is not None:
                theta_l = theta_l + lag**2 / 2 * taylor(moving[2:], ahead) - lag**3 / 3 * moving[3]
                omega_l = omega_l + lag**2 / 2 * moving[3]
        return theta_l, omega_l

    def _torque_as_read(self, state: State, inputs: Inputs | None) -> Array:
        """Reading of the joint torque's sensor."""
        tau = self._late_torque(state, inputs)
        for effect in self._of(SensorEffect):
            tau = effect.torque_reading(tau)
        return tau

    def _late_torque(self, state: State, inputs: Inputs | None) -> Array:
        """The mesh torque when its sensor is read: Taylor's series to the fourth order in the delay. The first order is
        that of all effects; the others are those of the bare drive from its twist's acceleration on, under a steady
        torque."""
        conditions = Conditions() if inputs is None else inputs.conditions

        def torque(*state: Array) -> Array:
            return self._mesh_torque(self.motion(state, conditions), self._own_states(state))

        ahead = _ahead(effect.torque_delay() for effect in self._of(SensorEffect))
        if ahead is None:
            return torque(*state)
        if inputs is None:
            nothing = jnp.zeros_like(state[0])
            rates = dataclasses.replace(self, effects=()).component_rates(tuple(state)[:4], nothing, nothing)
            rates += [nothing] * (len(state) - 4)
        else:
            rates = self.component_rates(tuple(state), inputs.torque, inputs.load_torque, conditions)
        now, first = jax.jvp(torque, tuple(state), tuple(rates))

        def twist(*state: Array) -> tuple[Array, Array]:
            motion = self.motion(state, conditions)
            return motion.x, motion.v

        (x, v), (_, acceleration) = jax.jvp(twist, tuple(state), tuple(rates))
        series, moving, derivative = [now, first], [x, v, acceleration], time_derivative(self.drive.mesh_torque)
        for _ in range(3):
            moving.append(-self._mesh_mobility * series[-1])
            derivative = time_derivative(derivative)
            series.append(derivative(*moving))
        return taylor(series, ahead)

    @property
    def _mesh_mobility(self) -> Array:
        """Acceleration of the twist by a unit of mesh torque [1/(kg m^2)]."""
        return 1.0 / self._load_inertia + 1.0 / (self._motor_inertia * self.drive.N**2)


def reading_both_angles(model: Model) -> Model:
    """The model with an encoder on either side, whatever was measured in the log that it is from; a reduced one is
    unchanged."""
    return dataclasses.replace(model, measured=BOTH_ANGLES) if isinstance(model, TwoInertiaModel) else model


def _ahead(delays: Iterable[Array | None]) -> Array | None:
    """Time by which a sensor is read ahead [s], from the delays of all effects; None without any."""
    found = [delay for delay in delays if delay is not None]
    return -sum(found, jnp.zeros(())) if found else None


class TwistModel(Model):
    """The dynamic error alone. States: x, v."""

    motion_states: ClassVar[tuple[str, ...]] = ("x", "v")
    measured: ClassVar[tuple[str, ...]] = ("dynamic_error",)  # pyright: ignore[reportIncompatibleVariableOverride]

    def __check_init__(self):
        for effect in self.effects:
            if effect.needs_motor:
                raise ValueError(f"`{effect.name}` needs the motor's motion; use a TwoInertiaModel")

    def motion(self, state: State | Sequence[Array], conditions: Conditions = Conditions()) -> Motion:
        return Motion(x=state[0], v=state[1], **vars(conditions))

    def outputs(self, state: State, inputs: Inputs | None = None) -> Float[Array, "1"]:
        return state[:1]

    @abc.abstractmethod
    def twist_acceleration(self, torque: Array, tau: Array, load_torque: Array) -> Array:
        """x'' [rad/s^2] under the torque, the mesh torque tau, and the load torque."""

    def component_rates(
        self, state: Sequence[Array], torque: Array, load_torque: Array, conditions: Conditions = Conditions()
    ) -> list[Array]:
        motion = self.motion(state, conditions)
        own = self._own_states(state)
        acceleration = self.twist_acceleration(torque, self._mesh_torque(motion, own), load_torque)
        return self._with_own_rates(motion, [state[1], acceleration], own)


class ReducedModel(TwistModel):
    """The dynamic error alone, `x'' = gain u - torque(x, v, ...)`. States: x, v."""

    drive: ReducedDrive
    effects: tuple[Effect, ...] = ()

    def twist_acceleration(self, torque: Array, tau: Array, load_torque: Array) -> Array:
        return self.drive.gain * torque - tau

    def mobility(self, moved: str, opposed: str) -> Array | float:
        return 1.0
