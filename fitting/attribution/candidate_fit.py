"""Fits of candidate models to training data, and their evaluation on held-out data."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.attribution.rules import RULES
from fitting.attribution.study import LEAST_PROGRESS, Study
from fitting.estimation.base_fit import leaves_white_noise
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import fitted_paths
from fitting.estimation.problem import states_from
from fitting.estimation.whole_log_fit import follows, over_whole_stretches, with_memory_carried, without_gaps
from fitting.uncertainty.identifiability import parameters_at_bounds
from hdjax import Hold, Model
from hdjax.effects import Effect

# Most iterations of a candidate's fit: a form that needs more has no clear minimum.
_TRIAL_STEPS = 25
# Iterations from a fit of the same model.
_CONTINUED = Strategy(_TRIAL_STEPS, begin_anew_above=np.inf, retry_states=False)
# Most further passes of a fit; LuGre friction takes three.
_MOST_PASSES = 6
# Iterations that rank the starts.
_FIRST_STEPS = replace(_CONTINUED, max_steps=12, give_up_above=-np.inf)
# Longest delay or lag of the torque [s].
_LONGEST_DELAY = 1e-2
# Share of the required gain that a first pass must reach; hidden states may converge later.
_MOST_OF_THE_WAY = 2.0 / 3.0


class Trial(eqx.Module):
    """A model fitted to training data and evaluated on held-out data.

    Attributes:
        model: with fitted values.
        training: the fit.
        held_out: fit to held-out data with the same parameters; only initial states are free.
        hold: inter-sample behaviour of the torque.
        lasting: share of its gain that persists over whole stretches.
    """

    model: Model
    training: Fit
    held_out: Fit
    hold: Hold = eqx.field(static=True)
    lasting: float = eqx.field(static=True, default=1.0)

    def gain_over(self, before: "Trial") -> float:
        """Decrease of the held-out objective; of a model with memory, the part that persists over whole stretches."""
        return (before.held_out.objective - self.held_out.objective) * self.lasting

    @cached_property
    def along_whole_stretches(self) -> Fit:
        """The held-out fit along whole stretches, whose initial states are fitted to all samples."""
        return without_gaps(over_whole_stretches(self.held_out, least_progress=LEAST_PROGRESS))


def attempt(
    model: Model, study: Study, hold: Hold, *, start: Trial | None = None, hold_parameters: bool = False
) -> Trial:
    """Fit a model and evaluate it on held-out data.

    Args:
        model: equations and starting values.
        study: the data and their segmentation.
        hold: inter-sample behaviour of the torque.
        start: a similar trial, which supplies the initial error covariance and initial states.
        hold_parameters: see [`fitting.estimation.estimate.Strategy`][].
    """
    near = None if start is None else start.training
    strategy = replace(_strategy_beside(near, model), hold_parameters=hold_parameters)
    return _judged(trained(model, study, hold, near, strategy).with_all_free(), study, hold)


def continued(trial: Trial, study: Study) -> Trial:
    """A trial after further passes of its fit, as long as they gain something: what is left to gain would be taken for
    a further effect. A shape runs to a bound only where that gains something on held-out data.

    Args:
        trial: the current one.
        study: the data and their segmentation.
    """
    for _ in range(_MOST_PASSES):
        before, trial = trial, _after_a_pass(trial, study)
        if trial is before:
            break
    return trial


def _after_a_pass(trial: Trial, study: Study) -> Trial:
    """A trial after a further pass of its fit; itself where that gains nothing."""
    training = trained(trial.model, study, trial.hold, trial.training, _CONTINUED)
    if ran_away := _at_bounds(training.model) - _at_bounds(trial.model):
        # A shape that the data don't determine stays where it was.
        kept = training.model.replace({path: trial.model.get(path) for path in ran_away})
        strategy = replace(_CONTINUED, hold_parameters=tuple(sorted(ran_away)))
        held = trained(kept, study, trial.hold, trial.training, strategy).with_all_free()
        training = held if held.objective < training.objective + RULES.least_gain else training
    if training.objective > trial.training.objective - LEAST_PROGRESS:
        return trial
    found = _judged(training, study, trial.hold)
    runs_away = not _at_bounds(found.model) <= _at_bounds(trial.model)
    return trial if runs_away and found.gain_over(trial) < RULES.least_gain else found


def _at_bounds(model: Model) -> set[str]:
    return {path for effect in model.effects for path in parameters_at_bounds(model, effect.name)}


def challenge(model: Model, study: Study, hold: Hold, *, champion: Trial) -> Trial | None:
    """The fit of a model, if it explains the training data at least as well as the current model.

    Args:
        model: equations and starting values.
        study: the data and their segmentation.
        hold: inter-sample behaviour of the torque.
        champion: the current model.
    """
    return completed(first_pass([model], study, hold, champion=champion), study, hold, champion=champion)


def first_pass(
    models: Sequence[Model],
    study: Study,
    hold: Hold,
    *,
    champion: Trial,
    near: Sequence[Fit] | None = None,
    own_states: Float[np.ndarray, "segments own"] | None = None,
) -> Fit:
    """The first pass of a challenger, from the best start after a few iterations from each.

    Args:
        models: the same model at several starting values.
        study: the data and their segmentation.
        hold: inter-sample behaviour of the torque.
        champion: the current model.
        near: a similar fit for each start; that of the current model where not given.
        own_states: hidden initial states of the first model's last effect, by segment.
    """
    study = study.for_rivals()
    near = [champion.training] * len(models) if near is None else near
    best, start = models[0], near[0]
    if len(models) > 1:
        own = own_states, *[None] * (len(models) - 1)
        begun = [
            trained(model, study, hold, beside, _FIRST_STEPS, own_states=states)
            for model, beside, states in zip(models, near, own, strict=True)
        ]
        start = min(begun, key=lambda found: found.objective)
        best, own_states = start.model, None
    strategy = Strategy(_TRIAL_STEPS, begin_anew_above=champion.training.objective, give_up_above=-np.inf)
    return trained(best, study, hold, start, strategy, own_states=own_states)


def completed(first: Fit, study: Study, hold: Hold, *, champion: Trial, give_up_above: float = np.inf) -> Trial | None:
    """The completed fit of a challenger after its first pass, or None where it is given up.

    Args:
        first: the first pass.
        study: the data and their segmentation.
        hold: inter-sample behaviour of the torque.
        champion: the current model.
        give_up_above: an objective that it must reach.
    """
    to_judge, study = study, study.for_rivals()
    before = champion.training.objective
    limit = min(give_up_above, before + RULES.least_gain)
    remembers_more = first.model.state_names != champion.model.state_names and _may_remember_better(first)
    if remembers_more and first.objective <= before - _MOST_OF_THE_WAY * (before - limit):
        first = with_memory_carried(first, least_progress=study.setting.least_progress)
    if first.objective > limit:
        return None
    study = study.fine_enough(first)
    # A segment that diverged while the parameters were far off would now keep them there.
    strategy = replace(_CONTINUED, retry_states=True, give_up_above=limit)
    best = trained(first.model, study, hold, first, strategy)
    if best.objective > limit:
        return None
    # Where the solver steps do not resolve a sharp nonlinearity, a fit smooths it until they do.
    finer = study.fine_enough(best)
    if finer is not study:
        best = trained(best.model, finer, hold, best, strategy)
    return _judged(best, to_judge.with_substeps(best.substeps), hold) if best.objective <= limit else None


def trained(
    model: Model,
    study: Study,
    hold: Hold,
    near: Fit | None,
    strategy: Strategy,
    *,
    own_states: Float[np.ndarray, "segments own"] | None = None,
) -> Fit:
    """A fit that starts with the covariance of a similar one, and from its states where the model has them.

    Args:
        model: equations and starting values.
        study: the data, their segmentation, and the least progress of a fit.
        hold: inter-sample behaviour of the torque.
        near: the similar fit, if any.
        strategy: further settings of the iteration.
        own_states: hidden initial states of the last effect, by segment; in steady state where not given.
    """
    start = Start()
    if near is not None:
        states = states_from(model, near.model, near.unknowns.states)
        if own_states is not None:
            states = jnp.asarray(np.hstack([np.asarray(states)[:, : -own_states.shape[1]], own_states]))
        start = Start(near.covariance, states)
    strategy = replace(strategy, least_progress=study.setting.least_progress)
    segmentation = study.setting.segmentation
    return fit(model, study.data[hold][0], fitted_paths(model), segmentation, start=start, strategy=strategy)


def _strategy_beside(near: Fit | None, model: Model) -> Strategy:
    """Settings of a fit that starts from a similar one. The first pass is repeated where states differ, or without a
    similar fit."""
    if near is None:
        return Strategy(_TRIAL_STEPS)
    if near.model.state_names == model.state_names:
        return _CONTINUED
    return Strategy(_TRIAL_STEPS, begin_anew_above=near.objective)


def _judged(training: Fit, study: Study, hold: Hold) -> Trial:
    least_progress = study.setting.least_progress
    held_out = fit(
        training.model,
        study.data[hold][1],
        training.free.paths,
        study.setting.segmentation,
        start=Start(training.covariance),
        strategy=Strategy(_TRIAL_STEPS, least_progress, hold_parameters=True),
    )
    if _may_remember_better(held_out):
        held_out = with_memory_carried(held_out, hold_parameters=True, least_progress=least_progress)
    return Trial(training.model, training, held_out, hold)


def _may_remember_better(found: Fit) -> bool:
    """Whether an effect with memory leaves a residual above the noise."""
    return any(e.states for e in found.model.effects) and not leaves_white_noise(found)


def lasting_share(effect: Effect, before: Trial, trial: Trial) -> float:
    """Share of an effect's gain that persists over whole held-out stretches. It is one for an effect without memory,
    and where neither model follows the drive for so long.

    On short segments, fitted hidden initial states can compensate other errors, such as an offset. Over a whole stretch
    hidden states follow from the motion.
    """
    short = before.held_out.objective - trial.held_out.objective
    if not effect.states or short <= 0.0:
        return 1.0
    whole = _along_whole_stretches([before, trial])
    if whole is None:
        return 1.0
    first, last = (fitted.objective for fitted in whole)
    return float(np.clip((first - last) / short, 0.0, 1.0)) if np.isfinite(last) else 0.0


def long_gains(before: Trial, trials: Sequence[Trial]) -> list[float] | None:
    """Decreases of the principal output's log rms error along whole held-out stretches, from the preceding model to
    trials. None where no model follows the drive for so long, or the preceding one diverges.

    A motor angle is not among these outputs: nothing holds it, so that it drifts with the smallest error of a torque.
    """
    whole = _along_whole_stretches([before, *trials])
    if whole is None:
        return None
    first, *others = (np.log(fitted.principal_std) for fitted in whole)
    return [float(first - log) if np.isfinite(log) else -np.inf for log in others]


def _along_whole_stretches(trials: Sequence[Trial]) -> list[Fit] | None:
    """Trials along whole held-out stretches. None where none follows the drive for so long, or the first diverges."""
    whole = [trial.along_whole_stretches for trial in trials]
    usable = np.isfinite(whole[0].objective) and any(follows(fitted) for fitted in whole)
    return whole if usable else None


def halo_for(training: Sequence[Stretch]) -> int:
    """Intervals of torque before each segment of training stretches."""
    step = min(stretch.experiment.time_step for stretch in training)
    return int(np.clip(np.ceil(_LONGEST_DELAY / step) + 1, 4, 64))
