"""What the twist does while a joint rests: whether it relaxes after the stop, or follows the torque as logged.

A rest is quiet: no ripple, no eccentricity, and friction holds one way. What creeps then stands far above the noise,
though a look at the whole log, most of whose error arises while the joint moves, can't see it. So each rest is taken as
a log of its own, with a zero of its own (friction bears any part of the torque there), and looked at as logs are.

A torque whose noise hides its course leaves something over even where the twist follows it, so that a relaxation has to
be called for whichever of the two is taken to be the noisy one: beside the torque in the twist, and beside the twist in
the torque. There the twist may follow the torque with any stiffness that the whole logs allow. Where they allow none
that would do, but one of the rests' own would, the two explanations stay tied.
"""

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fitting.attribution.decisions import RULES
from fitting.quasi_static.attribution import Held, Round, Trial, look
from fitting.quasi_static.form import START, Form
from fitting.quasi_static.intervals import Figure
from fitting.quasi_static.points import Points
from fitting.quasi_static.strengths import stiffness_of
from fitting.quasi_static.stretches import stretches
from fitting.quasi_static.torque_forms import delay
from fitting.quasi_static.twist_model import fit_twist

# Assumed: a stop rings for a tenth of a rest, or a quarter of a second [s] where that is less.
_RINGING, _LONGEST_RINGING = 0.1, 0.25
# Points that tell a relaxation from a straight line and noise.
_FEWEST = 50
_MOST_RESTS = 10
_POINTS_IN_CONSTANT, _CONSTANTS = 8, 12
# This is a second look at the same logs.
_SIGNIFICANCE = 0.5 * RULES.significance


@dataclass(frozen=True, eq=False)
class RestLook:
    """A look at what the twist does at rest.

    Attributes:
        held: The points at rest, each rest as a log.
        round: The look at what may explain them.
        p_value: Chance that noise asks for as much, be it the twist's or the torque's.
        own_stiffness: Stiffness with which the twist may follow the torque at rest instead, though the whole logs rule
            it out [N m/rad]; None where no stiffness would do.
        form: The effect that was found, beside the equation of the whole logs; None where nothing was.
        shape: Its shape parameters.
    """

    held: Held
    round: Round
    p_value: float
    own_stiffness: float | None
    form: Form | None
    shape: np.ndarray

    @property
    def after(self) -> Trial:
        """The equation at rest with the effect."""
        return self.round.rivals[0].trial

    @property
    def gain(self) -> float:
        """Share of the held-out error at rest that the effect removes."""
        return 1.0 - self.after.rmse / self.round.before.rmse


@dataclass(frozen=True, eq=False)
class _Rests:
    """Where points stand in the rests that are looked at.

    Attributes:
        number: Of the rest, once its stop has rung out; -1 elsewhere, (n,).
        since: Time from its stop [s], (n,).
    """

    number: np.ndarray
    since: np.ndarray

    @property
    def count(self) -> int:
        return int(self.number.max()) + 1


def look_at_rests(held: Held, current: Trial, seed: int) -> RestLook | None:
    """Look at the rests of joints that moved; None where no rest is long enough.

    Args:
        held: The points of whole logs.
        current: Their model so far, for its compliance.
        seed: Of the surrogates.
    """
    rests = _settled(held.points)
    if not rests.count:
        return None
    rows = np.flatnonzero(rests.number >= 0)
    points = _as_logs(held.points, rests, rows, float(abs(current.model.coefficients[0])))
    form = _relaxation(points.step, _Rests(rests.number[rows], rests.since[rows]))
    resting, this = _look(points, form, seed)
    p_value, own_stiffness = _chance(this), None
    if np.ptp(points.torque) > 0:
        allowed = stiffness_of(held.points, current.model)["K"].ci95 or (0.0, math.inf)
        turned = replace(points, torque=points.twist, twist=points.logged_torque)
        free = in_return = _look(turned, form, seed)[1]
        slope = float(free.before.model.coefficients[0])
        if not allowed[0] <= slope <= allowed[1]:
            nearest = min(allowed, key=lambda end: abs(end - slope))
            left = points.logged_torque - nearest * points.twist
            in_return = _look(replace(points, torque=np.zeros_like(left), twist=left), form, seed)[1]
        p_value = max(p_value, _chance(in_return))
        # Turned round, the line's compliance is the stiffness; where the torque stays as it is, that is not known.
        follows = stiffness_of(turned, free.before.model)["K"].identifiable
        own_stiffness = slope if follows and _chance(free) > _SIGNIFICANCE else None
    if not this.accepted or p_value > _SIGNIFICANCE:
        return RestLook(resting, this, p_value, own_stiffness, None, np.zeros(0))
    whole = _relaxation(points.step, rests, initial=f"{START} ")
    return RestLook(resting, this, p_value, own_stiffness, whole, this.rivals[0].trial.model.shapes[0])


