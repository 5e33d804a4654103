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

from fitting.attribution.rules import RULES
from fitting.quasi_static.attribution import Held, TwistRound, TwistTrial, look
from fitting.quasi_static.form import START, Form, Terms
from fitting.quasi_static.intervals import Figure
from fitting.quasi_static.points import Points
from fitting.quasi_static.torque_forms import delay
from fitting.quasi_static.twist_model import stiffness_of

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
        points: At rest, each rest as a log.
        round: The look at what may explain them.
        p_value: Chance that noise asks for as much, be it the twist's or the torque's.
        own_stiffness: Stiffness with which the twist may follow the torque at rest instead, though the whole logs rule
            it out [N m/rad]; None where no stiffness would do.
        terms: The effect that was found, beside the equation of the whole logs; none where nothing was.
    """

    points: Points
    round: TwistRound
    p_value: float
    own_stiffness: float | None
    terms: Terms

    @property
    def after(self) -> TwistTrial:
        """The equation at rest with the effect."""
        return self.round.winner.trial

    @property
    def gain(self) -> float:
        """Share of the held-out error at rest that the effect removes."""
        return 1.0 - self.after.rmse / self.round.before.rmse


def look_at_rests(held: Held, current: TwistTrial, seed: int) -> RestLook | None:
    """Look at the rests of joints that moved; None where no rest is long enough.

    Args:
        held: The points of whole logs.
        current: Their model so far, for its compliance.
        seed: Of the surrogates.
    """
    rest, since = _settled(held.points)
    rows = np.flatnonzero(rest >= 0)
    if not rows.size:
        return None
    compliance = float(abs(current.model.coefficients[0]))
    points = _as_logs(replace(held.points, time=since, log=rest), rows, compliance)
    form = _relaxation(points.step, points.log, points.time)
    this = _look(points, form, seed)
    p_value, own_stiffness = _chance(this), None
    if np.ptp(points.torque) > 0:
        allowed = stiffness_of(held.points, current.model)["K"].ci95 or (0.0, math.inf)
        turned = replace(points, torque=points.twist, twist=points.logged_torque)
        free = in_return = _look(turned, form, seed)
        slope = float(free.before.model.coefficients[0])
        nearest = float(np.clip(slope, *allowed))
        if slope != nearest:
            left = points.logged_torque - nearest * points.twist
            in_return = _look(replace(points, torque=np.zeros_like(left), twist=left), form, seed)
        p_value = max(p_value, _chance(in_return))
        # Turned round, the line's compliance is the stiffness; where the torque stays as it is, that is not known.
        follows = stiffness_of(turned, free.before.model)["K"].identifiable
        own_stiffness = slope if follows and _chance(free) > _SIGNIFICANCE else None
    terms: Terms = ()
    if this.accepted and p_value <= _SIGNIFICANCE:
        ((_, shape),) = this.winner.trial.model.terms
        terms = ((_relaxation(points.step, rest, since, initial=f"{START} "), shape),)
    return RestLook(points, this, p_value, own_stiffness, terms)


def _look(points: Points, form: Form, seed: int) -> TwistRound:
    held = Held.of(points)
    base = held.attempt()
    return look(held, base, base, [(form,), (delay(),)], seed, elastic=False)


def _chance(this: TwistRound) -> float:
    """The p-value of a relaxation; where another form does better, or none is worth a refit, there is none."""
    return this.winner.p_value if this.verdicts and this.winner.family == "creep" else 1.0


def _relaxation(step: float, rest: np.ndarray, since: np.ndarray, initial: str = "") -> Form:
    """The twist relaxes after a stop, in each rest from a state of its own, with one time constant.

    At rest the torque of a gear that bears a load hardly changes, so that a standard linear solid fades exponentially;
    how far from its end it begins hangs on what the gear bore while friction hid it. Each rest's own mean is left out:
    the level of a rest is friction's.

    Args:
        step: Time between points [s].
        rest: Number of the rest of each point, -1 elsewhere, (n,).
        since: Time from its stop [s], (n,).
        initial: What its parameters' names begin with: `START` where they count as initial states of the rests, which
            the other points of a log know nothing of.
    """
    low, high = math.log(_POINTS_IN_CONSTANT * step), math.log(float(np.max(since[rest >= 0])))
    text, numbers = "of the relaxation at the stop before rest", range(1, int(rest.max()) + 2)
    amplitudes = (Figure(f"amplitude_{i}", lambda own, i=i: own[i], "rad", f"{text} {i}") for i in numbers)
    return Form(
        "creep",
        "relaxation after a stop",
        partial(_fading, rest, since),
        tuple(f"{initial}amplitude {i}" for i in numbers),
        "at rest: twist = tau/K + level of the rest + a exp(-t/T), t from the stop on",
        (Figure("time_constant", lambda own: math.exp(own[-1]), "s", "of the relaxation", True), *amplitudes),
        np.linspace(low, high, _CONSTANTS)[:, None],
        (f"{initial}log time constant",),
        np.array([[low], [high]]),
        of_torque=False,
    )


def _fading(rest: np.ndarray, since: np.ndarray, points: Points, shape: np.ndarray) -> np.ndarray:
    own = rest[:, None] == np.arange(int(rest.max()) + 1)
    fading = own * np.exp(-since / math.exp(shape[0]))[:, None]
    return fading - own * (np.sum(fading, axis=0) / np.sum(own, axis=0))


def _settled(points: Points) -> tuple[np.ndarray, np.ndarray]:
    """Of each point the number of its rest, -1 elsewhere, and the time from the stop [s].

    Only the longest rests count, less the time in which their stops ring.
    """
    since, found = np.zeros(len(points.twist)), []
    for i in range(int(points.rest.max()) + 1):
        own = np.flatnonzero(points.rest == i)
        since[own] = points.time[own] - points.time[own[0]]
        found.append(own[since[own] >= min(_RINGING * since[own[-1]], _LONGEST_RINGING)])
    longest = sorted((own for own in found if len(own) >= _FEWEST), key=len, reverse=True)[:_MOST_RESTS]
    number = np.full(len(points.twist), -1)
    for i, own in enumerate(sorted(longest, key=lambda own: own[0])):
        number[own] = i
    return number, since


def _as_logs(points: Points, rows: np.ndarray, compliance: float) -> Points:
    """The points at rest, each rest as a log; the torque is a constant where its changes could not be seen."""
    log, count = points.log[rows], int(points.log.max()) + 1
    columns = np.column_stack([points.torque, points.logged_torque, points.twist])[rows]
    for i in range(count):
        columns[log == i] -= np.mean(columns[log == i], axis=0)
    torque, logged, twist = columns.T
    return replace(
        points,
        torque=torque * (compliance * float(np.ptp(torque)) >= points.twist_noise),
        logged_torque=logged,
        twist=twist,
        time=points.time[rows],
        log=log,
        motor_angle=None,
        load_angle=None,
        direction=None,
        rest=np.full(len(rows), -1),
        temperature=None if points.temperature is None else points.temperature[rows],
        motion=("held",) * count,
        names=tuple(f"rest {i + 1}" for i in range(count)),
        rows=(1,) * count,
        reversals=(0,) * count,
    )
