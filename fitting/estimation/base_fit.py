"""Fit of the base model from the log alone: starting values, coarse fits from each, refinement of the best one.

Fits over short horizons converge from far away, because a wrong frequency can't run out of phase; long horizons are
more accurate. So each start is fitted over short horizons first. The best fit is continued over longer ones, from its
own states.
"""

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from fitting.estimation.beside_friction import fits_of_starts, refitted_beside
from fitting.estimation.encoder_delay import delay_of_load
from fitting.estimation.estimate import Fit, Start, Strategy, fit, mostly_lost
from fitting.estimation.experiment import Moved, Stretch
from fitting.estimation.free_parameters import MESH, base_paths, with_priors
from fitting.estimation.late_readings import moved_to
from fitting.estimation.one_side import held_at, one_side_fit, with_known_priors
from fitting.estimation.outliers import without_glitches, without_lone_errors
from fitting.estimation.problem import Segmentation, initial_states, segment_length, short_horizon, suggested_substeps
from fitting.estimation.scales import largest_torque
from fitting.estimation.starting_values import (
    MOST_LEFT,
    apart,
    sees_twist,
    starting_models,
    starts_blind_to_loads,
    with_starting_inertias,
)
from fitting.estimation.steady_torque import SteadyLoad
from fitting.estimation.whiteness import autocorrelation, left_over, ljung_box
from hdjax import Drive, Model, TwoInertiaModel
from hdjax.drive import Prior
from hdjax.effects.friction import MotorFriction

# Iterations of a trial fit, enough to rank the starts.
_TRIAL_STEPS = 10
# A start whose trial is this much worse than the best (in the objective: 10 % of the error) is dropped.
_HOPELESS = 0.1
# Distance of a fit's log stiffness from all weak forms that are insensitive to constant loads. Beyond it, an unlogged
# load may have caused a wrong minimum. It has, where constant loads per segment explain most of the error.
_OFF = 0.3
# Passes of outlier removal; each improves the noise estimate, and so detects smaller outliers.
_CLEANINGS = 3
# Lags of the whiteness test, and its significance level.
_LAGS = 20
_FALSE_ALARM = 1e-3


class BaseFit(NamedTuple):
    """The fit of a drive without effects.

    Attributes:
        fit: its `problem.model` holds the starting values. Friction or an unlogged load may leave the objective without
            a minimum near the true parameters. Then they are fixed (see [`is_held`][]).
        source: the fit that supplied fixed values: of one side's equation, or beside motor friction; None where nothing
            was fixed, or by other means.
    """

    fit: Fit
    source: Fit | None


def base_fit(model: Model, training: Sequence[Stretch], *, halo: int = 0) -> BaseFit:
    """Fit a drive without effects, from starting values estimated from the data.

    Args:
        model: the base model; its stiffness and damping are only placeholders.
        training: the data.
        halo: intervals of torque before a segment.

    Raises:
        DataError: no starting values follow from the data.
    """
    training = without_glitches(training)
    source = None
    if sees_twist(training):
        best, start, source = _fit_of_twist(model, training, halo)
    else:
        alone, beside, start = fits_of_starts(starting_models(model, training), training, halo)
        much = alone.objective - beside.objective > -np.log(MOST_LEFT)
        bare = beside.model.without_effect(MotorFriction.name)
        best = _held_at(beside, bare, training, halo) if much else alone
        source = refitted_beside(best) if much else None
    if is_held(best):
        return BaseFit(eqx.tree_at(lambda f: f.problem.model, best, start), source)
    horizon = short_horizon(best.model, training)
    if not best.horizon <= 2 * horizon <= 4 * best.horizon:
        best = _refined(best, training, halo)
    for _ in range(_CLEANINGS):
        cleaned = without_lone_errors(best)
        if cleaned is None:
            break
        best = fit(
            best.model,
            cleaned,
            base_paths(best.model),
            best.segmentation,
            start=Start(states=best.unknowns.states),
        )
    return BaseFit(eqx.tree_at(lambda f: f.problem.model, best, start), None)


