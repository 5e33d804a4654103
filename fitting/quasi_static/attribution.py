"""One round of attribution with the torque-twist equation: screening, refits, ties."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from fitting.attribution.case_evidence import EffectEvidence, RoundEvidence
from fitting.attribution.decisions import support
from fitting.attribution.rules import RULES
from fitting.attribution.screening import Screen
from fitting.attribution.selection_round import Round, Verdict
from fitting.attribution.shortlist import NEARLY
from fitting.quasi_static.form import Form, Terms
from fitting.quasi_static.points import Points
from fitting.quasi_static.screening import Lead, screen
from fitting.quasi_static.stretches import folds, stretches, worse
from fitting.quasi_static.twist_model import TwistModel, fit_twist, hold_out, strengths_of

# A form with less than this share of the best gain is not refitted.
_RIVAL = 0.25
# A form of plausible strength is preferred where it has this share of the best gain.
_PLAUSIBLE = 0.5
# A multiple of the few percent of creep that real drives show.
_LARGEST_CREEP = 0.5
# Share of a searched range, logarithmic, at either end: what is found there would lie beyond it.
_EDGE = 0.01
# Number of forms of one family that are refitted.
_FORMS = 3


@dataclass(frozen=True, eq=False)
class TwistTrial:
    """A fitted equation with its errors on held-out stretches.

    Attributes:
        model: Fitted to all points.
        held_out: Misfit of each point in the fit without its fold [rad], (n,).
    """

    model: TwistModel
    held_out: np.ndarray

    @property
    def mean_square(self) -> float:
        """Mean square of the held-out misfit [rad^2]."""
        return float(np.mean(self.held_out**2))

    @property
    def rmse(self) -> float:
        """Rms of the held-out misfit [rad]."""
        return math.sqrt(self.mean_square)

    def gain_over(self, other: "TwistTrial") -> float:
        """Half the logarithm of the other's held-out mean square over this one's."""
        return 0.5 * math.log(max(other.mean_square, 1e-300) / max(self.mean_square, 1e-300))

    def beyond(self, other: "TwistTrial") -> tuple[Form, ...]:
        """The forms that the other trial lacks."""
        return tuple(form for form in self.model.forms if form not in other.model.forms)


TwistVerdict = Verdict[TwistTrial]
TwistRound = Round[TwistTrial, TwistTrial]


@dataclass(frozen=True, eq=False)
class Held:
    """Points and their folds for cross-validation.

    Attributes:
        points: Of all logs.
        stretch: Number of the stretch of each point, (n,).
        fold: Number of the fold of each point, (n,).
    """

    points: Points
    stretch: np.ndarray
    fold: np.ndarray

    @classmethod
    def of(cls, points: Points) -> "Held":
        """Points in folds of whole stretches, from the straight line's misfit."""
        # At least two stretches per log, so that its zero is determined where one is held out.
        stretch = stretches(fit_twist(points).misfit, points.log, each=2)
        return cls(points, stretch, folds(stretch))

    def attempt(self, terms: Terms = ()) -> TwistTrial:
        """A fit with its held-out errors."""
        model = fit_twist(self.points, terms)
        return TwistTrial(model, hold_out(self.points, model, self.fold))

    def beside(self, trial: TwistTrial, terms: Terms) -> TwistTrial:
        """The model with further terms, less the forms of which it then has a generalisation."""
        every = (*trial.model.terms, *(term for term in terms if term[0] not in trial.model.forms))
        included = {form.includes for form, _ in every}
        return self.attempt(tuple(term for term in every if term[0].name not in included))

    def without(self, trial: TwistTrial, forms: Sequence[Form]) -> TwistTrial:
        """The model without some of its forms."""
        return self.attempt(tuple(term for term in trial.model.terms if term[0] not in forms))

    def is_worse(self, one: TwistTrial, other: TwistTrial) -> bool:
        """Whether the first predicts held-out stretches significantly worse."""
        return worse(one.held_out, other.held_out, self.stretch, self.points.twist_noise)


def look(
    held: Held,
    before: TwistTrial,
    base: TwistTrial,
    choices: Sequence[tuple[Form, ...]],
    seed: int,
    *,
    elastic: bool = True,
) -> TwistRound:
    """Find the effect that explains most of a model's residual.

    Args:
        held: The points.
        before: The current model.
        base: The model without any effect.
        choices: Candidate forms, or pairs of them, the more common ones first.
        seed: Of the surrogates.
        elastic: Whether the twist must rise with the torque. At rest, where the torque hardly changes, noise may make
            it fall.
    """
    screened = screen(held.points, before.model, choices, held.fold, seed)
    verdicts = [_refit(held, before, lead, screened) for lead in _worth_a_refit(screened)]
    if elastic:
        # Physically, the twist rises with the torque.
        verdicts = [v for v in verdicts if v.trial.model.coefficients[0] > 0]
    verdicts.sort(key=lambda verdict: -verdict.gain)
    if verdicts:
        best = verdicts[0]
        asked = [_evidence(best.trial.beyond(before), best.gain, best.p_value)]
    else:
        asked = [_evidence(lead.forms, lead.gain, screened.p_value(lead.gain)) for lead in screened.leads[:1]]
    accepted = bool(verdicts) and _is_supported(asked[0])
    if accepted:
        verdicts = _simplest_first(held, verdicts, screened, before, choices)
        winner, share = verdicts[0], _share_of_removed(held, verdicts[0].trial, before, base)
        asked = [_evidence(winner.trial.beyond(before), winner.gain, winner.p_value, share)]
        accepted = _is_supported(asked[0])
    return Round(before, screened, tuple(verdicts), accepted, RoundEvidence(tuple(asked)))


