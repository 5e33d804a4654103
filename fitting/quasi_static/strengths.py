"""The figures of a fitted torque-twist equation: stiffness, amplitudes, friction, knees, each with its interval."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from fitting.quasi_static.form import Form
from fitting.quasi_static.intervals import Figure, Known, scatter
from fitting.quasi_static.points import Points
from fitting.quasi_static.stretches import stretches
from fitting.quasi_static.twist_model import TwistModel


def stiffness_of(points: Points, model: TwistModel) -> dict[str, Known]:
    """The stiffness that stands beside the effects."""
    where = "stiffness" if points.centre == 0.0 else f"stiffness at {points.centre:.3g} N m"
    bent = any(form.family in ("stiffness_shape", "backlash") for form in model.forms)
    text = where + (" (without what the effects add)" if bent else "")
    return _known(points, model, [Figure("K", lambda fitted: 1.0 / fitted[0], "N m/rad", text, True)])


def strengths_of(points: Points, model: TwistModel, form: Form) -> dict[str, Known]:
    """The figures of one effect, by name."""
    strengths, shapes = model.own(form)
    own = np.r_[0, strengths, shapes]
    figures = (replace(one, formula=lambda fitted, of=one.formula: of(fitted[own])) for one in form.figures)
    return _known(points, model, figures)


def contribution(points: Points, model: TwistModel, forms: tuple[Form, ...]) -> np.ndarray:
    """What effects add to the twist [rad], (n,), less its mean."""
    total = np.zeros_like(points.twist)
    for form in forms:
        strengths, _ = model.own(form)
        total += model.jacobian[:, strengths] @ model.coefficients[strengths]
    return total - np.mean(total)


def _known(points: Points, model: TwistModel, figures: Iterable[Figure]) -> dict[str, Known]:
    fitted = np.concatenate([model.coefficients, *(shape for _, shape in model.terms)])
    found = scatter(model.jacobian, model.misfit, stretches(model.misfit, points.log, each=2))
    # A thousandth of each parameter's scatter; without noise nothing scatters.
    steps = 1e-3 * np.sqrt(np.maximum(np.diag(found.classical), 0.0))
    steps = np.maximum(steps, 1e-9 * np.maximum(np.abs(fitted), 1e-12))
    return {one.name: one.known(fitted, steps, found) for one in figures}
