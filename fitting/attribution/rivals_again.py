"""Rivals of earlier rounds, compared again beside all effects of the model.

A round chooses a form while later effects are still missing. Beside these the data may tell it from its ties, or a
simpler form of its family may suffice.
"""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx

from fitting.attribution.candidate_fit import Trial, challenge
from fitting.attribution.case_evidence import RoundEvidence
from fitting.attribution.selection_round import Round, Verdict, simplest_first, with_ties
from fitting.attribution.study import Study
from fitting.attribution.support import nonzero_effects
from fitting.uncertainty.identifiability import parameters_at_bounds
from hdjax.effects import Effect


def compare_again(kept: Sequence[Round], current: Trial, study: Study) -> tuple[Trial, list[Round], dict[str, Round]]:
    """The model with the chosen forms, the rounds with their rivals compared in it, and those of them that replace a
    round's effect, by its name.

    Args:
        kept: the rounds of the model's effects.
        current: the model.
        study: the data and their segmentation.
    """
    compared, instead = {}, {}
    # All other effects were there in the last round, unless one is replaced now.
    for this in [*reversed(kept[:-1]), *kept[-1:]]:
        found = _decided_again(this, current, study) if this is not kept[-1] or instead else (this,)
        compared[this.winner.name], chosen = found, found[-1].winner
        if chosen.name != this.winner.name and chosen.trial is not None:
            current, instead[this.winner.name] = chosen.trial, found[-1]
    return current, [one for this in kept for one in compared[this.winner.name]], instead


def _decided_again(this: Round, current: Trial, study: Study) -> tuple[Round, ...]:
    """A round without its rivals, and their comparison with its effect in the final model, the chosen one first.

    Rivals are its ties and the other forms of its family. It is the round alone where there are none, or where it is
    about a hold. Holds stay where they are.

    Args:
        this: an accepted round.
        current: the model.
        study: the data and their segmentation.
    """
    winner, *others = this.verdicts
    present = {e.name for e in current.model.effects}
    rivals = [
        (v, effect)
        for v in others
        if v.trial is not None and v.name not in present and (v.family == winner.family or not v.separable)
        for effect in v.trial.model.effects
        if effect.name == v.name
    ]
    if winner.name not in present or not rivals:
        return (this,)
    study.progress(f"refitting with rivals of {winner.name}")
    study = study.with_substeps(current.training.substeps)
    tried = [replace(winner, trial=current), *(_instead_of(winner, *rival, current, study) for rival in rivals)]
    tried, _ = with_ties(sorted((v for v in tried if v.trial is not None), key=lambda v: -v.gain))
    tried, _ = simplest_first(tried, this.before)
    (first, *rest), _ = with_ties(tried)
    names = {v.name for v, _ in rivals}
    apart = [v for v in others if v.name not in names]
    again = Round(this.before, this.screen, (replace(first, separable=True), *rest), True, RoundEvidence())
    return eqx.tree_at(lambda r: r.verdicts, this, (winner, *apart)), again


def _instead_of(winner: Verdict, other: Verdict, effect: Effect, current: Trial, study: Study) -> Verdict:
    """The result of another form in the place of a round's effect in the final model; without a trial where it explains
    less, or the data do not determine it."""
    model = current.model.without_effect(winner.name).with_effects(effect)
    trial = challenge(model, study, current.hold, champion=current)
    if trial is not None and not _is_determined(trial, effect.name):
        trial = None
    lost = 0.0 if trial is None else trial.held_out.objective - current.held_out.objective
    return replace(other, trial=trial, gain=winner.gain - lost)


def _is_determined(trial: Trial, name: str) -> bool:
    """Whether an effect has a significantly nonzero strength and no parameter at a bound."""
    return not parameters_at_bounds(trial.model, name) and bool(nonzero_effects(trial.training, {name}))
