"""A model on trial: fitted to the training stretches, judged on those it has not seen."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from fitting.attribution.decisions import RULES
from fitting.base_fit import leaves_white_noise
from fitting.estimate import Fit, fit, needed_substeps
from fitting.experiment import Stretch
from fitting.free import fitted_paths
from fitting.free_run import FreeRun, free_run, rms_error
from fitting.long_fit import follows, over_whole_stretches, with_gaps_closed, with_memory_carried
from fitting.posing import states_from
from hdjax import Hold, Model
from hdjax.effects import Effect

# Iterations of a trial at most: a form that needs more than this has no clear minimum.
_TRIAL_STEPS = 25
# Those that tell a good start from a poor one.
_FIRST_STEPS = 12
# A few steps that together lower the objective by less than half of this are not worth another; nor by less than half
# of the latter while a model is but one of several.
_LEAST_PROGRESS, _LEAST_OF_A_RIVAL = 0.1 * RULES.least_gain, RULES.least_gain
# What a first pass may fall short of because of what effects remember: it must have come so far towards what it is to
# reach.
_MOST_OF_THE_WAY = 2.0 / 3.0


class Setting(eqx.Module):
    """How the data are cut and simulated; the same for all trials, so that they share programs.

    Attributes:
        horizon: samples in a segment.
        halo: intervals of torque before a segment.
        substeps: solver steps in a sample interval.
        count: segments in each program.
        least_progress: share of the sum of squares that a few steps of a fit must take off it.
        thorough: whether all forms of the catalogue are refitted in each round.
    """

    horizon: int = eqx.field(static=True)
    halo: int = eqx.field(static=True)
    substeps: int = eqx.field(static=True)
    count: int = eqx.field(static=True)
    least_progress: float = eqx.field(static=True, default=_LEAST_PROGRESS)
    thorough: bool = eqx.field(static=True, default=False)

    @property
    def options(self) -> dict[str, Any]:
        """The same as options of [`fitting.estimate.fit`][]."""
        names = ("horizon", "halo", "substeps", "count", "least_progress")
        return {name: getattr(self, name) for name in names}

    def with_steps_of(self, found: Fit) -> "Setting":
        """The same, with the solver steps of a fit."""
        return replace(self, substeps=found.substeps)

    def for_rivals(self) -> "Setting":
        """The same, with no more patience than one of several models needs."""
        return replace(self, least_progress=max(self.least_progress, _LEAST_OF_A_RIVAL))

    def fine_enough(self, found: Fit) -> "Setting":
        """The same, with as many solver steps as the fitted motion needs; itself where these are enough."""
        substeps = needed_substeps(found)
        return replace(self, substeps=substeps) if substeps > self.substeps else self


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


Data = dict[Hold, tuple[tuple[Stretch, ...], tuple[Stretch, ...]]]
"""Training and held-out stretches for each assumption about the torque between samples."""


def attempt(
    model: Model,
    data: Data,
    hold: Hold,
    setting: Setting,
    *,
    start: Trial | None = None,
    hold_parameters: bool = False,
) -> Trial:
    """Fit a model and look at it on held-out data.

    Args:
        model: equations and starting values.
        data: the stretches.
        hold: what the torque does between samples.
        setting: how the data are cut.
        start: a trial near by, whose error covariance weighs the outputs at the start, and whose initial states it
            starts from.
        hold_parameters: see [`fitting.estimate.fit`][].
    """
    near = None if start is None else start.training
    training = trained(model, data, hold, setting, near, hold_parameters=hold_parameters)
    # What the data say of them is asked all the same.
    training = eqx.tree_at(lambda t: t.problem.active, training, jnp.ones_like(training.problem.active))
    return _judged(training, data, hold, setting)


def gone_on(trial: Trial, data: Data, setting: Setting) -> Trial:
    """A trial after another pass of its fit; the same where that gains nothing.

    Args:
        trial: as it stands.
        data: the stretches.
        setting: how they are cut.
    """
    training = trained(trial.model, data, trial.hold, setting, trial.training)
    if training.objective > trial.training.objective - _LEAST_PROGRESS:
        return trial
    return _judged(training, data, trial.hold, setting)


def challenge(
    models: Sequence[Model],
    data: Data,
    hold: Hold,
    setting: Setting,
    *,
    champion: Trial,
    give_up_above: float = np.inf,
    own_states: Float[np.ndarray, "segments own"] | None = None,
) -> Trial | None:
    """The best fit of several starts, if it explains the training data at least as well as the model that it is to
    replace.

    Args:
        models: one and the same model at several starting values.
        data: the stretches.
        hold: what the torque does between samples.
        setting: how the data are cut.
        champion: the model to replace.
        give_up_above: a lower objective that it must reach.
        own_states: where the own states of the first model's last effect start, in each segment.
    """
    first = first_pass(models, data, hold, setting, champion=champion, own_states=own_states)
    return to_the_end(first, data, hold, setting, champion=champion, give_up_above=give_up_above)


def first_pass(
    models: Sequence[Model],
    data: Data,
    hold: Hold,
    setting: Setting,
    *,
    champion: Trial,
    own_states: Float[np.ndarray, "segments own"] | None = None,
) -> Fit:
    """The first pass of a challenger, from the best of its starts as a few iterations from each tell it; arguments as
    in [`challenge`][]."""
    setting = setting.for_rivals()
    best, near = models[0], champion.training
    if len(models) > 1:
        once: dict[str, Any] = {"give_up_above": -np.inf, "begin_anew_above": np.inf, "retry_states": False}
        own = own_states, *[None] * (len(models) - 1)
        begun = [
            trained(model, data, hold, setting, near, max_steps=_FIRST_STEPS, own_states=states, **once)
            for model, states in zip(models, own, strict=True)
        ]
        near = min(begun, key=lambda found: found.objective)
        best, own_states = near.model, None
    return trained(
        best,
        data,
        hold,
        setting,
        near,
        give_up_above=-np.inf,
        begin_anew_above=champion.training.objective,
        retry_states=True,
        own_states=own_states,
    )


def to_the_end(
    first: Fit, data: Data, hold: Hold, setting: Setting, *, champion: Trial, give_up_above: float = np.inf
) -> Trial | None:
    """A challenger followed from its first pass to the end, as far as it is worth it; arguments as in
    [`challenge`][]."""
    to_judge, setting = setting, setting.for_rivals()
    before = champion.training.objective
    limit = min(give_up_above, before + RULES.least_gain)
    remembers_more = first.model.state_names != champion.model.state_names and _may_remember_better(first)
    if remembers_more and first.objective <= before - _MOST_OF_THE_WAY * (before - limit):
        first = with_memory_carried(first, least_progress=setting.least_progress)
    if first.objective > limit:
        return None
    setting = setting.fine_enough(first)
    # A segment that lost its way while the parameters were far off would now hold them there.
    best = trained(first.model, data, hold, setting, first, give_up_above=limit, retry_states=True)
    if best.objective > limit:
        return None
    # Where a corner is sharper than the steps resolve, a fit rounds it until they do.
    finer = setting.fine_enough(best)
    if finer is not setting:
        best = trained(best.model, data, hold, finer, best, give_up_above=limit, retry_states=True)
    return _judged(best, data, hold, to_judge.with_steps_of(best)) if best.objective <= limit else None


def trained(
    model: Model,
    data: Data,
    hold: Hold,
    setting: Setting,
    near: Fit | None,
    *,
    give_up_above: float = np.inf,
    begin_anew_above: float | None = None,
    retry_states: bool | None = None,
    max_steps: int = _TRIAL_STEPS,
    reweigh: bool = True,
    hold_parameters: bool = False,
    own_states: Float[np.ndarray, "segments own"] | None = None,
) -> Fit:
    """A fit that starts with the covariance of one near by, and from its states as far as the model has the same.

    Args:
        model: equations and starting values.
        data: the stretches.
        hold: what the torque does between samples.
        setting: how the data are cut.
        near: the fit near by, if there is one.
        give_up_above: see [`fitting.estimate.fit`][], as for the rest.
        begin_anew_above: likewise; where not given, a fit begins anew in any case where the model has other states than
            the one near by, and in none where it has the same.
        retry_states: likewise; where not given, as it may begin anew.
        max_steps: likewise.
        reweigh: likewise.
        hold_parameters: likewise.
        own_states: where the last effect's own states start, in each segment; as if they had long moved like this where
            not given.
    """
    same = near is not None and near.model.state_names == model.state_names
    if begin_anew_above is None:
        begin_anew_above = np.inf if same else -np.inf if near is None else near.objective
    states = None if near is None else states_from(model, near.model, near.unknowns.states)
    if states is not None and own_states is not None:
        states = jnp.concatenate([states[:, : -own_states.shape[1]], jnp.asarray(own_states)], axis=1)
    return fit(
        model,
        data[hold][0],
        fitted_paths(model),
        **setting.options,
        covariance=None if near is None else near.covariance,
        max_steps=max_steps,
        reweigh=reweigh,
        hold_parameters=hold_parameters,
        states=states,
        begin_anew_above=begin_anew_above,
        retry_states=not same if retry_states is None else retry_states,
        give_up_above=give_up_above,
    )


def _judged(training: Fit, data: Data, hold: Hold, setting: Setting) -> Trial:
    held_out = fit(
        training.model,
        data[hold][1],
        training.free.paths,
        **setting.options,
        covariance=training.covariance,
        max_steps=_TRIAL_STEPS,
        hold_parameters=True,
    )
    if _may_remember_better(held_out):
        held_out = with_memory_carried(held_out, hold_parameters=True, least_progress=setting.least_progress)
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
    long_before, long_after = (
        over_whole_stretches(t.held_out, least_progress=_LEAST_PROGRESS) for t in (before, trial)
    )
    if not (follows(long_before) or follows(long_after)):
        return 1.0
    return float(np.clip((with_gaps_closed(long_before) - with_gaps_closed(long_after)) / short, 0.0, 1.0))


def long_gains(before: Trial, trials: Sequence[Trial], data: Data, setting: Setting) -> list[float] | None:
    """What trials gain over the model before them in free runs along whole held-out stretches: logs of the ratios of
    the errors. None where free runs tell nothing: the model before runs away, or neither it nor one of the trials
    follows the drive for long.
    """
    old = _free_runs(before, data, setting)
    before_long = rms_error(old)
    after_long = [rms_error(_free_runs(trial, data, setting)) for trial in trials]
    moves = float(np.std(np.concatenate([run.measured for run in old])))
    if not np.isfinite(before_long) or min(before_long, max(after_long)) > 0.5 * moves:
        return None
    return [float(np.log(before_long / after)) for after in after_long]


def _free_runs(trial: Trial, data: Data, setting: Setting) -> tuple[FreeRun, ...]:
    """Of the held-out stretches."""
    return free_run(
        trial.model,
        data[trial.hold][1],
        covariance=trial.training.covariance,
        halo=setting.halo,
        substeps=setting.substeps,
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
