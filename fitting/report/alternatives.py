"""Other refitted explanations."""

from collections.abc import Mapping
from typing import Any

from fitting.attribution.candidate_fit import Trial
from fitting.attribution.selection_round import Verdict
from fitting.discrepancy.learn import Unknown
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
            entry = _alternative(verdict, verdict.trial, this.winner)
            known = found.get(verdict.name)
            if known is None or _closeness(entry) < _closeness(known):
                found[verdict.name] = entry
    if isinstance(outcome, Loop) and outcome.tied is not None:
        found[FAMILY] = _unknown(outcome.tied, (kept_rounds(outcome) or outcome.rounds)[-1].winner, outcome.findings[0])
    return sorted(found.values(), key=_closeness)


def _alternative(verdict: Verdict, trial: Trial, winner: Verdict) -> dict[str, Any]:
    experiment = separating_experiment(winner.family, verdict.family)
    if verdict.separable:
        experiment = "None is needed: the selection data distinguish the two."
    return {
        "family": verdict.family,
        "name": verdict.name,
        "selection_rmse": trial.held_out.principal_std,
        "separable": verdict.separable,
        "separating_experiment": experiment,
        "instead_of": winner.name,
        "selection_rmse_of_found": None if winner.trial is None else winner.trial.held_out.principal_std,
    }


def _unknown(tied: Unknown, winner: Verdict, first: Finding) -> dict[str, Any]:
    """A learned term.

    Args:
        tied: the term.
        winner: of the last round.
        first: of the found effects.
    """
    return {
        "family": FAMILY,
        "name": f"learned {learned_in_words(tied)}",
        "selection_rmse": tied.trial.held_out.principal_std,
        "separable": False,
        "separating_experiment": separating_experiment(first.family, FAMILY),
        "instead_of": first.name,
        "selection_rmse_of_found": None if winner.trial is None else winner.trial.held_out.principal_std,
    }


def _closeness(alternative: Mapping[str, Any]) -> tuple[bool, float]:
    return alternative["separable"], alternative["selection_rmse"]
