"""Check of named effects by learned terms: where a residual remains, one is learned beside them and one in their
place."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np

from fitting.attribution.candidate_fit import Trial
from fitting.attribution.case_evidence import ChallengeEvidence, ModelEvidence
from fitting.attribution.decisions import names_stand, next_question, unknown_ties
from fitting.attribution.effect_search import refitted_without
from fitting.attribution.rules import RULES
from fitting.attribution.score import block_scores
from fitting.attribution.study import Study
from fitting.attribution.support import (
    Standing,
    is_noise,
    leaves_imperfection,
    noise_evidence,
    nonzero_effects,
)
from fitting.discrepancy.learn import Unknown, learn_supported, share_of
from fitting.estimation.base_fit import leaves_white_noise
from fitting.estimation.estimate import half_log_determinant
from fitting.estimation.free_run import rms_error
from fitting.uncertainty.measurement_noise import MeasurementNoise, excess
from fitting.uncertainty.noise_model import NoiseModel
from fitting.validation.account import free_runs


class Challenge(eqx.Module):
    """Result of a check of named effects by learned terms.

    Attributes:
        trusted: the model with the accepted names.
        unknown: the term learned beside them, or in place of all.
        left: noise of sensors and torque, where that explains the named model's residual.
        instead: the term learned in place of all names; None where none was learned, or is supported.
        tied: a learned term that differs from the accepted names and explains the selection data as well.
        seen: evidence for the decision.
    """

    trusted: Trial
    unknown: Unknown | None
    left: NoiseModel | None
    instead: Unknown | None
    tied: Unknown | None
    seen: ChallengeEvidence = eqx.field(static=True)


def challenge_names(base: Trial, named: Trial, study: Study, *, noise: MeasurementNoise) -> Challenge:
    """Learn the terms that the rules need to accept or reject the named effects.

    Names that a learned term beside them makes superfluous are dropped in any case.

    Args:
        base: the model without effects.
        named: the model with named effects.
        study: the data and their segmentation.
        noise: of the measured outputs, where it was estimated.
    """

    @functools.cache
    def in_place() -> Unknown | None:
        return _learned(Standing(base, base, noise), study)

    return _challenged(base, named, study, noise, in_place)


def _challenged(
    base: Trial, named: Trial, study: Study, noise: MeasurementNoise, in_place: Callable[[], Unknown | None]
) -> Challenge:
    """[`challenge_names`][] with a function that learns a term in place of all names."""

    def seen_as(trial: Trial) -> ModelEvidence:
        return model_evidence(trial, noise)

    beside: Unknown | None = None
    instead: Unknown | None = None
    imperfect = leaves_imperfection(named, base, noise)[0]
    least = half_log_determinant(noise.covariance)
    seen = ChallengeEvidence(seen_as(base), seen_as(named), len(_names(base, named)), least, imperfect)
    standing = Standing(named, base, noise)
    left = None if seen.enough else standing.left
    if left is not None:
        seen = replace(seen, left=noise_evidence(left))
    while (question := next_question(seen)) is not None:
        if question == "instead":
            instead = in_place()
            if instead is None:
                seen = seen.answered("instead", None)
                continue
            seen = seen.answered("instead", seen_as(instead.trial), come_out=_come_out(base, named, instead))
        else:
            beside = _learned(standing, study.with_substeps(named.training.substeps))
            if beside is not None:
                completed = _without_learned(base, named, beside, study)
                if completed is not None:
                    return _challenged(base, completed, study, noise, in_place)
                named, beside = _without_superfluous(base, named, beside, study)
            seen = seen.answered("beside", None if beside is None else seen_as(beside.trial))
            seen = replace(seen, named=seen_as(named), names=len(_names(base, named)))
    left = left if beside is None and is_noise(left) else None
    if named is base:
        return Challenge(base, beside, left, instead, None, seen)
    if instead is not None:
        rival = named if beside is None else beside.trial
        errors = _long_errors([rival, instead.trial], study)
        worse = 0.0 if errors is None else float(np.log(errors[1]) - np.log(errors[0]))
        seen = replace(seen, longer_worse=worse)
    if instead is not None and beside is not None:
        names = {e.name for e in named.model.effects}
        one, other = beside.chosen, instead.chosen
        seen = replace(
            seen,
            come_out=_come_out(base, named, instead),
            shown=nonzero_effects(beside.trial.training, names) == names,
            one_shape=(one.form, one.variables) == (other.form, other.variables)
            and any(other.variables == (e.one_shape_of,) for e in named.model.effects),
        )
    if not any(check.holds for check in names_stand(seen)):
        return Challenge(base, instead, None, instead, None, seen)
    if instead is not None and beside is None:
        whitening = np.asarray(instead.trial.held_out.problem.whitening)
        behind = block_scores(named, whitening) - block_scores(instead.trial, whitening)
        seen = replace(seen, behind=tuple(map(float, behind)))
    tied = any(check.holds for check in unknown_ties(seen))
    return Challenge(named, beside, left, instead, instead if tied else None, seen)


def _come_out(base: Trial, named: Trial, instead: Unknown) -> float:
    """Share of a replacing term that the named effects reproduce."""
    return share_of(named.model, instead, named.training) if named.hold == base.hold else 0.0


def _learned(standing: Standing, study: Study) -> Unknown | None:
    """The learned term that the data support, also against a noise model; None without any."""
    found = learn_supported(standing.before, study)
    supported = found is not None and standing.over_noise(found.trial) > RULES.noise_gain
    return found if supported else None


def model_evidence(trial: Trial, noise: MeasurementNoise) -> ModelEvidence:
    """Evidence on a fitted model for the decisions.

    Args:
        trial: the model.
        noise: of the measured outputs.
    """
    left = excess(trial.training, noise.covariance)
    return ModelEvidence(
        training=trial.training.objective,
        selection=trial.held_out.objective,
        parameters=len(trial.training.free.paths),
        excess=tuple(map(float, excess(trial.held_out, noise.covariance))),
        # Rigid-body motion of the motor hardly twists the gear.
        white=leaves_white_noise(trial.training) and bool(np.all(left < RULES.excess)),
    )


def _names(base: Trial, named: Trial) -> set[str]:
    """Names of a model's effects and of another hold."""
    found = {e.name for e in named.model.effects}
    return found | ({"hold"} if named.hold != base.hold else set())


