"""The closed loop: fit, attribute the residual to an effect, add it to the equations, refit."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import equinox as eqx
import numpy as np

from fitting.attribution.candidate_fit import Trial
from fitting.attribution.case_evidence import CaseEvidence
from fitting.attribution.decisions import decide
from fitting.attribution.effect_evidence import evidence
from fitting.attribution.effect_search import Search, base_trial, refitted_without, search_effects
from fitting.attribution.log_alignment import clock_shifts, with_clock_shifts, with_clocks_set
from fitting.attribution.selection_round import Round
from fitting.attribution.study import Study
from fitting.attribution.support import noise_of_torque
from fitting.blas import one_blas_thread
from fitting.clock import Clock
from fitting.conclusion import Conclusion, draw_conclusion
from fitting.discrepancy.challenge import Challenge, challenge_names
from fitting.estimation.base_fit import need_double_precision
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Experiment, Stretch, split, whole
from fitting.estimation.free_run import FreeRun, rms_error
from fitting.estimation.recalibration import recalibrated
from fitting.estimation.whole_log_fit import refitted_on_all
from fitting.one_side_check import source_of
from fitting.outcome import Finding, Loop
from fitting.progress import Progress, silent
from fitting.search_options import SearchOptions
from fitting.uncertainty.measurement_noise import excess
from fitting.uncertainty.one_side import without_mesh_priors
from fitting.validation.account import Account, account, free_runs, of_parameters
from fitting.validation.residual_diagnostics import diagnose
from hdjax import Hold, Model
from hdjax.effects import CATALOGUE, Effect


@one_blas_thread
def close_loop(
    model: Model,
    experiments: dict[Hold, tuple[Experiment, ...]],
    *,
    test: Mapping[Hold, tuple[Experiment, ...]] | None = None,
    hold: Hold | None = None,
    catalogue: Sequence[type[Effect]] = CATALOGUE,
    search: SearchOptions = SearchOptions(),
    progress: Progress = silent,
) -> Loop:
    """Close the loop between a model and the logs of one drive.

    Args:
        model: the base model; its stiffness and damping are only placeholders.
        experiments: the same logs under each hold of the torque. The end of each is selection data.
        test: the same of test data, which only the final figures use; without them there are no test figures.
        hold: the stated hold; the best one for the base model if None.
        catalogue: candidate forms.
        search: settings of the search.
        progress: receives messages.

    Returns:
        The outcome.

    Raises:
        DataError: no oscillator fits the data.
    """
    need_double_precision()
    clock = Clock()
    progress("computing starting values")
    base, read = base_trial(model, {h: split(e) for h, e in experiments.items()}, hold)
    if (again := recalibrated(base.training, experiments, test or {})) is not None:
        experiments, test = again
        base, read = base_trial(model, {h: split(e) for h, e in experiments.items()}, hold)
    setting = replace(read.setting, thorough=search.thorough)
    read = replace(read, setting=setting, seed=search.seed, progress=progress)
    clock.lap("base fit")
    base, study = with_clocks_set(base, read)
    fitted = study.data[base.hold][0]
    late = clock_shifts(read.data[base.hold][0], fitted)
    clock.lap("clocks")
    found = search_effects(base, study, max_effects=search.max_effects, catalogue=catalogue, hold=hold)
    clock.lap("attribution")
    challenge = challenge_names(base, found.named, study, noise=found.noise)
    clock.lap("unknown effects")
    end = draw_conclusion(base, challenge, study, noise=found.noise)
    clock.lap("final fit")
    progress("free runs")
    tests = with_clock_shifts(late, {h: whole(e) for h, e in (test or {}).items()}, fitted)
    return _Closed(base, study, found, challenge, end).told(tests, late, clock)


@dataclass(frozen=True)
class _Closed:
    """Results of the stages."""

    base: Trial
    study: Study
    found: Search
    challenge: Challenge
    end: Conclusion

    def told(self, tests: Mapping[Hold, tuple[Stretch, ...]], late: tuple[float, ...], clock: Clock) -> Loop:
        """The outcome with all diagnostics."""
        end, found, base, final = self.end, self.found, self.base, self.end.final
        case = CaseEvidence(tuple(this.evidence for this in found.rounds), self.challenge.seen, end.seen)
        before, after = self._accounts(tests)
        findings = self._findings(after)
        clock.lap("free runs")
        seen = evidence(final.training)
        clock.lap("evidence")
        trusted = {e.name for e in end.trusted.model.effects}
        time_step = self.study.data[base.hold][0][0].experiment.time_step
        return Loop(
            decision=end.outcome,
            checks=decide(case).checks,
            before=before,
            after=after,
            findings=findings,
            rounds=found.rounds,
            compared=found.compared,
            dropped=found.dropped,
            doubted=tuple(e.name for e in found.named.model.effects if e.name not in trusted),
            unknown=end.unknown,
            tied=self.challenge.tied if end.outcome == "effect_found" and end.unknown is None else None,
            case=case,
            evidence=seen,
            noise=end.noise,
            noise_memory=None if end.left is None else end.left.sensors.memory(time_step),
            torque_noise=noise_of_torque(end.left),
            left=tuple(map(float, excess(final.held_out, end.noise))),
            residual_before=diagnose(base.training),
            residual_after=diagnose(final.training),
            hold=final.hold,
            setting=self.study.setting,
            after_substeps=end.fitted.substeps,
            stretches=self.study.data[final.hold],
            surprise=None if end.seen.replaced else end.seen.surprise,
            parameters_from=source_of(end.side),
            put_back=late,
            seconds=clock.laps,
            limited=found.limited,
        )

    def _accounts(self, tests: Mapping[Hold, tuple[Stretch, ...]]) -> tuple[Account, Account]:
        """Accounts of the base model and the final model, each refitted to training and selection data; equal where
        nothing was found."""
        end = self.end

        def accounted(trial: Trial, fitted: Fit, runs: tuple[FreeRun, ...], side: Fit | None = None) -> Account:
            fitted = eqx.tree_at(lambda f: f.model, fitted, without_mesh_priors(fitted.model))
            both, test = refitted_on_all(fitted, trial.held_out), tests.get(trial.hold, ())
            training, halo = self.study.data[trial.hold][0], self.study.setting.halo
            known = of_parameters(both, drive_from=side)
            return account(both, training, test, noise=end.noise, halo=halo, selection=runs, known=known)

        after = accounted(end.final, end.fitted, end.runs, end.side)
        if end.final is self.base:
            return after, after
        return accounted(self.base, self.base.training, end.runs_at_first, self.study.side), after

    def _findings(self, after: Account) -> tuple[Finding, ...]:
        """The accepted effects with their final values, largest gain first; a learned term comes last."""
        end = self.end
        by_name = self._rmse(end.trusted)
        rmse_without = {name: self._rmse(trial) for name, trial in self._without().items()}
        findings = _named_findings(self.found.rounds, after.model, by_name, rmse_without)
        if end.unknown is None:
            return findings
        effect = after.model.effect(end.unknown.chosen.form.name)
        gain = _gain(self._rmse(end.final), by_name)
        return (*findings, Finding(effect, effect.name, effect.family, gain, end.unknown.p_value))

    def _without(self) -> dict[str, Trial]:
        """The accepted model without each of its effects."""
        base, named, trusted, without = self.base, self.found.named, self.end.trusted, self.found.without
        if trusted is named:
            return without
        fallen = {e.name for e in named.model.effects} - {e.name for e in trusted.model.effects}
        kept = [] if trusted is base else [name for name in without if name not in fallen]
        if len(kept) == 1 and trusted.hold == base.hold:
            return {kept[0]: base}
        return {name: refitted_without([name], trusted, base, self.study) for name in kept}

    def _rmse(self, trial: Trial) -> float:
        """Rms error of a model's free runs along selection data."""
        if trial is self.base:
            return rms_error(self.end.runs_at_first)
        stretches, halo = self.study.data[trial.hold][1], self.study.setting.halo
        return rms_error(free_runs(trial.training, stretches, noise=self.end.noise, halo=halo))


def _named_findings(
    rounds: Sequence[Round], final: Model, rmse: float, rmse_without: Mapping[str, float]
) -> tuple[Finding, ...]:
    """The accepted effects with their final values.

    Args:
        rounds: of the search.
        final: the final model.
        rmse: error of its free runs on selection data.
        rmse_without: the same without each effect that was kept.
    """
    effects = {e.name: e for e in final.effects}
    # A form that was dropped may be accepted again: its last round counts.
    winners = {this.winner.name: this.winner for this in rounds if this.accepted}
    found = [
        Finding(effects.get(name), name, w.family, _gain(rmse, rmse_without[name]), w.p_value)
        for name, w in winners.items()
        if name in rmse_without
    ]
    return tuple(sorted(found, key=lambda f: (np.isnan(f.gain), -f.gain)))


def _gain(rmse: float, without: float) -> float:
    """Share of an error that an effect removes; NaN where free runs diverge with it."""
    return 1.0 - rmse / without if np.isfinite(rmse) else np.nan
