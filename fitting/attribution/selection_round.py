"""One round of the search: candidates are refitted inside the equations and compared on held-out data."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any, Generic

import equinox as eqx
import numpy as np
from typing_extensions import TypeVar

from fitting.attribution.candidate_fit import Trial, long_gains
from fitting.attribution.candidate_refit import begin, complete_refit, try_hold
from fitting.attribution.case_evidence import EffectEvidence, Rival, RoundEvidence
from fitting.attribution.decisions import compete, leader, support, tie
from fitting.attribution.rules import RULES
from fitting.attribution.score import block_scores
from fitting.attribution.screening import Lead, Screen, screen
from fitting.attribution.shortlist import first_of_each_family, further_forms, possible_ties, worth_a_refit
from fitting.attribution.study import Study
from fitting.attribution.support import (
    Standing,
    is_plausible,
    share_of_removed,
    strength_errors,
)
from fitting.estimation.base_fit import leaves_white_noise
from fitting.first_order.motion import place_of
from fitting.uncertainty.identifiability import parameters_at_bounds
from hdjax.effects import Effect
from hdjax.parameters import own_parameters

# A candidate needs this share of the best gain after its first pass to be refitted further; ties have nearly the same
# gain.
_NEAR_TIE = 0.1
# Further forms of a family are refitted if one of its forms has this share of the best gain.
_MAY_DO_BETTER = 0.75
# A rival with less than this share of the best gain after its first pass is dropped.
_HOPELESS = 0.3


# Types of a fitted model, and of one that may be missing; quasi-static logs have other fits.
Fitted = TypeVar("Fitted", default=Trial)
Refitted = TypeVar("Refitted", default=Trial | None)


class Verdict(eqx.Module, Generic[Refitted]):
    """Result of one candidate of a round.

    Attributes:
        name: the form.
        family: its family.
        trial: the refitted model, or None without a refit.
        gain: decrease of the held-out objective (first-order estimate without a refit); of an effect with memory, the
            part that persists over whole stretches.
        p_value: of that gain under the null distribution of the catalogue's best.
        separable: whether held-out data distinguish it from the winner.
    """

    name: str = eqx.field(static=True)
    family: str = eqx.field(static=True)
    trial: Refitted
    gain: float
    p_value: float
    separable: bool


class Round(eqx.Module, Generic[Fitted, Refitted]):
    """One round of the search.

    Attributes:
        before: the current model.
        screen: first-order gains and their null distribution.
        verdicts: all candidates, best first.
        accepted: whether the best one is supported.
        evidence: for that decision.
    """

    before: Fitted
    screen: Screen[Any]
    verdicts: tuple[Verdict[Refitted], ...]
    accepted: bool
    evidence: RoundEvidence = eqx.field(static=True, default=RoundEvidence())

    @property
    def winner(self) -> Verdict[Refitted]:
        """The best candidate."""
        return self.verdicts[0]


def _evidence(verdict: Verdict, standing: Standing) -> EffectEvidence:
    """The evidence for a candidate; another hold has no strength to test."""
    trial = verdict.trial
    assert trial is not None
    own = {verdict.name} & {e.name for e in trial.model.effects}
    errors = strength_errors(trial.training, own)
    return EffectEvidence(
        name=verdict.name,
        gain=verdict.gain,
        p_value=verdict.p_value,
        removed=share_of_removed(trial, standing.before, standing.base),
        imperfection=standing.imperfection(trial, verdict.name),
        strength_errors=min(errors.values(), default=np.inf),
        over_noise=standing.over_noise(trial),
        at_bounds=len(parameters_at_bounds(trial.model, verdict.name)),
    )


def look(standing: Standing, study: Study, *, catalogue: Sequence[type[Effect]]) -> Round:
    """Find the effect that explains most of a model's residual.

    Args:
        standing: the current model.
        study: the data under every hold to compare, and whether all forms are refitted.
        catalogue: candidate forms.
    """
    before = standing.before
    study.progress("screening the catalogue")
    screened = screen(before.training, before.held_out, catalogue=catalogue, seed=study.seed, side=study.side)
    refits = _Refits(before, study)
    refits.of_all(screened) if study.setting.thorough else refits.in_proportion(screened)
    found = [*refits.forms(screened), *(refits.holds(screened) if standing.exempt is None else [])]
    found.sort(key=lambda v: (v.trial is None, -v.gain))
    found, tied = with_ties(found)
    rivals: tuple[Rival, ...] = ()
    known: dict[str, EffectEvidence] = {}

    def ask(verdict: Verdict) -> EffectEvidence:
        if verdict.name not in known:
            known[verdict.name] = _evidence(verdict, standing)
        return known[verdict.name]

    verdicts, asked, accepted = _supported_first(found, ask)
    if accepted:
        found, rivals = simplest_first(found, before)
        if rivals and leader(rivals)[0].tied:
            # Others may be tied with the chosen one that are not with the best one.
            found, tied = with_ties(found)
        verdicts, asked, accepted = _supported_first(found, ask)
    return Round(before, screened, tuple(verdicts), accepted, replace(tied, asked=asked, rivals=rivals))


class _Refits:
    """Refits of forms inside the equations, one after the other."""

    def __init__(self, before: Trial, study: Study) -> None:
        self.before, self.study = before, study
        self.done: dict[str, Trial] = {}

    def of_all(self, screened: Screen) -> None:
        """Refit every form completely."""
        self._refit(screened.leads, self.study, 0.0)

    def in_proportion(self, screened: Screen) -> None:
        """Refit likely forms, and those that the best one contains: with fewer parameters they may be supported where
        that one is not."""
        self._likely(screened)
        if self.done:
            best = self._best()
            contained = set(best.model.effects[-1].contains) - self.done.keys()
            self._beside(best, [lead for lead in screened.leads if lead.effect.name in contained], _HOPELESS)

    def _best(self) -> Trial:
        return max(self.done.values(), key=lambda trial: trial.gain_over(self.before))

    def _likely(self, screened: Screen) -> None:
        """Refit the most likely form of each family, and further forms near the best one."""
        before = self.before
        worth = worth_a_refit(screened, least=0.25 * RULES.least_gain)
        swing = self.study.scales(before.training.stretches, before.model)
        behind = [lead for lead in screened.leads if lead.effect.imitated(before.model.drive, swing)]
        suspects = [lead for lead in behind if lead not in worth]
        first = first_of_each_family(worth, suspects)
        self._refit(first[:1], self.study)
        leader = self.done.get(first[0].effect.name) if first else None
        if leader is not None and leaves_white_noise(leader.training):
            self._beside(leader, possible_ties([*worth, *suspects], first, suspects))
            return
        hidden = [a for a in screened.leads if self.study.suspects(a.effect, before.model) and a not in first]
        self._refit([*first[1:], *hidden], self.study)
        if self.done:
            best = self._best()
            near = _on_the_way(before, best.training.objective, _MAY_DO_BETTER)
            families = [
                a.effect.family
                for a in first
                if (trial := self.done.get(a.effect.name)) is not None and trial.training.objective <= near
            ]
            self._beside(best, further_forms([*worth, *suspects], families, [*first, *hidden]))

    def _refit(self, leads: Sequence[Lead], study: Study, share: float = _HOPELESS) -> None:
        begun = []
        for lead in leads:
            study.progress(f"refitting with {lead.effect.name}")
            begun.append((lead, begin(self.before, lead, study, sibling=self._sibling(lead))))
        # The best one after its first pass is completed first; most others need not be.
        for lead, found in sorted(begun, key=lambda pair: pair[1].objective):
            best = min((t.training.objective for t in self.done.values()), default=np.inf)
            limit = _on_the_way(self.before, best, share)
            trial = complete_refit(self.before, lead, found, study, limit)
            if trial is not None and np.isfinite(trial.held_out.objective):
                self.done[lead.effect.name] = trial

    def _sibling(self, lead: Lead) -> Trial | None:
        """The best refit so far with a form of the same family, or one at the same place that shares parameters."""
        refits = [t for t in self.done.values() if _are_siblings(lead.effect, t.model.effects[-1])]
        return min(refits, key=lambda trial: trial.training.objective, default=None)

    def _beside(self, best: Trial, leads: Sequence[Lead], share: float = 1.0 - _NEAR_TIE) -> None:
        # Comparable first passes need its number of solver steps.
        self._refit(leads, self.study.with_substeps(best.training.substeps), share)

    def forms(self, screened: Screen) -> list[Verdict]:
        """Results of all forms, with the first-order gain of those that were not refitted."""
        found = []
        for lead in screened.leads:
            trial = self.done.get(lead.effect.name)
            gain = lead.gain if trial is None else trial.gain_over(self.before)
            p_value = screened.p_value(gain)
            found.append(Verdict(lead.effect.name, lead.effect.family, trial, gain, p_value, True))
        return found

    def holds(self, screened: Screen) -> list[Verdict]:
        """Refit with other holds of the torque."""
        found = []
        for hold in self.study.data:
            if hold == self.before.hold:
                continue
            self.study.progress(f"refitting with a {hold} torque")
            trial = try_hold(self.before, hold, self.study)
            gain = -np.inf if trial is None else trial.gain_over(self.before)
            found.append(Verdict(f"{hold} hold", "input_delay", trial, gain, screened.p_value(gain), True))
        return found


def _are_siblings(effect: Effect, refitted: Effect) -> bool:
    names, theirs = ({name for name, _ in own_parameters(e)} for e in (effect, refitted))
    same_place = place_of(effect) is not None and place_of(effect) is place_of(refitted)
    return effect.family == refitted.family or (same_place and not names.isdisjoint(theirs))


def _supported_first(
    verdicts: list[Verdict], ask: Callable[[Verdict], EffectEvidence]
) -> tuple[list[Verdict], tuple[EffectEvidence, ...], bool]:
    """The list with unsupported leaders moved behind the first supported candidate (unchanged where none is); the
    evidence for each tested one; and whether one is supported."""
    asked = []
    for i, verdict in enumerate(verdicts):
        if verdict.trial is None:
            break
        hopeless = verdict.gain <= 0.0 or verdict.p_value > RULES.significance
        if hopeless and asked:
            # Where whole stretches chose the first one, those behind it may gain more.
            continue
        asked.append(ask(verdict))
        if all(check.holds for check in support(asked[-1])):
            return [verdict, *verdicts[:i], *verdicts[i + 1 :]], tuple(asked), True
    return verdicts, tuple(asked), False


def _on_the_way(before: Trial, best: float, share: float) -> float:
    """The training objective at a share of the best gain; infinite where there is no refit yet."""
    return before.training.objective - share * (before.training.objective - best) if np.isfinite(best) else np.inf


def with_ties(verdicts: list[Verdict]) -> tuple[list[Verdict], RoundEvidence]:
    """The candidates, with ties of the first one marked; and the evidence for them.

    That is what each refitted one lacks of the first one's score, block by block, and of its gain.
    """
    if not verdicts or (first := verdicts[0].trial) is None:
        return verdicts, RoundEvidence()
    whitening = np.asarray(first.held_out.problem.whitening)
    reference = block_scores(first, whitening)
    behind = {v.name: reference - block_scores(v.trial, whitening) for v in verdicts if v.trial is not None}
    lost = {v.name: float(verdicts[0].gain - v.gain) for v in verdicts if v.name in behind}
    apart = [v.name not in behind or not tie(v.name, behind[v.name], lost[v.name]).holds for v in verdicts]
    marked = [eqx.tree_at(lambda v: v.separable, v, a) for v, a in zip(verdicts, apart, strict=True)]
    return marked, RoundEvidence(behind={n: tuple(map(float, blocks)) for n, blocks in behind.items()}, lost=lost)


def simplest_first(verdicts: list[Verdict], before: Trial) -> tuple[list[Verdict], tuple[Rival, ...]]:
    """The candidates with the chosen one of several ties first, and the evidence of the ties.

    Short segments hide slow errors, and leave hidden states free; so simulations along whole stretches decide.
    """
    refitted = [v for v in verdicts if v.trial is not None]
    best, *others = (_rival(v, before) for v in refitted)
    near = {rival.name for rival in compete(best, others)}
    if len(near) < 2:
        return verdicts, ()
    competing = [v for v in refitted if v.name in near]
    trials = [v.trial for v in competing if v.trial is not None]
    gains = long_gains(before, trials)
    if gains is None or max(gains) <= RULES.least_gain:
        # Whole stretches decide nothing.
        gains = [v.gain for v in competing]
    rivals = tuple(replace(_rival(v, before), long_gain=g) for v, g in zip(competing, gains, strict=True))
    first, close = leader(rivals)
    if not first.tied:
        # Whole stretches distinguish it from one that only short segments preferred.
        apart = [v.name not in close if v.name in near else v.separable for v in verdicts]
        verdicts = [eqx.tree_at(lambda v: v.separable, v, a) for v, a in zip(verdicts, apart, strict=True)]
    return sorted(verdicts, key=lambda v: v.name != first.name), rivals


def _rival(verdict: Verdict, before: Trial) -> Rival:
    trial = verdict.trial
    assert trial is not None
    states = len(trial.model.state_names)
    return Rival(
        name=verdict.name,
        gain=verdict.gain,
        long_gain=verdict.gain,
        tied=not verdict.separable,
        parameters=len(trial.training.free.paths),
        states=states,
        plausible=is_plausible(trial, verdict.name),
        remembers=states > len(before.model.state_names),
    )