def _fit_of_twist(model: Model, training: Sequence[Stretch], halo: int) -> tuple[Fit, Model, Fit | None]:
    """The fit over short horizons where the dynamic error was measured, its starting model, and the fit of one side at
    whose values it is fixed.

    Encoders that are read rows apart leave no minimum near the true parameters. They are fixed at those of the fit
    without these rows.
    """
    late = delay_of_load(model, training)
    if not late:
        return _fit_of_both_angles(model, training, halo)
    # Taken as logged like this, or a fit without an encoder's delay would move the readings back.
    moved = [replace(s, experiment=replace(moved_to(s.experiment, Moved(late)), moved=Moved())) for s in training]
    best, start, _ = _fit_of_both_angles(model, moved, halo)
    return _held_at(best, best.model, training, halo), start, None


def _fit_of_both_angles(model: Model, training: Sequence[Stretch], halo: int) -> tuple[Fit, Model, Fit | None]:
    """[`_fit_of_twist`][] of encoders that are read together."""
    priors = ()
    if isinstance(model, TwoInertiaModel):
        # Free inertias would absorb what the base model lacks before the load's equation is used.
        priors = model.drive.priors
        model = with_priors(with_starting_inertias(model, training), ())
    best, start, side = _coarse_fit(starting_models(model, training), training, halo)
    if side is None:
        best = _beside_loads(best, training, halo)
    if priors:
        start = with_priors(start, priors)
        best = _with_inertias_free(best, priors)
        # The equation determines the stiffness only in proportion to that side's inertia.
        side = with_known_priors(side, priors) if side is not None and is_held(best) else None
    return best, start, side


def _coarse_fit(starts: Sequence[Model], training: Sequence[Stretch], halo: int) -> tuple[Fit, Model, Fit | None]:
    """The best of the fits from each start, over horizons that suit the fastest of them; its starting model; and the
    fit of one side at whose values it is fixed."""
    # Equally short segments for all starts make their objectives comparable.
    horizon = segment_length(min(short_horizon(s, training) for s in starts))
    substeps = max(suggested_substeps(s, training) for s in starts)

    fitted = functools.partial(_fitted, training=training, segmentation=Segmentation(horizon, None, halo, substeps))
    if len(starts) > 1:
        starts = sorted(starts, key=lambda s: fitted(s, strategy=Strategy(20, hold_parameters=True)).objective)
    best, begun = fitted(starts[0]), starts[0]
    if leaves_white_noise(best):
        return best, begun, None
    driven = one_side_fit(best.model, training) if isinstance(best.model, TwoInertiaModel) else None
    if (held := _held_by(driven, best, training, halo)) is not None:
        return held, begun, driven
    first = best
    trials = [(fitted(s, strategy=Strategy(_TRIAL_STEPS)), s) for s in starts[1:]]
    for trial, start in sorted(trials, key=lambda pair: pair[0].objective):
        if trial.objective < best.objective + _HOPELESS:
            other = fitted(trial.model)
            if other.objective < best.objective:
                best, begun = other, start
    if best is not first and (held := _held_by(driven, best, training, halo)) is not None:
        return held, begun, driven
    return best, begun, None


def _fitted(
    model: Model, *, training: Sequence[Stretch], segmentation: Segmentation, strategy: Strategy = Strategy()
) -> Fit:
    """Fit the base parameters from the model's current values; arguments as in
    [`fitting.estimation.estimate.fit`][]."""
    return fit(model, training, base_paths(model), segmentation, strategy=strategy)


def _beside_loads(best: Fit, training: Sequence[Stretch], halo: int) -> Fit:
    """The fit started with a constant load torque in each segment, where such loads explain most of the residual; else
    the given fit.

    Under a large unlogged load (a weight, a spring to the ground) the twist hardly depends on the motor torque, and a
    wrong stiffness fits better than the right one. Where there is no minimum near the right one, the parameters are
    fixed at their values in the fit with constant loads.
    """
    drive = best.model.drive
    if not isinstance(drive, Drive) or leaves_white_noise(best):
        return best
    starts = starts_blind_to_loads(best.model, training)
    if not starts or min(apart(best.model, start) for start in starts) < _OFF:
        return best
    horizon = segment_length(short_horizon(starts[0], training))
    substeps = suggested_substeps(starts[0], training)
    fitted = functools.partial(_fitted, training=training, segmentation=Segmentation(horizon, None, halo, substeps))
    reach = drive.N * largest_torque(training)
    loaded = fitted(starts[0].with_effects(SteadyLoad(reach=reach)))
    bare = loaded.model.without_effect(SteadyLoad.name)
    other = fitted(bare)
    if not loaded.objective < other.objective + np.log(MOST_LEFT):
        return best
    return other if apart(other.model, bare) < _OFF else fitted(bare, strategy=Strategy(hold_parameters=True))


