"""Selection of places and variables of learned functions, by first-order gain.

Along the fitted motion the problem is linear. The number of coefficients is chosen by cross-validation on training
data.
"""

from collections.abc import Iterable, Sequence
from itertools import combinations

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float, Int
from scipy.linalg import block_diag, eigh, null_space

from fitting.attribution.rules import RULES
from fitting.estimation.estimate import Fit
from fitting.estimation.free_parameters import effect_paths
from fitting.first_order.gains import (
    Acting,
    LinearisedFit,
    Products,
    Sizes,
    best_steps,
    left_after,
    linearise_along,
    parameter_torques,
    products,
)
from fitting.first_order.motion import ERROR, SLOPE, place_of, unit_reading
from fitting.first_order.spectral_lines import spectral_lines
from fitting.uncertainty.innovations import spread_evenly
from hdjax import Model, ReducedModel
from hdjax.effects.learned import (
    LEARNED,
    Learned,
    LearnedFriction,
    LearnedMeshError,
    LearnedMeshTorque,
    LearnedPeriodic,
    LearnedReading,
    LearnedTorque,
)
from hdjax.effects.learned_axes import (
    ANGLES,
    UNITS,
    AngleAxis,
    Axis,
    LinearAxis,
    PeriodicAxis,
    PowerAxis,
    SignAxis,
    axes_over,
)
from hdjax.engine.pointwise import at_instants, slopes_at_instants

# Number of parts of the cross-validation.
_FOLDS = 4
# Most coefficients of a function of one variable, and of two.
_SIZES = {1: (1, 2, 3, 4, 5, 6, 7, 9, 11, 13, 16), 2: (1, 2, 3, 5, 7, 9, 12, 16, 20, 24)}
# A candidate with this share of the best first-order gain may be the better one after a refit.
NEARLY = 0.8
# A free parameter is a function of the same variables if these reproduce this share of its mean square.
_SAME_FUNCTION = 0.99
# Quantiles of a variable's range: rare extremes are not part of it.
_RARE = 5e-4
# Roughness of the functions of a `PowerAxis`, so different that they enter one by one, by degree.
_ROUGHNESS_OF_POWERS = (0.0, 1e-8, 1.0, 1e-4, 1e4)
# Roughness of a sign: after the constant and before all others.
_ROUGHNESS_OF_A_SIGN = 1e-10
# Number of instants that sample the density of the data.
_INSTANTS = 3000


class Candidate(eqx.Module):
    """A place and variables with first-order estimates.

    Attributes:
        form: the place.
        variables: arguments of the function.
        gain: cross-validated decrease of the training objective, to first order.
        effect: the learned function with first-order estimates of its coefficients.
        known: functions of the variables that free parameters represent, at the kept instants.
    """

    form: type[Learned] = eqx.field(static=True)
    variables: tuple[str, ...] = eqx.field(static=True)
    gain: float
    effect: Learned
    known: Float[np.ndarray, "instants known"]


class SearchContext(eqx.Module):
    """A linearised fit with data that candidates share.

    Attributes:
        look: the linearised fit.
        values: variables at each knot.
        weight: of each knot.
        lines: frequencies of significant lines of the fit's residual [rad/s].
    """

    look: LinearisedFit
    values: dict[str, Float[np.ndarray, "segments knots"]]
    weight: Float[np.ndarray, "segments knots"]
    lines: tuple[float, ...] = eqx.field(static=True)

    @property
    def instants(self) -> Int[np.ndarray, " instants"]:
        """Evenly spaced valid knots, which sample the density of the data."""
        kept = np.flatnonzero(self.weight.reshape(-1) > 0)
        return kept[spread_evenly(kept.size, _INSTANTS)]

    def acting(self, form: type[Learned]) -> Acting:
        """Influence of a unit of a form's function, and of its slope for an error of the mesh."""
        if issubclass(form, LearnedReading):
            return Acting(readings=(unit_reading(self.look.model, form),))
        return self.look.acting(*((form.name,) if issubclass(form, LearnedTorque) else (ERROR, SLOPE)))

    def torque_push(self, place: type[LearnedTorque] | None) -> Float[np.ndarray, "segments knots states"]:
        """Change of the state's rates by a unit of torque at a place; in the mesh for an error of an angle."""
        return self.look.pushes[(place or LearnedMeshTorque).name]


