"""Which effect explains what the model leaves over: trials inside the equations, judged on data they have not seen."""

from collections.abc import Callable, Collection, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from fitting.attribution.candidate_fit import LEAST_GAIN, Data, Setting, Trial, long_gains
from fitting.attribution.candidate_refit import begin, go_on, try_hold
from fitting.attribution.screening import Lead, Screen, screen
from fitting.attribution.shortlist import first_of_each_family, further_forms, possible_ties, worth_a_refit
from fitting.base_fit import leaves_white_noise
from fitting.estimate import Fit
from fitting.experiment import scales
from fitting.free import effect_paths, strength_paths
from fitting.measurement_noise import MeasurementNoise
from fitting.normal_law import NORMAL_95
from fitting.uncertainty import Estimate, Uncertainty, uncertainty
from hdjax import ReducedModel
from hdjax.effects import Effect
from hdjax.parameters import own_parameters

SIGNIFICANCE = 0.01
"""Largest p-value of an accepted effect: the chance that the best of the catalogue does as well on noise."""


# Standard errors by which a strength must differ from zero: one percent of chance over a hundred forms and shapes.
_BEST_OF_MANY = 3.9
# What is tied with the best gains as much but for this share; so it must in its first pass to be worth another.
_NEAR_TIE = 0.1
# A family of which one form gains this share of what the best of all does may have one that does better.
_MAY_DO_BETTER = 0.75
# Gains that differ by less than this share are the same.
_SAME_GAIN = 0.02
# What gains this share of what a form with memory does over short segments, where that may begin as it likes, is
# compared with it over whole stretches.
_RIVAL_OF_MEMORY = 0.5
# A rival that explains less than this share of what the best one so far does, in its first pass, is given up.
_HOPELESS = 0.3


class Verdict(eqx.Module):
    """One competitor of a round.

    Attributes:
        name: the form.
        family: its family.
        trial: the refitted model, or None where it was not worth a refit.
        gain: decrease of the held-out objective (first-order estimate where there was no refit); of an effect with
            memory, what of it lasts over whole stretches.
        p_value: of that gain against the best of the catalogue on noise.
        separable: whether held-out data tell it from the round's winner.
    """

    name: str = eqx.field(static=True)
    family: str = eqx.field(static=True)
    trial: Trial | None
    gain: float
    p_value: float
    separable: bool


class Round(eqx.Module):
    """One look at the catalogue under one model.

    Attributes:
        before: the model that was looked at.
        screen: first-order look and the law of chance.
        verdicts: all competitors, best first.
        accepted: whether the best one is supported.
    """

    before: Trial
    screen: Screen
    verdicts: tuple[Verdict, ...]
    accepted: bool

    @property
    def winner(self) -> Verdict:
        """The best competitor."""
        return self.verdicts[0]


