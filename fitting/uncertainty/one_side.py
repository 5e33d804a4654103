"""What the equation of one side says about K, alpha and B_sp, where it leaves only noise.

Friction of one side does not enter the equation of the other. So it holds whatever law that friction has.
"""

import numpy as np

from fitting.estimation.estimate import Fit
from fitting.estimation.free_parameters import MESH, with_priors
from fitting.uncertainty.measurement_noise import measurement_noise
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Model, OneSideModel, TwoInertiaModel
from hdjax.drive import Prior
from hdjax.effects import Effect, SensorEffect


def leaves_only_noise(side: Fit, found: Fit, *, most: float) -> bool:
    """Whether one side's equation determines K, leaves less than a model of the drive, and no more than noise.

    Args:
        side: the fit of the equation; a fit of another model does not count.
        found: the fit of the model, with its priors.
        most: times the noise.
    """
    if not isinstance(side.model, OneSideModel):
        return False
    assert isinstance(found.model, TwoInertiaModel)
    unknown = {prior.path for prior in found.model.drive.priors if np.isinf(prior.tolerance)}
    if unknown.intersection(side.model.scaled_by) or side.principal_std >= found.principal_std:
        return False
    # Encoder noise enters the equation of one side in another way than a model of the drive, and may cancel.
    noises = (measurement_noise(fit).covariance[-1, -1] for fit in (side, found))
    return any(side.principal_std < most * float(np.sqrt(variance)) for variance in noises)


def contradicts(effect: Effect, side: Fit | None) -> bool:
    """Whether K and B_sp of one side's equation are wrong where an effect is there: it corrects a stated value that
    they are in proportion to, or what a sensor reads, since the equation is driven by the motion as it is read."""
    if side is None or not isinstance(side.model, OneSideModel):
        return False
    return isinstance(effect, SensorEffect) or effect.corrects in side.model.scaled_by


def with_mesh_priors(model: Model, side: Fit) -> Model:
    """The model with what one side's equation says as priors of K, alpha and B_sp.

    While a model lacks something, its residual has little weight, and the priors keep the parameters where they are.
    Once it leaves only noise, its own information counts.

    Args:
        model: of the drive.
        side: the fit of the equation.
    """
    assert isinstance(model, TwoInertiaModel)
    known = uncertainty(side).estimates
    logarithmic = dict(zip(side.free.paths, side.free.logarithmic, strict=True))
    priors = [Prior(p, known[p].value, known[p].std / (known[p].value if logarithmic[p] else 1.0)) for p in MESH]
    return with_priors(model, (*model.drive.priors, *priors))


def without_mesh_priors(model: Model) -> Model:
    """The model with the priors of its drive file alone."""
    if not isinstance(model, TwoInertiaModel):
        return model
    return with_priors(model, tuple(prior for prior in model.drive.priors if prior.path not in MESH))
