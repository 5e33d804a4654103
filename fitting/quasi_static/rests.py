"""Analysis of the twist at rest: relaxation after a stop, or dependence on the logged torque.

At rest there is no ripple or eccentricity, and friction is constant. Creep is then far above the noise, while in the
whole log errors during motion mask it. So each rest is treated as a log with its own zero (friction may bear any part
of the torque there).

A noisy torque leaves a residual even where the twist depends on it. So a relaxation must be significant both beside the
torque in the twist, and beside the twist in the torque. There the stiffness may be any that the whole logs allow. Where
only a stiffness that they exclude explains the rests, the two explanations are tied.
"""

import math
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from fitting.attribution.rules import RULES
from fitting.quasi_static.attribution import Held, TwistRound, TwistTrial, is_within, look
from fitting.quasi_static.form import START, Form, Terms
from fitting.quasi_static.intervals import Figure
from fitting.quasi_static.points import Points
from fitting.quasi_static.torque_forms import delay
from fitting.quasi_static.twist_model import stiffness_of

# Assumed: oscillation after a stop lasts a tenth of a rest, or a quarter of a second [s] where that is less.
_RINGING, _LONGEST_RINGING = 0.1, 0.25
# Least number of points to separate a relaxation from a straight line and noise.
_FEWEST = 50
_MOST_RESTS = 10
_POINTS_IN_CONSTANT, _CONSTANTS = 8, 12
# Significance level of this second test on the same logs.
_SIGNIFICANCE = 0.5 * RULES.significance


@dataclass(frozen=True, eq=False)
class RestAnalysis:
    """Result of the analysis of rests.

    Attributes:
        points: At rest, each rest as a log.
        round: The round of attribution at rest.
        p_value: The larger one under noise of the twist and of the torque.
        own_stiffness: Stiffness that explains the rests instead, though the whole logs exclude it [N m/rad]; None
            without one.
        terms: The accepted effect, beside the equation of the whole logs; empty without one.
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


def analyse_rests(held: Held, current: TwistTrial, seed: int) -> RestAnalysis | None:
    """Analyse the rests of moving joints; None where no rest is long enough.

    Args:
        held: The points of whole logs.
        current: Their current model, for its compliance.
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
        # With exchanged axes, the line's compliance is the stiffness; at constant torque it is unknown.
        follows = stiffness_of(turned, free.before.model)["K"].identifiable
        own_stiffness = slope if follows and _chance(free) > _SIGNIFICANCE else None
    terms: Terms = ()
    if this.accepted and p_value <= _SIGNIFICANCE and all(is_within(*term) for term in this.winner.trial.model.terms):
        ((_, shape),) = this.winner.trial.model.terms
        terms = ((_relaxation(points.step, rest, since, initial=f"{START} "), shape),)
    return RestAnalysis(points, this, p_value, own_stiffness, terms)


def _look(points: Points, form: Form, seed: int) -> TwistRound:
    held = Held.of(points)
    base = held.attempt()
    return look(held, base, base, [(form,), (delay(),)], seed, elastic=False)


def _chance(this: TwistRound) -> float:
    """The p-value of a relaxation; one where another form is better, or none is worth a refit."""
    return this.winner.p_value if this.verdicts and this.winner.family == "creep" else 1.0


def _relaxation(step: float, rest: np.ndarray, since: np.ndarray, initial: str = "") -> Form:
    """Relaxation of the twist after a stop, with one time constant and a free initial state for each rest.

    At rest the torque on a loaded gear hardly changes, so that a standard linear solid relaxes exponentially. Its
    initial state depends on the preceding torque, which friction hides. Each rest's mean is removed, since it depends
    on friction.

    Args:
        step: Time between points [s].
        rest: Number of the rest of each point, -1 elsewhere, (n,).
        since: Time from its stop [s], (n,).
        initial: Prefix of its parameters' names: `START` for initial states of the rests, which other points do not
            determine.
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
    """Number of each point's rest, -1 elsewhere, and the time from the stop [s].

    Only the longest rests are used, without the oscillation after their stops.
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
    """The points at rest, each rest as a log; the torque is constant where its changes are not significant."""
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