def _refit(held: Held, before: TwistTrial, lead: Lead, screened: Screen[Lead]) -> TwistVerdict:
    trial = held.beside(before, lead.terms)
    gain = trial.gain_over(before)
    # The null distribution is that of the grid of shapes; further gain by the search between grid points is not
    # counted.
    p_value = screened.p_value(min(gain, lead.gain))
    name, family = (" and ".join(words) for words in ([form.name for form in lead.forms], lead.families))
    return Verdict(name, family, trial, gain, p_value, True)


def _share_of_removed(held: Held, trial: TwistTrial, before: TwistTrial, base: TwistTrial) -> float:
    """Error that a form removes, over the error that preceding ones have removed (rms)."""
    removed, earlier = before.mean_square - trial.mean_square, base.mean_square - before.mean_square
    # A form that depends on the torque must also remove more than the torque's error may cause.
    if any(form.of_torque for form in trial.beyond(before)) and removed <= torque_error(held.points, base):
        removed = 0.0
    return math.sqrt(max(removed, 0.0) / earlier) if earlier > 0 else math.inf if removed > 0 else 0.0


def _evidence(forms: Sequence[Form], gain: float, p_value: float, removed: float = math.inf) -> EffectEvidence:
    name = " and ".join(form.name for form in forms)
    return EffectEvidence(name, gain, p_value, removed, RULES.quasi_static_imperfection)


def _is_supported(seen: EffectEvidence) -> bool:
    """Whether an effect's gain is significant, and exceeds the possible error of earlier effects' laws."""
    return all(check.holds for check in support(seen))


def torque_error(points: Points, base: TwistTrial) -> float:
    """Mean square of the twist that the torque's error may cause [rad^2]; a smaller gain is no evidence."""
    # Stein's estimate of a single log scatters, and the error concentrates at the torque's corners.
    return 2.0 * float(base.model.coefficients[0] * points.torque_error) ** 2


def _worth_a_refit(screened: Screen[Lead]) -> list[Lead]:
    """The best forms of each family near the overall best, or none where that one is not significant."""
    best = screened.leads[0].gain if screened.leads else 0.0
    if not _is_supported(_evidence((), best, screened.p_value(best))):
        return []
    near = [lead for lead in screened.leads if lead.gain >= _RIVAL * best]
    return [lead for i, lead in enumerate(near) if sum(other.families == lead.families for other in near[:i]) < _FORMS]


def _simplest_first(
    held: Held,
    verdicts: list[TwistVerdict],
    screened: Screen[Lead],
    before: TwistTrial,
    choices: Sequence[tuple[Form, ...]],
) -> list[TwistVerdict]:
    """The candidates with the chosen one first; the others with whether the logs distinguish them from the best.

    Forms are tied where one does not predict held-out stretches significantly worse, and where the better one explains
    nothing beside it. Of tied forms the one with the fewest parameters is chosen; of nearly equal ones the more common.
    An implausible one yields to a form with half its gain.
    """
    forms = {verdict.name: verdict.trial.beyond(before) for verdict in verdicts}

    def is_tied(verdict: TwistVerdict) -> bool:
        if verdict.p_value > RULES.significance or held.is_worse(verdict.trial, leader.trial):
            return False
        both = held.beside(verdict.trial, tuple(t for t in leader.trial.model.terms if t[0] in forms[leader.name]))
        return screened.p_value(both.gain_over(verdict.trial)) > RULES.significance

    def size(verdict: TwistVerdict) -> int:
        return sum(form.size for form in verdict.trial.model.forms)

    able = [v for v in verdicts if v.p_value <= RULES.significance and v.gain >= _PLAUSIBLE * verdicts[0].gain]
    leader = next((v for v in able if _is_possible(v.trial.model)), verdicts[0])
    tied = [leader, *(v for v in verdicts if v is not leader and is_tied(v))]
    small = [v for v in tied if size(v) == min(map(size, tied))]
    near = [v for v in small if v.gain >= NEARLY * max(v.gain for v in small)]
    winner = min(near, key=lambda v: choices.index(forms[v.name]))
    return [winner, *(replace(v, separable=v not in tied) for v in verdicts if v is not winner)]


def is_determined(points: Points, model: TwistModel, form: Form) -> bool:
    """Whether the logs determine at least one figure of a form other than phases, and its values are physical."""
    figures = strengths_of(points, model, form)
    known = any(one.identifiable for name, one in figures.items() if not name.startswith("phase"))
    share = figures["share"].value if "share" in figures else 0.0
    return known and share is not None and share <= 1.0 and is_within(form, dict(model.terms)[form])


def is_within(form: Form, shape: Float[np.ndarray, " parameters"]) -> bool:
    """Whether a time constant, if any, is inside the searched range; at an end of it, it would lie beyond."""
    low, high = form.range
    where = zip(form.shape_names, (shape - low) / (high - low), strict=True)
    return all(bool(_EDGE < at < 1.0 - _EDGE) for name, at in where if name.endswith("time constant"))


def _is_possible(model: TwistModel) -> bool:
    """Whether strengths are plausible: delayed twist is a fraction of immediate twist."""
    creeps = [model.coefficients[model.own(form)[0].start] for form in model.forms if form.family == "creep"]
    return bool(max(map(abs, creeps), default=0.0) <= _LARGEST_CREEP * abs(model.coefficients[0]))