def look(
    before: Trial,
    data: Data,
    setting: Setting,
    *,
    catalogue: Sequence[type[Effect]],
    seed: int,
    progress: Callable[[str], None],
    base: Trial | None = None,
) -> Round:
    """Look for the effect that explains most of what a model leaves over.

    Args:
        before: the current model.
        data: the stretches; every hold that is here competes with the present one.
        setting: how they are cut.
        catalogue: forms to consider.
        seed: of the surrogates.
        progress: told what is being done.
        base: the model without any effect; where not given, `before`.
    """
    base = before if base is None else base
    progress("looking through the catalogue")
    screened = screen(before.training, before.held_out, catalogue=catalogue, seed=seed)
    refitted: dict[str, Trial] = {}
    worth = worth_a_refit(screened, least=0.25 * LEAST_GAIN)
    swing = scales(before.training.stretches, before.model)
    behind = [lead for lead in screened.leads if lead.effect.imitated(before.model.drive, swing)]
    suspects = [lead for lead in behind if lead not in worth]

    def refit(leads: Sequence[Lead], setting: Setting, share: float = _HOPELESS) -> None:
        begun = []
        for lead in leads:
            progress(f"refitting with {lead.effect.name}")
            begun.append((lead, begin(before, lead, data, setting)))
        # The one that has come farthest goes on first: beside it most others need not.
        for lead, found in sorted(begun, key=lambda pair: pair[1].objective):
            best = min((t.training.objective for t in refitted.values()), default=np.inf)
            trial = go_on(before, lead, found, data, setting, _on_the_way(before, best, share))
            if trial is not None and np.isfinite(trial.held_out.objective):
                refitted[lead.effect.name] = trial

    def refit_beside(best: Trial, leads: Sequence[Lead]) -> None:
        # What is to come near it in its first pass needs its steps.
        refit(leads, setting.with_steps_of(best.training), 1.0 - _NEAR_TIE)

    first = first_of_each_family(worth, suspects)
    refit(first[:1], setting)
    leader = refitted.get(first[0].effect.name) if first else None
    if leader is not None and leaves_white_noise(leader.training):
        refit_beside(leader, [*possible_ties(worth, first), *(lead for lead in suspects if lead in first[1:])])
    else:
        refit(first[1:], setting)
        if refitted:
            best = max(refitted.values(), key=lambda trial: trial.gain_over(before))
            near = _on_the_way(before, best.training.objective, _MAY_DO_BETTER)
            families = [a.effect.family for a in first if _reaches(refitted.get(a.effect.name), near)]
            refit_beside(best, further_forms([*worth, *suspects], families, first))
    found: list[Verdict] = []
    for lead in screened.leads:
        trial = refitted.get(lead.effect.name)
        gain = lead.gain if trial is None else trial.gain_over(before)
        p_value = screened.p_value(gain)
        found.append(Verdict(lead.effect.name, lead.effect.family, trial, gain, p_value, True))
    for hold in data:
        if hold == before.hold:
            continue
        progress(f"refitting with a {hold} torque")
        trial = try_hold(before, data, hold, setting)
        gain = -np.inf if trial is None else trial.gain_over(before)
        found.append(Verdict(f"{hold} hold", "input_delay", trial, gain, screened.p_value(gain), True))
    found.sort(key=lambda v: (v.trial is None, -v.gain))
    found = _with_separability(found)
    if any(_supported(verdict, before, base) for verdict in found):
        found = _simplest_first(found, before, data, setting)
    verdicts, accepted = _supported_first(found, before, base)
    return Round(before, screened, tuple(verdicts), accepted)


def _supported(verdict: Verdict, before: Trial, base: Trial) -> bool:
    """Whether a competitor is more than chance, more than an imperfection, and has a strength that is not zero."""
    return (
        verdict.trial is not None
        and verdict.gain > LEAST_GAIN
        and verdict.p_value <= SIGNIFICANCE
        and _share_of_removed(verdict.trial, before, base) > _imperfection(before)
        and _has_a_strength(verdict)
    )


def _imperfection(before: Trial) -> float:
    """Share (rms) of what a model's effects have removed that they may get wrong themselves."""
    return max((effect.imperfection for effect in before.model.effects), default=0.0)


def leaves_imperfection(before: Trial, base: Trial, noise: MeasurementNoise) -> tuple[bool, MeasurementNoise]:
    """Whether nothing is left beyond the measurement noise but what a model's effects may get wrong themselves, so
    that no further effect could remove more.

    Args:
        before: the model.
        base: the model without effects.
        noise: as far as fits have been asked for it.

    Returns:
        Whether it is so, and the noise, for which the model has been asked as well where it mattered: it may see less
        of it than the base model.
    """
    small = _imperfection(before)
    if _share(before, base, np.diag(np.asarray(noise.covariance))) > small:
        return False, noise
    noise = noise.and_beside(before.training)
    return _share(before, base, np.diag(np.asarray(noise.covariance))) <= small, noise


