"""Other refitted explanations."""

from collections.abc import Mapping
from typing import Any

from fitting.attribution.candidate_fit import Trial
from fitting.attribution.selection_round import Verdict
from fitting.outcome import Finding, Loop, kept_rounds
from fitting.report.outcome import Outcome
from fitting.report.separating import separating_experiment
from fitting.report.unknown import learned_in_words
from hdjax.effects.learned import FAMILY


def alternatives(outcome: Outcome) -> list[dict[str, Any]]:
    """Other refitted explanations: ties, and families that the data rule out."""
    names = {f.name for f in outcome.findings}
    families = {f.family for f in outcome.findings}
    found: dict[str, dict[str, Any]] = {}
    for this in kept_rounds(outcome):
        for verdict in this.verdicts:
            if verdict.trial is None or verdict.name in names or (verdict.family in families and verdict.separable):
                continue
            entry = _alternative(verdict.family, verdict.name, verdict.trial, this.winner, separable=verdict.separable)
            known = found.get(verdict.name)
            if known is None or _closeness(entry) < _closeness(known):
                found[verdict.name] = entry
    if isinstance(outcome, Loop) and (tied := outcome.tied) is not None:
        last, name = (kept_rounds(outcome) or outcome.rounds)[-1].winner, f"learned {learned_in_words(tied)}"
        found[FAMILY] = _alternative(FAMILY, name, tied.trial, last, instead_of=outcome.findings[0])
    return sorted(found.values(), key=_closeness)


def _alternative(
    family: str,
    name: str,
    trial: Trial,
    winner: Verdict,
    *,
    instead_of: Finding | None = None,
    separable: bool = False,
) -> dict[str, Any]:
    """An explanation beside the found one.

    Args:
        family: of the explanation.
        name: of the explanation.
        trial: the model with it.
        winner: of the round, whose error it is compared with.
        instead_of: the effect that it replaces; the winner where not given.
        separable: whether selection data distinguish the two.
    """
    replaced = instead_of or winner
    experiment = separating_experiment(replaced.family, family)
    if separable:
        experiment = "None is needed: the selection data distinguish the two."
    return {
        "family": family,
        "name": name,
        "selection_rmse": trial.held_out.principal_std,
        "separable": separable,
        "separating_experiment": experiment,
        "instead_of": replaced.name,
        "selection_rmse_of_found": None if winner.trial is None else winner.trial.held_out.principal_std,
    }


def _closeness(alternative: Mapping[str, Any]) -> tuple[bool, float]:
    return alternative["separable"], alternative["selection_rmse"]
