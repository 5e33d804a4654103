"""A torque with a memory of its own, where no function of the present motion explains what is missing."""

import equinox as eqx
import numpy as np
from jaxtyping import Float

from fitting.attribution.candidate_fit import Trial
from fitting.attribution.candidate_refit import try_lead
from fitting.attribution.screening import Lead, Screen, screen
from fitting.attribution.shortlist import worth_a_refit
from fitting.attribution.study import Study
from fitting.discrepancy.variable_selection import LearnedLook, own_functions
from fitting.first_order.motion import place_of
from hdjax.effects.learned import LearnedMeshTorque
from hdjax.effects.learned_memory import LEARNED_WITH_MEMORY, LearnedMemory

# Laws that are put inside the equations, the likeliest first.
_TRIED = 2


class Remembered(eqx.Module):
    """A law with memory at a place, as the first look sees it.

    Attributes:
        lead: that look.
        known: what the free parameters stand for at its place, at the instants that are kept.
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
        """What it remembers."""
        return (self.form.angle,)

    @property
    def of(self) -> tuple[type[LearnedMemory], tuple[str, ...]]:
        """Law and variable."""
        return self.form, self.variables


class Remembering(eqx.Module):
    """What torques with memory would explain.

    Attributes:
        candidates: places and laws, best first by the first look.
        screen: that look.
    """

    candidates: tuple[Remembered, ...]
    screen: Screen

    def put_inside(
        self, before: Trial, study: Study, *, rival: tuple[object, Trial] | None
    ) -> tuple[Remembered, Trial] | None:
        """The candidate that explains most inside the equations, of the likeliest ones, and the model with it.

        Args:
            before: the model that was looked at.
            study: the data, and how they are cut.
            rival: what else was learned, and a model that it has to better.
        """
        best: tuple[Remembered, Trial] | None = None
        limit = (before if rival is None else rival[1]).training.objective
        for candidate in self.candidates[:_TRIED]:
            study.progress(f"learning a {candidate.form.name.replace('_', ' ')}")
            trial = try_lead(before, candidate.lead, study, limit)
            if trial is not None and (best is None or trial.gain_over(before) > best[1].gain_over(before)):
                best, limit = (candidate, trial), trial.training.objective
        return best


def remembering(before: Trial, seen: LearnedLook, study: Study, *, least: float) -> Remembering:
    """Look for torques with memory.

    Where an effect of the model remembers already, no further memory is looked for: two of the same thing could not be
    told apart.

    Args:
        before: the model.
        seen: a look at it.
        study: supplies the seed of the surrogates.
        least: gain to first order that is worth a refit.
    """
    taken = {place_of(e) for e in before.model.effects if e.states}
    forms = [form for form in LEARNED_WITH_MEMORY if place_of(form) not in taken]
    study.progress("looking for a memory")
    screened = screen(before.training, before.held_out, catalogue=forms, seed=study.seed)
    worth = worth_a_refit(screened, least=least)
    return Remembering(tuple(Remembered(lead, _known(lead, seen)) for lead in worth), screened)


def _known(lead: Lead, seen: LearnedLook) -> Float[np.ndarray, "instants known"]:
    """What the free parameters stand for in the mesh; none of them acts on a shaft alone."""
    if place_of(lead.effect) is not LearnedMeshTorque:
        return np.zeros((seen.instants.size, 0))
    own = own_functions(seen, LearnedMeshTorque)
    known = own.reshape(-1, own.shape[2])[seen.instants]
    return known[:, np.any(known != 0.0, axis=0)]
