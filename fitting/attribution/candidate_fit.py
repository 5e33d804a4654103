"""A model on trial: fitted to the training stretches, judged on those it has not seen."""

from collections.abc import Sequence
from dataclasses import replace

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
from fitting.estimation.free_run import FreeRun, free_run, rms_error
from fitting.estimation.problem import states_from
from fitting.estimation.whole_log_fit import follows, over_whole_stretches, with_gaps_closed, with_memory_carried
from hdjax import Hold, Model
from hdjax.effects import Effect

# Iterations of a trial at most: a form that needs more than this has no clear minimum.
_TRIAL_STEPS = 25
# From a fit of the same model.
_CONTINUED = Strategy(_TRIAL_STEPS, begin_anew_above=np.inf, retry_states=False)
# What tells a good start from a poor one.
_FIRST_STEPS = replace(_CONTINUED, max_steps=12, give_up_above=-np.inf)
# What a first pass may fall short of because of what effects remember: it must have come so far towards what it is to
# reach.
_MOST_OF_THE_WAY = 2.0 / 3.0


class Trial(eqx.Module):
    """A model fitted to the training stretches, and what it does on the held-out ones.

    Attributes:
        model: with fitted values.
        training: the fit.
        held_out: the same parameters on unseen stretches; only initial states are fitted there.
        hold: what the torque does between samples.
        lasting: the share of its gain that lasts over whole stretches.
    """

    model: Model
    training: Fit
    held_out: Fit
    hold: Hold = eqx.field(static=True)
    lasting: float = eqx.field(static=True, default=1.0)

    def gain_over(self, before: "Trial") -> float:
        """Decrease of the held-out objective; of a model with memory, what of it lasts."""
        return (before.held_out.objective - self.held_out.objective) * self.lasting


def attempt(
    model: Model, study: Study, hold: Hold, *, start: Trial | None = None, hold_parameters: bool = False
) -> Trial:
    """Fit a model and look at it on held-out data.

    Args:
        model: equations and starting values.
        study: the data, and how they are cut.
        hold: what the torque does between samples.
        start: a trial near by, whose error covariance weighs the outputs at the start, and whose initial states it
            starts from.
        hold_parameters: see [`fitting.estimation.estimate.Strategy`][].
    """
    near = None if start is None else start.training
    strategy = replace(_strategy_beside(near, model), hold_parameters=hold_parameters)
    return _judged(trained(model, study, hold, near, strategy).with_all_free(), study, hold)


def gone_on(trial: Trial, study: Study) -> Trial:
    """A trial after another pass of its fit; the same where that gains nothing.

    Args:
        trial: as it stands.
        study: the data, and how they are cut.
    """
    training = trained(trial.model, study, trial.hold, trial.training, _CONTINUED)
    if training.objective > trial.training.objective - LEAST_PROGRESS:
        return trial
    return _judged(training, study, trial.hold)


def challenge(
    models: Sequence[Model], study: Study, hold: Hold, *, champion: Trial, give_up_above: float = np.inf
) -> Trial | None:
    """The best fit of several starts, if it explains the training data at least as well as the model that it is to
    replace.

    Args:
        models: one and the same model at several starting values.
        study: the data, and how they are cut.
        hold: what the torque does between samples.
        champion: the model to replace.
        give_up_above: a lower objective that it must reach.
    """
    first = first_pass(models, study, hold, champion=champion)
    return to_the_end(first, study, hold, champion=champion, give_up_above=give_up_above)


def first_pass(
    models: Sequence[Model],
    study: Study,
    hold: Hold,
    *,
    champion: Trial,
    own_states: Float[np.ndarray, "segments own"] | None = None,
) -> Fit:
    """The first pass of a challenger, from the best of its starts as a few iterations from each tell it.

    Args:
        models: one and the same model at several starting values.
        study: the data, and how they are cut.
        hold: what the torque does between samples.
        champion: the model to replace.
        own_states: where the own states of the first model's last effect start, in each segment.
    """
    study = study.for_rivals()
    best, near = models[0], champion.training
    if len(models) > 1:
        own = own_states, *[None] * (len(models) - 1)
        begun = [
            trained(model, study, hold, near, _FIRST_STEPS, own_states=states)
            for model, states in zip(models, own, strict=True)
        ]
        near = min(begun, key=lambda found: found.objective)
        best, own_states = near.model, None
    strategy = Strategy(_TRIAL_STEPS, begin_anew_above=champion.training.objective, give_up_above=-np.inf)
    return trained(best, study, hold, near, strategy, own_states=own_states)


