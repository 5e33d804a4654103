"""A fit without a search for effects, with all that can be said of it."""

from collections.abc import Mapping
from typing import ClassVar

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from fitting.attribution.selection_round import Round
from fitting.clock import Clock
from fitting.estimation.base_fit import base_fit, is_held, told_by_load
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Experiment, whole
from fitting.estimation.free_parameters import with_priors
from fitting.estimation.sample_rate import refined_intervals, with_intervals
from fitting.estimation.starting_values import sees_twist
from fitting.estimation.whole_log_fit import long_fit
from fitting.outcome import Finding
from fitting.progress import Progress, silent
from fitting.stored_model import StoredModel
from fitting.uncertainty.measurement_noise import measurement_noise
from fitting.uncertainty.posterior import Posterior, posterior
from fitting.uncertainty.prediction_band import PredictionBand, prediction_bands
from fitting.validation.account import Account, account
from fitting.validation.frequency_response import FrequencyResponse, frequency_response
from fitting.validation.goodness_of_fit import Goodness, goodness
from fitting.validation.residual_diagnostics import ResidualDiagnostics, diagnose
from fitting.validation.residual_tests import ResidualTests, residual_tests
from hdjax import Hold, Model, TwoInertiaModel


class FitOnly(eqx.Module):
    """A fitted drive; stands in for a [`Loop`][] in reports.

    Attributes:
        account: the fitted model's.
        start: the model that the fit started from.
        noise: covariance of the measurement noise of the outputs.
        hold: what the torque does between samples, as used.
        residual: diagnostics of what the model leaves over.
        tests: of the same.
        goodness: figures of merit.
        frequency_response: of the logs and of the model; None where the logs are too short for it.
        bands: how well the free runs are known, along test data where there are any.
        posterior: draws, where they were asked for.
        seconds: where the time went.
        by_load: whether K, alpha and B_sp are those of the load's own equation, see
            [`fitting.estimation.motor_driven`][], since the motion does not follow from the torque.
        by_friction: whether all parameters are those of a fit beside friction of the motor, see
            [`fitting.estimation.beside_friction`][], for the same reason; the load was not seen.
        assumed: where by load, what the load's equation was given of the inertia of which nothing was known.
    """

    account: Account
    start: Model
    noise: Float[Array, "outputs outputs"]
    hold: Hold = eqx.field(static=True)
    residual: ResidualDiagnostics
    tests: ResidualTests
    goodness: Goodness
    frequency_response: FrequencyResponse | None
    bands: tuple[PredictionBand, ...]
    posterior: Posterior | None
    seconds: dict[str, float]
    by_load: bool = eqx.field(static=True)
    by_friction: bool = eqx.field(static=True)
    assumed: dict[str, float]
    decision: ClassVar[str] = "fit_only"
    findings: ClassVar[tuple[Finding, ...]] = ()
    rounds: ClassVar[tuple[Round, ...]] = ()
    dropped: ClassVar[tuple[str, ...]] = ()

    @property
    def stored(self) -> StoredModel:
        """The model, as `model.json` has it."""
        return StoredModel(self.account.model, self.hold, self.goodness.substeps, 0, self.noise)

    @property
    def before(self) -> Account:
        """The one account that there is."""
        return self.account

    @property
    def after(self) -> Account:
        """Likewise."""
        return self.account


def fit_only(
    model: Model,
    experiments: Mapping[Hold, tuple[Experiment, ...]],
    *,
    test: Mapping[Hold, tuple[Experiment, ...]] | None = None,
    hold: Hold | None = None,
    seed: int | None = None,
    progress: Progress = silent,
) -> FitOnly:
    """Fit the base model to the logs of one drive and account for it; arguments as in [`fitting.loop.close_loop`][].

    Args:
        model: the base model; its stiffness and damping are only placeholders.
        experiments: the same logs under each assumption about the torque between samples.
        test: likewise of data that only the final figures look at.
        hold: the assumption that the user states; where None, the one that suits the model best.
        seed: of draws from the posterior; where None, none are made.
        progress: told what is being done.

    Raises:
        DataError: where no oscillator fits the data.
        ImportError: where draws are asked for and blackjax is not installed.
    """
    clock = Clock()
    progress("fitting the base model")
    hold, base, experiments, test = _base(model, experiments, test or {}, hold)
    tests = whole(test.get(hold, ()))
    clock.lap("base fit")
    noise = measurement_noise(base).covariance
    clock.lap("measurement noise")
    progress("final fit over long horizons")
    told_by = told_by_load(base)
    by_friction = told_by is not None and not sees_twist(base.stretches)
    base, assumed = (base, {}) if told_by is None or by_friction else _without_priors(base)
    found = base if is_held(base) else long_fit(base, must_explain=True)
    clock.lap("final fit")
    progress("free runs")
    result = account(found, found.stretches, tests, noise=noise, halo=0, profiles=True, told_by=told_by)
    seen = found.stretches if not tests else tests
    bands = prediction_bands(found, result.uncertainty, seen, noise=noise, runs=result.judged)
    clock.lap("free runs and standard errors")
    residual = diagnose(found)
    tests = residual_tests(found, residual)
    response = frequency_response(
        found.model, experiments[hold], hold=hold, noise=float(np.sqrt(np.asarray(noise)[-1, -1]))
    )
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
        tests=tests,
        goodness=goodness(found, result, noise),
        frequency_response=response,
        bands=bands,
        posterior=draws,
        seconds=clock.laps,
        by_load=told_by is not None and not by_friction,
        by_friction=by_friction,
        assumed=assumed,
    )


def _base(
    model: Model,
    experiments: Mapping[Hold, tuple[Experiment, ...]],
    test: Mapping[Hold, tuple[Experiment, ...]],
    hold: Hold | None,
) -> tuple[Hold, Fit, Mapping[Hold, tuple[Experiment, ...]], Mapping[Hold, tuple[Experiment, ...]]]:
    """The base fit under the stated hold, or under the one that suits it best; and the data with the sample intervals
    that it makes of those which rounded stamps leave open."""
    holds: list[Hold] = list(experiments) if hold is None else [hold]
    fits = {h: base_fit(model, whole(experiments[h])) for h in holds}
    hold = min(holds, key=lambda h: fits[h].objective)
    factors = refined_intervals(fits[hold])
    if not factors:
        return hold, fits[hold], experiments, test
    experiments, test = with_intervals(experiments, factors), with_intervals(test, factors)
    return hold, base_fit(model, whole(experiments[hold])), experiments, test


def _without_priors(base: Fit) -> tuple[Fit, dict[str, float]]:
    """A base fit whose motion does not follow from the torque, with inertias and torque constant held, which then don't
    either; and what the load's equation was given of an inertia of which nothing was known."""
    if not isinstance(base.model, TwoInertiaModel) or not base.model.drive.priors:
        return base, {}
    unknown = [p.path for p in base.model.drive.priors if np.isinf(p.tolerance) and p.path == "J_l"]
    assumed = {path: float(base.model.get(path)) for path in unknown}
    return base_fit(with_priors(base.model, ()), base.stretches), assumed
