"""Choice of the forms to refit, from screening alone."""

from collections.abc import Sequence

from fitting.attribution.screening import Lead, Screen
from fitting.estimation.free_parameters import effect_paths
from hdjax.effects import CATALOGUE

NEARLY = 0.95
"""A form with fewer parameters goes first where it has at least this share of its family's best gain."""
# A form whose first-order gain has a p-value above this is not refitted.
_WORTH_A_REFIT = 0.2
# Nor is one with less than this share of the best gain. Where the stiffness is far off, as with backlash, screening may
# underestimate the right form's gain by a factor of ten.
_SHARE_OF_BEST = 0.05
# First-order gains that differ by less than this share are equal.
_THE_SAME = 1e-6
# Number of families whose most likely form is refitted in each round.
_FAMILIES = 5
# Hidden states are simulated, and their initial values fitted, in each segment. So a form with several goes first in
# its family only where no other has this share of its gain.
_FEWER_STATES = 0.25
# Number of further forms that are refitted of the best one's family, and of each close one.
_FORMS = 3
# If an effect leaves only noise, others can at best be tied with it. Only those with at least this share of its
# first-order gain are refitted.
_POSSIBLE_TIE = 0.5


def worth_a_refit(screened: Screen, *, least: float) -> list[Lead]:
    """The best form, and others with a plausible p-value and a share of its gain, best first.

    Where another form extrapolates wildly, all p-values are too large. So the best form is refitted in any case.

    Args:
        screened: the result of screening.
        least: smallest gain.
    """
    if not screened.leads or screened.leads[0].gain < least:
        return []
    first, *others = screened.leads
    least = max(least, _SHARE_OF_BEST * first.gain)
    return [first, *(lead for lead in others if lead.gain >= least and screened.p_value(lead.gain) <= _WORTH_A_REFIT)]


def first_of_each_family(leads: Sequence[Lead], suspects: Sequence[Lead] = ()) -> list[Lead]:
    """The most likely form of each family, best first; the simplest of those with nearly the same gain.

    Args:
        leads: forms to refit, best first.
        suspects: forms that base parameters may imitate; one of each of their families is always included.
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
    """The form of a family that is refitted first."""
    lean = [a for a in forms if len(a.effect.states) < 2 and a.gain >= _FEWER_STATES * forms[0].gain]
    near = lean or list(forms)
    return _simplest([a for a in near if a.gain >= NEARLY * near[0].gain])


def _simplest(leads: Sequence[Lead]) -> Lead:
    """The form with the fewest parameters and hidden states; of those that are equal to first order (backlash with and
    without damping in the gap) the first of the catalogue."""
    best = max(leads, key=lambda lead: lead.gain)

    def order(lead: Lead) -> tuple[int, int, int]:
        behind = round((best.gain - lead.gain) / (_THE_SAME * best.gain))
        own = len(effect_paths(lead.effect)) + len(lead.effect.states)
        return own, behind, CATALOGUE.index(type(lead.effect)) if type(lead.effect) in CATALOGUE else len(CATALOGUE)

    return min(leads, key=order)


def possible_ties(leads: Sequence[Lead], first: Sequence[Lead], suspects: Sequence[Lead] = ()) -> list[Lead]:
    """Possible ties of the best form, which leaves only noise.

    They are forms of other families, equal to the first one of their family to first order, and forms of its own family
    with a larger first-order gain.

    Args:
        leads: all forms that may be refitted.
        first: the first form of each family, best first.
        suspects: forms that base parameters may imitate; their gain does not matter.
    """
    leader = first[0]
    others = [
        lead
        for best in first[1:]
        if best in suspects or best.gain >= _POSSIBLE_TIE * leader.gain
        for lead in leads
        if lead.effect.family == best.effect.family and abs(lead.gain - best.gain) <= _THE_SAME * best.gain
    ]
    forms = [a for a in leads if a.effect.family == leader.effect.family and a.gain > leader.gain and a is not leader]
    return others + forms[:_FORMS]


def further_forms(leads: Sequence[Lead], families: Sequence[str], tried: Sequence[Lead]) -> list[Lead]:
    """The next forms of some families."""
    left = [lead for lead in leads if lead not in tried]
    return [lead for family in families for lead in [a for a in left if a.effect.family == family][:_FORMS]]
