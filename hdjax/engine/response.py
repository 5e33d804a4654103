"""Linear response of a motion in each sample interval: to a deviation of the state, and to a force."""

from collections.abc import Mapping, Sequence
from typing import Any

import diffrax as dfx
import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.dynamics import Inputs, Model, State
from hdjax.effects import Conditions, Effect, Motion
from hdjax.engine.equations import LOAD, TEMPERATURE, numbers_of
from hdjax.engine.kernel import Lanes, Marched, Wanted, kernel, march_arrays, threads


class Pushed(Model):
    """A model with a force that is linear in time added to its rates; its last state is the time since its start."""

    model: Model
    steady: tuple[Array, ...]
    rising: tuple[Array, ...]

    @classmethod
    def of(cls, model: Model, steady: tuple[Array, ...], rising: tuple[Array, ...]) -> "Pushed":
        """A model with added rates of its states: constant ones, and such that are proportional to time."""
        # Fields of a model are properties here.
        return cls(model=model, steady=steady, rising=rising)  # pyright: ignore[reportCallIssue]

    # All states count as motion states, so that none has a prior.
    @property
    def motion_states(self) -> tuple[str, ...]:  # pyright: ignore[reportIncompatibleVariableOverride]
        return self.state_names

    @property
    def drive(self) -> Drive | ReducedDrive:
        return self.model.drive

    @property
    def effects(self) -> tuple[Effect, ...]:
        return self.model.effects

    @property
    def measured(self) -> tuple[str, ...]:
        return self.model.state_names

    @property
    def state_names(self) -> tuple[str, ...]:
        return (*self.model.state_names, "passed")

    @property
    def forces(self) -> tuple[str, ...]:
        """The paths of the force's numbers."""
        return tuple(f"{kind}.{i}" for kind in ("steady", "rising") for i in range(len(self.steady)))

    def values(self, paths: Sequence[str]) -> list[Any]:
        return [getattr(self, kind)[int(index)] for kind, index in (path.split(".") for path in paths)]

    def motion(self, state: State | Sequence[Array], conditions: Conditions = Conditions()) -> Motion:
        return self.model.motion(state[:-1], conditions)

    def component_rates(
        self, state: Sequence[Array], torque: Array, load_torque: Array, conditions: Conditions = Conditions()
    ) -> list[Array]:
        *own, passed = state
        found = self.model.component_rates(own, torque, load_torque, conditions)
        pushes = zip(found, self.steady, self.rising, strict=True)
        return [*(rate + steady + rising * passed for rate, steady, rising in pushes), jnp.ones_like(passed)]

    def mobility(self, moved: str, opposed: str) -> Array | float:
        return self.model.mobility(moved, opposed)

    def outputs(self, state: State, inputs: Inputs | None = None) -> Array:
        return state[:-1]


class Response(eqx.Module):
    """A simulated motion, and its linear response in every sample interval.

    Attributes:
        states: at each knot, the end of the last interval included; NaN where the simulation diverges.
        transition: derivative of the state at an interval's end by that at its start.
        from_start: response at the end to a force (a rate of the state) that falls from one to zero through the
            interval.
        from_end: response to one that rises from zero to one.
    """

    states: Float[Array | np.ndarray, "*segments knots states"]
    transition: Float[Array | np.ndarray, "*segments samples states states"]
    from_start: Float[Array | np.ndarray, "*segments samples states states"]
    from_end: Float[Array | np.ndarray, "*segments samples states states"]

    @classmethod
    def of(cls, states: Any, transition: Any, steady: Any, rising: Any, width: Any) -> "Response":
        """From the responses to a constant force, and to one equal to the time since the interval's start."""
        from_end = rising / width[..., None, None]
        return cls(states, transition, steady - from_end, from_end)


def response(
    model: Model,
    states: Float[np.ndarray, "segments states"],
    knots: Float[np.ndarray, "segments knots"],
    torque: Float[np.ndarray, "segments samples powers"],
    beside: Mapping[str, Float[np.ndarray, "segments samples _"]],
    substeps: int,
    solver: dfx.AbstractERK,
) -> Response:
    """Simulate segments and linearise every sample interval.

    Args:
        model: the equations.
        states: initial state of each segment.
        knots: of its sample intervals.
        torque: coefficients of the torque after actuator effects, or of the forcing.
        beside: coefficients of other inputs, by the names in `Kernel.signals`.
        substeps: solver steps in each interval.
        solver: explicit Runge-Kutta solver of diffrax.
    """
    # Modules that need llvmlite are imported only if it is installed.
    from hdjax.engine.rows import LOST

    (segments, count), samples = states.shape, knots.shape[1] - 1
    zeros = (jnp.asarray(np.zeros(())),) * count
    pushed = Pushed.of(model, zeros, zeros)
    around = {"loaded": LOAD in beside, "warm": TEMPERATURE in beside}
    made = kernel(pushed, pushed.forces, **around, solver=solver)
    others = numbers_of(pushed)
    signals = [torque, *(beside[name] for name in made.signals)]

    def marched(states: np.ndarray, knots: np.ndarray, signals: list[np.ndarray], wanted: Wanted) -> Marched:
        many, length = knots.shape[0], knots.shape[1] - 1
        data = Lanes(
            free=np.zeros(2 * count),
            slopes=np.ones(2 * count),
            constants=np.concatenate([np.zeros(0), *(np.ravel(np.asarray(a)) for a in others)]),
            states=np.pad(states, ((0, 0), (0, 1))),
            knots=knots,
            measured=np.zeros((many, length, count)),
            weight=np.ones((many, length)),
            joined=np.zeros(many),
            whitening=-np.eye(count),
            settings=np.array([substeps, 1, threads()]),
            signals=tuple(signals),
        )
        return march_arrays(made.jacobian, data, made.hidden, "jacobian", wanted)

    values = marched(states, knots, signals, "rows")
    states = np.concatenate([values.rows.reshape(segments, samples, count), values.end[:, None, :-1]], axis=1)
    states = np.where(np.abs(states) < LOST, states, np.nan)
    pairs = np.stack([knots[:, :-1], knots[:, 1:]], axis=-1).reshape(-1, 2)
    pieces = [s.reshape(-1, 1, s.shape[-1]) for s in signals]
    slopes = marched(states[:, :-1].reshape(-1, count), pairs, pieces, "jacobian")
    shape = (segments, samples, count, count)
    assert slopes.end_by_state is not None and slopes.end_by_parameter is not None
    steady, rising = (slopes.end_by_parameter[:, :-1, i * count :][..., :count].reshape(shape) for i in (0, 1))
    transition = slopes.end_by_state[:, :-1, :-1].reshape(shape)
    return Response.of(states, transition, steady, rising, np.diff(knots))
