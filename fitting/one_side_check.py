"""Check of the drive's parameters by the equation of motion of one side.

Friction of one side does not enter the equation of the other. Where the final model leaves more than noise and one
side's own equation does not, that equation determines K, alpha and B_sp without the law of the friction.
"""

from fitting.attribution.rules import RULES
from fitting.estimation.estimate import Fit
from fitting.estimation.free_parameters import with_priors
from fitting.estimation.one_side import fits_of_sides, held_at, stiffness_error, with_known_priors
from fitting.estimation.starting_values import sees_twist
from fitting.estimation.whole_log_fit import follows
from fitting.uncertainty.one_side import contradicts, leaves_only_noise
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import OneSideModel, TwoInertiaModel
from hdjax.effects import SensorEffect


def better_side(found: Fit) -> Fit | None:
    """The fit of one side whose own equation leaves only noise, if that excludes the model's K or determines it better.
    None also where both sides leave only noise and contradict each other: a stated inertia is wrong.

    Args:
        found: the fit of a model that leaves more than noise.
    """
    model = found.model
    if not isinstance(model, TwoInertiaModel) or not sees_twist(found.stretches):
        return None
    if any(isinstance(effect, SensorEffect) for effect in model.effects):
        # What corrects a reading contradicts both sides: each equation is driven by the other side's reading.
        return None
    fits = fits_of_sides(with_priors(TwoInertiaModel(model.drive), ()), found.stretches)
    good = [
        one
        for one in fits
        if leaves_only_noise(one, found, most=RULES.excess) and not any(contradicts(e, one) for e in model.effects)
    ]
    sides = [with_known_priors(one, model.drive.priors) for one in sorted(good, key=stiffness_error)]
    told = [uncertainty(one).estimates["K"] for one in sides]
    if not told or max(e.ci95[0] for e in told) > min(e.ci95[1] for e in told):
        return None
    own = uncertainty(found).estimates["K"]
    agrees = told[0].ci95[0] <= own.value <= told[0].ci95[1]
    return None if agrees and own.std <= told[0].std else sides[0]


def held_by_side(side: Fit, found: Fit) -> Fit | None:
    """A fit with K, alpha and B_sp fixed at those of one side's equation; None where it then no longer follows the
    logs, since what was learned in the mesh beside other values does not suit these."""
    held = held_at(side.model, found, side.free.paths)
    return held if follows(held) else None


def source_of(side: Fit | None) -> str:
    """What the drive's parameters are from: the torque, or one side's equation."""
    return f"{side.model.equation} equation" if side is not None and isinstance(side.model, OneSideModel) else "torque"
