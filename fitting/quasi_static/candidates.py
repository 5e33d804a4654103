"""The catalogue of effects that a torque-twist log may hide, and which of them are looked at together."""

from collections.abc import Sequence

from fitting.quasi_static.form import Form
from fitting.quasi_static.motion_forms import motion_forms
from fitting.quasi_static.points import Points
from fitting.quasi_static.torque_forms import torque_forms
from fitting.quasi_static.twist_model import TwistModel

# Some times the 3 ms that actuators show.
_LARGEST_DELAY = 0.01
# Some times the percents of the twist that drives creep by.
_LARGEST_CREEP = 0.5


def catalogue(points: Points) -> tuple[Form, ...]:
    """The forms that the logs can tell something about, the more usual ones first.

    A loop may run either way: friction on the motor's side turns it round, where the torque is a motor's current.
    """
    return (*torque_forms(points), *motion_forms(points))


def choices(forms: Sequence[Form], families: int) -> list[tuple[Form, ...]]:
    """Forms to look at: each alone, and each bend together with each loop, of which either hides the other.

    Args:
        forms: That may be added.
        families: Number of families that may be added.
    """
    alone = [(form,) for form in forms]
    if families < 2:
        return alone
    loops = [form for form in forms if form.family == "hysteresis"]
    bends = [form for form in forms if form.family == "stiffness_shape" and not form.shape_names]
    return alone + [(loop, bend) for loop in loops for bend in bends]


def is_possible(model: TwistModel, forms: Sequence[Form]) -> bool:
    """Whether drives can show such strengths: what creeps is a part of the twist that was there at once."""
    return _largest(model, forms, "creep") <= _LARGEST_CREEP


def is_usual(model: TwistModel, forms: Sequence[Form], points: Points) -> bool:
    """Whether logs mostly show such strengths: a channel is late by milliseconds or samples."""
    return _largest(model, forms, "input_delay") <= max(_LARGEST_DELAY, 2.0 * points.step)


def _largest(model: TwistModel, forms: Sequence[Form], family: str) -> float:
    """The first strength of a form of that family, over the compliance; the largest where there are several."""
    own = [model.coefficients[model.own(form)[0].start] for form in forms if form.family == family]
    return max(map(abs, own), default=0.0) / max(abs(model.coefficients[0]), 1e-300)