def search_context(fit: Fit) -> SearchContext:
    """Linearise a fit for the search of learned functions."""
    look = linearise_along(fit)
    values = {n: np.asarray(getattr(look.motion, n)) for n in UNITS if getattr(look.motion, n) is not None}
    weight = np.asarray(look.problem.segments.weight)
    finite = np.all([np.isfinite(v).all(axis=1) for v in values.values()], axis=0)
    # The last knot of a segment is the first one of the next segment.
    weight = np.pad(weight * finite[:, None], ((0, 0), (0, 1)))
    return SearchContext(look, values, weight, spectral_lines(fit))


def candidates(seen: SearchContext, *, pairs: bool) -> list[Candidate]:
    """Candidates of every place with every variable; and with two where asked for: the best variable with another, or
    any two where no single one has a gain."""
    reduced = isinstance(seen.look.model, ReducedModel)
    forms = [form for form in LEARNED if not (form.needs_motor and reduced)]
    own = {form: own_functions(seen, form) for form in forms}
    may = {form: [name for name in seen.values if form.may_depend_on(name)] for form in forms}

    def look_at(form: type[Learned], choices: Iterable[tuple[str, ...]]) -> list[Candidate]:
        found = (_simplest(seen, form, variables, own[form]) for variables in choices)
        return [candidate for candidate in found if candidate is not None]

    alone = {form: look_at(form, [(name,) for name in may[form]]) for form in forms}
    found = [candidate for those in alone.values() for candidate in those]
    if not pairs:
        return found
    any_two = all(candidate.gain < RULES.coefficient for candidate in found)
    for form, those in alone.items():
        best = {max(those, key=lambda c: c.gain).variables[0]} if those and not any_two else set()
        both = (p for p in combinations(may[form], 2) if any_two or best & set(p))
        # The angles of both shafts are equal except for the twist.
        found += look_at(form, (p for p in both if not set(p) <= set(ANGLES)))
    return found


def reselected(first: Candidate, seen: SearchContext) -> list[Candidate]:
    """A candidate's place and variables with functions selected again along another motion: the simplest one with
    nearly the best gain, then the one with the best gain.

    To first order, a steep slope and a jump are equivalent along a motion that was fitted with a slope."""
    found = _functions_of(seen, first.form, first.variables, own_functions(seen, first.form))
    if not found:
        return []
    best = max(found, key=lambda c: c.gain)
    simplest = next(c for c in found if c.gain > NEARLY * best.gain)
    return [simplest] if simplest is best else [simplest, best]


def sizes_along(chosen: Candidate, seen: SearchContext) -> Sizes:
    """The functions that a candidate's coefficients multiply, along another fit's motion."""
    values = {name: np.nan_to_num(value) for name, value in seen.values.items()}
    mixing = np.asarray(chosen.effect.mixing)
    return tuple(part @ mixing for part in _functions(chosen.form, chosen.effect.axes, values))


def own_functions(seen: SearchContext, form: type[Learned]) -> Float[np.ndarray, "segments knots parameters"]:
    """The free parameters as torques at the place of a form; none of them represents an error of an angle."""
    if issubclass(form, LearnedTorque):
        return parameter_torques(seen.look, seen.torque_push(place_of(form)))
    return np.zeros((*seen.weight.shape, len(seen.look.problem.free.paths)))


def _functions(form: type[Learned], axes: Sequence[Axis], values: dict[str, np.ndarray]) -> Sizes:
    """The functions of the axes, and their slopes for an error of the mesh."""
    along = [((values[axis.variable][..., None], values[axis.variable].ndim), (axis, 0)) for axis in axes]
    raw = _all_products([at_instants(_functions_of_one, *each) for each in along])
    if not issubclass(form, LearnedMeshError):
        return (raw,)
    (each,) = along
    return raw, slopes_at_instants(_functions_of_one, *each)[..., 0]


def _all_products(parts: Sequence[np.ndarray]) -> np.ndarray:
    """All products of one function of each part."""
    found = parts[0]
    for part in parts[1:]:
        found = (found[..., :, None] * part[..., None, :]).reshape(*found.shape[:-1], -1)
    return found


def _ranges(seen: SearchContext, variables: tuple[str, ...]) -> dict[str, tuple[float, float]]:
    """Range of each quantity in the data."""
    found = {}
    for variable in variables:
        low, high = np.quantile(seen.values[variable][seen.weight > 0], [_RARE, 1.0 - _RARE])
        reach = max(high - low, 1e-12 * max(abs(low), abs(high)), 1e-300)
        found[variable] = (float(low), float(low + reach))
    return found


