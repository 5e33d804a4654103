"""The base model's fit, from nothing but the log: starting values, coarse fits from each, and the best one refined.

Short simulations find their minimum from far away, because a wrong frequency can't run out of phase; long ones use the
data fully. So each start is fitted over short horizons first, and the best goes on to longer ones from the states that
it has found.
"""

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import TypeGuard

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from fitting.estimation.beside_friction import fits_of_starts, held_beside, refitted_beside
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import MESH, base_paths, with_priors
from fitting.estimation.motor_driven import held_at, motor_driven_fit
from fitting.estimation.outliers import without_glitches, without_lone_errors
from fitting.estimation.problem import Segmentation, initial_states, segment_length, short_horizon, suggested_substeps
from fitting.estimation.scales import largest_torque
from fitting.estimation.starting_values import (
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

# Iterations that tell a start that leads somewhere from one that does not.
_TRIAL_STEPS = 10
# A start whose trial is this much worse than the best (in the objective: 10 % of the error) is given up.
_HOPELESS = 0.1
# A fit whose stiffness is off by so much (in its logarithm) from all weak forms that see no steady load may be in a
# minimum that a large load has made; so it is where steady loads leave less than this share of its error.
_OFF, _MUCH = 0.3, 0.5
# Rounds of leaving out what stands alone; each tells the noise better, and so shows smaller outliers.
_CLEANINGS = 3
# Lags of the test for whiteness, and the chance that it takes white noise for anything else.
_LAGS = 20
_FALSE_ALARM = 1e-3


def base_fit(model: Model, training: Sequence[Stretch], *, halo: int = 0) -> Fit:
    """Fit a drive without effects, from starting values that the data supply; the fit's `problem.model` holds them.

    Where what acts on the motor (friction, say) or a load that is not logged leaves the model no minimum near the
    drive's parameters, they are held (see [`is_held`][]).

    Args:
        model: the base model; its stiffness and damping are only placeholders.
        training: the data.
        halo: intervals of torque before a segment.

    Raises:
        DataError: where the data supply no starting values.
    """
    training = without_glitches(training)
    if sees_twist(training):
        best, start = _fit_of_twist(model, training, halo)
    else:
        alone, beside, start = fits_of_starts(starting_models(model, training), training, halo)
        much = alone.objective - beside.objective > -np.log(_MUCH)
        best = held_beside(beside, start, training, halo) if much else alone
    if is_held(best):
        return eqx.tree_at(lambda f: f.problem.model, best, start)
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
    return eqx.tree_at(lambda f: f.problem.model, best, start)


def _fit_of_twist(model: Model, training: Sequence[Stretch], halo: int) -> tuple[Fit, Model]:
    """The fit over short horizons where the dynamic error was measured, and where it started."""
    priors = ()
    if isinstance(model, TwoInertiaModel):
        # What the base model lacks would go into inertias that are free, before the load's equation is asked.
        priors = model.drive.priors
        model = with_priors(with_starting_inertias(model, training), ())
    best, start = _coarse_fit(starting_models(model, training), training, halo)
    if not is_held(best):
        best = _beside_loads(best, training, halo)
    if priors:
        start = with_priors(start, priors)
        best = _with_inertias_free(best, priors)
    return best, start


def _coarse_fit(starts: Sequence[Model], training: Sequence[Stretch], halo: int) -> tuple[Fit, Model]:
    """The best of the fits from each start, over horizons that suit the fastest of them; and where it started."""
    # Judged on equally short segments, a start with the wrong frequency can't hide.
    horizon = segment_length(min(short_horizon(s, training) for s in starts))
    substeps = max(suggested_substeps(s, training) for s in starts)

    fitted = functools.partial(_fitted, training=training, segmentation=Segmentation(horizon, None, halo, substeps))
    if len(starts) > 1:
        starts = sorted(starts, key=lambda s: fitted(s, strategy=Strategy(20, hold_parameters=True)).objective)
    best, begun = fitted(starts[0]), starts[0]
    if leaves_white_noise(best):
        return best, begun
    driven = motor_driven_fit(best.model, training) if isinstance(best.model, TwoInertiaModel) else None
    if _contradicts(driven, best):
        return _held_at(driven, best.model, training, halo), begun
    trials = [(fitted(s, strategy=Strategy(_TRIAL_STEPS)), s) for s in starts[1:]]
    for trial, start in sorted(trials, key=lambda pair: pair[0].objective):
        if trial.objective < best.objective + _HOPELESS:
            other = fitted(trial.model)
            if other.objective < best.objective:
                best, begun = other, start
    if _contradicts(driven, best):
        best = _held_at(driven, best.model, training, halo)
    return best, begun


def _fitted(
    model: Model, *, training: Sequence[Stretch], segmentation: Segmentation, strategy: Strategy = Strategy()
) -> Fit:
    """Fit all that the model has of its own, from where it stands; arguments as in
    [`fitting.estimation.estimate.fit`][]."""
    return fit(model, training, base_paths(model), segmentation, strategy=strategy)


def _beside_loads(best: Fit, training: Sequence[Stretch], halo: int) -> Fit:
    """The minimum to which steady loads in each segment lead, where they explain most of what is left; else the same.

    Under a large load that is not logged (a weight, a spring to the ground) the twist hardly follows the motor's
    torque, and a drive with a wrong stiffness fits better than the right one. Where there is no minimum near the right
    one, the parameters are held at what the steady loads tell.
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
    if not loaded.objective < other.objective + np.log(_MUCH):
        return best
    return other if apart(other.model, bare) < _OFF else fitted(bare, strategy=Strategy(hold_parameters=True))


def _with_inertias_free(found: Fit, priors: tuple[Prior, ...]) -> Fit:
    """The fit with all that its drive's priors are of free as well; one whose parameters are held stays so, unless that
    leaves nothing but noise: then an inertia was wrong, and nothing acts on the motor."""
    model = with_priors(found.model, priors)
    fitted = functools.partial(
        fit, model, found.stretches, base_paths(model), found.segmentation, start=Start(states=found.unknowns.states)
    )
    free = fitted()
    return fitted(strategy=Strategy(hold_parameters=True)) if is_held(found) and not leaves_white_noise(free) else free


def _contradicts(driven: Fit | None, best: Fit) -> TypeGuard[Fit]:
    """Whether the load's own equation, which holds whatever acts on the motor, contradicts a fit of the drive.

    A motor whose friction is a good part of its torque moves far less than the base model makes it. Nothing in that
    model takes energy from the motor alone. So the fit brakes the motor by tying it to the load, with a damping B_sp so
    large that the twist stands still and K no longer matters.
    """
    if driven is None:
        return False
    return held_at(best.model, driven).objective - driven.objective > -np.log(_MUCH)


def _held_at(driven: Fit, model: Model, training: Sequence[Stretch], halo: int) -> Fit:
    """The base model with its parameters held at what the load's own equation tells."""
    told = model.replace({path: driven.model.get(path) for path in MESH})
    horizon = short_horizon(told, training)
    segmentation = Segmentation(horizon, segment_length(horizon), halo, suggested_substeps(told, training))
    return _fitted(told, training=training, segmentation=segmentation, strategy=Strategy(hold_parameters=True))


def is_held(found: Fit) -> bool:
    """Whether its parameters were held."""
    return not np.any(np.asarray(found.problem.active))


def _refined(best: Fit, training: Sequence[Stretch], halo: int) -> Fit:
    """The fit over horizons of six natural periods, from one over shorter ones."""
    paths = base_paths(best.model)
    # The reach of a horizon is in inverse proportion to it, so that none may be skipped. Joined segments make a longer
    # one by the same program.
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


def told_by_load(found: Fit) -> Fit | None:
    """The fit whose values a base fit holds, of the load's own equation or beside friction of the motor; None where it
    holds none, or others."""
    if not is_held(found) or not isinstance(found.model, TwoInertiaModel):
        return None
    if not sees_twist(found.stretches):
        return refitted_beside(found)
    driven = motor_driven_fit(with_priors(found.model, ()), found.stretches)
    if driven is None or any(float(found.model.get(p)) != float(driven.model.get(p)) for p in MESH):
        return None
    # The stiffness is known in proportion to the load's inertia, and no better.
    known = tuple(p for p in found.model.drive.priors if p.path == "J_l" and np.isfinite(p.tolerance))
    return motor_driven_fit(with_priors(found.model, known), found.stretches) if known else driven


def need_double_precision() -> None:
    """Refuse to go on in single precision, which fits do not converge in.

    Raises:
        ValueError: JAX computes in single precision.
    """
    if jnp.zeros(0).dtype != jnp.float64:
        raise ValueError('fits need double precision: call jax.config.update("jax_enable_x64", True) first')


def leaves_white_noise(found: Fit) -> bool:
    """Whether nothing is left of the dynamic error that a better minimum could explain: a test of its first
    autocorrelations (Ljung and Box 1978)."""
    _, p_value = ljung_box(autocorrelation(found, _LAGS)[1:], left_over(found).size)
    return p_value > _FALSE_ALARM


def as_followed(found: Fit) -> tuple[Stretch, ...]:
    """The stretches with the outputs that a fit gives in place of the measured ones."""
    parts = []
    for stretch, error in zip(found.stretches, found.by_stretch(np.asarray(found.error)), strict=True):
        measured = stretch.experiment.measured.copy()
        measured[stretch.start : stretch.stop] -= error
        parts.append(Stretch(replace(stretch.experiment, measured=measured), stretch.start, stretch.stop))
    return tuple(parts)
