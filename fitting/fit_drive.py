"""A fit without a search for effects, with all its diagnostics."""

from collections.abc import Collection, Mapping

import numpy as np

from fitting.blas import one_blas_thread
from fitting.clock import Clock
from fitting.estimation.base_fit import BaseFit, base_fit, is_held
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Experiment, whole
from fitting.estimation.free_parameters import with_priors
from fitting.estimation.recalibration import recalibrated
from fitting.estimation.whole_log_fit import long_fit
from fitting.outcome import FitOnly
from fitting.progress import Progress, silent
from fitting.uncertainty.measurement_noise import measurement_noise
from fitting.uncertainty.posterior import posterior
from fitting.uncertainty.prediction_band import prediction_bands
from fitting.validation.account import account, of_parameters
from fitting.validation.frequency_response import frequency_response
from fitting.validation.goodness_of_fit import goodness
from fitting.validation.residual_diagnostics import diagnose
from fitting.validation.residual_tests import residual_tests
from hdjax import Hold, Model, OneSideModel, TwoInertiaModel


@one_blas_thread
def fit_only(
    model: Model,
    experiments: Mapping[Hold, tuple[Experiment, ...]],
    *,
    test: Mapping[Hold, tuple[Experiment, ...]] | None = None,
    hold: Hold | None = None,
    seed: int | None = None,
    progress: Progress = silent,
) -> FitOnly:
    """Fit the base model to the logs of one drive, with all diagnostics; arguments as in [`fitting.loop.close_loop`][].

    Args:
        model: the base model; its stiffness and damping are only placeholders.
        experiments: the same logs under each hold of the torque.
        test: the same of test data, which only the final figures use.
        hold: the stated hold; the best one if None.
        seed: of draws from the posterior; None for no draws.
        progress: receives messages.

    Raises:
        DataError: no oscillator fits the data.
        ImportError: draws are requested and blackjax is not installed.
    """
    clock = Clock()
    progress("fitting the base model")
    hold, (base, fixed_by), experiments, test = _base(model, experiments, test or {}, hold)
    tests = whole(test.get(hold, ()))
    clock.lap("base fit")
    noise = measurement_noise(base).covariance
    clock.lap("measurement noise")
    progress("final fit over long horizons")
    base, source, assumed = _parameters_from(base, fixed_by)
    found = base if is_held(base) else long_fit(base, must_explain=True)
    clock.lap("final fit")
    progress("free runs")
    known = of_parameters(found, profiles=True, std_from=fixed_by)
    result = account(found, found.stretches, tests, noise=noise, halo=0, known=known)
    bands = prediction_bands(found, result.uncertainty, tests or found.stretches, noise=noise, runs=result.judged)
    clock.lap("free runs and standard errors")
    residual = diagnose(found)
    checked = residual_tests(found, residual)
    noise_std = float(np.sqrt(np.asarray(noise)[-1, -1]))
    response = frequency_response(found.model, experiments[hold], hold=hold, noise=noise_std)
    clock.lap("diagnostics")
    draws = None
    if seed is not None:
        progress("drawing from the posterior")
        draws = posterior(found, result.uncertainty, seed=seed)
        clock.lap("posterior")
    return FitOnly(
        account=result,
        start=base.problem.model,
        noise=noise,
        hold=hold,
        residual=residual,
        tests=checked,
        goodness=goodness(found, result, noise),
        frequency_response=response,
        bands=bands,
        posterior=draws,
        seconds=clock.laps,
        parameters_from=source,
        assumed=assumed,
    )


def _base(
    model: Model,
    experiments: Mapping[Hold, tuple[Experiment, ...]],
    test: Mapping[Hold, tuple[Experiment, ...]],
    hold: Hold | None,
) -> tuple[Hold, BaseFit, Mapping[Hold, tuple[Experiment, ...]], Mapping[Hold, tuple[Experiment, ...]]]:
    """The base fit under the stated or the best hold; and the data with refined constants of the logs."""
    holds: list[Hold] = list(experiments) if hold is None else [hold]
    fits = {h: base_fit(model, whole(experiments[h])) for h in holds}
    hold = min(holds, key=lambda h: fits[h].fit.objective)
    again = recalibrated(fits[hold].fit, experiments, test)
    if again is None:
        return hold, fits[hold], experiments, test
    experiments, test = again
    return hold, base_fit(model, whole(experiments[hold])), experiments, test


def _parameters_from(base: Fit, fixed_by: Fit | None) -> tuple[Fit, str, dict[str, float]]:
    """The base fit; what determines its parameters; and values that were assumed for that."""
    if fixed_by is None:
        return base, "torque", {}
    if not isinstance(fixed_by.model, OneSideModel):
        return base, "torque beside friction", {}
    base, assumed = _without_priors(base, fixed_by.model.scaled_by)
    return base, f"{fixed_by.model.equation} equation", assumed


def _without_priors(base: Fit, scaled_by: Collection[str]) -> tuple[Fit, dict[str, float]]:
    """A base fit whose torque does not explain the motion, with inertias and torque constant fixed, since they are not
    identifiable then; and the value of an unknown inertia in the equation that determines the parameters."""
    if not isinstance(base.model, TwoInertiaModel) or not base.model.drive.priors:
        return base, {}
    unknown = [p.path for p in base.model.drive.priors if np.isinf(p.tolerance) and p.path in scaled_by]
    assumed = {path: float(base.model.get(path)) for path in unknown}
    return base_fit(with_priors(base.model, ()), base.stretches).fit, assumed
