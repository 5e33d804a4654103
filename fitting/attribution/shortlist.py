"""Which forms are put inside the equations and refitted, from the first look alone."""

from collections.abc import Sequence

from fitting.attribution.screening import Lead, Screen
from fitting.estimation.free_parameters import effect_paths
from hdjax.effects import CATALOGUE

NEARLY = 0.95
"""A form with fewer parameters goes first where it explains at least this share of what its family's best one does."""
# A form that to first order does no better than chance does in this share of cases is not refitted.
_WORTH_A_REFIT = 0.2
# Nor is one that explains less than this share of what the best one does: where stiffness is far off, as with backlash,
# the first look misses the gain of the right form by a factor of ten.
_SHARE_OF_BEST = 0.05
# First-order gains that differ by less than this share are the same.
_THE_SAME = 1e-6
# Families whose likeliest form is refitted inside the equations in each round.
_FAMILIES = 5
# Each state of a form's own is followed, and its start fitted, in each segment: one with several goes first in its
# family only where no other explains at least this share of what it does.
_FEWER_STATES = 0.25
# Further forms of the best one's family, and of each that comes near it, that compete there.
_FORMS = 3
# Beside an effect that leaves nothing but noise, others can at best be tied with it: those that to first order explain
# at least this share of what it does,
_POSSIBLE_TIE = 0.5


def worth_a_refit(screened: Screen, *, least: float) -> list[Lead]:
    """Leads that may be more than chance and explain a share of what the best one does, best first.

    Args:
        screened: the first look.
        least: gain that none may fall below.
    """
    if screened.leads:
        least = max(least, _SHARE_OF_BEST * screened.leads[0].gain)
    return [lead for lead in screened.leads if lead.gain >= least and screened.p_value(lead.gain) <= _WORTH_A_REFIT]


def first_of_each_family(leads: Sequence[Lead], suspects: Sequence[Lead] = ()) -> list[Lead]:
    """The likeliest form of each family, likeliest first; the simplest of those that explain nearly as much.

    Args:
        leads: what is worth a refit, best first.
        suspects: what else may be behind the model's own parameters; of these families one form is always there.
    """
    families: dict[str, list[Lead]] = {}
    for lead in leads:
        families.setdefault(lead.effect.family, []).append(lead)
    found = [_likeliest(forms) for forms in families.values()][:_FAMILIES]
    for lead in suspects:
        if lead.effect.family not in {other.effect.family for other in found}:
            found.append(lead)
    return found


def _likeliest(forms: Sequence[Lead]) -> Lead:
    """The form of a family, best first, that goes first."""
    lean = [a for a in forms if len(a.effect.states) < 2 and a.gain >= _FEWER_STATES * forms[0].gain]
    near = lean or list(forms)
    return _simplest([a for a in near if a.gain >= NEARLY * near[0].gain])


def _simplest(leads: Sequence[Lead]) -> Lead:
    """The one with the fewest parameters and states of its own; of those that to first order are one and the same
    (backlash with and without damping in the gap) the one that the catalogue lists first."""
    best = max(leads, key=lambda lead: lead.gain)

    def order(lead: Lead) -> tuple[int, int, int]:
        behind = round((best.gain - lead.gain) / (_THE_SAME * best.gain))
        own = len(effect_paths(lead.effect)) + len(lead.effect.states)
        return own, behind, CATALOGUE.index(type(lead.effect))

    return min(leads, key=order)


def possible_ties(leads: Sequence[Lead], first: Sequence[Lead]) -> list[Lead]:
    """What may explain as much as the first of all, which leaves nothing but noise: other families, and forms of its
    own one that to first order explain more."""
    leader = first[0]
    others = [lead for lead in first[1:] if lead.gain >= _POSSIBLE_TIE * leader.gain]
    forms = [a for a in leads if a.effect.family == leader.effect.family and a.gain > leader.gain and a is not leader]
    return others + forms[:_FORMS]


def further_forms(leads: Sequence[Lead], families: Sequence[str], tried: Sequence[Lead]) -> list[Lead]:
    """The next forms of some families."""
    left = [lead for lead in leads if lead not in tried]
    return [lead for family in families for lead in [a for a in left if a.effect.family == family][:_FORMS]]
