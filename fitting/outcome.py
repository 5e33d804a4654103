"""What closing the loop comes to."""

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
    """An effect that the data support.

    Attributes:
        effect: with fitted values; None where the finding is another hold of the torque.
        name: its form.
        family: its family.
        gain: share of the free-run error on selection data that it removes, against the same model without it; of what
            has a name, in the model before anything is learned beside it.
        p_value: chance that the best of the catalogue would gain as much on noise.
    """

    effect: Effect | None
    name: str = eqx.field(static=True)
    family: str = eqx.field(static=True)
    gain: float
    p_value: float


class Loop(eqx.Module):
    """The outcome of closing the loop.

    Attributes:
        decision: what the data say.
        checks: the rules as they were applied.
        before: the base model's account.
        after: the final model's account; the same where nothing was found.
        findings: supported effects, largest gain first; what was learned comes last.
        rounds: every look at the catalogue.
        dropped: effects that a later one made superfluous.
        doubted: effects that were found, but that a learned torque contradicts.
        unknown: what was learned, where the catalogue does not explain what is missing, or not all of it.
        case: what the decision rests on.
        evidence: what each effect of the final model does, and what the data say of it.
        noise: covariance of the measurement noise of the outputs.
        noise_memory: for how long [s] what is left over remembers itself, where it was taken for noise of the sensors
            with a memory; None elsewhere.
        torque_noise: standard deviation of the noise of a sample of the logged torque [N m], where that is what is
            left; None elsewhere.
        left: what short segments of the selection data leave of each output under the final model, over the
            measurement noise.
        residual_before: diagnostics of what the base model leaves over.
        residual_after: likewise of the final model.
        hold: what the torque does between samples, as used.
        setting: how the logs were cut.
        after_substeps: solver steps in a sample interval of the final model.
        stretches: training and selection stretches.
        surprise: how much farther off than they promised free runs of selection stretches are where effects were found
            that do not explain them, and nothing was learned that does better; None elsewhere.
        put_back: by how much the clock of each log was put back [s], so that a line is in phase.
        seconds: where the time went.
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
        """What short segments of the selection data leave under the final model, over the measurement noise; of the
        output where it is largest. Noise of the torque does not count."""
        return 1.0 if self.torque_noise is not None else max(self.left)
