"""Check of the drive's parameters by the equation of motion of one side.

Friction of one side does not enter the equation of the other. Where the final model leaves more than noise and one
side's own equation does not, that equation determines K, alpha and B_sp without the law of the friction.
"""

from fitting.attribution.rules import RULES
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.one_side import SIDES, fit_of_side, known_to
from fitting.estimation.starting_values import sees_twist
from fitting.uncertainty.measurement_noise import measurement_noise
from fitting.uncertainty.standard_errors import uncertainty
from fitting.validation.account import excess
from hdjax import OneSideModel, TwoInertiaModel


def better_side(found: Fit) -> Fit | None:
    """The fit of the only side whose own equation leaves no more than noise, if that excludes the model's K or
    determines it better.

    Two such sides would contradict each other in the inertias, since together they are the drive without effects.

    Args:
        found: the fit of a model that leaves more than noise.
    """
    model = found.model
    if not isinstance(model, TwoInertiaModel) or not sees_twist(found.stretches):
        return None
    known = [(side, alone) for side in SIDES if (alone := known_to(side, model)) is not None]
    fits = [fit_of_side(side, alone, found.stretches) for side, alone in known]
    good = [one for one in fits if one is not None and _leaves_noise(one)]
    if len(good) != 1:
        return None
    own, other = (uncertainty(one).estimates["K"] for one in (found, good[0]))
    agrees = other.ci95[0] <= own.value <= other.ci95[1]
    return None if agrees and own.std <= other.std else good[0]


def with_values_of(side: Fit, found: Fit) -> Fit:
    """A fit of the drive with its parameters fixed at those of one side's equation.

    Args:
        side: the fit of that equation.
        found: the fit of the drive.
    """
    shared = tuple(path for path in side.free.paths if path in found.free.paths)
    return fit(
        found.model.replace({path: side.model.get(path) for path in shared}),
        found.stretches,
        found.free.paths,
        found.segmentation,
        start=Start(found.covariance, found.unknowns.states),
        strategy=Strategy(hold_parameters=shared),
    )


def source_of(side: Fit | None) -> str:
    """What the drive's parameters are from: the torque, or one side's equation."""
    return f"{side.model.equation} equation" if side is not None and isinstance(side.model, OneSideModel) else "torque"


def _leaves_noise(found: Fit) -> bool:
    return bool(excess(found, measurement_noise(found).covariance)[-1] < RULES.excess)
