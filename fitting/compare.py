"""Before against after: the same logs, free-running, on what the fits have seen and on what they have not."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from fitting.engines import why_not
from fitting.estimate import Fit
from fitting.experiment import Stretch
from fitting.free_run import FreeRun, free_run, motor_rms_error, rms_error
from fitting.identifiability import Identifiability, identifiability
from fitting.profile import with_profiles
from fitting.uncertainty import Uncertainty, uncertainty
from hdjax import Model

EXCESS = 1.5
"""A residual this many times as large as the measurement noise is not noise."""

EXPLAINED = 0.9
"""Share of the unexplained variance that found effects must remove to be the explanation: two thirds of its rms."""


class Account(eqx.Module):
    """What one fitted model is worth.

    Attributes:
        model: with fitted values.
        uncertainty: of what was fitted.
        training: free runs along the training stretches.
        validation: free runs along the held-out stretches.
        identifiability: what the logs can't tell of it.
        not_machine_code: why XLA evaluates its residual; None where machine code does.
    """

    model: Model
    uncertainty: Uncertainty
    training: tuple[FreeRun, ...]
    validation: tuple[FreeRun, ...]
    identifiability: Identifiability
    not_machine_code: str | None = eqx.field(static=True, default=None)

    @property
    def training_rmse(self) -> float:
        """Rms error of the dynamic error on training stretches."""
        return rms_error(self.training)

    @property
    def validation_rmse(self) -> float:
        """Rms error of the dynamic error on held-out stretches."""
        return rms_error(self.validation)

    @property
    def training_motor_rmse(self) -> float | None:
        """Rms error of the motor's angle on training stretches; None for a reduced model."""
        return motor_rms_error(self.training)

    @property
    def validation_motor_rmse(self) -> float | None:
        """Likewise on held-out stretches."""
        return motor_rms_error(self.validation)


def account(
    fit: Fit,
    training: Sequence[Stretch],
    validation: Sequence[Stretch],
    *,
    noise: Float[Array, "outputs outputs"],
    halo: int,
    profiles: bool = False,
) -> Account:
    """Free runs and standard errors of a fit, and what it can't tell.

    Args:
        fit: the fitted model.
        training: stretches that were fitted.
        validation: stretches that were not.
        noise: covariance of the measurement noise.
        halo: intervals of torque before a stretch.
        profiles: whether doubtful intervals are taken from the likelihood's profile, which compiles a program of its
            own.
    """
    seen, unseen = _runs(fit, training, validation, noise, halo)
    found = uncertainty(fit)
    if profiles:
        found = with_profiles(fit, found)
    told = identifiability(fit, found)
    return Account(fit.model, found, seen, unseen, told, why_not(fit.problem))


def validation_rmse(
    fit: Fit,
    training: Sequence[Stretch],
    validation: Sequence[Stretch],
    *,
    noise: Float[Array, "outputs outputs"],
    halo: int,
) -> float:
    """Rms error of a fit's free runs on held-out stretches; arguments as in [`account`][]."""
    return rms_error(_runs(fit, training, validation, noise, halo)[1])


def _runs(
    fit: Fit, training: Sequence[Stretch], validation: Sequence[Stretch], noise: Array, halo: int
) -> tuple[tuple[FreeRun, ...], tuple[FreeRun, ...]]:
    """Free runs on training and held-out stretches, in one program."""
    together = free_run(
        fit.model,
        [*training, *validation],
        covariance=noise,
        halo=halo,
        substeps=fit.substeps,
        like=fit,
    )
    return together[: len(training)], together[len(training) :]


def excess(fit: Fit, noise: Float[Array, "outputs outputs"]) -> Float[np.ndarray, " outputs"]:
    """What a fit leaves over of each output, in units of the measurement noise; 1 is nothing but noise."""
    return np.sqrt(np.diag(np.asarray(fit.covariance)) / np.diag(np.asarray(noise)))
