"""Subject of a report: a closed loop, or a fit alone."""

from fitting.attribution.selection_round import Round
from fitting.outcome import FitOnly, Loop

Outcome = Loop | FitOnly


def kept_rounds(outcome: Outcome) -> list[Round]:
    """Rounds of the search whose effect is still in the final model."""
    names = {f.name for f in outcome.findings}
    return [this for this in outcome.rounds if this.accepted and this.winner.name in names]
