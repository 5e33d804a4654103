"""A learned lagging torque as a dynamic stiffness over frequency, with standard errors."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.discrepancy.curve import PLACES, with_errors
from fitting.first_order.motion import place_of
from fitting.uncertainty.standard_errors import Uncertainty
from hdjax import Model
from hdjax.effects.learned_memory import Lagging

_POINTS = 300
# The frequency range extends from the natural frequency by this factor to either side.
_REACH = 30.0


class LearnedResponse(eqx.Module):
    """A torque that lags behind an angle.

    Attributes:
        place: "mesh", "motor" or "load".
        angle: that it lags behind.
        frequency: [Hz].
        stiffness: magnitude of torque over angle [N m/rad].
        std: standard error of its logarithm.
    """

    place: str = eqx.field(static=True)
    angle: str = eqx.field(static=True)
    frequency: Float[np.ndarray, " frequencies"]
    stiffness: Float[np.ndarray, " frequencies"]
    std: Float[np.ndarray, " frequencies"]


def learned_response(name: str, model: Model, uncertainty: Uncertainty) -> LearnedResponse:
    """The response of a learned torque.

    Args:
        name: of the effect.
        model: with the final values.
        uncertainty: of the values.
    """
    effect = model.effect(name)
    assert isinstance(effect, Lagging)
    place = place_of(effect)
    assert place is not None
    omega = np.geomspace(float(effect.omega) / _REACH, float(effect.omega) * _REACH, _POINTS)

    def size(moved: Model, omega: Array) -> Array:
        own = moved.effect(name)
        assert isinstance(own, Lagging)
        return jnp.log(jnp.abs(own.stiffness(omega, moved.drive)))

    found, std = with_errors(size, model, name, uncertainty, omega)
    return LearnedResponse(PLACES[place.name], effect.angle, omega / (2 * np.pi), np.exp(found), std)
