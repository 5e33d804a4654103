"""Weights of outputs, from the covariance of their errors, and of the gaps between joined segments."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.linear_response import readout
from fitting.estimation.residual import Problem
from hdjax import Model, TwoInertiaModel
from hdjax.dynamics import BOTH_ANGLES


class Shown(eqx.Module):
    """Visibility of each state in the outputs, for its weight in a gap.

    Attributes:
        angles: derivatives of the outputs by the angles.
        rates: likewise by the rates.
        omega_0: natural frequency [rad/s].
        hidden: units of the hidden states.
        swing: amplitude of the principal output per twist.
        sides: each side's angle over that of the output, where other signals than both angles are measured.
    """

    angles: Float[np.ndarray, "outputs angles"]
    rates: Float[np.ndarray, "outputs angles"]
    omega_0: float
    hidden: Float[np.ndarray, " hidden"]
    swing: float
    sides: Float[np.ndarray, " angles"] | None

    @classmethod
    def of(cls, model: Model, swing: float) -> "Shown":
        """From a model's states."""
        count = len(model.motion_states) // 2
        # At rest no temperature is known.
        steady = replace(model, effects=tuple(e for e in model.effects if not e.needs_temperature))
        slopes = readout(steady, steady.rest())
        hidden = np.concatenate([np.zeros(0), *(np.asarray(e.state_scale()) for e in model.effects if e.states)])
        sides = None
        if isinstance(model, TwoInertiaModel) and model.measured != BOTH_ANGLES:
            sides = np.array([float(model.drive.N), 1.0])
        own = slopes[:, :count], slopes[:, count : 2 * count]
        return cls(*own, float(model.drive.omega_0), hidden, swing, sides)


def weighed(problem: Problem, covariance: Array | np.ndarray, shown: Shown) -> Problem:
    """The problem, weighed by the covariance of the outputs' errors."""
    white = whitening(covariance)
    gap_weight = np.sqrt(problem.segments.weight.shape[1]) * _gap_weight(white, shown)
    return replace(problem, whitening=jnp.asarray(white), gap_weight=jnp.asarray(gap_weight))


def whitening(covariance: Float[Array | np.ndarray, "outputs outputs"]) -> Float[np.ndarray, "outputs outputs"]:
    """W with `W covariance W^T = 1`."""
    return np.linalg.inv(np.linalg.cholesky(np.asarray(covariance)))


def _gap_weight(white: np.ndarray, shown: Shown) -> Float[np.ndarray, " states"]:
    """Weight of each state in a gap: about its effect on each sample of the following segment.

    An angle appears in every sample, a rate as the angle that it causes within a radian of the oscillation. A hidden
    state has the effect of its range on the error. With smaller weights the solver would avoid closing the gaps.
    """
    angles = np.linalg.norm(white @ shown.angles, axis=0)
    if shown.sides is not None:
        # States without a sensor count by the motion that they cause.
        rates = np.linalg.norm(white @ shown.rates, axis=0) * shown.omega_0
        angles = np.max(np.maximum(angles, rates) * shown.sides) / shown.sides
    visible = 0.1 * shown.swing * np.linalg.norm(white[:, -1])
    return np.concatenate([angles, angles / shown.omega_0, visible / shown.hidden])
