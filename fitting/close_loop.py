"""The whole story: fit, look at what is left over, find the effect behind it, put it inside the equations, refit."""

from collections.abc import Callable, Mapping, Sequence
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.attribution.candidate_fit import LEAST_GAIN, Data, Setting, Trial, attempt, gone_on, halo_for
from fitting.attribution.effect_evidence import Evidence, evidence
from fitting.attribution.log_alignment import put_back, put_back_as, with_clocks_set
from fitting.attribution.selection_round import Round, leaves_imperfection, look
from fitting.base_fit import base_fit, is_held
from fitting.clock import Clock
from fitting.compare import EXCESS, EXPLAINED, Account, account, excess, free_runs
from fitting.diagnostics import ResidualDiagnostics, diagnose
from fitting.doubt import what_is_unknown
from fitting.errors import DataError
from fitting.estimate import Fit, lost
from fitting.experiment import Experiment, Stretch, segment_count, split, whole
from fitting.free_run import FreeRun, rms_error
from fitting.long_fit import long_fit, refitted_on_all
from fitting.measurement_noise import MeasurementNoise, measurement_noise
from fitting.noise_memory import noise_with_memory
from fitting.outliers import with_weights
from fitting.posing import segment_length
from fitting.surprise import SURPRISED, surprise
from fitting.unknown import Unknown, learn_supported
from hdjax import Hold, Model
from hdjax.effects import CATALOGUE, Effect

Decision = Literal["effect_found", "model_sufficient", "unexplained"]

# Share of segments in which the base model may run away.
_MOST_LOST = 0.5


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
        before: the base model's account.
        after: the final model's account; the same where nothing was found.
        findings: supported effects, largest gain first; what was learned comes last.
        rounds: every look at the catalogue.
        dropped: effects that a later one made superfluous.
        doubted: effects that were found, but that a learned torque contradicts.
        unknown: what was learned, where the catalogue does not explain what is missing, or not all of it.
        evidence: what each effect of the final model does, and what the data say of it.
        noise: covariance of the measurement noise of the outputs.
        noise_memory: for how long [s] what is left over remembers itself, where it is more than short pieces tell of
            the noise and was taken for noise with a memory; None elsewhere.
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

    decision: Decision = eqx.field(static=True)
    before: Account
    after: Account
    findings: tuple[Finding, ...]
    rounds: tuple[Round, ...]
    dropped: tuple[str, ...] = eqx.field(static=True)
    doubted: tuple[str, ...] = eqx.field(static=True)
    unknown: Unknown | None
    evidence: tuple[Evidence, ...]
    noise: Float[Array, "outputs outputs"]
    noise_memory: float | None
    residual_before: ResidualDiagnostics
    residual_after: ResidualDiagnostics
    hold: Hold = eqx.field(static=True)
    setting: Setting
    after_substeps: int = eqx.field(static=True)
    stretches: tuple[tuple[Stretch, ...], tuple[Stretch, ...]]
    surprise: float | None
    put_back: tuple[float, ...] = eqx.field(static=True)
    seconds: dict[str, float]


def _silent(message: str) -> None:
    pass


