"""Influence of fixed values of the drive file on the fitted parameters."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from fitting.estimation.engines import linearise, residual_at
from fitting.estimation.estimate import Fit
from fitting.estimation.free_parameters import named
from fitting.estimation.projection import FirstStates
from fitting.estimation.residual import Problem
from fitting.formatting import words
from fitting.uncertainty.standard_errors import Uncertainty
from hdjax import OneSideModel

# Values of the drive file that no log of angles and torque can verify; their errors are in units of 1 %.
_HELD = ("J_m", "J_l")
_PERCENT = 0.01
# Relative changes of a parameter beyond the reach of the linearisation.
_MOST_LINEAR = 0.3
# Relative step of the central differences by fixed values; their error is its square.
_STEP = 1e-4


class Held(eqx.Module):
    """A fixed value of the drive file, and the influence of an error in it.

    Attributes:
        path: dotted path.
        value: in SI units.
        changes: relative change of each free parameter if the value is 1 % larger, at the fit's weights.
        std_if_free: relative standard error of each free parameter if this value were fitted as well.
        sentence: a sentence on this influence.
    """

    path: str = eqx.field(static=True)
    value: float
    changes: dict[str, float]
    std_if_free: dict[str, float]
    sentence: str


# Parameters without any information are not at a bound.
@np.errstate(over="ignore", invalid="ignore", divide="ignore")
def held_values(fit: Fit, found: Uncertainty) -> tuple[Held, ...]:
    """Fixed values of the drive file that a fit of both sides or of one side's equation relies on; an effect may
    correct one.

    Args:
        fit: the fit.
        found: its uncertainty.
    """
    free = {*fit.free.paths, *(effect.corrects for effect in fit.model.effects)}
    known = fit.model.scaled_by if isinstance(fit.model, OneSideModel) else _HELD
    held = tuple(p for p in _HELD if p in known and p not in free)
    if not held:
        return ()
    count = len(fit.free.paths)
    products = np.asarray(_products(fit, held))
    products[:count, :count] += np.diag(np.asarray(fit.free.precision) ** 2)
    information, coupling = products[:count, :count], products[:count, count:]
    # The optimum moves so that the gradient remains zero: (J^T J) dp + J^T dr/dJ dJ = 0.
    response = -np.linalg.lstsq(information, coupling, rcond=None)[0]
    values = np.array([e.value for e in found.estimates.values()])
    relative = np.abs(np.asarray(fit.free.slopes(fit.model)) / np.where(values == 0, np.inf, values))
    classical = np.linalg.pinv(information, hermitian=True)
    robust = np.diag(found.covariance) / np.diag(classical)
    told, made = named(fit.model, fit.free.paths), []
    for i, path in enumerate(held):
        own = products[count + i, count + i] - coupling[:, i] @ classical @ coupling[:, i]
        if_free = np.diag(classical) + response[:, i] ** 2 / max(own, 1e-300)
        std_if_free = np.nan_to_num(relative * np.sqrt(robust * if_free), nan=np.inf)
        change = _PERCENT * response[:, i] * np.sign(values) * relative
        changes, errors = (
            {p: v for p, v, kept in zip(found.estimates, each.tolist(), told, strict=True) if kept}
            for each in (change, std_if_free)
        )
        made.append(_held_one(fit, path, changes, errors))
    return tuple(made)


def _held_one(fit: Fit, path: str, changes: dict[str, float], std_if_free: dict[str, float]) -> Held:
    own = {p: c for p, c in changes.items() if "." not in p and p != "alpha"}
    sentence = f"{path} is taken from the drive file"
    if any(abs(c) > _MOST_LINEAR for c in own.values()):
        sentence += f", and must be correct there: {words(list(own))} can't compensate an error of 1 %."
    elif own:
        moved = words([f"{p} by {100 * c:+.2g} %" for p, c in own.items()])
        sentence += f": if it is 1 % too large there, that changes {moved}."
    else:
        sentence += "."
    return Held(path, float(fit.model.get(path)), changes, std_if_free, sentence)


def _products(fit: Fit, held: tuple[str, ...]) -> Float[np.ndarray, "all all"]:
    """J^T J of the free parameters and the logarithms of fixed values, without the initial states.

    By central differences with the fit's compiled program.
    """
    problem = fit.at_solution
    found = linearise(problem, fit.unknowns)
    rows, gaps = [], []
    for path in held:
        value = float(fit.model.get(path))
        up, down = (
            residual_at(_with_held(problem, path, value * (1.0 + sign * _STEP)), fit.unknowns) for sign in (1, -1)
        )
        row, gap = ((np.asarray(a) - np.asarray(b)) / (2 * _STEP) for a, b in zip(up, down, strict=True))
        rows, gaps = [*rows, row], [*gaps, gap]
    states = FirstStates.of(found, problem.segments.joined)
    columns, before = np.stack(rows, axis=-1), -np.stack(gaps, axis=-1)
    both = np.concatenate([states.parameters_without(found), states.without(columns, before)], axis=2)
    flat = both.reshape(-1, both.shape[-1])
    return flat.T @ flat


def _with_held(problem: Problem, path: str, value: float) -> Problem:
    return eqx.tree_at(lambda p: p.model, problem, problem.model.replace({path: value}))
