"""Regressors of effects at zero strength along a motion: forces, or changes of the encoders' readings."""

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.free_parameters import strength_paths
from fitting.estimation.linear_response import Forces, Inputs, acting, inputs_at, polynomial, state_rates
from fitting.estimation.machine_code import actuated
from fitting.first_order.internal_states import Memory, memory_of, own_between, own_states
from fitting.first_order.motion import ERROR, INPUT, PART, SLOPE, Along, place_of
from hdjax import Drive, Model, PiecewisePolynomial
from hdjax.dynamics import JOINT_TORQUE
from hdjax.effects import (
    ActuatorEffect,
    Effect,
    MeshGeometryEffect,
    MeshTorqueEffect,
    Motion,
    MotorSideEffect,
    SensorEffect,
    ShaftEffect,
)
from hdjax.effects.learned import LearnedMotorTorque
from hdjax.engine.pointwise import at_instants, slopes_at_instants
from hdjax.parameters import own_value


class Regressors(eqx.Module):
    """Derivatives by the strengths of an effect, one column for each strength of each proposal.

    Attributes:
        forces: derivatives of the forces along the motion; None without any.
        reading: derivatives of the readings at the samples; None without any.
    """

    forces: Forces | None
    reading: Float[np.ndarray, "segments samples outputs columns"] | None = None


def regressors(
    seen: Along, proposals: Sequence[Effect], before: Memory | None = None
) -> tuple[Regressors, Memory | None]:
    """The regressors of proposals of one form along a motion, and the effect's hidden states there.

    Args:
        seen: the motion.
        proposals: effects of one and the same form, at zero strength.
        before: hidden states along the preceding stretches.
    """
    stacked = jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *proposals)
    segments = seen.segments
    shape = segments.measured.shape
    states = np.zeros((shape[0], shape[1] + 1, len(proposals), 0))
    memory = None
    if stacked.states:
        states = own_states(seen, stacked, len(proposals), before)
        memory = memory_of(seen, states)
    if isinstance(stacked, ActuatorEffect):
        added = {INPUT: _inputs(seen, proposals)}
    elif isinstance(stacked, SensorEffect):
        return Regressors(None, _finite(_readings(seen, stacked, states))), memory
    else:
        # An effect's contribution does not depend on other effects.
        bare = replace(seen.model, effects=())
        inertial = isinstance(stacked, ShaftEffect) and stacked.takes_inertia()
        accelerations = _accelerations(seen) if inertial else None
        added = _by_strength(_added, stacked, bare, seen.between, accelerations, own=own_between(states))
    added = {name: _finite(values) for name, values in added.items()}
    lands, sizes = [seen.carried[name] for name in added], list(added.values())
    forces = Forces(np.concatenate(lands, axis=3), np.concatenate(sizes, axis=2))
    # A sensor of the joint torque measures the added torque directly.
    in_the_mesh = isinstance(stacked, MeshTorqueEffect | MeshGeometryEffect)
    read = isinstance(stacked, SensorEffect) or (in_the_mesh and JOINT_TORQUE in seen.model.measured)
    return Regressors(forces, _finite(_readings(seen, stacked, states)) if read else None), memory


def _finite(values: np.ndarray) -> np.ndarray:
    """Set the regressors of an effect that diverges along the motion to zero."""
    lost = ~np.isfinite(values).all(axis=tuple(range(values.ndim - 1)))
    return np.where(lost, 0.0, values) if lost.any() else values


def _by_strength(function: Callable[..., Any], stacked: Effect, model: Model, *looked_at: Any, own: np.ndarray) -> Any:
    """Derivatives of a function of an effect at each instant by each strength of each proposal, as columns.

    Args:
        function: of the strengths, the effect, the model, further inputs, and the effect's hidden states.
        stacked: the proposals, along the first axis of each array.
        model: the equations.
        looked_at: further inputs: trees of arrays whose first axes are those of the instants.
        own: hidden states of each proposal, on the first axis. At zero strength they don't depend on it.
    """
    instants = own.shape[1:-1]
    each = jax.tree.map(lambda a: a[:, None], stacked)
    strengths = np.stack([np.asarray(value) for value in _strengths(each)], axis=-1)
    flat = [
        (jax.tree.map(lambda a: np.asarray(a).reshape(-1, *a.shape[len(instants) :]), tree), 1) for tree in looked_at
    ]
    states = own.reshape(own.shape[0], math.prod(instants), own.shape[-1])
    found = slopes_at_instants(function, (strengths, 2), (each, 2), (model, 0), *flat, (states, 2))
    # Columns of all proposals side by side.
    whole = jax.tree.map(lambda values: np.moveaxis(values, 0, -2), found)
    return jax.tree.map(lambda values: values.reshape(*instants, *values.shape[1:-2], -1), whole)


