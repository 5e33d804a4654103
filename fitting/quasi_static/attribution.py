"""Which effect explains what the torque-twist equation leaves over: one look at the catalogue, refits, ties."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from fitting.attribution.decisions import RULES
from fitting.attribution.shortlist import NEARLY
from fitting.quasi_static.candidates import is_possible, is_usual
from fitting.quasi_static.form import Form
from fitting.quasi_static.points import Points
from fitting.quasi_static.screening import Lead, Screen, screen
from fitting.quasi_static.stretches import folds, worse
from fitting.quasi_static.twist_model import TwistModel, fit_twist, hold_out

# A form that explains less than this share of what the best one does is no rival, and is not refitted.
_RIVAL = 0.25
# A form of a strength that drives can show leads where it explains this share of what the best one does.
_PLAUSIBLE = 0.5
# Forms of one family that are refitted.
_FORMS = 3


@dataclass(frozen=True, eq=False)
class Trial:
    """A model with its errors on stretches that its fit has not seen.

    Attributes:
        model: Fitted to all points.
        held_out: Misfit of each point by fits without its fold [rad], (n,).
    """

    model: TwistModel
    held_out: np.ndarray

    @property
    def mean_square(self) -> float:
        """Of the held-out misfit [rad^2]."""
        return float(np.mean(self.held_out**2))

    @property
    def rmse(self) -> float:
        """Held-out [rad]."""
        return math.sqrt(self.mean_square)

    def gain_over(self, other: "Trial") -> float:
        """Half the logarithm of the other's held-out mean square over this one's."""
        return 0.5 * math.log(max(other.mean_square, 1e-300) / max(self.mean_square, 1e-300))


@dataclass(frozen=True, eq=False)
class Held:
    """Points, and how they are parted into what a fit sees and what it doesn't.

    Attributes:
        points: Of all logs.
        stretch: Number of the stretch of each point, (n,).
        fold: Number of the fold of each point, (n,).
    """

    points: Points
    stretch: np.ndarray
    fold: np.ndarray

    @classmethod
    def of(cls, points: Points, stretch: np.ndarray) -> "Held":
        """Points parted into folds of whole stretches."""
        return cls(points, stretch, folds(stretch))

    def attempt(self, forms: tuple[Form, ...], shapes: tuple[np.ndarray, ...]) -> Trial:
        """A fit with its held-out errors."""
        model = fit_twist(self.points, forms, shapes)
        return Trial(model, hold_out(self.points, model, self.fold))

    def beside(self, trial: Trial, lead: Lead) -> Trial:
        """The model with what it lacks of a lead."""
        new = [i for i, form in enumerate(lead.forms) if form not in trial.model.forms]
        return self.attempt(
            (*trial.model.forms, *(lead.forms[i] for i in new)), (*trial.model.shapes, *(lead.shapes[i] for i in new))
        )

    def without(self, trial: Trial, forms: Sequence[Form]) -> Trial:
        """The model without some of its forms."""
        model = trial.model
        kept = [i for i, form in enumerate(model.forms) if form not in forms]
        return self.attempt(tuple(model.forms[i] for i in kept), tuple(model.shapes[i] for i in kept))

    def is_worse(self, one: Trial, other: Trial) -> bool:
        """Whether the first predicts held-out stretches clearly worse."""
        return worse(one.held_out, other.held_out, self.stretch, self.points.twist_noise)


@dataclass(frozen=True, eq=False)
class Rival:
    """A form, or two, refitted inside the equation.

    Attributes:
        lead: The forms, where its refit began.
        trial: The refit.
        gain: Over the model without it, on held-out stretches.
        p_value: Chance that the best of the catalogue gains as much on noise.
        separable: Whether the logs tell it from the round's winner.
    """

    lead: Lead
    trial: Trial
    gain: float
    p_value: float
    separable: bool = True


@dataclass(frozen=True, eq=False)
class Round:
    """One look at the catalogue beside one model.

    Attributes:
        before: The model that was looked at.
        screen: What each form would gain, and the law of chance.
        rivals: Forms that were refitted, the winner first; empty where none was worth it.
        accepted: Whether the winner is supported.
    """

    before: Trial
    screen: Screen
    rivals: tuple[Rival, ...]
    accepted: bool


def look(
    held: Held, before: Trial, base: Trial, choices: Sequence[tuple[Form, ...]], seed: int, imperfection: float
) -> Round:
    """Look for the effect that explains most of what a model leaves over.

    Args:
        held: The points.
        before: The current model.
        base: The model without any effect.
        choices: Forms, or two together, to consider, the more usual ones first.
        seed: Of the surrogates.
        imperfection: Share (rms) of what earlier effects removed that a further one must remove at least.
    """
    screened = screen(held.points, before.model, choices, held.fold, seed)
    leads = _worth_a_refit(screened)
    rivals = []
    for lead in leads:
        trial = held.beside(before, lead)
        gain = trial.gain_over(before)
        # The law of chance holds for the grid of shapes; what a search between its points gains has to count as chance.
        rivals.append(Rival(lead, trial, gain, screened.p_value(min(gain, lead.gain))))
    rivals.sort(key=lambda rival: -rival.gain)
    if not rivals or rivals[0].p_value > RULES.significance or rivals[0].gain < RULES.least_gain:
        return Round(before, screened, tuple(rivals), accepted=False)
    winner, told = _compared(held, rivals, screened, list(choices))
    removed = before.mean_square - winner.trial.mean_square
    enough = removed > imperfection**2 * (base.mean_square - before.mean_square)
    if any(form.of_torque for form in winner.lead.forms):
        enough = enough and removed > torque_error(held.points, base)
    return Round(before, screened, (winner, *told), accepted=enough)


def torque_error(points: Points, base: Trial) -> float:
    """Mean square of the twist that the torque's own error may account for [rad^2]; less than this shows no effect."""
    # Stein's estimate of a single log scatters, and the error stands together at the torque's corners.
    return 2.0 * float(base.model.coefficients[0] * points.torque_error) ** 2


