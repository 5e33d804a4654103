"""Outcomes of a fit and of the closed loop."""

from typing import ClassVar

import equinox as eqx
from jaxtyping import Array, Float

from fitting.attribution.case_evidence import CaseEvidence
from fitting.attribution.decisions import Check, Outcome
from fitting.attribution.effect_evidence import Evidence
from fitting.attribution.rules import RULES
from fitting.attribution.selection_round import Round
from fitting.attribution.study import Setting
from fitting.discrepancy.learn import Unknown
from fitting.estimation.experiment import Stretch
from fitting.stored_model import StoredModel
from fitting.uncertainty.posterior import Posterior
from fitting.uncertainty.prediction_band import PredictionBand
from fitting.validation.account import Account
from fitting.validation.frequency_response import FrequencyResponse
from fitting.validation.goodness_of_fit import Goodness
from fitting.validation.residual_diagnostics import ResidualDiagnostics
from fitting.validation.residual_tests import ResidualTests
from hdjax import Hold, Model
from hdjax.effects import Effect


class Finding(eqx.Module):
    """An accepted effect.

    Attributes:
        effect: with fitted values; None for another hold of the torque.
        name: its form.
        family: its family.
        gain: share of the free-run error on selection data that it removes, relative to the same model without it; for
            named effects, without learned terms. NaN where free runs diverge with it.
        p_value: under the null distribution of the catalogue's best on noise; of a learned term, under its own.
    """

    effect: Effect | None
    name: str = eqx.field(static=True)
    family: str = eqx.field(static=True)
    gain: float
    p_value: float


class FitOnly(eqx.Module):
    """The outcome of a fit without a search for effects.

    Attributes:
        account: of the fitted model.
        start: the starting model.
        noise: covariance of the measurement noise of the outputs.
        hold: inter-sample behaviour of the torque, as used.
        residual: diagnostics of the residual.
        tests: of the residual.
        goodness: figures of merit.
        frequency_response: of the logs and of the model; None where the logs are too short.
        bands: prediction bands of the free runs, along test data where there are any.
        posterior: draws, if requested.
        seconds: time by stage.
        parameters_from: "torque"; where that does not explain the motion, the "load equation" or "motor equation" for
            K, alpha and B_sp (see [`fitting.estimation.one_side`][]), or, if the load was not measured, "torque beside
            friction" of the motor for all parameters (see [`fitting.estimation.beside_friction`][]).
        assumed: value of an unknown inertia in one side's equation, if the parameters are from it.
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
    parameters_from: str = eqx.field(static=True)
    assumed: dict[str, float]
    decision: ClassVar[str] = "fit_only"
    findings: ClassVar[tuple[Finding, ...]] = ()
    rounds: ClassVar[tuple[Round, ...]] = ()
    compared: ClassVar[tuple[Round, ...]] = ()
    dropped: ClassVar[tuple[str, ...]] = ()

    @property
    def stored(self) -> StoredModel:
        """The model, as `model.json` has it."""
        return StoredModel(self.account.model, self.hold, self.goodness.substeps, 0, self.noise, self.account.zeros)

    @property
    def before(self) -> Account:
        """The account."""
        return self.account

    @property
    def after(self) -> Account:
        """The account, as there is no second model."""
        return self.account


class Loop(eqx.Module):
    """The outcome of closing the loop.

    Attributes:
        decision: the conclusion.
        checks: the applied rules.
        before: account of the base model.
        after: account of the final model; equal to `before` where nothing was found.
        findings: accepted effects, largest gain first; a learned term comes last.
        rounds: of the search.
        compared: the rounds of the kept effects, with ties compared in the final model.
        dropped: accepted effects that a later one made superfluous.
        doubted: effects that a learned torque contradicts.
        unknown: learned term, where the catalogue does not explain all that is missing.
        tied: another one, which explains the selection data as well as the found effects.
        case: evidence for the decision.
        evidence: contribution of each effect of the final model, and its estimate from the data.
        noise: covariance of the measurement noise of the outputs.
        noise_memory: correlation time [s] of the residual, where it is attributed to coloured sensor noise; None
            otherwise.
        torque_noise: standard deviation of the noise of a torque sample [N m], where that explains the residual; None
            otherwise.
        left: residual of each output over short segments of the selection data with the final model, over the
            measurement noise.
        residual_before: diagnostics of the base model's residual.
        residual_after: diagnostics of the final model's residual.
        hold: inter-sample behaviour of the torque, as used.
        setting: segmentation of the logs.
        after_substeps: solver steps in a sample interval of the final model.
        stretches: training and selection stretches.
        surprise: error of free runs over their bands, the larger one of training and selection data, where effects were
            accepted that leave more than noise, or do not explain them; None otherwise, or where bands say nothing.
        parameters_from: "torque"; or the "load equation" or "motor equation" for K, alpha and B_sp of the final model,
            see [`fitting.one_side_check`][].
        put_back: time offset subtracted from the clock of each training stretch [s], so that a line is in phase.
        seconds: time by stage.
        limited: whether the largest number of effects ended the search.
    """

    decision: Outcome = eqx.field(static=True)
    checks: tuple[Check, ...] = eqx.field(static=True)
    before: Account
    after: Account
    findings: tuple[Finding, ...]
    rounds: tuple[Round, ...]
    compared: tuple[Round, ...]
    dropped: tuple[str, ...] = eqx.field(static=True)
    doubted: tuple[str, ...] = eqx.field(static=True)
    unknown: Unknown | None
    tied: Unknown | None
    case: CaseEvidence = eqx.field(static=True)
    evidence: tuple[Evidence, ...]
    noise: Float[Array, "outputs outputs"]
    noise_memory: float | None
    torque_noise: float | None
    left: tuple[float, ...] = eqx.field(static=True)
    residual_before: ResidualDiagnostics
    residual_after: ResidualDiagnostics
    hold: Hold = eqx.field(static=True)
    setting: Setting
    after_substeps: int = eqx.field(static=True)
    stretches: tuple[tuple[Stretch, ...], tuple[Stretch, ...]]
    surprise: float | None
    parameters_from: str = eqx.field(static=True)
    put_back: tuple[float, ...] = eqx.field(static=True)
    seconds: dict[str, float]
    limited: bool = eqx.field(static=True)

    @property
    def stored(self) -> StoredModel:
        """The final model, as `model.json` has it."""
        return StoredModel(
            self.after.model, self.hold, self.after_substeps, self.setting.halo, self.noise, self.after.zeros
        )

    @property
    def unknown_remains(self) -> bool:
        """Whether something is missing that no name explains."""
        if self.decision == "effect_found":
            drifts = self.surprise is not None and self.surprise > RULES.surprise
            return self.unknown is not None or self.times_noise >= RULES.excess or drifts
        return self.decision == "unexplained"

    @property
    def times_noise(self) -> float:
        """Largest residual of an output over short segments of the selection data with the final model, over the
        measurement noise. Torque noise does not count."""
        return 1.0 if self.torque_noise is not None else max(self.left)


def kept_rounds(outcome: Loop | FitOnly) -> list[Round]:
    """Rounds of the search whose effect is still in the final model."""
    names = {f.name for f in outcome.findings}
    return [this for this in outcome.compared if this.accepted and this.winner.name in names]
