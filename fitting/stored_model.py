"""A fitted model on disk: `model.json`, as read by `hdjax predict`."""

import itertools
import json
import math
from pathlib import Path
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.errors import InputError
from hdjax import HOLDS, Drive, Hold, Model, ReducedDrive, ReducedModel, Trajectory, TwoInertiaModel, sampled, simulate
from hdjax.drive import Prior
from hdjax.dynamics import BOTH_ANGLES, OUTPUTS
from hdjax.effects import BY_NAME, Effect
from hdjax.effects.learned import LEARNED, Learned, LearnedFriction, LearnedPeriodic
from hdjax.effects.learned_axes import (
    UNITS,
    AngleAxis,
    Axis,
    LinearAxis,
    PeriodicAxis,
    PowerAxis,
    SignAxis,
    SplineAxis,
)
from hdjax.effects.learned_memory import LEARNED_WITH_MEMORY
from hdjax.parameters import as_scalar, own_parameters, own_value

SCHEMA = "hdjax-model/1"

_MOST_FUNCTIONS = 1000
# Data of learned functions in addition to their coefficients.
_SHAPES: dict[type[Learned], str] = {LearnedFriction: "transition", LearnedPeriodic: "omega"}
_WITH_PARAMETERS: dict[str, type[Effect]] = {**BY_NAME, **{form.name: form for form in LEARNED_WITH_MEMORY}}


class StoredModel(eqx.Module):
    """A model with the settings of its free runs.

    Attributes:
        model: with fitted values.
        hold: inter-sample behaviour of the torque.
        substeps: solver steps in a sample interval.
        halo: intervals of torque before the start, for delays.
        noise: covariance of the measurement noise of the outputs.
        zeros: what was subtracted from the dynamic error of the logs, each value once.
    """

    model: Model
    hold: Hold = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    halo: int = eqx.field(static=True)
    noise: Float[Array, "outputs outputs"]
    zeros: tuple[float, ...] = eqx.field(static=True, default=())

    def simulate(self, torque: Float[Array | np.ndarray, " n"], times: Float[Array | np.ndarray, " n"]) -> Trajectory:
        """Simulate the drive under a sampled torque, from rest.

        Args:
            torque: of the motor [N m], or the forcing of a reduced model; with the inter-sample behaviour of the logs.
            times: stamps of the samples [s], rising; the motion is returned there.
        """
        forcing = sampled(np.asarray(times), np.asarray(torque), hold=self.hold)
        return simulate(self.model, forcing, jnp.asarray(times))


def to_json(stored: StoredModel) -> str:
    """The file's text."""
    model = stored.model
    content = {
        "schema": SCHEMA,
        "kind": "two-inertia" if isinstance(model, TwoInertiaModel) else "reduced",
        "measured": list(model.measured),
        "drive": _values(model.drive),
        "priors": [_prior(p) for p in model.drive.priors] if isinstance(model.drive, Drive) else [],
        "effects": [{"name": e.name, "parameters": _values(e)} | _learned_content(e) for e in model.effects],
        "torque_hold": stored.hold,
        "substeps": stored.substeps,
        "halo": stored.halo,
        "noise_covariance": np.asarray(stored.noise).tolist(),
        "zeros": list(stored.zeros),
    }
    return json.dumps(content, indent=1, allow_nan=False)


def read_model(path: str | Path) -> StoredModel:
    """Read a model.

    Raises:
        InputError: the file is missing or not a model of this program.
    """
    try:
        content = json.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        reason = f"the model can't be read ({error.strerror})"
        raise InputError(f"{path}: {reason}; give the model.json of a report") from error
    except ValueError as error:
        raise InputError(f"{path}: not a JSON file ({error}); give the model.json of a report") from error
    try:
        return _stored(content)
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise InputError(f"{path}: not a model of this program ({error}); give the model.json of a report") from error


def _values(module: eqx.Module) -> dict[str, float]:
    return {name: float(own_value(module, name)) for name, _ in own_parameters(module)}


def _prior(prior: Prior) -> dict[str, Any]:
    """A parameter's prior in the file; no tolerance for a free one."""
    return {
        "path": prior.path,
        "value": prior.value,
        "tolerance": None if math.isinf(prior.tolerance) else prior.tolerance,
    }


def _priors(content: Any) -> tuple[Prior, ...]:
    return tuple(
        Prior(str(p["path"]), float(p["value"]), math.inf if p["tolerance"] is None else float(p["tolerance"]))
        for p in content
    )


def _learned_content(effect: Effect) -> dict[str, Any]:
    """Data of a learned function in addition to its coefficients."""
    if not isinstance(effect, Learned):
        return {}
    axes = [_axis_content(a) for a in effect.axes]
    return {"axes": axes, "mixing": np.asarray(effect.mixing).tolist()}


def _axis_content(axis: Axis) -> dict[str, Any]:
    own = {name: value for name, value in vars(axis).items() if value is not None}
    return {
        n: _axis_content(v) if isinstance(v, Axis) else v if isinstance(v, str | int) else float(v)
        for n, v in own.items()
    }


