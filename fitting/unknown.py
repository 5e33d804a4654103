"""What is missing where the catalogue does not say: learned inside the equations, as a function of what matters.

Which place and which variables is decided on training data alone, by leaving parts of them out in turn; the held-out
stretches then judge one learned function, like any other effect.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.linalg import eigh, null_space

from fitting.along import ERROR, SLOPE
from fitting.attribution import SIGNIFICANCE
from fitting.base_fit import leaves_white_noise
from fitting.estimate import Fit
from fitting.linear_look import (
    Look,
    Products,
    Pushes,
    Sizes,
    best_step,
    left_after,
    look_along,
    parameter_torques,
    products,
    surrogate_gains,
)
from fitting.surrogates import surrogates
from fitting.trial import LEAST_GAIN, Data, Setting, Trial, challenge
from hdjax import Model, ReducedModel, sampled
from hdjax.effects import Conditions, Motion
from hdjax.effects.learned import (
    ANGLES,
    LEARNED,
    UNITS,
    AngleAxis,
    Axis,
    Learned,
    LearnedMeshTorque,
    LearnedTorque,
    axis_over,
)

# Parts that training data are left out in, in turn.
_FOLDS = 4
# How many coefficients a function of one variable may have, and of two.
_SIZES = {1: (1, 2, 3, 4, 5, 7, 9, 11, 13, 16), 2: (3, 5, 7, 9, 12, 16, 20, 24)}
# A poorer error by this share (in the objective) is no reason for more coefficients, or for a second variable.
_WORTH_A_COEFFICIENT, _WORTH_A_VARIABLE = 0.005, 0.03
# A rival that gains this share of what the best one does, to first order, is refitted as well.
_NEARLY = 0.8
# Share of its mean square that the functions of the same variables must reach to take a free parameter for one of them.
_SAME_FUNCTION = 0.99
# What explains less than this share of the error, to first order, is not refitted: of what the base model leaves,
# and beside effects that have a name already.
_LEAST_SHARE, _LEAST_SHARE_BESIDE = 0.005, 0.02
# Motions that so few samples reach are no part of the range.
_RARE = 5e-4
# First-order changes of a logarithm are taken no larger than this.
_LARGEST_CHANGE = 1.0
# Instants of the motion that stand for the density of the data.
_INSTANTS = 3000


class Candidate(eqx.Module):
    """A place and variables, as the first look sees them.

    Attributes:
        form: the place.
        variables: what the function depends on.
        gain: decrease of the objective on parts of the training data that were left out, to first order.
        effect: the learned function, at the coefficients that suit best to first order.
        drive_step: change of the free vector that goes with it.
        known: functions of the variables that the free parameters stand for already, at the instants that are kept.
    """

    form: type[Learned] = eqx.field(static=True)
    variables: tuple[str, ...] = eqx.field(static=True)
    gain: float
    effect: Learned
    drive_step: Float[np.ndarray, " parameters"]
    known: Float[np.ndarray, "instants known"]


class Unknown(eqx.Module):
    """A learned function that the data support.

    Attributes:
        before: the model without it.
        trial: the model with it.
        candidates: all places and variables, best first by the first look.
        chosen: the one that was taken.
        states: of the model without it, at the instants that stand for the density of the data.
        conditions: time and temperature there.
        push: what a unit of torque adds to their rates: at its place, or in the mesh for an error there.
        gain: decrease of the held-out objective.
        p_value: chance of such a gain where nothing is missing.
    """

    before: Trial
    trial: Trial
    candidates: tuple[Candidate, ...]
    chosen: Candidate
    states: Float[np.ndarray, "instants states"]
    conditions: Conditions
    push: Float[np.ndarray, "instants states"]
    gain: float
    p_value: float

    @property
    def motion(self) -> Motion:
        """The motion at the instants."""
        return jax.vmap(self.before.model.motion)(jnp.asarray(self.states), self.conditions)


class _Sight(eqx.Module):
    """A look, with what candidates share.

    Attributes:
        look: at the fit.
        pushes: what each form's function adds, and its slope as well for an error of the mesh, by the form's name.
        values: variables at each knot.
        weight: of each knot.
    """

    look: Look
    pushes: dict[str, Pushes]
    values: dict[str, Float[np.ndarray, "segments knots"]]
    weight: Float[np.ndarray, "segments knots"]


def learn(before: Trial, data: Data, setting: Setting, *, seed: int, progress: Callable[[str], None]) -> Unknown | None:
    """Learn what a model lacks.

    Args:
        before: the model.
        data: the stretches.
        setting: how they are cut.
        seed: of the surrogates behind the p-value.
        progress: told what is being done.

    Returns:
        The learned torque; None where none brings the training error down.
    """
    progress("looking for what the missing torque depends on")
    sight = _sight(before.training)
    least = _LEAST_SHARE_BESIDE if before.model.effects else _LEAST_SHARE
    found = sorted((c for c in _candidates(sight) if c.gain > least), key=lambda c: -c.gain)
    best: tuple[Candidate, Trial] | None = None
    for several in (False, True):
        if best is not None and leaves_white_noise(best[1].training):
            break
        for candidate in _rivals([c for c in found if (len(c.variables) > 1) == several]):
            if several and best is not None and candidate.gain < best[0].gain + _WORTH_A_VARIABLE:
                break
            progress(f"learning a function of {' and '.join(candidate.variables)}")
            trial = _refitted(before, candidate, data, setting)
            if trial is not None and _penalised(trial) < _penalised(before if best is None else best[1]):
                best = candidate, trial
    if best is None:
        return None
    if not leaves_white_noise(best[1].training):
        best = _refined(best, data, setting, progress)
    chosen, trial = best
    gain = before.held_out.objective - trial.held_out.objective
    p_value = _p_value(sight, before, chosen, gain, seed)
    instants = _instants(sight)
    states, acting = (
        np.asarray(a).reshape(-1, a.shape[2])[instants]
        for a in (sight.look.followed.states, _torque_push(sight, chosen.form))
    )
    conditions = jax.tree.map(lambda a: a.reshape(-1)[instants], sight.look.conditions)
    return Unknown(before, trial, tuple(found), chosen, states, conditions, acting, gain, p_value)


def _refined(
    best: tuple[Candidate, Trial], data: Data, setting: Setting, progress: Callable[[str], None]
) -> tuple[Candidate, Trial]:
    """The same function with as many coefficients as a second look, along the motion that the first fit found, calls
    for: the first look is but first order."""
    first, trial = best
    sight = _sight(trial.training, (first.form,))
    own = _own_functions(sight, first.form)
    again = _candidate(sight, first.form, first.variables, first.effect.axes, own)
    if again is None:
        return best
    progress("learning its shape more closely")
    finer = _refitted(trial, again, data, setting)
    if finer is None or not _penalised(finer) < _penalised(trial):
        return best
    again = eqx.tree_at(lambda c: c.gain, again, first.gain)
    return again, finer


def is_supported(found: Unknown | None) -> bool:
    """Whether a learned torque is more than chance and more than an imperfection of the solver."""
    return found is not None and found.gain > LEAST_GAIN and found.p_value <= SIGNIFICANCE


def share_of(named: Model, found: Unknown) -> float:
    """Share of a learned torque's mean square that the effects of a model, beyond those it was learned with, make up.

    Near one the learned torque, which was free to be anything, has come out as those effects.

    Args:
        named: the model with the effects.
        found: what was learned.
    """
    theirs, learned = (without(_torques(m, found), found.chosen.known) for m in (named, found.trial.model))
    return float((theirs @ learned) ** 2 / max((theirs @ theirs) * (learned @ learned), 1e-300))


def _torques(model: Model, found: Unknown) -> Float[np.ndarray, " instants"]:
    """What the effects of a model, beyond those a function was learned with, are as a torque at the function's place,
    at the instants."""
    bare = eqx.tree_at(lambda m: m.effects, model, found.before.model.effects)
    hidden = jnp.asarray(model.rest())[found.states.shape[1] :]
    zero = jnp.zeros(())
    # An error of the torque is an effect as well: what acts where none is logged.
    silence = sampled(np.arange(2.0), np.zeros(2), hold="zero-order")
    acting, before = (m.actuate(silence)(zero) for m in (model, bare))

    def added(state: Array, conditions: Conditions) -> Array:
        own = model.rates(jnp.concatenate([state, hidden]), acting, zero, conditions)
        return own[: state.shape[0]] - bare.rates(state, before, zero, conditions)

    rates = np.asarray(jax.vmap(added)(jnp.asarray(found.states), found.conditions))
    return np.sum(found.push * rates, axis=1) / np.sum(found.push**2, axis=1)


def without(values: np.ndarray, known: Float[np.ndarray, "instants known"]) -> np.ndarray:
    """What of values is no combination of known functions."""
    return values - known @ np.linalg.lstsq(known, values, rcond=1e-10)[0]


def _sight(fit: Fit, places: Sequence[type[Learned]] = LEARNED) -> _Sight:
    look = look_along(fit)
    reduced = isinstance(look.model, ReducedModel)
    forms = [f for f in places if not (f.needs_motor and reduced)]
    values = {n: np.asarray(getattr(look.motion, n)) for n in UNITS if getattr(look.motion, n) is not None}
    weight = np.asarray(look.problem.segments.weight)
    finite = np.all([np.isfinite(v).all(axis=1) for v in values.values()], axis=0)
    # The last knot of a segment is the first one of the next.
    weight = np.pad(weight * finite[:, None], ((0, 0), (0, 1)))
    return _Sight(look, {f.name: _pushes(look, f) for f in forms}, values, weight)


def _pushes(look: Look, form: type[Learned]) -> Pushes:
    names = (form.name,) if issubclass(form, LearnedTorque) else (ERROR, SLOPE)
    return tuple(look.pushes[name] for name in names)


def _torque_push(sight: _Sight, form: type[Learned]) -> Array:
    """What a unit of torque does at the place of a form."""
    return sight.look.pushes[form.name if issubclass(form, LearnedTorque) else LearnedMeshTorque.name]


def _own_functions(sight: _Sight, form: type[Learned]) -> Float[np.ndarray, "segments knots parameters"]:
    """The free parameters as torques at the place of a form; none of them is an error of the mesh."""
    if issubclass(form, LearnedTorque):
        return np.asarray(parameter_torques(sight.look, _torque_push(sight, form)))
    return np.zeros((*sight.weight.shape, len(sight.look.problem.free.paths)))


def _functions(form: type[Learned], axes: Sequence[Axis], values: dict[str, np.ndarray]) -> Sizes:
    """The functions of the axes, and their slopes for an error of the mesh."""
    raw = _all_products([_evaluated(a, values[a.variable]) for a in axes])
    if issubclass(form, LearnedTorque):
        return (raw,)
    (axis,) = axes
    return raw, np.asarray(_all_slopes(axis, jnp.asarray(values[axis.variable])))


def _candidates(sight: _Sight) -> list[Candidate]:
    """Every place with every variable, and with the best one of them and another."""
    found = []
    for form in LEARNED:
        if form.name not in sight.pushes:
            continue
        own = _own_functions(sight, form)

        def look_at(variables: tuple[str, ...], form=form, own=own) -> Candidate | None:
            axes = tuple(_axis(sight, n, b) for n, b in zip(variables, _others(variables), strict=True))
            return _candidate(sight, form, variables, axes, own)

        may = [n for n in sight.values if form.may_depend_on(n)]
        alone = [c for c in (look_at((n,)) for n in may) if c is not None]
        found += alone
        if alone:
            best = max(alone, key=lambda c: c.gain).variables[0]
            pairs = [
                tuple(n for n in may if n in (best, other))
                for other in may
                # The angles of both shafts are one and the same, but for the twist.
                if other != best and not {best, other} <= set(ANGLES)
            ]
            found += [c for c in map(look_at, pairs) if c is not None]
    return found


def _all_products(parts: Sequence[np.ndarray]) -> np.ndarray:
    """All products of one function of each part."""
    found = parts[0]
    for part in parts[1:]:
        found = (found[..., :, None] * part[..., None, :]).reshape(*found.shape[:-1], -1)
    return found


def _others(variables: tuple[str, ...]) -> tuple[str | None, ...]:
    """The variable beside each."""
    return (None,) if len(variables) == 1 else (variables[1], variables[0])


def _axis(sight: _Sight, variable: str, beside: str | None) -> Axis:
    seen = sight.values[variable][sight.weight > 0]
    low, high = np.quantile(seen, [_RARE, 1.0 - _RARE])
    reach = max(high - low, 1e-12 * max(abs(low), abs(high)), 1e-300)
    return axis_over(variable, float(low), float(low + reach), beside=beside)


def _evaluated(axis: Axis, values: np.ndarray) -> np.ndarray:
    return np.asarray(_all_functions(axis, jnp.asarray(values)))


@eqx.filter_jit
def _all_slopes(axis: Axis, values: Array) -> Array:
    return jax.vmap(jax.vmap(jax.jacfwd(axis.functions)))(values)


@eqx.filter_jit
def _all_functions(axis: Axis, values: Array) -> Array:
    return jax.vmap(jax.vmap(axis.functions))(values)


def _candidate(
    sight: _Sight,
    form: type[Learned],
    variables: tuple[str, ...],
    axes: tuple[Axis, ...],
    own: Float[np.ndarray, "segments knots parameters"],
) -> Candidate | None:
    """One place and choice of variables, with as many coefficients as parts of the data that were left out call for."""
    instants = _instants(sight)
    raw = _functions(form, axes, sight.values)
    flat = np.asarray(raw[0]).reshape(-1, raw[0].shape[2])[instants]
    parameters = own.shape[2] - _coefficients(sight.look.model, form)
    known = _same_functions(flat, own.reshape(-1, own.shape[2])[instants][:, :parameters])
    sizes = _SIZES[len(variables)]
    mixing = _smooth_first(flat, known, _roughness(axes))[:, : max(sizes)]
    if mixing.shape[1] == 0:
        return None
    # One width, one program.
    width = ((0, 0), (0, 0), (0, max(sizes) - mixing.shape[1]))
    padded = tuple(np.pad(part @ mixing, width) for part in raw)
    found = _instead_of_own(products(sight.look, sight.pushes[form.name], padded), sight.look, parameters, own.shape[2])
    best: tuple[float, int] | None = None
    base = _left_out(found, parameters)
    for size in (s for s in sizes if s <= mixing.shape[1]):
        gain = base - _left_out(found, parameters + size)
        if best is None or gain > best[0] + _WORTH_A_COEFFICIENT:
            best = gain, size
    if best is None or not best[0] > 0:
        return None
    gain, size = best
    step = best_step(_first(found, parameters + size))
    effect = form(axes=axes, mixing=mixing[:, :size], c=tuple(step[parameters:]))
    return Candidate(form, variables, gain, effect, step[:parameters], known)


def _coefficients(model: Model, form: type[Learned]) -> int:
    """How many coefficients of a learned function at this place a model has already; its last effect."""
    return next((len(e.c) for e in model.effects if isinstance(e, form)), 0)


def _instead_of_own(found: Products, look: Look, kept: int, free: int) -> Products:
    """Products with what the model's learned torque explains put back into the residual, and its columns left out."""
    if kept == free:
        return found
    own = np.zeros(found.gram.shape[-1])
    own[kept:free] = np.asarray(look.problem.free.pack(look.model))[kept:free]
    moved = found.gram @ own
    against = found.gradient @ own
    others = np.delete(np.arange(own.size), np.s_[kept:free])
    return Products(
        found.gram[..., others[:, None], others],
        (found.gradient + moved)[..., others],
        found.square + against + np.swapaxes(against, 1, 2) + moved @ own,
        found.samples,
    )