def close_loop(
    model: Model,
    experiments: dict[Hold, tuple[Experiment, ...]],
    *,
    test: Mapping[Hold, tuple[Experiment, ...]] | None = None,
    hold: Hold | None = None,
    max_effects: int = 3,
    catalogue: Sequence[type[Effect]] = CATALOGUE,
    seed: int = 0,
    progress: Callable[[str], None] = _silent,
) -> Loop:
    """Close the loop between a model and the logs of one drive.

    Args:
        model: the base model; its stiffness and damping are only placeholders.
        experiments: the same logs under each assumption about the torque between samples. The end of each selects the
            model.
        test: likewise of data that only the final figures look at; where there are none, no figures are claimed.
        hold: the assumption that the user states; where None, the one that suits the base model best.
        max_effects: effects to add at most.
        catalogue: forms to look for.
        seed: of the surrogates behind the p-values.
        progress: told what is being done.

    Returns:
        The outcome.

    Raises:
        DataError: where no oscillator fits the data.
    """
    if jnp.zeros(0).dtype != jnp.float64:
        raise ValueError('fits need double precision: call jax.config.update("jax_enable_x64", True) first')
    clock = Clock()
    data: Data = {h: split(e) for h, e in experiments.items()}
    progress("finding starting values")

    base, setting, hold, data = _base_trial(model, data, hold)
    clock.lap("base fit")
    base, clocked = with_clocks_set(base, data, setting, progress=progress)
    late, data = put_back(data[hold][0], clocked[hold][0]), clocked
    clock.lap("clocks")
    named, rounds, dropped, without, seen_noise = _add_effects(
        base, data, setting, max_effects=max_effects, catalogue=catalogue, seed=seed, progress=progress
    )
    clock.lap("attribution")
    trusted, unknown = what_is_unknown(base, named, data, setting, noise=seen_noise, seed=seed, progress=progress)
    clock.lap("unknown effects")
    best = named if unknown is None else unknown.trial
    noise = seen_noise.and_beside(best.training).covariance
    decision = _decide(base, trusted, unknown, noise)
    slow = None
    if decision == "unexplained" and unknown is None:
        # Pieces of half a period take the slow part of noise with a memory for motion.
        slow = noise_with_memory(trusted.held_out)
        if slow is not None:
            noise = slow.covariance
            decision = "model_sufficient" if trusted is base else "effect_found"
    if decision == "effect_found" and np.max(excess(trusted.held_out, noise)) < EXCESS:
        # What the names leave is hardly more than noise.
        unknown = None
    current = trusted if unknown is None else unknown.trial
    progress("final fit over long horizons")
    long = long_fit(current.training)
    clock.lap("final fit")
    progress("free runs")

    def selection_runs(fitted: Fit, hold: Hold) -> tuple[FreeRun, ...]:
        return free_runs(fitted, data[hold][1], noise=noise, halo=setting.halo)

    then, now = selection_runs(base.training, base.hold), selection_runs(long, current.hold)
    surprised = None
    if decision == "effect_found":
        surprised = surprise(long, then, now, current.held_out, noise=noise, halo=setting.halo)
        if surprised is not None and surprised > SURPRISED:
            decision = "unexplained"
            # What follows over long times may be learned in the place of names that do not.
            instead = learn_supported(base, data, setting, seed=seed, progress=progress)
            if instead is not None:
                other = long_fit(instead.trial.training)
                runs = selection_runs(other, instead.trial.hold)
                if rms_error(runs) < rms_error(now):
                    trusted, unknown, current = base, instead, instead.trial
                    long, now, surprised = other, runs, None

    final = refitted_on_all(long, current.held_out)
    tests = put_back_as(late, {h: whole(e) for h, e in (test or {}).items()}, data[current.hold][0])

    def accounted(fitted: Fit, hold: Hold, runs: tuple[FreeRun, ...]) -> Account:
        return account(fitted, data[hold][0], tests.get(hold, ()), selection=runs, noise=noise, halo=setting.halo)

    after = accounted(final, current.hold, now)
    before = after
    if current is not base:
        before = accounted(refitted_on_all(base.training, base.held_out), base.hold, then)

    def rmse_of(trial: Trial) -> float:
        return rms_error(then if trial is base else selection_runs(trial.training, trial.hold))

    fallen = {e.name for e in named.model.effects} - {e.name for e in trusted.model.effects}
    by_name = rms_error(now) if unknown is None else rmse_of(trusted)
    if trusted is not named:
        kept = [] if trusted is base else [n for n in without if n not in fallen]
        finer = setting.with_steps_of(trusted.training)
        without = {n: base if len(kept) == 1 else _without(n, trusted, base, data, finer) for n in kept}
    rmse_without = {name: rmse_of(trial) for name, trial in without.items()}
    findings = _findings(rounds, after.model, by_name, rmse_without)
    if unknown is not None:
        findings = (*findings, _unknown_finding(unknown, after, by_name))
    clock.lap("free runs")
    progress("asking the data for each effect")
    seen = evidence(current.training)
    clock.lap("evidence")
    return Loop(
        decision=decision,
        before=before,
        after=after,
        findings=findings,
        rounds=rounds,
        dropped=dropped,
        doubted=tuple(e.name for e in named.model.effects if e.name in fallen),
        unknown=unknown,
        evidence=seen,
        noise=noise,
        noise_memory=None if slow is None else slow.memory(data[base.hold][0][0].experiment.time_step),
        residual_before=diagnose(base.training),
        residual_after=diagnose(current.training),
        hold=current.hold,
        setting=setting,
        after_substeps=final.substeps,
        stretches=data[current.hold],
        surprise=surprised,
        put_back=late,
        seconds=clock.laps,
    )


def _base_trial(model: Model, data: Data, hold: Hold | None) -> tuple[Trial, Setting, Hold, Data]:
    """The base model fitted under the stated hold, or under the one that suits it best, and the data without the
    samples that its fit does not believe."""
    first = hold if hold is not None else next(iter(data))
    training = data[first][0]
    halo = halo_for(training)
    best = base_fit(model, training, halo=halo)
    data = {h: (with_weights(t, best.stretches), v) for h, (t, v) in data.items()}
    count = segment_count(training, segment_length(best.horizon))
    setting = Setting(best.horizon, halo, best.substeps, count)
    holds: list[Hold] = list(data) if hold is None else [hold]
    trials = [attempt(best.model, data, h, setting, hold_parameters=is_held(best)) for h in holds]
    chosen = min(trials, key=lambda t: t.training.objective)
    finer = setting.fine_enough(chosen.training)
    if finer is not setting:
        chosen = attempt(chosen.model, data, chosen.hold, finer, start=chosen, hold_parameters=is_held(best))
        setting = finer
    if np.mean(lost(chosen.training)) > _MOST_LOST:
        raise DataError(
            "no stiffness and damping let the simulated drive follow the logs: it runs away; check the inertias in the "
            "drive file, and unit, sign and side of the torque column"
        )
    return chosen, setting, chosen.hold, data


