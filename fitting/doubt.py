"""Whether names can be trusted: what is learned where they leave something, beside them and in their place."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from fitting.attribution.candidate_fit import LEAST_GAIN, Data, Setting, Trial, attempt
from fitting.attribution.selection_round import leaves_imperfection, told_from_zero
from fitting.base_fit import leaves_white_noise
from fitting.compare import EXCESS, excess
from fitting.estimate import half_log_determinant
from fitting.measurement_noise import MeasurementNoise
from fitting.unknown import Unknown, learn_supported, share_of

# Share of a learned torque's mean square that named effects must make up for it to have come out as them.
_COME_OUT = 0.75
# A learned torque that adds less than this share to the gain of named effects, on training and on held-out data alike,
# casts no doubt on them; one in their place must do better by this share of its own gain to outdo them.
_LITTLE = 0.05
# Noise is known to a few per cent, and fitted initial states take as much off it: what this adds to an objective.
_NOISE_MARGIN = 0.05
# So many names that together leave nothing but noise may be the terms of one function.
_MANY = 3


def what_is_unknown(
    base: Trial,
    named: Trial,
    data: Data,
    setting: Setting,
    *,
    noise: MeasurementNoise,
    seed: int,
    progress: Callable[[str], None],
) -> tuple[Trial, Unknown | None]:
    """The model whose names can be trusted, and the torque that is learned beside them.

    A name is doubtful where a learned torque in its place, which is free to be anything, predicts unseen data as well
    as one beside it does (where nothing can be learned beside it: by far better than it does), and either does not come
    out as the named effect or does better by far with fewer parameters. What a learned torque beside it hardly betters
    is in no doubt. Names of which a learned torque beside them leaves nothing fall in any case. Where names leave
    nothing but noise and what their laws may get wrong, there is nothing to learn beside them; only many of them are in
    doubt then, where one learned torque with fewer parameters does as well.

    Args:
        base: the model without effects.
        named: the model with those that were found.
        data: the stretches.
        setting: how they are cut.
        noise: of the measured outputs, as far as fits have been asked for it.
        seed: of the surrogates behind the p-values.
        progress: told what is being done.
    """
    enough = _leaves_noise(named, noise) or leaves_imperfection(named, base, noise)[0]
    if enough and len(named.model.effects) < _MANY:
        return named, None
    little = _explain_all_but_little(base, named, noise)
    instead = None
    if named is not base and not enough and not little:
        instead = learn_supported(base, data, setting, seed=seed, progress=progress)
        if instead is not None and _leaves_noise(instead.trial, noise) and not _has_come_out(instead, named, base):
            # Nothing beside the names could be better.
            return base, instead
    beside = None
    if not enough:
        beside = learn_supported(named, data, setting.with_steps_of(named.training), seed=seed, progress=progress)
    if beside is not None:
        named, beside = _without_superfluous(base, named, beside, data, setting)
    if named is base:
        return base, beside
    if beside is not None and _is_little(
        added=(named.training.objective - beside.trial.training.objective, beside.gain),
        explained=(base.training.objective - named.training.objective, named.gain_over(base)),
    ):
        return named, beside
    if beside is None and not enough and little:
        return named, None
    if enough or little:
        instead = learn_supported(base, data, setting, seed=seed, progress=progress)
    if instead is None:
        return named, beside
    rival = named if beside is None else beside.trial
    stands = _names_stand(
        better_by=rival.held_out.objective - instead.trial.held_out.objective,
        gain=instead.gain,
        beside=beside is not None,
        enough=enough,
        come_out=_has_come_out(instead, named, base) and _show_what_they_are_named_for(named, beside),
        fewer=len(rival.training.free.paths) - len(instead.trial.training.free.paths),
        out_of_shape=beside is not None
        and beside.chosen.of == instead.chosen.of
        and any(instead.chosen.variables == (e.one_shape_of,) for e in named.model.effects),
    )
    return (named, beside) if stands else (base, instead)


def _has_come_out(instead: Unknown, named: Trial, base: Trial) -> bool:
    """Whether what was learned in the place of names has come out as them."""
    return named.hold == base.hold and share_of(named.model, instead, named.training) >= _COME_OUT


def _leaves_noise(trial: Trial, noise: MeasurementNoise) -> bool:
    """Whether nothing but noise is left: of the dynamic error nothing that its colour betrays, and of no output more
    than the measurement noise. (What moves a motor as a whole hardly twists the gear.)"""
    left = excess(trial.training, noise.covariance)
    return leaves_white_noise(trial.training) and bool(np.all(left < EXCESS))


def _without_superfluous(
    base: Trial, named: Trial, beside: Unknown, data: Data, setting: Setting
) -> tuple[Trial, Unknown]:
    """Names, and what was learned beside them, without the effects that this has made superfluous: none of their
    strengths is told from zero any more, and held-out data hardly miss them."""
    names = {e.name for e in named.model.effects}
    fallen = names - told_from_zero(beside.trial.training, names)
    if not fallen:
        return named, beside
    trial = _refitted_without(fallen, beside.trial, data, setting)
    if trial.held_out.objective - beside.trial.held_out.objective >= max(LEAST_GAIN, _LITTLE * beside.gain):
        return named, beside
    bare = base
    if fallen != names or named.hold != base.hold:
        bare = _refitted_without(fallen, named, data, setting)
    states = [n for n in named.model.state_names if n in bare.model.state_names]
    kept = [named.model.state_names.index(n) for n in states]
    gain = bare.held_out.objective - trial.held_out.objective
    return bare, replace(
        beside, before=bare, trial=trial, states=beside.states[:, kept], push=beside.push[:, kept], gain=gain
    )


def _show_what_they_are_named_for(named: Trial, beside: Unknown | None) -> bool:
    """Whether every name still has a strength that is told from zero beside what was learned: friction that ripples,
    whose ripple is gone there, has the right size and the wrong name."""
    names = {e.name for e in named.model.effects}
    return beside is None or told_from_zero(beside.trial.training, names) == names


def _refitted_without(fallen: set[str], trial: Trial, data: Data, setting: Setting) -> Trial:
    model = trial.model
    for name in fallen:
        model = model.without_effect(name)
    return attempt(model, data, trial.hold, setting.with_steps_of(trial.training), start=trial)


def _is_little(added: Sequence[float], explained: Sequence[float]) -> bool:
    """Whether a torque that is learned beside names adds next to nothing to what they explain.

    Args:
        added: decrease of the objective by that torque, on training and on held-out data: either may show motions that
            the other does not.
        explained: decrease of it by the names.
    """
    return all(a < _LITTLE * e for a, e in zip(added, explained, strict=True))


def _explain_all_but_little(base: Trial, named: Trial, noise: MeasurementNoise) -> bool:
    """Whether not even a torque that left nothing but noise would be better than names by far."""
    least = half_log_determinant(noise.covariance) - _NOISE_MARGIN
    return named.held_out.objective - least < _LITTLE * (base.held_out.objective - least)


def _names_stand(
    *, better_by: float, gain: float, beside: bool, enough: bool, come_out: bool, fewer: int, out_of_shape: bool
) -> bool:
    """Whether names are in no doubt.

    Args:
        better_by: decrease of the held-out objective by a learned torque in their place, against what they explain with
            what is learned beside them.
        gain: what that torque explains.
        beside: whether anything is learned beside them.
        enough: whether they leave nothing but noise, and what they may get wrong themselves.
        come_out: whether it has come out as what they name.
        fewer: how many parameters fewer it has.
        out_of_shape: whether one of them stands for one shape of a function of a quantity, and what is learned beside
            them is a function of that as well.
    """
    by_far = better_by > _LITTLE * gain
    as_good = by_far or ((beside or (enough and fewer > 0)) and better_by >= -LEAST_GAIN)
    simpler = (by_far and fewer > 0) or (out_of_shape and fewer >= 0)
    return not as_good or (come_out and not simpler)
