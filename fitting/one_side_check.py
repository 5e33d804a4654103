"""Check of the drive's parameters by the equation of motion of one side.

Friction of one side does not enter the equation of the other. Where the final model leaves more than noise and one
side's own equation does not, that equation determines K, alpha and B_sp without the law of the friction.
"""

from fitting.attribution.rules import RULES
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.free_parameters import with_priors
from fitting.estimation.one_side import fits_of_sides, with_known_priors
from fitting.estimation.starting_values import sees_twist
from fitting.uncertainty.one_side import leaves_only_noise
from fitting.uncertainty.standard_errors import uncertainty
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
    fits = fits_of_sides(with_priors(TwoInertiaModel(model.drive), ()), found.stretches)
    good = [one for one in fits if leaves_only_noise(one, found, most=RULES.excess)]
    if len(good) != 1:
        return None
    side = with_known_priors(good[0], model.drive.priors)
    own, other = (uncertainty(one).estimates["K"] for one in (found, side))
    agrees = other.ci95[0] <= own.value <= other.ci95[1]
    return None if agrees and own.std <= other.std else side


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
