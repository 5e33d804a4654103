"""The figures of a fitted torque-twist equation: stiffness, amplitudes, friction, knees, each with its interval."""

import math
from collections.abc import Callable, Iterator

import numpy as np

from fitting.quasi_static.form import Form
from fitting.quasi_static.intervals import Figure, Known, scatter
from fitting.quasi_static.points import Points
from fitting.quasi_static.stretches import stretches
from fitting.quasi_static.twist_model import TwistModel

Formula = Callable[[np.ndarray], float]
# Name, formula of all fitted numbers, unit, description, and whether it must be positive.
_Figure = tuple[str, Formula, str, str, bool]


def stiffness_of(points: Points, model: TwistModel) -> dict[str, Known]:
    """The stiffness that stands beside the effects."""
    where = "stiffness" if points.centre == 0.0 else f"stiffness at {points.centre:.3g} N m"
    bent = any(form.family in ("stiffness_shape", "backlash") for form in model.forms)
    text = where + (" (without what the effects add)" if bent else "")
    return _known(points, model, [("K", lambda p: 1.0 / p[0], "N m/rad", text, True)])


def strengths_of(points: Points, model: TwistModel, form: Form) -> dict[str, Known]:
    """The figures of one effect, by name."""
    return _known(points, model, list(_figures(points, model, form)))


def contribution(points: Points, model: TwistModel, forms: tuple[Form, ...]) -> np.ndarray:
    """What effects add to the twist [rad], (n,), less its mean."""
    total = np.zeros_like(points.twist)
    for form in forms:
        strengths, _ = model.own(form, len(points.names))
        total += model.jacobian[:, strengths] @ model.coefficients[strengths]
    return total - np.mean(total)


def _known(points: Points, model: TwistModel, figures: list[_Figure]) -> dict[str, Known]:
    fitted = np.concatenate([model.coefficients, *model.shapes])
    found = scatter(model.jacobian, model.misfit, stretches(model.misfit, points.log, each=2))
    # A thousandth of each parameter's scatter; without noise nothing scatters.
    steps = 1e-3 * np.sqrt(np.maximum(np.diag(found.classical), 0.0))
    steps = np.maximum(steps, 1e-9 * np.maximum(np.abs(fitted), 1e-12))
    return {figure[0]: Figure(*figure).known(fitted, steps, found) for figure in figures}


def _figures(points: Points, model: TwistModel, form: Form) -> Iterator[_Figure]:
    strengths, shapes = model.own(form, len(points.names))
    first, shape = strengths.start, shapes.start
    if form.strengths[0].startswith("cosine"):
        yield from _of_an_order(form, first)
    elif form.family == "hysteresis":
        yield "friction", lambda p: -p[first] / p[0], "N m", "friction behind the loop, half its width in torque", False
        yield "width", lambda p: float(-2.0 * p[first]), "rad", "width of the developed loop", False
        yield "reach", lambda p: math.exp(p[shape]), "N m", "torque over which the branch changes, half way", True
    elif form.family == "stiffness_shape":
        yield from _of_a_bend(form, first, shape)
    elif form.family == "backlash":
        yield "half_width", lambda p: float(p[first]), "rad", "half of the dead zone", True
    elif form.family == "creep":
        yield "time_constant", lambda p: math.exp(p[shape]), "s", "of the relaxation", True
        if form.of_torque:
            yield "share", lambda p: p[first] / p[0], "1", "delayed twist over immediate twist", True
        else:
            for i in range(strengths.stop - first):
                text = f"of the relaxation at the stop before rest {i + 1}"
                yield f"amplitude_{i + 1}", lambda p, i=i: float(p[first + i]), "rad", text, False
    elif form.family == "motor_friction":
        yield "friction", lambda p: -p[first] / p[0], "N m", "friction while the joint moves, at its output", False
        if "share of load" in form.strengths:
            text = "by which the friction grows with the torque"
            yield "share_of_load", lambda p: -p[first + 1] / p[0], "1", text, False
    elif form.family == "input_delay":
        yield "delay", lambda p: -p[first] / p[0], "s", "by which the twist is behind the torque as logged", False
    elif form.strengths == ("compliance",):
        text = "share by which the stiffness changes with temperature"
        yield "coefficient", lambda p: -p[first] / p[0], "1/K", text, False
    else:
        unit = "rad/K" if points.temperature is not None else "rad/s"
        yield "drift", lambda p: float(p[first]), unit, "drift of the twist", False


def _of_an_order(form: Form, first: int) -> Iterator[_Figure]:
    order = form.strengths[0].split()[1]
    a, b = first, first + 1
    if form.family == "position_dependent_stiffness":
        text = "of the stiffness, as a share of it"
        yield f"amplitude_{order}", lambda p: math.hypot(p[a], p[b]) / abs(p[0]), "1", text, True
        yield f"phase_{order}", lambda p: math.atan2(p[b], -p[a]), "rad", "of the stiffness at theta_m = 0", False
    elif form.family == "position_dependent_friction":
        yield f"amplitude_{order}", lambda p: math.hypot(p[a], p[b]) / abs(p[0]), "N m", "of the friction", True
    else:
        what = "kinematic error" if form.family == "kinematic_error" else "reading"
        yield f"amplitude_{order}", lambda p: math.hypot(p[a], p[b]), "rad", f"of the {what}, zero to peak", True
        text = f"psi in A cos({order} theta + psi)"
        yield f"phase_{order}", lambda p: math.atan2(p[b], -p[a]), "rad", text, False


def _of_a_bend(form: Form, first: int, shape: int) -> Iterator[_Figure]:
    if form.shape_names:
        yield "K2", lambda p: 1.0 / (p[0] + p[first]), "N m/rad", "stiffness beyond the knee", True
        yield "T1", lambda p: math.exp(p[shape]), "N m", "torque at the knee", True
        return
    units = {"quadratic": "rad/(N m)^2", "cubic": "rad/(N m)^3"}
    for i, name in enumerate(form.strengths):
        text = f"{name} term of the twist in the torque"
        yield name, lambda p, i=i: float(p[first + i]), units[name], text, False
    if form.strengths[-1] == "cubic":
        at = first + len(form.strengths) - 1
        text = "cubic coefficient in tau = K (x + alpha x^3), to first order"
        yield "alpha", lambda p: -p[at] / p[0] ** 3, "rad^-2", text, False
