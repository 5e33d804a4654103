"""Outcome of the closed loop."""

import equinox as eqx
from jaxtyping import Array, Float

from fitting.attribution.case_evidence import CaseEvidence
from fitting.attribution.decisions import Check, Outcome
from fitting.attribution.effect_evidence import Evidence
from fitting.attribution.selection_round import Round
from fitting.attribution.study import Setting
from fitting.discrepancy.learn import Unknown
from fitting.estimation.experiment import Stretch
from fitting.stored_model import StoredModel
from fitting.validation.account import Account
from fitting.validation.residual_diagnostics import ResidualDiagnostics
from hdjax import Hold
from hdjax.effects import Effect


class Finding(eqx.Module):
    """An accepted effect.

    Attributes:
        effect: with fitted values; None for another hold of the torque.
        name: its form.
        family: its family.
        gain: share of the free-run error on selection data that it removes, relative to the same model without it; for
            named effects, without learned terms.
        p_value: under the null distribution of the catalogue's best on noise.
    """

    effect: Effect | None
    name: str = eqx.field(static=True)
    family: str = eqx.field(static=True)
    gain: float
    p_value: float


class Loop(eqx.Module):
    """The outcome of closing the loop.

    Attributes:
        decision: the conclusion.
        checks: the applied rules.
        before: account of the base model.
        after: account of the final model; equal to `before` where nothing was found.
        findings: accepted effects, largest gain first; a learned term comes last.
        rounds: of the search.
        dropped: accepted effects that a later one made superfluous.
        doubted: effects that a learned torque contradicts.
        unknown: learned term, where the catalogue does not explain all that is missing.
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
        surprise: error of free runs along selection stretches over their bands, where accepted effects do not explain
            it and no learned term is better; None otherwise.
        put_back: time offset subtracted from each log's clock [s], so that a line is in phase.
        seconds: time by stage.
    """

    decision: Outcome = eqx.field(static=True)
    checks: tuple[Check, ...] = eqx.field(static=True)
    before: Account
    after: Account
    findings: tuple[Finding, ...]
    rounds: tuple[Round, ...]
    dropped: tuple[str, ...] = eqx.field(static=True)
    doubted: tuple[str, ...] = eqx.field(static=True)
    unknown: Unknown | None
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
    put_back: tuple[float, ...] = eqx.field(static=True)
    seconds: dict[str, float]

    @property
    def stored(self) -> StoredModel:
        """The final model, as `model.json` has it."""
        return StoredModel(self.after.model, self.hold, self.after_substeps, self.setting.halo, self.noise)

    @property
    def times_noise(self) -> float:
        """Largest residual of an output over short segments of the selection data with the final model, over the
        measurement noise. Torque noise does not count."""
        return 1.0 if self.torque_noise is not None else max(self.left)
