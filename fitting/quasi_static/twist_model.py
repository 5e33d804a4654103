"""The torque-twist equation with effects: fit, held-out errors and figures."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import least_squares

from fitting.quasi_static.differences import slopes
from fitting.quasi_static.form import START, Form, Terms
from fitting.quasi_static.intervals import Figure, Known, scatter
from fitting.quasi_static.points import Points
from fitting.quasi_static.stretches import FOLDS, stretches


@dataclass(frozen=True, eq=False)
class TwistModel:
    """A straight line with effects, fitted.

    Attributes:
        terms: The effects' forms with their shape parameters, in order of acceptance.
        coefficients: Compliance, each log's zero, then each form's strengths.
        misfit: Measured less fitted twist [rad], (n,).
        jacobian: Of the fitted twist with respect to coefficients and shape parameters, (n, all).
    """

    terms: Terms
    coefficients: np.ndarray
    misfit: np.ndarray
    jacobian: np.ndarray

    @property
    def forms(self) -> tuple[Form, ...]:
        """Forms of the effects."""
        return tuple(form for form, _ in self.terms)

    def own(self, form: Form) -> tuple[slice, slice]:
        """Columns of a form's strengths and shape parameters in the Jacobian."""
        at, strengths, shapes = self.forms.index(form), *_sizes(self.terms)
        first = len(self.coefficients) - sum(strengths[at:])
        behind = len(self.coefficients) + sum(shapes[:at])
        return slice(first, first + strengths[at]), slice(behind, behind + shapes[at])


def fit_twist(points: Points, terms: Terms = ()) -> TwistModel:
    """Least squares over strengths and shape parameters together (variable projection: Golub and Pereyra 1973).

    Args:
        points: The data.
        terms: Of the effects, with starting values of shape parameters.
    """
    found = _polished(points, terms, np.ones(len(points.twist), dtype=bool))
    matrix = design(points, found)
    coefficients = _solved(matrix, points.twist)
    flat, ranges = _flat(found), [form.range for form, _ in found]
    steps = 1e-3 * np.concatenate([np.zeros(0), *(high - low for low, high in ranges)])
    moved = [slopes(lambda at: design(points, _moved(found, at)) @ coefficients, flat, steps)] if flat.size else []
    return TwistModel(found, coefficients, points.twist - matrix @ coefficients, np.column_stack([matrix, *moved]))


def hold_out(points: Points, model: TwistModel, fold: np.ndarray) -> np.ndarray:
    """Misfit [rad] of each point in the fit of all parameters without the point's fold, (n,).

    Initial branches and states of logs and rests are taken from the fit of all points, since only the log's first
    stretch or the rest determines them.
    """
    names = [name for form in model.forms for name in form.strengths]
    line = [False] * (len(model.coefficients) - len(names))
    start = np.array(line + [name.startswith(START) for name in names])
    misfit = np.empty_like(points.twist)
    for i in range(FOLDS):
        seen = fold != i
        matrix = design(points, _polished(points, model.terms, seen, starts=False))
        left, free = points.twist - matrix[:, start] @ model.coefficients[start], matrix[:, ~start]
        misfit[~seen] = (left - free @ _solved(free[seen], left[seen]))[~seen]
    return misfit


def stiffness_of(points: Points, model: TwistModel) -> dict[str, Known]:
    """The stiffness beside the effects."""
    where = "stiffness" if points.centre == 0.0 else f"stiffness at {points.centre:.3g} N m"
    bent = any(form.family in ("stiffness_shape", "backlash") for form in model.forms)
    text = where + (" (without the effects' contribution)" if bent else "")
    return _known(points, model, [Figure("K", lambda fitted: 1.0 / fitted[0], "N m/rad", text, True)])


def strengths_of(points: Points, model: TwistModel, form: Form) -> dict[str, Known]:
    """The figures of one effect, by name."""
    strengths, shapes = model.own(form)
    own = np.r_[0, strengths, shapes]
    figures = (replace(one, formula=lambda fitted, of=one.formula: of(fitted[own])) for one in form.figures)
    return _known(points, model, figures)


def contribution(model: TwistModel, forms: tuple[Form, ...]) -> np.ndarray:
    """Contribution of effects to the twist [rad], (n,), without its mean."""
    own = [model.own(form)[0] for form in forms]
    total = np.sum([model.jacobian[:, strengths] @ model.coefficients[strengths] for strengths in own], axis=0)
    return total - np.mean(total)


def _known(points: Points, model: TwistModel, figures: Iterable[Figure]) -> dict[str, Known]:
    fitted = np.concatenate([model.coefficients, *(shape for _, shape in model.terms)])
    found = scatter(model.jacobian, model.misfit, stretches(model.misfit, points.log, each=2))
    # A thousandth of each parameter's standard deviation; with a minimum for data without noise.
    steps = 1e-3 * np.sqrt(np.maximum(np.diag(found.classical), 0.0))
    steps = np.maximum(steps, 1e-9 * np.maximum(np.abs(fitted), 1e-12))
    return {one.name: one.known(fitted, steps, found) for one in figures}


def design(points: Points, terms: Terms) -> np.ndarray:
    """All regressors: the straight line's, then each form's, (n, coefficients)."""
    zeros = (points.log == i for i in range(len(points.names)))
    added = (form.columns(points, shape) for form, shape in terms)
    return np.column_stack([points.torque - points.centre, *zeros, *added])


def _sizes(terms: Terms) -> tuple[list[int], list[int]]:
    """Numbers of strengths and of shape parameters."""
    return [len(form.strengths) for form, _ in terms], [len(shape) for _, shape in terms]


def _flat(terms: Terms) -> np.ndarray:
    return np.concatenate([np.zeros(0), *(shape for _, shape in terms)])


def _moved(terms: Terms, flat: np.ndarray) -> Terms:
    """The forms with other shape parameters."""
    shapes = np.split(flat, np.cumsum(_sizes(terms)[1])[:-1])
    return tuple((form, shape) for (form, _), shape in zip(terms, shapes, strict=True))


def _polished(points: Points, terms: Terms, seen: np.ndarray, *, starts: bool = True) -> Terms:
    """Shape parameters of least misfit on the fitted points, with or without initial states of logs."""
    names = [name for form, _ in terms for name in form.shape_names]
    free = np.array([starts or not name.startswith(START) for name in names], dtype=bool)
    if not free.any():
        return terms
    flat, scale = _flat(terms), float(np.std(points.twist)) or 1.0

    def moved(values: np.ndarray) -> Terms:
        whole = flat.copy()
        whole[free] = values
        return _moved(terms, whole)

    def residual(values: np.ndarray) -> np.ndarray:
        matrix = design(points, moved(values))[seen]
        return (points.twist[seen] - matrix @ _solved(matrix, points.twist[seen])) / scale

    low, high = np.hstack([form.range for form, _ in terms])[:, free]
    inside = np.clip(flat[free], low + 1e-6 * (high - low), high - 1e-6 * (high - low))
    # Kinks move from point to point: steps of difference quotients must extend over them.
    found = least_squares(residual, inside, bounds=(low, high), diff_step=1e-3, x_scale=high - low, max_nfev=25)
    return moved(found.x)


def _solved(matrix: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Least squares with scaled columns; undetermined coefficients are zero."""
    norms = np.linalg.norm(matrix, axis=0)
    scale = 1.0 / np.where(norms > 0, norms, 1.0)
    solution, *_ = np.linalg.lstsq(matrix * scale, values, rcond=1e-8)
    return scale * solution