def to_the_end(first: Fit, study: Study, hold: Hold, *, champion: Trial, give_up_above: float = np.inf) -> Trial | None:
    """A challenger followed from its first pass to the end, as far as it is worth it; arguments as in
    [`challenge`][]."""
    to_judge, study = study, study.for_rivals()
    before = champion.training.objective
    limit = min(give_up_above, before + RULES.least_gain)
    remembers_more = first.model.state_names != champion.model.state_names and _may_remember_better(first)
    if remembers_more and first.objective <= before - _MOST_OF_THE_WAY * (before - limit):
        first = with_memory_carried(first, least_progress=study.setting.least_progress)
    if first.objective > limit:
        return None
    study = study.fine_enough(first)
    # A segment that lost its way while the parameters were far off would now hold them there.
    strategy = replace(_CONTINUED, retry_states=True, give_up_above=limit)
    best = trained(first.model, study, hold, first, strategy)
    if best.objective > limit:
        return None
    # Where a corner is sharper than the steps resolve, a fit rounds it until they do.
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
    """A fit that starts with the covariance of one near by, and from its states as far as the model has the same.

    Args:
        model: equations and starting values.
        study: the data, how they are cut, and how little progress ends a fit.
        hold: what the torque does between samples.
        near: the fit near by, if there is one.
        strategy: how the fit is iterated, for the rest.
        own_states: where the last effect's own states start, in each segment; as if they had long moved like this where
            not given.
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
    """How a model is fitted that starts from a fit near by: begun anew where it has other states, and in any case where
    there is none."""
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
    """Whether an effect with memory leaves more than noise."""
    return any(e.states for e in found.model.effects) and not leaves_white_noise(found)


def lasting_share(effect: Effect, before: Trial, trial: Trial) -> float:
    """The share of an effect's gain that lasts over whole held-out stretches; all of it for an effect without memory,
    and where neither model follows the drive for so long.

    Hidden states are fitted to each short segment, where they can stand for what something else leaves there: an
    offset, say. Over a whole stretch they have to follow from the motion.
    """
    short = before.held_out.objective - trial.held_out.objective
    if not effect.states or short <= 0.0:
        return 1.0
    long_before, long_after = (over_whole_stretches(t.held_out, least_progress=LEAST_PROGRESS) for t in (before, trial))
    if not (follows(long_before) or follows(long_after)):
        return 1.0
    return float(np.clip((with_gaps_closed(long_before) - with_gaps_closed(long_after)) / short, 0.0, 1.0))


def long_gains(before: Trial, trials: Sequence[Trial], study: Study) -> list[float] | None:
    """What trials gain over the model before them in free runs along whole held-out stretches: logs of the ratios of
    the errors. None where free runs tell nothing: the model before runs away, or neither it nor one of the trials
    follows the drive for long.
    """
    old = _free_runs(before, study)
    before_long = rms_error(old)
    after_long = [rms_error(_free_runs(trial, study)) for trial in trials]
    moves = float(np.std(np.concatenate([run.measured for run in old])))
    if not np.isfinite(before_long) or min(before_long, max(after_long)) > 0.5 * moves:
        return None
    return [float(np.log(before_long / after)) for after in after_long]


def _free_runs(trial: Trial, study: Study) -> tuple[FreeRun, ...]:
    """Of the held-out stretches."""
    return free_run(
        trial.model,
        study.data[trial.hold][1],
        covariance=trial.training.covariance,
        halo=study.setting.halo,
        substeps=study.setting.segmentation.substeps,
        like=trial.held_out,
    )


def halo_for(training: Sequence[Stretch], *, longest_delay: float = 1e-2) -> int:
    """Intervals of torque before each segment.

    Args:
        training: training stretches.
        longest_delay: how far back a delayed or lagging torque may reach [s].
    """
    step = training[0].experiment.time_step
    return int(np.clip(np.ceil(longest_delay / step) + 1, 4, 64))