def _with_inertias_free(found: Fit, priors: tuple[Prior, ...]) -> Fit:
    """The fit with all parameters that have a prior free as well. A fit with fixed parameters keeps them fixed unless
    freeing leaves only noise: then an inertia was wrong, and nothing unmodelled acts on the motor."""
    model = with_priors(found.model, priors)
    fitted = functools.partial(
        fit, model, found.stretches, base_paths(model), found.segmentation, start=Start(states=found.unknowns.states)
    )
    free = fitted()
    return fitted(strategy=Strategy(hold_parameters=True)) if is_held(found) and not leaves_white_noise(free) else free


def _held_by(driven: Fit | None, best: Fit, training: Sequence[Stretch], halo: int) -> Fit | None:
    """The drive fixed at the values of one side's own equation, where this contradicts a fit of the drive; else None.

    The equation holds whatever acts on the other side. Large friction makes a side move far less than the base model
    predicts. In that model only the mesh can dissipate the energy. So the fit raises B_sp until the twist vanishes and
    K has no influence. But what the equation lacks itself (a flexible load) may make its own B_sp so negative that the
    drive diverges.
    """
    if driven is None or held_at(best.model, driven).objective - driven.objective <= -np.log(MOST_LEFT):
        return None
    held = _held_at(driven, best.model, training, halo)
    return None if mostly_lost(held) else held


def _held_at(driven: Fit, model: Model, training: Sequence[Stretch], halo: int) -> Fit:
    """The base model with its parameters fixed at estimates from one side's equation, or from a fit beside friction."""
    told = model.replace({path: driven.model.get(path) for path in MESH})
    horizon = short_horizon(told, training)
    segmentation = Segmentation(horizon, None, halo, suggested_substeps(told, training))
    return _fitted(told, training=training, segmentation=segmentation, strategy=Strategy(hold_parameters=True))


def is_held(found: Fit) -> bool:
    """Whether the fit's parameters were fixed."""
    return not np.any(np.asarray(found.problem.active))


def _refined(best: Fit, training: Sequence[Stretch], halo: int) -> Fit:
    """The fit over horizons of six natural periods, from one over shorter ones."""
    paths = base_paths(best.model)
    # The range of convergence is inversely proportional to the horizon, so that none may be skipped. Longer horizons
    # are made of joined segments, by the same program.
    while 4 * best.horizon <= short_horizon(best.model, training):
        best = fit(
            best.model,
            training,
            paths,
            replace(best.segmentation, horizon=2 * best.horizon),
            start=Start(states=best.unknowns.states),
        )
    segmentation = Segmentation(
        short_horizon(best.model, training), halo=halo, substeps=suggested_substeps(best.model, training)
    )
    states = initial_states(best.model, segmentation.of(as_followed(best)))
    return fit(best.model, training, paths, segmentation, start=Start(states=states))


def need_double_precision() -> None:
    """Refuse single precision, in which fits do not converge.

    Raises:
        ValueError: JAX computes in single precision.
    """
    if jnp.result_type(float) != jnp.float64:
        raise ValueError('fits need double precision: call jax.config.update("jax_enable_x64", True) first')


def leaves_white_noise(found: Fit) -> bool:
    """Whether the residual of the dynamic error is white: a test of its first autocorrelations (Ljung and Box 1978)."""
    _, p_value = ljung_box(autocorrelation(found, _LAGS)[1:], left_over(found).size)
    return p_value > _FALSE_ALARM


def as_followed(found: Fit) -> tuple[Stretch, ...]:
    """The stretches with a fit's simulated outputs in place of the measured ones."""
    parts = []
    for stretch, error in zip(found.stretches, found.by_stretch(np.asarray(found.error)), strict=True):
        measured = stretch.experiment.measured.copy()
        measured[stretch.start : stretch.stop] -= error
        parts.append(Stretch(replace(stretch.experiment, measured=measured), stretch.start, stretch.stop))
    return tuple(parts)