def _share_of_removed(trial: Trial, before: Trial, base: Trial) -> float:
    """What a further effect removes of the held-out error, over what the effects before it have removed (rms), of the
    output of which it is the most; infinite for the first one.

    What a form gets wrong is a share of what it does to each output: friction may turn the motor thousands of times
    farther than its encoder's noise, and the twist only a little.
    """
    return _share(before, base, _mean_squares(trial))


def _share(before: Trial, base: Trial, left: Float[np.ndarray, " outputs"]) -> float:
    """What it would take off the held-out error if so little (mean squares) were left, as in
    [`_share_of_removed`][]."""
    then, first = _mean_squares(before), _mean_squares(base)
    better = first > then
    if before is base or not np.any(better):
        return np.inf
    return float(np.sqrt(np.max(np.maximum(then - left, 0.0)[better] / (first - then)[better])))


def _mean_squares(trial: Trial) -> Float[np.ndarray, " outputs"]:
    """Of each output's held-out error."""
    return np.diag(np.asarray(trial.held_out.covariance))


def _has_a_strength(verdict: Verdict) -> bool:
    """Whether one of a competitor's strengths is told from zero; another hold has none to tell."""
    assert verdict.trial is not None
    own = {verdict.name} & {e.name for e in verdict.trial.model.effects}
    return told_from_zero(verdict.trial.training, own) == own


def told_from_zero(fit: Fit, names: Collection[str]) -> set[str]:
    """Those effects of a model of which the fit tells at least one strength from zero, of those that their name speaks
    of.

    With the effect's shape as fitted: where a strength is zero, its shape means nothing, and along a valley of shapes
    that explain the same (a creep's stiffness over its time) the strength may well be open.

    Args:
        fit: of the model.
        names: of effects to ask for.
    """
    if not names:
        return set()
    found = uncertainty(fit, torque_noise=False)
    return {name for name in names if _is_told(found, fit.model.effect(name))}


def _is_told(found: Uncertainty, effect: Effect) -> bool:
    paths, strengths = list(found.estimates), strength_paths(effect)
    shape = [paths.index(p) for p in effect_paths(effect) if p not in strengths]
    across = found.covariance[:, shape]
    explained = np.einsum("pi,ij,pj->p", across, np.linalg.pinv(across[shape], hermitian=True), across)
    total = np.diag(found.covariance)
    part = np.sqrt(np.clip(1.0 - explained / np.maximum(total, 1e-300), 0.0, 1.0))
    told = [f"{effect.name}.{n}" for n in effect.named_for] or strengths
    return any(_is_known(found.estimates[p], float(part[paths.index(p)]), effect) for p in told)


def _is_known(estimate: Estimate, part: float, effect: Effect) -> bool:
    """Whether a strength is told from zero at the level of the best of many, where only a part of its error is left."""
    info = dict(own_parameters(effect))[estimate.path.split(".")[1]]
    upper, widened = estimate.ci95[1], part * _BEST_OF_MANY / NORMAL_95
    if info.positive:
        return bool(widened * np.log(max(upper / estimate.value, 1.0)) < 1.0)
    return bool(widened * (upper - estimate.value) < abs(estimate.value))


def _supported_first(verdicts: list[Verdict], before: Trial, base: Trial) -> tuple[list[Verdict], bool]:
    """The list from its first supported competitor on, the unsupported ones behind it, unchanged where none is; and
    whether there is one."""
    for i, verdict in enumerate(verdicts):
        if verdict.trial is None or verdict.gain <= LEAST_GAIN:
            break
        if _supported(verdict, before, base):
            return [verdict, *verdicts[:i], *verdicts[i + 1 :]], True
    return verdicts, False


def _on_the_way(before: Trial, best: float, share: float) -> float:
    """The training objective of what gains a share of what the best one does; infinite where there is none yet."""
    return before.training.objective - share * (before.training.objective - best) if np.isfinite(best) else np.inf


def _reaches(trial: Trial | None, objective: float) -> bool:
    return trial is not None and trial.training.objective <= objective


