"""Torque of an effect along the fitted motion, from its law and as estimated from the data without a law."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.estimate import Fit
from fitting.estimation.projection import solved
from fitting.first_order.gains import LinearisedFit, linearise_along, products
from fitting.first_order.motion import place_of
from fitting.uncertainty.innovations import spread_evenly
from hdjax import Model
from hdjax.effects import Effect, MeshTorqueEffect, Motion, ShaftEffect
from hdjax.effects.learned import Learned, LearnedTorque
from hdjax.effects.learned_axes import ANGLES
from hdjax.engine.pointwise import at_instants

# Values of the variable at which the torque is estimated, in each direction.
_PLACES = 14
# Share of the samples, on each side, that the effect is averaged over at each value.
_NEARBY = 500
# Instants of the motion that are plotted.
_INSTANTS = 1500


class Evidence(eqx.Module):
    """The torque of one effect over the variable that shows it best.

    Attributes:
        effect: its name.
        variable: the abscissa; angles within one turn.
        at: the variable at instants of the motion.
        does: torque of the effect at these instants [N m].
        places: values of the variable for the estimate, one row for each direction of the motion.
        told: torque estimated from the data there, with all parameters as fitted.
        std: standard error of `told`, for a white residual.
    """

    effect: str = eqx.field(static=True)
    variable: str = eqx.field(static=True)
    at: Float[np.ndarray, " instants"]
    does: Float[np.ndarray, " instants"]
    places: Float[np.ndarray, "directions places"]
    told: Float[np.ndarray, "directions places"]
    std: Float[np.ndarray, "directions places"]


def evidence(fit: Fit) -> tuple[Evidence, ...]:
    """The evidence of each effect that depends mainly on one variable.

    Args:
        fit: of the model with the effects.
    """
    drawn = [e for e in fit.model.effects if e.drawn_against is not None and not isinstance(e, Learned)]
    if not drawn:
        return ()
    look = linearise_along(fit)
    return tuple(found for found in (_evidence(look, effect) for effect in drawn) if found is not None)


def _evidence(look: LinearisedFit, effect: Effect) -> Evidence | None:
    assert effect.drawn_against is not None
    value = np.array(getattr(look.motion, effect.drawn_against))
    does = at_instants(_done, (look.followed.states, 2), ((effect.name, look.model), 0), (look.motion, 2))
    weight = np.asarray(look.problem.segments.weight)
    known = np.isfinite(value) & np.isfinite(does)
    # The last knot of a segment is the first one of the next segment.
    kept = (np.pad(weight, ((0, 0), (0, 1))) > 0) & known
    if effect.drawn_against in ANGLES and np.ptp(value[kept]) > 2 * np.pi:
        value = np.mod(value, 2 * np.pi)
    if not np.ptp(value[kept]) > 0:
        return None
    some = np.flatnonzero(kept)
    some = some[spread_evenly(some.size, _INSTANTS)]
    at, done = value.reshape(-1)[some], does.reshape(-1)[some]
    form = place_of(effect)
    # Only torques are drawn against a quantity.
    assert form is not None
    # The effect acts at samples without valid outputs as well.
    signs = np.where(known, _directions(effect, look.motion), np.nan)
    places, told, std = _told(look, form, value, does, kept, signs)
    return Evidence(effect.name, effect.drawn_against, at, done, places, told, std)


def _directions(effect: Effect, motion: Motion) -> np.ndarray:
    """The sign of the rate by which an effect with memory or sliding may differ; zero for other effects."""
    v = np.asarray(motion.v)
    memory_of_twist = bool(effect.states) and effect.drawn_against == "x"
    slides = effect.family == "position_dependent_friction"
    if not (memory_of_twist or slides):
        return np.zeros_like(v)
    speed = v if motion.omega_m is None or memory_of_twist else np.asarray(motion.omega_m)
    return np.where(speed >= 0, 1.0, -1.0)


def _done(state: Array, named: tuple[str, Model], motion: Motion) -> Array:
    """Torque of a named effect at an instant."""
    name, model = named
    effect = model.effect(name)
    names = model.state_names
    assert isinstance(effect, MeshTorqueEffect | ShaftEffect)
    own = [state[names.index(f"{name}.{s}")] for s in effect.states]
    # A model has the drive that its effects need.
    return effect.torque(motion, model.drive, jnp.array(own))  # pyright: ignore[reportArgumentType]


def _told(
    look: LinearisedFit,
    form: type[LearnedTorque],
    value: Float[np.ndarray, "segments knots"],
    does: Float[np.ndarray, "segments knots"],
    kept: np.ndarray,
    direction: Float[np.ndarray, "segments knots"],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Least-squares estimate of the torque as a piecewise linear function with nodes at `places`, for each direction
    (NaN where it is unknown), with all parameters as fitted."""
    signs = np.unique(direction[kept])
    places, hats, middle = [], [], []
    for sign in signs:
        acting = direction == sign
        there = kept & acting
        nodes = np.unique(np.quantile(value[there], np.linspace(0.01, 0.99, _PLACES)))
        nodes = np.pad(nodes, (0, _PLACES - nodes.size), constant_values=np.nan)
        places.append(nodes)
        middle.append(_nearby(value[there], does[there], nodes))
        hats.append(np.where(acting[..., None], _hats(value, nodes), 0.0))
    found = products(look, look.acting(form.name), (np.concatenate(hats, axis=-1),))
    own = slice(len(look.problem.free.paths), None)
    # The error is whitened: the plain sum over outputs is the likelihood.
    gram = np.einsum("siipq->pq", found.gram[..., own, own])
    gradient = np.einsum("siip->p", found.gradient[..., own])
    added = solved(gram, gradient[:, None])[:, 0]
    variance = np.diag(solved(gram, np.eye(len(gram))))
    shape = (signs.size, _PLACES)
    return np.stack(places), np.stack(middle) + added.reshape(shape), np.sqrt(variance).reshape(shape)


def _nearby(value: np.ndarray, does: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """The effect at each node, averaged over the nearest samples."""
    order = np.argsort(value)
    middle = np.searchsorted(value[order], nodes)
    reach = max(1, value.size // _NEARBY)
    return np.array([np.mean(does[order][max(0, m - reach) : m + reach]) for m in middle])


def _hats(value: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Piecewise linear functions that are one at one node and zero at the others; constant beyond the ends. Zero for a
    missing node."""
    there = np.isfinite(nodes)
    unit = np.eye(int(there.sum()))
    known = np.stack([np.interp(value, nodes[there], row) for row in unit], axis=-1)
    found = np.zeros((*value.shape, nodes.size))
    found[..., there] = known
    return found