def _functions_of_one(value: Array, axis: Axis) -> Array:
    return axis.functions(value[0])


def _simplest(
    seen: SearchContext,
    form: type[Learned],
    variables: tuple[str, ...],
    own: Float[np.ndarray, "segments knots parameters"],
) -> Candidate | None:
    """A candidate of given place and variables, with the simplest function among those of equal gain."""
    best: Candidate | None = None
    for candidate in _functions_of(seen, form, variables, own):
        if best is None or candidate.gain > best.gain + RULES.coefficient:
            best = candidate
    return best


def _functions_of(
    seen: SearchContext,
    form: type[Learned],
    variables: tuple[str, ...],
    own: Float[np.ndarray, "segments knots parameters"],
) -> list[Candidate]:
    """Candidates of given place and variables with all types of axes, fewest coefficients first."""
    jumps_with = next((name for name in variables if form.may_jump_with(name)), None)
    # The previous candidate supplies the width of a jump and the frequency of a periodic torque.
    before = next((e for e in seen.look.model.effects if isinstance(e, form)), None)
    corner = float(before.corner) if isinstance(before, LearnedFriction) else None
    lines = (float(before.omega),) if isinstance(before, LearnedPeriodic) else seen.lines
    axes = axes_over(_ranges(seen, variables), jumps_with=jumps_with, corner=corner, lines=lines)
    choices = (_candidate(seen, form, each, own) for each in axes)
    return sorted((c for c in choices if c is not None), key=lambda c: len(c.effect.c))


def _candidate(
    seen: SearchContext,
    form: type[Learned],
    axes: tuple[Axis, ...],
    own: Float[np.ndarray, "segments knots parameters"],
) -> Candidate | None:
    """A candidate of given place and variables, with the cross-validated number of coefficients."""
    instants = seen.instants
    raw = _functions(form, axes, seen.values)
    flat = np.asarray(raw[0]).reshape(-1, raw[0].shape[2])[instants]
    parameters = own.shape[2] - _of_its_own(seen.look.model, form)
    known = _same_functions(flat, own.reshape(-1, own.shape[2])[instants][:, :parameters])
    sizes = _SIZES[len(axes)]
    roughness = _roughness(axes)
    first = axes[0]
    if isinstance(first.beside if isinstance(first, SignAxis) else first, PowerAxis):
        roughness = _but_for(known, flat, roughness)
    mixing = _smooth_first(flat, known, roughness)[:, : max(sizes)]
    if mixing.shape[1] == 0:
        return None
    found = products(seen.look, seen.acting(form), tuple(part @ mixing for part in raw)).in_parts(_FOLDS)
    found = _instead_of_own(found, seen.look, parameters, own.shape[2])
    sizes = [s for s in sizes if s <= mixing.shape[1]]
    base, *left = _left_out(found, [parameters, *(parameters + s for s in sizes)])
    gain, size = 0.0, 0
    for more, after in zip(sizes, left, strict=True):
        if size == 0 or base - after > gain + RULES.coefficient:
            gain, size = float(base - after), more
    if not gain > 0:
        return None
    (step,) = best_steps(found.first(parameters + size).in_parts(1))
    effect = form.made_of(axes, mixing[:, :size], step[parameters:])
    return Candidate(form, tuple(axis.variable for axis in axes), gain, effect, known)


def _of_its_own(model: Model, form: type[Learned]) -> int:
    """Number of free parameters of the model's learned function at this place (its last effect)."""
    return next((len(effect_paths(e)) for e in model.effects if isinstance(e, form)), 0)


def _instead_of_own(found: Products, look: LinearisedFit, kept: int, free: int) -> Products:
    """Products with the model's learned torque added back to the residual, and its columns removed."""
    if kept == free:
        return found
    own = np.zeros(found.gram.shape[-1])
    # The parameters other than coefficients only set the width of a jump.
    linear = [i for i in range(kept, free) if not look.problem.free.logarithmic[i]]
    own[linear] = np.asarray(look.problem.free.pack(look.model))[linear]
    moved = found.gram @ own
    against = found.gradient @ own
    others = np.delete(np.arange(own.size), np.s_[kept:free])
    return Products(
        found.gram[..., others[:, None], others],
        (found.gradient + moved)[..., others],
        found.square + against + np.swapaxes(against, 1, 2) + moved @ own,
        found.samples,
    )


