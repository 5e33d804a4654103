"""The conclusion: the accepted model and the decision."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from fitting.attribution.candidate_fit import Trial
from fitting.attribution.case_evidence import FinalEvidence
from fitting.attribution.decisions import Outcome, conclude
from fitting.attribution.rules import RULES
from fitting.attribution.study import Study
from fitting.attribution.support import noise_of_torque, shows_noise
from fitting.discrepancy.challenge import Challenge
from fitting.discrepancy.learn import Unknown, learn_supported
from fitting.estimation.estimate import Fit
from fitting.estimation.free_run import FreeRun, rms_error
from fitting.estimation.whole_log_fit import long_fit
from fitting.one_side_check import better_side, held_by_side
from fitting.uncertainty.identifiability import outside_domain
from fitting.uncertainty.measurement_noise import MeasurementNoise, excess
from fitting.uncertainty.noise_model import NoiseModel
from fitting.uncertainty.one_side import without_mesh_priors
from fitting.uncertainty.standard_errors import uncertainty
from fitting.validation.account import free_runs
from fitting.validation.free_run_check import share_explained, surprise
from hdjax import Hold


class Conclusion(eqx.Module):
    """The final decision and its evidence.

    Attributes:
        outcome: the decision.
        seen: the evidence.
        trusted: the model with the accepted names.
        unknown: the term learned beside them, or in place of all.
        fitted: the final model on training data, over the longest horizons that follow the logs.
        runs: its free runs along the selection data.
        runs_at_first: free runs of the base model.
        noise: covariance of the measurement noise of the outputs.
        left: noise of sensors and torque, where that explains the residual, and short segments show it.
        side: the fit of one side's equation at which the final model's K, alpha and B_sp are fixed, if any.
    """

    outcome: Outcome = eqx.field(static=True)
    seen: FinalEvidence = eqx.field(static=True)
    trusted: Trial
    unknown: Unknown | None
    fitted: Fit
    runs: tuple[FreeRun, ...]
    runs_at_first: tuple[FreeRun, ...]
    noise: Float[Array, "outputs outputs"]
    left: NoiseModel | None
    side: Fit | None

    @property
    def final(self) -> Trial:
        """The final model over short horizons."""
        return self.trusted if self.unknown is None else self.unknown.trial


def draw_conclusion(base: Trial, challenge: Challenge, study: Study, *, noise: MeasurementNoise) -> Conclusion:
    """Gather the remaining evidence for the accepted model, and decide.

    Args:
        base: the model without effects.
        challenge: of the named effects.
        study: the data and their segmentation.
        noise: of the measured outputs, where it was estimated.
    """
    trusted, unknown = challenge.trusted, challenge.unknown
    covariance = noise.and_beside((trusted if unknown is None else unknown.trial).training).covariance
    left = challenge.left
    seen = replace(_final_evidence(base, trusted, unknown, covariance), noise_explains=left is not None)
    if left is not None and not shows_noise(left, trusted.held_out):
        left = None
    if left is not None:
        covariance = jnp.asarray(left.sensors.covariance)
    claimed, _ = conclude(seen)
    if claimed == "effect_found" and max(seen.excess) < RULES.excess:
        # The residual with the names is hardly more than noise.
        unknown, seen = None, replace(seen, learned=False)
    study.progress("final fit over long horizons")
    current = trusted if unknown is None else unknown.trial
    fitted, side = _fitted_to_the_end(current.training, seen, study)
    names = {e.name for e in trusted.model.effects}
    seen = replace(seen, at_bounds=sum(len(outside_domain(fitted, name)) for name in names))
    at_first = _along_selection(base.training, base.hold, study, covariance)
    runs = _along_selection(fitted, current.hold, study, covariance)
    outcome = claimed
    if claimed == "effect_found":
        explained = share_explained(at_first, runs, current.held_out, covariance)
        seen = replace(seen, free_runs_explained=explained)
        # Bands are of first order: chaotic motion exceeds them, though short segments leave only noise.
        much = explained is None or explained >= RULES.free_run_explained
        if not (much and challenge.seen.enough):
            known = {
                "of_parameters": uncertainty(fitted),
                "noise": covariance,
                "halo": study.setting.halo,
                "torque_noise": noise_of_torque(left) or 0.0,
            }
            ratio = surprise(fitted, runs, current.held_out, **known)
            if ratio is not None:
                # What is slow may differ between the fitted part of a log and the rest.
                ratio = max(ratio, surprise(fitted, None, current.training, **known) or 0.0)
            seen = replace(seen, surprise=ratio, wide_bands=ratio is None)
        outcome, _ = conclude(seen)
    found = Conclusion(outcome, seen, trusted, unknown, fitted, runs, at_first, covariance, left, side)
    if outcome == claimed:
        return found
    instead = challenge.instead or learn_supported(base, study)
    return found if instead is None else _with_term_in_place(found, instead, base, study, noise)


def _with_term_in_place(
    found: Conclusion, instead: Unknown, base: Trial, study: Study, noise: MeasurementNoise
) -> Conclusion:
    """The conclusion with a learned term in place of names that do not follow long stretches, where it does so better;
    else the same. The evidence against the names remains."""
    # Not what the names left, which may have been attributed to noise.
    covariance = noise.and_beside(instead.trial.training).covariance
    seen = _final_evidence(base, base, instead, covariance)
    fitted, side = _fitted_to_the_end(instead.trial.training, seen, study)
    runs = _along_selection(fitted, instead.trial.hold, study, covariance)
    if not rms_error(runs) < rms_error(found.runs):
        return found
    at_first = _along_selection(base.training, base.hold, study, covariance)
    seen = replace(found.seen, replaced=True)
    return Conclusion(found.outcome, seen, base, instead, fitted, runs, at_first, covariance, None, side)


def _along_selection(
    fitted: Fit, hold: Hold, study: Study, covariance: Float[Array, "outputs outputs"]
) -> tuple[FreeRun, ...]:
    return free_runs(fitted, study.data[hold][1], noise=covariance, halo=study.setting.halo)


def _fitted_to_the_end(found: Fit, seen: FinalEvidence, study: Study) -> tuple[Fit, Fit | None]:
    """The final fit over long horizons; where the model leaves more than noise, with K, alpha and B_sp of the side
    whose own equation leaves none, and that side's fit. What was fixed, for want of a minimum near the truth, stays."""
    found = eqx.tree_at(lambda f: f.model, found, without_mesh_priors(found.model))
    if max(seen.excess) < RULES.excess:
        return long_fit(found), None
    side = study.side_of(found.model) or better_side(found)
    held = None if side is None else held_by_side(side, found)
    if held is None:
        return found if found.was_held else long_fit(found), None
    return long_fit(held), side


def _final_evidence(
    base: Trial, trusted: Trial, unknown: Unknown | None, covariance: Float[Array, "outputs outputs"]
) -> FinalEvidence:
    names = [e.name for e in trusted.model.effects]
    if trusted.hold != base.hold:
        names.append(f"{trusted.hold} hold")
    return FinalEvidence(
        names=tuple(names),
        learned=unknown is not None,
        excess=tuple(map(float, excess(trusted.held_out, covariance))),
        excess_at_first=tuple(map(float, excess(base.held_out, covariance))),
    )