def _axis(content: dict[str, Any]) -> Axis:
    if "corner" in content:
        beside = content.get("beside")
        return SignAxis(content["variable"], content["corner"], None if beside is None else _axis(beside))
    own = {"omega": PeriodicAxis, "orders": AngleAxis, "largest": PowerAxis, "low": SplineAxis}
    form = next((form for name, form in own.items() if name in content), LinearAxis)
    return form(**content)


def _effect(content: Any) -> Effect:
    learned = {form.name: form for form in LEARNED}
    if content["name"] not in learned:
        return _WITH_PARAMETERS[content["name"]](**content["parameters"])
    form = learned[content["name"]]
    axes = tuple(_axis(a) for a in content["axes"])
    for i, axis in enumerate(axes):
        if isinstance(axis, SignAxis) and not (i == 0 and form.may_jump_with(axis.variable) and axis.corner > 0):
            raise ValueError(f"a jump with {axis.variable} over {axis.corner}")
    for axis in itertools.chain.from_iterable(map(_parts, axes)):
        if axis.variable not in UNITS or not form.may_depend_on(axis.variable) or axis.count > _MOST_FUNCTIONS:
            raise ValueError(f"{axis.variable} with {axis.count} functions")
        if isinstance(axis, SplineAxis) and not (axis.intervals >= 1 and axis.low < axis.high):
            raise ValueError(f"{axis.variable} from {axis.low} to {axis.high}")
        if isinstance(axis, PowerAxis) and not axis.largest > 0:
            raise ValueError(f"{axis.variable} up to {axis.largest}")
        if isinstance(axis, PeriodicAxis) and not (len(axes) == 1 and axis.variable == "time" and axis.omega > 0):
            raise ValueError(f"{axis.variable} at {axis.omega} rad/s")
    mixing = jnp.asarray(content["mixing"], dtype=float)
    own = dict(content["parameters"])
    shape = {name: own.pop(name) for name in _SHAPES.values() if name in own}
    coefficients = tuple(own[f"c_{i}"] for i in range(len(own)))
    wanted = (math.prod(a.count for a in axes), len(coefficients))
    if mixing.shape != wanted or not bool(jnp.all(jnp.isfinite(mixing))):
        raise ValueError(f"a mixing of shape {mixing.shape} where {wanted} was expected")
    effect = form.made_of(axes, mixing, coefficients)
    expected = {name for kind, name in _SHAPES.items() if isinstance(effect, kind)}
    if shape.keys() != expected or not all(value > 0 for value in shape.values()):
        raise ValueError(f"{shape} where {expected or 'nothing'} was expected")
    for name, value in shape.items():
        effect = eqx.tree_at(lambda e, n=name: getattr(e, n), effect, as_scalar(value))
    return effect


def _parts(axis: Axis) -> tuple[Axis, ...]:
    """An axis and its part beside the sign."""
    return (axis,) if not isinstance(axis, SignAxis) or axis.beside is None else (axis, *_parts(axis.beside))


def _stored(content: Any) -> StoredModel:
    if content["schema"] != SCHEMA:
        raise ValueError(f"schema {content['schema']!r} where {SCHEMA!r} was expected")
    effects = tuple(_effect(e) for e in content["effects"])
    if content["kind"] == "two-inertia":
        drive = Drive(**content["drive"], priors=_priors(content.get("priors", ())))
        measured = tuple(content.get("measured", BOTH_ANGLES))
        if not measured or not OUTPUTS.keys() >= set(measured):
            raise ValueError(f"measured is {measured}")
        model: Model = TwoInertiaModel(drive, effects, measured)
    else:
        model = ReducedModel(ReducedDrive(**content["drive"]), effects)
    for path, (value, info) in model.parameters().items():
        if not math.isfinite(value) or (info.role == "base" and info.positive and value <= 0):
            raise ValueError(f"{path} is {float(value)}")
    if content["torque_hold"] not in HOLDS:
        raise ValueError(f"torque_hold {content['torque_hold']!r}")
    noise = jnp.asarray(content["noise_covariance"], dtype=float)
    outputs = len(model.measured)
    if noise.shape != (outputs, outputs) or not bool(jnp.all(jnp.isfinite(noise))):
        raise ValueError("noise_covariance has the wrong shape")
    if np.min(np.linalg.eigvalsh(np.asarray(noise))) <= 0:
        raise ValueError("noise_covariance is not positive definite")
    substeps, halo = int(content["substeps"]), int(content["halo"])
    if substeps < 1 or halo < 0:
        raise ValueError(f"substeps is {substeps} and halo is {halo}")
    zeros = tuple(float(zero) for zero in content.get("zeros", ()))
    if not np.all(np.isfinite(zeros)):
        raise ValueError(f"zeros are {zeros}")
    return StoredModel(model, content["torque_hold"], substeps, halo, noise, zeros)