def _add_effects(
    base: Trial,
    data: Data,
    setting: Setting,
    *,
    max_effects: int,
    catalogue: Sequence[type[Effect]],
    seed: int,
    progress: Callable[[str], None],
) -> tuple[Trial, tuple[Round, ...], tuple[str, ...], dict[str, Trial], MeasurementNoise]:
    """Add the best effect, refit, look again; then drop what a later effect has made superfluous.

    Returns the model, the rounds, the names of what was dropped, the model without each of what was kept, and the
    noise.
    """
    current, rounds = base, []
    noise = measurement_noise(base.training)
    found = 0
    while found < max_effects:
        if found:
            enough, noise = leaves_imperfection(current, base, noise)
            if enough:
                break
        this = look(
            current,
            data,
            setting,
            catalogue=catalogue,
            seed=seed + len(rounds),
            progress=progress,
            base=base,
        )
        if not this.accepted:
            rounds.append(this)
            break
        assert this.winner.trial is not None
        current = this.winner.trial
        found += 1
        setting = setting.with_steps_of(current.training)
        # What a trial has not quite reached the next look would take for a further effect.
        current = gone_on(current, data, setting)
        rounds.append(this)
        progress(f"found {this.winner.name}")
    dropped = _holds_given_up(rounds, base.hold, current.hold)
    without = {}
    for name in [e.name for e in current.model.effects][:-1]:
        poorer = _without(name, current, base, data, setting)
        if poorer.held_out.objective - current.held_out.objective < LEAST_GAIN:
            dropped.append(name)
            current, without = poorer, {}
        else:
            without[name] = poorer
    kept = [this for this in rounds if this.accepted and this.winner.name not in dropped]
    if kept and not dropped:
        without[kept[-1].winner.name] = kept[-1].before
    for name in (this.winner.name for this in kept if this.winner.name not in without):
        without[name] = base if len(kept) == 1 else _without(name, current, base, data, setting)
    return current, tuple(rounds), tuple(dropped), without, noise


def _holds_given_up(rounds: Sequence[Round], first: Hold, last: Hold) -> list[str]:
    """Findings of another hold of the torque that a later one has taken back."""
    holds = [
        this for this in rounds if this.accepted and this.winner.trial and this.winner.trial.hold != this.before.hold
    ]
    return [this.winner.name for this in holds if last == first or this is not holds[-1]]


def _without(name: str, current: Trial, base: Trial, data: Data, setting: Setting) -> Trial:
    """The model refitted without one of its effects, or under the base model's hold where that is the effect."""
    if name in {e.name for e in current.model.effects}:
        return attempt(current.model.without_effect(name), data, current.hold, setting, start=current)
    return attempt(current.model, data, base.hold, setting, start=current)


def _decide(base: Trial, trusted: Trial, unknown: Unknown | None, noise: Float[Array, "outputs outputs"]) -> Decision:
    left = excess(trusted.held_out, noise)
    if trusted is base:
        return "model_sufficient" if unknown is None and np.max(left) < EXCESS else "unexplained"
    at_first = excess(base.held_out, noise)
    explained = 1.0 - (left**2 - 1.0) / np.maximum(at_first**2 - 1.0, 1e-12)
    misfit = np.argmax(at_first)
    if left[misfit] < EXCESS or explained[misfit] >= EXPLAINED:
        return "effect_found"
    return "unexplained"


def _findings(
    rounds: Sequence[Round], final: Model, rmse: float, rmse_without: Mapping[str, float]
) -> tuple[Finding, ...]:
    """The accepted effects with their final values.

    Args:
        rounds: every look at the catalogue.
        final: the final model.
        rmse: error of its free runs on selection data.
        rmse_without: likewise without each effect; those that were not kept are not in it.
    """
    effects = {e.name: e for e in final.effects}
    found = [
        Finding(effects.get(w.name), w.name, w.family, 1.0 - rmse / rmse_without[w.name], w.p_value)
        for w in (this.winner for this in rounds if this.accepted)
        if w.name in rmse_without
    ]
    return tuple(sorted(found, key=lambda f: -f.gain))


def _unknown_finding(unknown: Unknown, after: Account, by_name: float) -> Finding:
    """The learned function, with what the error on selection data is without it."""
    effect = after.model.effect(unknown.chosen.form.name)
    return Finding(effect, effect.name, effect.family, 1.0 - rms_error(after.selection) / by_name, unknown.p_value)
