"""Before against after: free runs along the same logs, on each part of the data."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.engines import why_not
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_run import FreeRun, free_run, rms_error
from fitting.uncertainty.identifiability import Identifiability, identifiability
from fitting.uncertainty.profile_likelihood import with_profiles
from fitting.uncertainty.standard_errors import Uncertainty, uncertainty
from hdjax import Model


class Account(eqx.Module):
    """What one fitted model is worth.

    Attributes:
        model: with fitted values.
        uncertainty: of what was fitted.
        training: free runs along the stretches that candidates are fitted to.
        selection: free runs along the stretches by which one of them was selected, by the model as it was fitted
            without them; none where nothing was to be selected.
        test: free runs along data that nothing has looked at; none where there are too few.
        identifiability: what the logs can't tell of it.
        not_machine_code: why XLA evaluates its residual; None where machine code does.
    """

    model: Model
    uncertainty: Uncertainty
    training: tuple[FreeRun, ...]
    selection: tuple[FreeRun, ...]
    test: tuple[FreeRun, ...]
    identifiability: Identifiability
    not_machine_code: str | None = eqx.field(static=True, default=None)

    def parts(self) -> dict[str, tuple[FreeRun, ...]]:
        """The free runs of each part of the data that there is, by its name."""
        named = {"training": self.training, "selection": self.selection, "test": self.test}
        return {name: runs for name, runs in named.items() if runs}

    @property
    def rmse(self) -> dict[str, float]:
        """Rms error of the principal output on each part of the data."""
        return {name: rms_error(runs) for name, runs in self.parts().items()}

    @property
    def rmse_of_outputs(self) -> dict[str, dict[str, float]]:
        """Likewise of each output, by its name in the log."""
        outputs = next(iter(self.parts().values()))[0].outputs
        return {o: {name: rms_error(runs, o) for name, runs in self.parts().items()} for o in outputs}

    @property
    def judged(self) -> tuple[FreeRun, ...]:
        """The free runs that tell best how good the model is: of test data, or else of what selected it."""
        return self.test or self.selection or self.training


def account(
    fit: Fit,
    training: Sequence[Stretch],
    test: Sequence[Stretch],
    *,
    noise: Float[Array, "outputs outputs"],
    halo: int,
    selection: tuple[FreeRun, ...] = (),
    profiles: bool = False,
    told_by: Fit | None = None,
) -> Account:
    """Free runs and standard errors of a fit, and what it can't tell.

    Args:
        fit: the fitted model.
        training: stretches along which it runs.
        test: likewise, that it has not seen.
        noise: covariance of the measurement noise.
        halo: intervals of torque before a stretch.
        selection: free runs along the stretches by which it was selected.
        profiles: whether doubtful intervals are taken from the likelihood's profile, which compiles a program of its
            own.
        told_by: a fit of the same parameters that their standard errors are taken from, where it is another one.
    """
    # Apart, so that test data do not even share the scale of a window.
    seen, unseen = (free_runs(fit, part, noise=noise, halo=halo) for part in (training, test))
    judged = fit if told_by is None else told_by
    found = uncertainty(judged)
    if profiles:
        found = with_profiles(judged, found)
    told = identifiability(judged, found)
    if told_by is not None:
        found = found.in_units_of(fit, told_by)
    return Account(fit.model, found, seen, selection, unseen, told, why_not(fit.problem))


def free_runs(
    fit: Fit, stretches: Sequence[Stretch], *, noise: Float[Array, "outputs outputs"], halo: int
) -> tuple[FreeRun, ...]:
    """Free runs of a fitted model; arguments as in [`account`][]."""
    if not stretches:
        return ()
    return free_run(fit.model, stretches, covariance=noise, halo=halo, substeps=fit.substeps, like=fit)


def excess(fit: Fit, noise: Float[Array, "outputs outputs"]) -> Float[np.ndarray, " outputs"]:
    """What a fit leaves over of each output, in units of the measurement noise; 1 is nothing but noise."""
    return np.sqrt(np.diag(np.asarray(fit.covariance)) / np.diag(np.asarray(noise)))
