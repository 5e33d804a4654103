"""The whole story: fit, look at what is left over, find the effect behind it, put it inside the equations, refit."""

from collections.abc import Callable, Mapping, Sequence

import jax.numpy as jnp

from fitting.attribution.candidate_fit import Data, Setting, Trial
from fitting.attribution.decisions import CaseEvidence, decide
from fitting.attribution.effect_evidence import evidence
from fitting.attribution.log_alignment import put_back, put_back_as, with_clocks_set
from fitting.attribution.selection_round import Round
from fitting.challenge import challenge_names
from fitting.clock import Clock
from fitting.compare import Account, account, excess, free_runs
from fitting.conclusion import Conclusion, draw_conclusion
from fitting.diagnostics import diagnose
from fitting.effect_search import Search, base_trial, refitted_without, search_effects
from fitting.experiment import Experiment, Stretch, split, whole
from fitting.free_run import rms_error
from fitting.long_fit import refitted_on_all
from fitting.outcome import Finding, Loop
from hdjax import Hold, Model
from hdjax.effects import CATALOGUE, Effect


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
    progress("finding starting values")
    base, setting, data = base_trial(model, {h: split(e) for h, e in experiments.items()}, hold)
    clock.lap("base fit")
    base, clocked = with_clocks_set(base, data, setting, progress=progress)
    late, data = put_back(data[base.hold][0], clocked[base.hold][0]), clocked
    clock.lap("clocks")
    seeds = {"seed": seed, "progress": progress}
    found = search_effects(base, data, setting, max_effects=max_effects, catalogue=catalogue, **seeds)
    clock.lap("attribution")
    challenge = challenge_names(base, found.named, data, setting, noise=found.noise, **seeds)
    clock.lap("unknown effects")
    end = draw_conclusion(base, challenge, data, setting, noise=found.noise, **seeds)
    clock.lap("final fit")
    case = CaseEvidence(tuple(this.evidence for this in found.rounds), challenge.seen, end.seen)
    progress("free runs")
    tests = put_back_as(late, {h: whole(e) for h, e in (test or {}).items()}, data[base.hold][0])
    before, after = _accounts(base, end, data, tests, setting)
    findings = _findings(base, found, end, after, data, setting)
    clock.lap("free runs")
    progress("asking the data for each effect")
    seen = evidence(end.final.training)
    clock.lap("evidence")
    trusted = {e.name for e in end.trusted.model.effects}
    return Loop(
        decision=end.outcome,
        checks=decide(case).checks,
        before=before,
        after=after,
        findings=findings,
        rounds=found.rounds,
        dropped=found.dropped,
        doubted=tuple(e.name for e in found.named.model.effects if e.name not in trusted),
        unknown=end.unknown,
        case=case,
        evidence=seen,
        noise=end.noise,
        noise_memory=None if end.slow is None else end.slow.memory(data[base.hold][0][0].experiment.time_step),
        torque_noise=None if end.torque is None else end.torque.std,
        left=tuple(map(float, excess(end.final.held_out, end.noise))),
        residual_before=diagnose(base.training),
        residual_after=diagnose(end.final.training),
        hold=end.final.hold,
        setting=setting,
        after_substeps=end.fitted.substeps,
        stretches=data[end.final.hold],
        surprise=end.seen.surprise,
        put_back=late,
        seconds=clock.laps,
    )


def _accounts(
    base: Trial, end: Conclusion, data: Data, tests: Mapping[Hold, tuple[Stretch, ...]], setting: Setting
) -> tuple[Account, Account]:
    """The base model's and the final model's, each fitted to the data that selected it as well; the same where nothing
    was found."""

    def accounted(trial: Trial, fitted, runs) -> Account:
        whole_fit = refitted_on_all(fitted, trial.held_out)
        test = tests.get(trial.hold, ())
        return account(whole_fit, data[trial.hold][0], test, selection=runs, noise=end.noise, halo=setting.halo)

    after = accounted(end.final, end.fitted, end.runs)
    if end.final is base:
        return after, after
    return accounted(base, base.training, end.runs_at_first), after


def _findings(
    base: Trial, found: Search, end: Conclusion, after: Account, data: Data, setting: Setting
) -> tuple[Finding, ...]:
    """The trusted effects with their final values, largest gain first; what was learned comes last."""

    def rmse_of(trial: Trial) -> float:
        if trial is base:
            return rms_error(end.runs_at_first)
        return rms_error(free_runs(trial.training, data[trial.hold][1], noise=end.noise, halo=setting.halo))

    without = found.without
    if end.trusted is not found.named:
        fallen = {e.name for e in found.named.model.effects} - {e.name for e in end.trusted.model.effects}
        kept = [] if end.trusted is base else [n for n in without if n not in fallen]
        finer = setting.with_steps_of(end.trusted.training)
        without = {n: base if len(kept) == 1 else refitted_without(n, end.trusted, base, data, finer) for n in kept}
    by_name = rms_error(end.runs) if end.unknown is None else rmse_of(end.trusted)
    rmse_without = {name: rmse_of(trial) for name, trial in without.items()}
    findings = _named_findings(found.rounds, after.model, by_name, rmse_without)
    if end.unknown is None:
        return findings
    effect = after.model.effect(end.unknown.chosen.form.name)
    gain = 1.0 - rms_error(end.runs) / by_name
    return (*findings, Finding(effect, effect.name, effect.family, gain, end.unknown.p_value))


def _named_findings(
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