def _without_learned(base: Trial, named: Trial, beside: Unknown, study: Study) -> Trial | None:
    """The named model refitted from its values beside the learned term, where they make this superfluous: its error
    on selection data is hardly larger. The named fit had then not reached its minimum."""
    learned = {e.name for e in beside.trial.model.effects} - {e.name for e in named.model.effects}
    if not named.model.effects or not learned:
        return None
    alone = refitted_without(learned, beside.trial, base, study)
    return alone if _misses_little(alone, beside) else None


def _misses_little(trial: Trial, beside: Unknown) -> bool:
    """Whether the error on selection data is hardly larger than beside the learned term."""
    missed = trial.held_out.objective - beside.trial.held_out.objective
    return missed < max(RULES.least_gain, RULES.little * beside.gain)


def _without_superfluous(base: Trial, named: Trial, beside: Unknown, study: Study) -> tuple[Trial, Unknown]:
    """The model without effects that the learned term has made superfluous: none of their strengths is significantly
    nonzero, and without them the error on selection data hardly changes."""
    names = {e.name for e in named.model.effects}
    fallen = names - nonzero_effects(beside.trial.training, names)
    if not fallen:
        return named, beside
    trial = refitted_without(fallen, beside.trial, base, study)
    if not _misses_little(trial, beside):
        return named, beside
    bare = base
    if fallen != names or named.hold != base.hold:
        bare = refitted_without(fallen, named, base, study)
    states = [n for n in named.model.state_names if n in bare.model.state_names]
    kept = [named.model.state_names.index(n) for n in states]
    gain = bare.held_out.objective - trial.held_out.objective
    return bare, replace(
        beside, before=bare, trial=trial, states=beside.states[:, kept], push=beside.push[:, kept], gain=gain
    )


def _long_errors(trials: Sequence[Trial], study: Study) -> list[float] | None:
    """Rms errors of free runs along whole held-out stretches, infinite where one diverges. None where none of them
    follows the drive for long, as where its motion is chaotic."""
    runs = [
        free_runs(t.training, study.data[t.hold][1], noise=t.training.covariance, halo=study.setting.halo)
        for t in trials
    ]
    errors, moves = [rms_error(own) for own in runs], float(np.std(np.concatenate([r.measured for r in runs[0]])))
    return errors if min(errors) <= 0.5 * moves else None