def _worth_a_refit(screened: Screen) -> list[Lead]:
    """The best forms of each family that come near the best of all, or none where that one is no more than chance."""
    best = screened.leads[0].gain if screened.leads else 0.0
    if best < RULES.least_gain or screened.p_value(best) > RULES.significance:
        return []
    near = [lead for lead in screened.leads if lead.gain >= _RIVAL * best]
    return [lead for i, lead in enumerate(near) if sum(other.families == lead.families for other in near[:i]) < _FORMS]


def _compared(
    held: Held, rivals: list[Rival], screened: Screen, order: list[tuple[Form, ...]]
) -> tuple[Rival, list[Rival]]:
    """The winner, and the other rivals with whether the logs tell them from it.

    Forms are tied where the one does not predict held-out stretches clearly worse, and where the better one has nothing
    left to explain beside it. Of tied forms the one with the fewest parameters wins; of nearly equal ones the more
    usual, and an unusual strength comes last. One that no drive can show stands back where another form explains half
    as much.
    """
    supported = [
        rival for rival in rivals if rival.p_value <= RULES.significance and rival.gain >= _PLAUSIBLE * rivals[0].gain
    ]
    leader = next((rival for rival in supported if _is_possible(held.points, rival)), rivals[0])
    others = [rival for rival in rivals if rival is not leader]
    tied = [leader, *(rival for rival in others if _is_tied(held, rival, leader, screened))]
    able = [rival for rival in tied if _is_usual(held.points, rival)] or tied
    fewest = min(rival.lead.size for rival in able)
    small = [rival for rival in able if rival.lead.size == fewest]
    most = max(rival.gain for rival in small)
    winner = min((r for r in small if r.gain >= NEARLY * most), key=lambda r: order.index(r.lead.forms))
    told = [Rival(r.lead, r.trial, r.gain, r.p_value, separable=r not in tied) for r in rivals if r is not winner]
    return winner, told


def _is_possible(points: Points, rival: Rival) -> bool:
    return all(is_possible(form, own, compliance) for form, own, compliance in _strengths(points, rival))


def _is_usual(points: Points, rival: Rival) -> bool:
    return all(is_usual(form, own, compliance, points) for form, own, compliance in _strengths(points, rival))


def _strengths(points: Points, rival: Rival) -> list[tuple[Form, np.ndarray, np.floating]]:
    """Each form with its strengths and the compliance beside them."""
    model = rival.trial.model
    return [
        (f, model.coefficients[model.own(f, len(points.names))[0]], model.coefficients[0]) for f in rival.lead.forms
    ]


def _is_tied(held: Held, rival: Rival, leader: Rival, screened: Screen) -> bool:
    if rival.p_value > RULES.significance or held.is_worse(rival.trial, leader.trial):
        return False
    both = held.beside(rival.trial, leader.lead)
    return screened.p_value(both.gain_over(rival.trial)) > RULES.significance