def _segment_squares(held_out: Fit, weigh: Fit) -> np.ndarray:
    """Weighted squared error of each held-out segment."""
    white = np.asarray(held_out.error) @ np.asarray(weigh.problem.whitening).T
    weight = np.asarray(held_out.problem.segments.weight).sum(axis=1)
    return (white**2).sum(axis=(1, 2))[weight > 0]


def _with_separability(verdicts: list[Verdict]) -> list[Verdict]:
    """Mark the competitors whose held-out error can't be told from the best one's.

    A signed-rank test over segments (Wilcoxon, one-sided 5 %): a few segments in which a simulation runs away must not
    hide that it is worse in all the others.
    """
    best = verdicts[0].trial if verdicts else None
    if best is None:
        return verdicts
    reference = _segment_squares(best.held_out, best.held_out)
    marked = []
    for verdict in verdicts:
        separable = True
        if verdict.trial is not None:
            difference = _segment_squares(verdict.trial.held_out, best.held_out) - reference
            separable = bool(np.any(difference)) and _p_worse(difference) < 0.05
        marked.append(eqx.tree_at(lambda v: v.separable, verdict, separable))
    return marked


def _p_worse(difference: np.ndarray) -> float:
    """Chance of differences at least this positive where there are none."""
    # Loaded here: it takes as long as jax, and a plain fit does without.
    from scipy.stats import wilcoxon

    return float(np.asarray(wilcoxon(difference, alternative="greater"))[1])


def _simplest_first(verdicts: list[Verdict], before: Trial, data: Data, setting: Setting) -> list[Verdict]:
    """Among competitors that can't be told apart, one with plausible values and the fewest parameters leads, as long as
    it gains nearly as much in free runs along whole held-out stretches: short segments hide what adds up slowly, and
    let what an effect remembers start where it suits them."""
    best = verdicts[0].gain
    freely = _RIVAL_OF_MEMORY * best if _remembers_more(verdicts[0], before) else best
    least = (1.0 - _NEAR_TIE) * best - LEAST_GAIN
    near = [v for v in verdicts if v.trial is not None and (v.gain > freely or (not v.separable and v.gain > least))]
    if len(near) < 2:
        return verdicts
    trials = [v.trial for v in near if v.trial is not None]
    gains = long_gains(before, trials, data, setting) or [v.gain for v in near]
    least = max(gains) - max(LEAST_GAIN, _SAME_GAIN * max(gains))
    close = [v for v, gain in zip(near, gains, strict=True) if gain >= least]
    leader = min(close, key=lambda v: (_beyond_real_drives(v), _size(v), -v.gain))
    # Whole stretches have told it from one that only short segments preferred.
    if leader.separable:
        known, tied = ({v.name for v in some} for some in (near, close))
        apart = [v.name not in tied if v.name in known else v.separable for v in verdicts]
        verdicts = [eqx.tree_at(lambda v: v.separable, v, a) for v, a in zip(verdicts, apart, strict=True)]
    return sorted(verdicts, key=lambda v: v.name != leader.name)


def _remembers_more(verdict: Verdict, before: Trial) -> bool:
    """Whether a competitor has hidden states of its own."""
    assert verdict.trial is not None
    return len(verdict.trial.model.state_names) > len(before.model.state_names)


def _beyond_real_drives(verdict: Verdict) -> bool:
    """Whether a parameter of the effect is larger than real drives show; a reduced log's units are its own."""
    assert verdict.trial is not None
    model = verdict.trial.model
    if isinstance(model, ReducedModel):
        return False
    own = [known for path, known in model.parameters().items() if path.startswith(f"{verdict.name}.")]
    return any(info.implausibly_large(float(value)) for value, info in own)


def _size(verdict: Verdict) -> tuple[int, int]:
    """How many parameters a competitor has, and how many states."""
    assert verdict.trial is not None
    return len(verdict.trial.training.free.paths), len(verdict.trial.model.state_names)
