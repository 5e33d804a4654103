"""The torque-twist equation with effects inside: its fit, and its errors on stretches that the fit has not seen."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.optimize import least_squares

from fitting.quasi_static.form import START, Form, base_columns
from fitting.quasi_static.points import Points
from fitting.quasi_static.stretches import FOLDS


@dataclass(frozen=True, eq=False)
class TwistModel:
    """A straight line with effects, fitted.

    Attributes:
        forms: Of the effects, in the order in which they were found.
        shapes: Their shape parameters.
        coefficients: Compliance, each log's zero, then each form's strengths.
        misfit: Measured less fitted twist [rad], (n,).
        jacobian: Of the fitted twist with respect to coefficients and shape parameters, (n, all).
    """

    forms: tuple[Form, ...]
    shapes: tuple[np.ndarray, ...]
    coefficients: np.ndarray
    misfit: np.ndarray
    jacobian: np.ndarray

    def own(self, form: Form, logs: int) -> tuple[slice, slice]:
        """Where a form's strengths and its shape parameters stand in the Jacobian."""
        at = self.forms.index(form)
        strengths = [len(f.strengths) for f in self.forms]
        shapes = [len(s) for s in self.shapes]
        first = 1 + logs + sum(strengths[:at])
        behind = len(self.coefficients) + sum(shapes[:at])
        return slice(first, first + strengths[at]), slice(behind, behind + shapes[at])

    def without(self, form: Form) -> tuple[tuple[Form, ...], tuple[np.ndarray, ...]]:
        """The other forms and their shapes."""
        kept = [i for i, other in enumerate(self.forms) if other is not form]
        return tuple(self.forms[i] for i in kept), tuple(self.shapes[i] for i in kept)


def fit_twist(points: Points, forms: tuple[Form, ...], shapes: tuple[np.ndarray, ...]) -> TwistModel:
    """Least squares over strengths and shape parameters together (variable projection: Golub and Pereyra 1973).

    Args:
        points: To be fitted.
        forms: Of the effects.
        shapes: Where to begin, for each form.
    """
    everywhere = np.ones(len(points.twist), dtype=bool)
    found = _polished(points, forms, shapes, everywhere)
    matrix = design(points, forms, found)
    coefficients = _solved(matrix, points.twist)
    moved = list(_shape_slopes(points, forms, found, coefficients))
    return TwistModel(
        forms, found, coefficients, points.twist - matrix @ coefficients, np.column_stack([matrix, *moved])
    )


def hold_out(points: Points, model: TwistModel, fold: np.ndarray) -> np.ndarray:
    """Misfit [rad] of each point by the equation that was fitted, shapes and all, without the point's fold, (n,).

    Where a log or a rest begins, the branch of a loop or the state of a relaxation, is taken from the fit of all
    points: it is an initial state, of which only the log's first stretch or the rest knows.
    """
    base = len(model.coefficients) - sum(len(form.strengths) for form in model.forms)
    names = [*[""] * base, *(name for form in model.forms for name in form.strengths)]
    start = np.array([name.startswith(START) for name in names])
    misfit = np.empty_like(points.twist)
    for i in range(FOLDS):
        seen = fold != i
        shapes = _polished(points, model.forms, model.shapes, seen, starts=False)
        matrix = design(points, model.forms, shapes)
        left = points.twist - matrix[:, start] @ model.coefficients[start]
        free = matrix[:, ~start]
        misfit[~seen] = (left - free @ _solved(free[seen], left[seen]))[~seen]
    return misfit


def design(points: Points, forms: tuple[Form, ...], shapes: tuple[np.ndarray, ...]) -> np.ndarray:
    """All columns: the straight line's, then each form's, (n, coefficients)."""
    own = [form.columns(points, shape) for form, shape in zip(forms, shapes, strict=True)]
    return np.column_stack([base_columns(points), *own])


def _polished(
    points: Points,
    forms: tuple[Form, ...],
    shapes: tuple[np.ndarray, ...],
    seen: np.ndarray,
    *,
    starts: bool = True,
) -> tuple[np.ndarray, ...]:
    """Shape parameters that suit the seen points best, with or without those that say where a log begins."""
    start = np.concatenate([np.zeros(0), *shapes])
    names = [name for form in forms for name in form.shape_names]
    free = np.array([starts or not name.startswith(START) for name in names], dtype=bool)
    if not free.any():
        return shapes
    ends = np.cumsum([len(shape) for shape in shapes])[:-1]
    scale = float(np.std(points.twist)) or 1.0

    def whole(moved: np.ndarray) -> tuple[np.ndarray, ...]:
        shape = start.copy()
        shape[free] = moved
        return tuple(np.split(shape, ends))

    def residual(moved: np.ndarray) -> np.ndarray:
        matrix = design(points, forms, whole(moved))[seen]
        return (points.twist[seen] - matrix @ _solved(matrix, points.twist[seen])) / scale

    low, high = (np.concatenate([np.asarray(getattr(form, side)) for form in forms])[free] for side in ("low", "high"))
    inside = np.clip(start[free], low + 1e-6 * (high - low), high - 1e-6 * (high - low))
    # Kinks pass from point to point: steps of the derivative must reach over them.
    found = least_squares(residual, inside, bounds=(low, high), diff_step=1e-3, x_scale=high - low, max_nfev=25)
    return whole(found.x)


def _solved(matrix: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Least squares with columns of one scale; what the points do not see is zero."""
    norms = np.linalg.norm(matrix, axis=0)
    scale = 1.0 / np.where(norms > 0, norms, 1.0)
    solution, *_ = np.linalg.lstsq(matrix * scale, values, rcond=1e-8)
    return scale * solution


def _shape_slopes(
    points: Points, forms: tuple[Form, ...], shapes: tuple[np.ndarray, ...], coefficients: np.ndarray
) -> Iterator[np.ndarray]:
    first = 1 + len(points.names)
    for form, shape in zip(forms, shapes, strict=True):
        strengths = coefficients[first : first + len(form.strengths)]
        first += len(form.strengths)
        for i in range(len(shape)):
            step = np.zeros(len(shape))
            step[i] = 1e-3 * (form.high[i] - form.low[i])
            up, down = (form.columns(points, shape + sign * step) @ strengths for sign in (1.0, -1.0))
            yield (up - down) / (2.0 * step[i])
