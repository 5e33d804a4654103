"""Free runs of a fitted model on each part of the data, to compare models before and after attribution."""

from collections.abc import Sequence

import equinox as eqx
from jaxtyping import Array, Float

from fitting.estimation.engines import why_not
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_run import FreeRun, free_run, rms_error
from fitting.estimation.late_readings import unaligned
from fitting.uncertainty.identifiability import Identifiability, identifiability
from fitting.uncertainty.profile_likelihood import with_profiles
from fitting.uncertainty.standard_errors import Uncertainty, uncertainty
from hdjax import Model


class Account(eqx.Module):
    """Free runs and uncertainty of one fitted model.

    Attributes:
        model: with fitted values.
        uncertainty: of the fitted parameters.
        training: free runs along the training stretches.
        selection: free runs along the selection stretches, by the model as fitted without them; none where nothing was
            selected.
        test: free runs along the test data; none where there are too few.
        identifiability: which parameters the logs don't determine.
        not_machine_code: reason why XLA evaluates its residual; None where machine code does.
        zeros: what was subtracted from the dynamic error of its logs, each value once.
    """

    model: Model
    uncertainty: Uncertainty
    training: tuple[FreeRun, ...]
    selection: tuple[FreeRun, ...]
    test: tuple[FreeRun, ...]
    identifiability: Identifiability
    not_machine_code: str | None = eqx.field(static=True, default=None)
    zeros: tuple[float, ...] = eqx.field(static=True, default=())

    def parts(self) -> dict[str, tuple[FreeRun, ...]]:
        """The free runs of each part of the data, by its name."""
        named = {"training": self.training, "selection": self.selection, "test": self.test}
        return {name: runs for name, runs in named.items() if runs}

    @property
    def rmse(self) -> dict[str, float]:
        """Rms error of the principal output on each part of the data."""
        return {name: rms_error(runs) for name, runs in self.parts().items()}

    @property
    def rmse_of_outputs(self) -> dict[str, dict[str, float]]:
        """Rms error of each output on each part of the data, by its name in the log."""
        outputs = next(iter(self.parts().values()))[0].outputs
        return {o: {name: rms_error(runs, o) for name, runs in self.parts().items()} for o in outputs}

    @property
    def judged(self) -> tuple[FreeRun, ...]:
        """The free runs by which the model is judged: on test data, else selection data, else training data."""
        return self.test or self.selection or self.training


def account(
    fit: Fit,
    training: Sequence[Stretch],
    test: Sequence[Stretch],
    *,
    noise: Float[Array, "outputs outputs"],
    halo: int,
    known: tuple[Uncertainty, Identifiability],
    selection: tuple[FreeRun, ...] = (),
) -> Account:
    """Free runs, standard errors and identifiability of a fit.

    Args:
        fit: the fitted model.
        training: training stretches.
        test: test stretches.
        noise: covariance of the measurement noise.
        halo: intervals of torque before a stretch.
        known: what is known of its parameters ([`of_parameters`][]).
        selection: free runs along the selection stretches.
    """
    # Separate runs, so that test data do not share the scale of a window.
    seen, unseen = (free_runs(fit, part, noise=noise, halo=halo) for part in (training, test))
    found, told = known
    zeros = tuple(dict.fromkeys(stretch.experiment.zero for stretch in training))
    return Account(unaligned(fit.model), found, seen, selection, unseen, told, why_not(fit.problem), zeros)


def of_parameters(
    fit: Fit, *, profiles: bool = False, std_from: Fit | None = None, drive_from: Fit | None = None
) -> tuple[Uncertainty, Identifiability]:
    """Standard errors and identifiability of the parameters of a fit.

    Args:
        fit: the fitted model.
        profiles: whether profile likelihood replaces inaccurate intervals, which compiles a further program.
        std_from: another fit of the same parameters that supplies their standard errors.
        drive_from: the fit of one side's equation at which the drive's parameters are fixed, and which supplies their
            standard errors.
    """
    judged = fit if std_from is None else std_from
    found = uncertainty(judged)
    if profiles:
        found = with_profiles(judged, found)
    side = None
    if drive_from is not None:
        side = drive_from, uncertainty(drive_from)
        found = found.with_parameters_of(side[1].in_units_of(fit, drive_from))
    told = identifiability(judged, found, drive_from=side)
    return (found if std_from is None else found.in_units_of(fit, std_from)), told


def free_runs(
    fit: Fit, stretches: Sequence[Stretch], *, noise: Float[Array, "outputs outputs"], halo: int
) -> tuple[FreeRun, ...]:
    """Free runs of a fitted model; arguments as in [`account`][]."""
    if not stretches:
        return ()
    return free_run(fit.model, stretches, covariance=noise, halo=halo, substeps=fit.substeps, like=fit)