def _strengths(effect: Any) -> list[Any]:
    return [own_value(effect, path.split(".")[1]) for path in strength_paths(effect)]


def _with(effect: Effect, strengths: Array) -> Effect:
    return eqx.tree_at(_strengths, effect, list(strengths))


def _added(
    strengths: Array, effect: Effect, bare: Model, motion: Motion, accelerations: Array | None, own: Array
) -> dict[str, Array]:
    """The quantities that an effect adds at an instant, by name. Inertia that it takes off a shaft adds the torque that
    accelerates it."""
    effect = _with(effect, strengths)
    if isinstance(effect, MeshGeometryEffect):
        assert motion.theta_m is not None
        return {ERROR: effect.error(motion.theta_m), SLOPE: effect.slope(motion.theta_m)}
    place = place_of(effect)
    assert place is not None and isinstance(effect, MeshTorqueEffect | ShaftEffect)
    torques = {place.name: effect.torque(motion, bare.drive, own)}  # pyright: ignore[reportArgumentType]
    if accelerations is not None:
        assert isinstance(effect, ShaftEffect) and isinstance(bare.drive, Drive)
        shaft = 0 if isinstance(effect, MotorSideEffect) else 1
        torques[place.name] += effect.inertia_taken(bare.drive) * accelerations[shaft]
    if isinstance(effect, MeshTorqueEffect) and effect.reacts() and isinstance(bare.drive, Drive):
        torques[LearnedMotorTorque.name] = effect.reaction(motion, bare.drive)
    return torques


def _inputs(seen: Along, proposals: Sequence[Effect]) -> Float[np.ndarray, "segments samples nodes columns"]:
    """Derivatives of the torque after actuator effects, at the nodes. These act on the torque signal as a whole, not at
    an instant."""
    segments = seen.segments
    logged = PiecewisePolynomial(np.asarray(segments.torque.knots), acting(seen.model, segments))
    found = []
    for effect in proposals:
        assert isinstance(effect, ActuatorEffect)
        _, slopes = actuated((effect,), tuple(strength_paths(effect)), np.stack(_strengths(effect)), logged)
        found += [slope[:, segments.halo :] for slope in slopes]
    # By columns, and then by powers.
    return polynomial(np.stack(found, axis=2)[:, :, None], (PART * segments.width[..., None])[..., None])


def _accelerations(seen: Along) -> Float[np.ndarray, "segments samples nodes 2"]:
    """Accelerations of motor and load at the nodes."""
    inputs = inputs_at(seen.model, seen.segments, PART * seen.segments.width[..., None])
    rates = at_instants(state_rates, (seen.model, 0), (seen.followed.between, 3), (inputs, 3))
    return rates[..., [seen.model.state_names.index(name) for name in ("omega_m", "omega_l")]]


def _readings(
    seen: Along, stacked: Effect, states: np.ndarray
) -> Float[np.ndarray, "segments samples outputs columns"]:
    """Derivatives of the outputs at the samples for a fixed motion."""
    own = np.moveaxis(states[:, :-1], 2, 0)
    inputs = inputs_at(seen.model, seen.segments, np.zeros_like(seen.segments.width))
    return _by_strength(_outputs, stacked, seen.model, seen.followed.states[:, :-1], inputs, own=own)


def _outputs(strengths: Array, effect: Effect, model: Model, state: Array, inputs: Inputs, own: Array) -> Array:
    return model.with_effects(_with(effect, strengths)).outputs(jnp.concatenate([state, own]), inputs)
