"""Torques with memory, for a discrepancy that no function of the present motion explains."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from fitting.attribution.candidate_fit import Trial
from fitting.attribution.candidate_refit import try_lead
from fitting.attribution.screening import Lead, Screen, screen
from fitting.attribution.shortlist import worth_a_refit
from fitting.attribution.study import Study
from fitting.discrepancy.variable_selection import SearchContext, own_functions
from fitting.first_order.motion import place_of
from hdjax.effects.learned import LearnedMeshTorque
from hdjax.effects.learned_memory import LEARNED_WITH_MEMORY, LearnedMemory

# Number of laws that are refitted inside the equations, the most likely first.
_TRIED = 2


class MemoryCandidate(eqx.Module):
    """A law with memory at a place, with first-order estimates.

    Attributes:
        lead: result of screening.
        known: functions that the free parameters represent at its place, at the kept instants.
    """

    lead: Lead
    known: Float[np.ndarray, "instants known"]

    @property
    def form(self) -> type[LearnedMemory]:
        """The law."""
        form = type(self.lead.effect)
        assert issubclass(form, LearnedMemory)
        return form

    @property
    def gain(self) -> float:
        """Decrease of the objective on held-out data, to first order."""
        return self.lead.gain

    @property
    def variables(self) -> tuple[str, ...]:
        """The variable that its hidden states follow."""
        return (self.form.angle,)


class MemoryScreen(eqx.Module):
    """Screening result of torques with memory.

    Attributes:
        candidates: places and laws, best first by first-order gain.
        screen: result of screening.
    """

    candidates: tuple[MemoryCandidate, ...]
    screen: Screen

    def put_inside(
        self, before: Trial, study: Study, *, rival: tuple[object, Trial] | None
    ) -> tuple[MemoryCandidate, Trial] | None:
        """The candidate with the largest gain inside the equations, of the most likely ones, and the model with it.

        Args:
            before: the current model.
            study: the data and their segmentation.
            rival: another learned term and its model, which it must improve on.
        """
        best: tuple[MemoryCandidate, Trial] | None = None
        limit = (before if rival is None else rival[1]).training.objective
        for candidate in self.candidates[:_TRIED]:
            study.progress(f"learning a {candidate.form.name.replace('_', ' ')}")
            trial = try_lead(before, candidate.lead, study, limit)
            if trial is not None and (best is None or trial.gain_over(before) > best[1].gain_over(before)):
                best, limit = (candidate, trial), trial.training.objective
        return best


def screen_memory(before: Trial, seen: SearchContext, study: Study, *, least: float) -> MemoryScreen:
    """Screen torques with memory.

    Not done where an effect of the model already has memory: the two would be confounded.

    Args:
        before: the current model.
        seen: its search context.
        study: supplies the seed of the surrogates.
        least: smallest first-order gain for a refit.
    """
    taken = {place_of(e) for e in before.model.effects if e.states}
    forms = [form for form in LEARNED_WITH_MEMORY if place_of(form) not in taken]
    study.progress("screening torques with memory")
    screened = screen(before.training, before.held_out, catalogue=forms, seed=study.seed, side=study.side)
    worth = worth_a_refit(screened, least=least)
    return MemoryScreen(tuple(MemoryCandidate(lead, _known(lead, seen)) for lead in worth), screened)


def _known(lead: Lead, seen: SearchContext) -> Float[np.ndarray, "instants known"]:
    """Functions that the free parameters represent in the mesh; none of them acts on a shaft alone."""
    if place_of(lead.effect) is not LearnedMeshTorque:
        return np.zeros((seen.instants.size, 0))
    own = own_functions(seen, LearnedMeshTorque)
    known = own.reshape(-1, own.shape[2])[seen.instants]
    return known[:, np.any(known != 0.0, axis=0)]