def _same_functions(raw: np.ndarray, own: np.ndarray) -> np.ndarray:
    """Free parameters that are functions of the same variables at the same place; the learned torque is made orthogonal
    to them."""
    size = np.sqrt(np.mean(own**2, axis=0))
    own = own[:, size > 0] / size[size > 0]
    if own.shape[1] == 0:
        return own
    coefficients = np.linalg.lstsq(raw, own, rcond=1e-10)[0]
    left = np.mean((own - raw @ coefficients) ** 2, axis=0)
    return own[:, left < 1.0 - _SAME_FUNCTION]


def _roughness(axes: Sequence[Axis]) -> np.ndarray:
    """Penalty on the curvature of a function over the unit range of each axis, per pair of products."""
    total = np.zeros((1, 1))
    for part in (_roughness_along(axis) for axis in axes):
        total = np.kron(total, np.eye(len(part))) + np.kron(np.eye(len(total)), part)
    return total


def _roughness_along(axis: Axis) -> np.ndarray:
    if isinstance(axis, SignAxis):
        beside = [] if axis.beside is None else [_roughness_along(axis.beside)]
        return np.asarray(block_diag(_ROUGHNESS_OF_A_SIGN, *beside))
    if isinstance(axis, AngleAxis | PeriodicAxis):
        order = np.concatenate([[0.0], np.repeat(np.arange(1.0, axis.orders + 1), 2)])
        return np.diag((2 * np.pi * order) ** 4)
    if isinstance(axis, PowerAxis):
        return np.diag(_ROUGHNESS_OF_POWERS)
    if isinstance(axis, LinearAxis):
        return np.zeros((1, 1))
    bends = np.diff(np.eye(axis.count), 2, axis=0)
    rises = np.diff(np.eye(axis.count), axis=0)
    # A small penalty on the slope orders the constant before the straight line.
    return axis.count**3 * bends.T @ bends + axis.count * rises.T @ rises


def _but_for(known: np.ndarray, raw: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """The penalty without cost for known functions, which are among the functions."""
    if known.shape[1] == 0:
        return roughness
    own = np.linalg.lstsq(raw, known / np.sqrt(np.mean(known**2, axis=0)), rcond=1e-10)[0]
    pulled = roughness @ own
    return roughness - pulled @ np.linalg.pinv(own.T @ pulled, hermitian=True) @ pulled.T


def _smooth_first(raw: np.ndarray, known: np.ndarray, roughness: np.ndarray) -> np.ndarray:
    """Combinations of functions, smoothest first, of unit rms on the data, uncorrelated with each other and with known
    functions (basis of Demmler and Reinsch 1975)."""
    moment = raw.T @ raw / len(raw)
    free = null_space((raw.T @ known / len(raw)).T, rcond=1e-8) if known.shape[1] else np.eye(raw.shape[1])
    inside = free.T @ moment @ free
    seen, directions = np.linalg.eigh(inside)
    # Directions without data are removed.
    free = free @ directions[:, seen > 1e-12 * np.max(seen, initial=0.0)]
    if free.shape[1] == 0:
        return free
    _, vectors = eigh(free.T @ roughness @ free, free.T @ moment @ free)
    return free @ vectors


def _left_out(found: Products, counts: Sequence[int]) -> Float[np.ndarray, " counts"]:
    """Cross-validated objective for each number of free columns: on each part after least squares on the others."""
    most = max(counts)
    free = np.arange(most) < np.asarray(counts)[:, None]

    def for_each(products: Products) -> Products:
        """Repeat for each count; columns that are not free have no effect."""
        first = products.first(most)
        gradient = first.gradient * free[:, None, None, None, :]
        gram = first.gram * free[:, None, None, None, :, None] * free[:, None, None, None, None, :]
        square, samples = (np.broadcast_to(a, (len(counts), *a.shape)) for a in (first.square, first.samples))
        return Products(*(a.reshape(-1, *a.shape[2:]) for a in (gram, gradient, square, samples)))

    left = left_after(for_each(found), best_steps(for_each(found.others())))
    left = np.sum(left.reshape(len(counts), -1, *left.shape[1:]), axis=1)
    return 0.5 * np.linalg.slogdet(left / found.samples.sum())[1]