def _look(points: Points, form: Form, seed: int) -> tuple[Held, Round]:
    line = fit_twist(points, (), ())
    held = Held.of(points, stretches(line.misfit, points.log, each=2))
    base = held.attempt((), ())
    return held, look(held, base, base, [(form,), (delay(),)], seed, 0.0)


def _chance(this: Round) -> float:
    """The p-value of a relaxation; where another form does better, or none is worth a refit, there is none."""
    best = this.rivals[0] if this.rivals else None
    return best.p_value if best is not None and best.lead.families == ("creep",) else 1.0


def _relaxation(step: float, rests: _Rests, initial: str = "") -> Form:
    """The twist relaxes after a stop, in each rest from a state of its own, with one time constant.

    At rest the torque of a gear that bears a load hardly changes, so that a standard linear solid fades exponentially;
    how far from its end it begins hangs on what the gear bore while friction hid it. Each rest's own mean is left out:
    the level of a rest is friction's.

    Args:
        step: Time between points [s].
        rests: Where points stand in them.
        initial: What its parameters' names begin with: `START` where they count as initial states of the rests, which
            the other points of a log know nothing of.
    """
    low, high = math.log(_POINTS_IN_CONSTANT * step), math.log(float(np.max(rests.since)))
    text = "of the relaxation at the stop before rest"
    amplitudes = (Figure(f"amplitude_{i}", lambda own, i=i: own[i], "rad", f"{text} {i}") for i in range(1, rests.count + 1))
    return Form(
        "creep",
        "relaxation after a stop",
        partial(_fading, rests),
        tuple(f"{initial}amplitude {i + 1}" for i in range(rests.count)),
        "at rest: twist = tau/K + level of the rest + a exp(-t/T), t from the stop on",
        (Figure("time_constant", lambda own: math.exp(own[-1]), "s", "of the relaxation", True), *amplitudes),
        np.linspace(low, high, _CONSTANTS)[:, None],
        (f"{initial}log time constant",),
        (low,),
        (high,),
        of_torque=False,
    )


def _fading(rests: _Rests, points: Points, shape: np.ndarray) -> np.ndarray:
    columns = np.zeros((len(rests.number), rests.count))
    for i in range(rests.count):
        own = rests.number == i
        fading = np.exp(-rests.since[own] / math.exp(shape[0]))
        columns[own, i] = fading - np.mean(fading)
    return columns


def _settled(points: Points) -> _Rests:
    """The longest rests, less the time in which their stops ring."""
    since, found = np.zeros(len(points.twist)), []
    for i in range(int(points.rest.max()) + 1):
        own = np.flatnonzero(points.rest == i)
        since[own] = points.time[own] - points.time[own[0]]
        own = own[since[own] >= min(_RINGING * since[own[-1]], _LONGEST_RINGING)]
        if len(own) >= _FEWEST:
            found.append(own)
    number = np.full(len(points.twist), -1)
    longest = sorted(found, key=len, reverse=True)[:_MOST_RESTS]
    for i, own in enumerate(sorted(longest, key=lambda own: int(own[0]))):
        number[own] = i
    return _Rests(number, since)


def _as_logs(points: Points, rests: _Rests, rows: np.ndarray, compliance: float) -> Points:
    """The points at rest, each rest as a log; the torque is a constant where its changes could not be seen."""
    log = rests.number[rows]
    torque, logged, twist = (getattr(points, name)[rows] for name in ("torque", "logged_torque", "twist"))
    for i in range(rests.count):
        for values in (torque, logged, twist):
            values[log == i] -= np.mean(values[log == i])
    if compliance * float(np.ptp(torque)) < points.twist_noise:
        torque = np.zeros_like(torque)
    return replace(
        points,
        torque=torque,
        logged_torque=logged,
        twist=twist,
        time=rests.since[rows],
        log=log,
        motor_angle=None,
        load_angle=None,
        direction=None,
        rest=np.full(len(rows), -1),
        temperature=None if points.temperature is None else points.temperature[rows],
        motion=("held",) * rests.count,
        names=tuple(f"rest {i + 1}" for i in range(rests.count)),
        rows=(1,) * rests.count,
        reversals=(0,) * rests.count,
    )