def _instants(sight: _Sight) -> np.ndarray:
    """Some of the knots with weight, evenly spread."""
    kept = np.flatnonzero(sight.weight.reshape(-1) > 0)
    return kept[np.unique(np.linspace(0, kept.size - 1, min(_INSTANTS, kept.size)).astype(int))]


def _same_functions(raw: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Those free parameters that are functions of the same variables at the same place: the learned torque leaves what
    they can do to them."""
    size = np.sqrt(np.mean(own**2, axis=0))
    own = own[:, size > 0] / size[size > 0]
    coefficients = np.linalg.lstsq(raw, own, rcond=1e-10)[0]
    left = np.mean((own - raw @ coefficients) ** 2, axis=0)
    return own[:, left < 1.0 - _SAME_FUNCTION]


def _roughness(axes: Sequence[Axis]) -> np.ndarray:
    """Penalty on the curvature of a function over the unit range of each axis, per pair of products."""
    parts = []
    for axis in axes:
        if isinstance(axis, AngleAxis):
            order = np.concatenate([[0.0], np.repeat(np.arange(1.0, axis.orders + 1), 2)])
            parts.append(np.diag((2 * np.pi * order) ** 4))
        else:
            bends = np.diff(np.eye(axis.count), 2, axis=0)
            rises = np.diff(np.eye(axis.count), axis=0)
            # The slope, counted little, puts the constant before the straight line.
            parts.append(axis.count**3 * bends.T @ bends + axis.count * rises.T @ rises)
    total = np.zeros((1, 1))
    for part in parts:
        total = np.kron(total, np.eye(len(part))) + np.kron(np.eye(len(total)), part)
    return total


def _smooth_first(raw: np.ndarray, known: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Combinations of functions, smoothest first, each of unit rms on the data, uncorrelated with each other and with
    what is known already (the basis of Demmler and Reinsch 1975)."""
    moment = raw.T @ raw / len(raw)
    free = null_space((raw.T @ known / len(raw)).T, rcond=1e-8) if known.shape[1] else np.eye(raw.shape[1])
    inside = free.T @ moment @ free
    seen, directions = np.linalg.eigh(inside)
    # Where there are no data, nothing can be learned.
    free = free @ directions[:, seen > 1e-6 * np.max(seen, initial=0.0)]
    if free.shape[1] == 0:
        return free
    _, vectors = eigh(free.T @ roughness @ free, free.T @ moment @ free)
    return free @ vectors


def _first(found: Products, columns: int) -> Products:
    return Products(found.gram[..., :columns, :columns], found.gradient[..., :columns], found.square, found.samples)


def _left_out(found: Products, columns: int) -> float:
    """The objective on each part of the data after least squares on the others, with the first columns free."""
    part = np.arange(found.samples.size) * _FOLDS // found.samples.size
    total = np.zeros(found.square.shape[1:])
    first = _first(found, columns)
    for fold in range(min(_FOLDS, found.samples.size)):
        step = best_step(first.of(part != fold))
        total += left_after(first.of(part == fold), step)
    return 0.5 * float(np.linalg.slogdet(total / found.samples.sum())[1])


def _rivals(found: Sequence[Candidate]) -> list[Candidate]:
    """The candidates, best first, that are worth a refit: the best one, and another one that gains nearly as much."""
    return [c for c in found[:2] if c.gain > _NEARLY * found[0].gain]


def _refitted(before: Trial, candidate: Candidate, data: Data, setting: Setting) -> Trial | None:
    free, step = before.training.free, candidate.drive_step
    # The coefficients of a learned torque that is there already come last.
    change = np.pad(step, (0, len(free.paths) - step.size))
    change = np.where(free.logarithmic, np.clip(change, -_LARGEST_CHANGE, _LARGEST_CHANGE), change)
    moved = free.unpack(before.model, free.pack(before.model) + change).without_effect(candidate.form.name)
    return challenge([moved.with_effects(candidate.effect)], data, before.hold, setting, champion=before)


def _penalised(trial: Trial) -> float:
    """The training objective, with what each parameter would gain on noise (Schwarz 1978)."""
    samples = float(trial.training.problem.segments.count)
    return trial.training.objective + 0.5 * len(trial.training.free.paths) * np.log(samples) / samples


def _p_value(sight: _Sight, before: Trial, chosen: Candidate, gain: float, seed: int) -> float:
    unseen = _sight(before.held_out)
    mixing, sizes = np.asarray(chosen.effect.mixing), []
    for one in (sight, unseen):
        values = {name: np.nan_to_num(value) for name, value in one.values.items()}
        sizes.append(tuple(part @ mixing for part in _functions(chosen.form, chosen.effect.axes, values)))
    null = surrogate_gains(
        (sight.look, unseen.look),
        (sight.pushes[chosen.form.name], unseen.pushes[chosen.form.name]),
        (sizes[0], sizes[1]),
        (surrogates(before.training, seed), surrogates(before.held_out, seed + 1)),
    )
    return (1 + int(np.sum(null >= gain))) / (1 + null.size)
