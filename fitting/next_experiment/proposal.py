"""The next experiment: the motor torque that tells apart, within limits, what the logs could not.

Tied explanations, or a drive with a small alpha against one without: both ask which of two models is right. Beside the
search's own criterion, the fit that real logs get says how far apart the two would be on the logs and on the proposal.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Array, Float

from fitting.attribution.candidate_fit import Trial
from fitting.attribution.selection_round import Verdict
from fitting.estimation.base_fit import as_followed
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.experiment import Experiment, Stretch, segment_count, whole
from fitting.estimation.free_parameters import fitted_paths
from fitting.estimation.problem import Segmentation, segment_length, typical_scales
from fitting.estimation.scales import scales
from fitting.estimation.weighing import whitening
from fitting.fit_drive import FitOnly
from fitting.next_experiment.command_search import Candidate, is_smooth, largest_twist, search
from fitting.next_experiment.discrimination import Bench, Explanation, Refit, Response, explanation, in_own_units
from fitting.next_experiment.excitation import Excitation, Limits, excitations, reached
from fitting.outcome import Loop
from fitting.progress import Progress, silent
from fitting.uncertainty.normal_law import NORMAL_95
from hdjax import Hold, Model, TwoInertiaModel, sampled

MOST_SAMPLES = 20_000
"""Longest command that can be designed."""

# Longest one where the user does not ask for more.
_USUAL_SAMPLES = 4096
# A log-likelihood ratio that leaves no doubt, whatever else the logs hold.
_DECIDED = 1e3
# Rivals that are told apart at once, the closest ones.
_MOST_RIVALS = 3
# The alpha against none: this share of the restoring torque at the largest twist of the usual commands; and the share
# of the noise against which it is sought.
_CUBIC_SHARE, _QUIET = 0.01, 0.01
# A shape parameter is not left below this share of where its fit began.
_SHARPEST = 0.03


class Separation(eqx.Module):
    """How far experiments tell the found explanation from a rival.

    Each number is the log-likelihood ratio to be expected, first where the found one is right, then where the rival is.

    Attributes:
        rival: the rival's form.
        family: its family.
        on_logs: on the logs that were fitted; None where a free run along them diverged.
        proposed: on the proposed experiment; None where the logs have decided, or where the rival has no derivatives.
        gathered: the same two by column as they grow along the proposal, as the search has it; None likewise.
    """

    rival: str = eqx.field(static=True)
    family: str = eqx.field(static=True)
    on_logs: tuple[float, float] | None
    proposed: tuple[float, float] | None
    gathered: Float[np.ndarray, "samples 2"] | None


class Precision(eqx.Module):
    """How well an experiment knows alpha, as far as measurement noise decides.

    Attributes:
        fitted: its value in the fit.
        on_logs: standard error on the logs that were fitted.
        proposed: likewise on the proposed experiment, of an alpha that is small.
        gathered: share of what the proposal knows of alpha, as it grows along it.
        unit: of alpha.
    """

    fitted: float
    on_logs: float
    proposed: float
    gathered: Float[np.ndarray, " samples"]
    unit: str = eqx.field(static=True)

    @property
    def visible(self) -> float:
        """The smallest alpha that the proposal tells from zero."""
        return NORMAL_95 * self.proposed


class NextExperiment(eqx.Module):
    """A proposed experiment.

    Attributes:
        time: of the samples [s].
        command: motor torque [N m], or the forcing of a reduced drive.
        limits: that it keeps under each explanation.
        begins_like: the usual command from which the search came.
        found: name of the explanation that was found.
        motor_angle: where the motor rests at the start [rad].
        dynamic_error: that the found explanation predicts [rad].
        motor_speed: likewise [rad/s]; None for a reduced drive.
        separations: of the found explanation from each rival; none where alpha is the question.
        precision: of alpha, where that is the question.
    """

    time: Float[np.ndarray, " samples"]
    command: Float[np.ndarray, " samples"]
    limits: Limits
    begins_like: str = eqx.field(static=True)
    found: str = eqx.field(static=True)
    motor_angle: float
    dynamic_error: Float[np.ndarray, " samples"]
    motor_speed: Float[np.ndarray, " samples"] | None
    separations: tuple[Separation, ...]
    precision: Precision | None


def tied(loop: Loop) -> tuple[tuple[Verdict, Verdict], ...]:
    """What explains selection data about as well as what was found: pairs of found and rival, the closest first."""
    names = {f.name for f in loop.findings}
    pairs = [
        (this.winner, verdict)
        for this in loop.rounds
        if this.accepted and this.winner.name in names
        for verdict in this.verdicts
        if verdict.trial is not None and not verdict.separable and verdict.name not in names
    ]
    once = {verdict.name: (winner, verdict) for winner, verdict in reversed(pairs)}
    return tuple(sorted(once.values(), key=lambda pair: -pair[1].gain))[:_MOST_RIVALS]


def experiment_for_ties(
    loop: Loop, limits: Mapping[str, float] | None = None, *, progress: Progress = silent
) -> NextExperiment | None:
    """The experiment that tells what a loop found from what is tied with it.

    Args:
        loop: the outcome.
        limits: any of [`fitting.next_experiment.excitation.Limits`][] by name; what is missing is what the logs have
            reached.
        progress: told what is being done.

    Returns:
        The experiment. None where nothing is tied, where a learned torque stands for what is missing, or where no
        command keeps the limits.
    """
    pairs = tied(loop)
    if not pairs or loop.unknown is not None:
        return None
    stretches = loop.stretches[0]
    own = loop.after.model
    found = _explanation(_name(loop), own, stretches, hold=loop.hold)
    rivals = [_rival(loop, *pair) for pair in pairs]
    bench = _bench(own, stretches, limits, noise=loop.noise, halo=loop.setting.halo, substeps=loop.after_substeps)
    progress("the next experiment: what the logs can tell")
    judge = _Judge(bench, replace(loop.setting.segmentation, substeps=loop.after_substeps))
    told = [_on_logs(judge, found, r, pair) for r, pair in zip(rivals, pairs, strict=True)]
    starts = _starts(bench, own, stretches)
    smooth = [k for k, rival in enumerate(rivals) if is_smooth(rival, starts, bench)]
    if not smooth:
        return None
    # Where the logs have decided all, short segments by which a loop judges have missed it; then all are still asked.
    open_ones = [k for k in smooth if not _is_decided(told[k])] or smooth
    best = search([found, *(rivals[k] for k in open_ones)], starts, bench, progress=progress)
    if best is None:
        return None
    made = []
    for k, ((_, verdict), ratios) in enumerate(zip(pairs, told, strict=True)):
        proposed, gathered = None, None
        if k in open_ones:
            place = open_ones.index(k)
            proposed = _on_proposal(judge, best, found, rivals[k], best.evaluation.own[place + 1])
            both = best.evaluation.forward[place], best.evaluation.backward[place]
            gathered = np.stack([0.5 * _gathered(side, best) for side in both], axis=1)
        made.append(Separation(verdict.name, verdict.family, ratios, proposed, gathered))
    return _proposal(best, bench, found, separations=tuple(made))


def _is_decided(ratios: tuple[float, float] | None) -> bool:
    """Whether simulations as long as the logs tell two explanations apart, whichever is right."""
    return ratios is not None and min(ratios) > _DECIDED


def experiment_for_alpha(
    fitted: FitOnly,
    experiments: Sequence[Experiment],
    limits: Mapping[str, float] | None = None,
    *,
    progress: Progress = silent,
) -> NextExperiment | None:
    """The experiment that knows alpha best.

    Args:
        fitted: a fit.
        experiments: its logs.
        limits: see [`experiment_for_ties`][].
        progress: told what is being done.

    Returns:
        The experiment; None where alpha is identifiable from the logs, or where no command keeps the limits.
    """
    estimate = fitted.account.uncertainty.estimates.get("alpha")
    if estimate is None or estimate.identifiable:
        return None
    stretches = whole(experiments)
    paths = [p for p in fitted.account.uncertainty.estimates if p != "alpha"]
    without = explanation("no alpha", fitted.account.model.replace({"alpha": 0.0}), paths, hold=fitted.hold)
    # An alpha so small that its square does not count shows against less noise; what noise does is in proportion to it.
    quiet = fitted.noise * _QUIET**2
    bench = _bench(without.model, stretches, limits, noise=quiet, halo=0, substeps=fitted.goodness.substeps)
    starts = _starts(bench, without.model, stretches)
    size = _CUBIC_SHARE / largest_twist(without, starts, bench) ** 2
    small = explanation("a small alpha", without.model.replace({"alpha": size}), paths, hold=fitted.hold)
    best = search([small, without], starts, bench, both_ways=False, progress=progress)
    if best is None or not best.evaluation.forward[0].squares > 0:
        return None
    seen = best.evaluation.forward[0]
    std = size / (_QUIET * np.sqrt(seen.squares))
    precision = Precision(
        fitted=estimate.value,
        on_logs=estimate.std_classical,
        proposed=std,
        gathered=_gathered(seen, best) / seen.squares,
        unit=estimate.unit,
    )
    return _proposal(best, bench, small, precision=precision)


def _name(loop: Loop) -> str:
    return " and ".join(f.name for f in loop.findings)


def _explanation(name: str, model: Model, stretches: Sequence[Stretch], *, hold: Hold) -> Explanation:
    return explanation(name, model, fitted_paths(model), scale=typical_scales(model, stretches), hold=hold)


def _rival(loop: Loop, winner: Verdict, verdict: Verdict) -> Explanation:
    """The final model with a rival in the place of what it is tied with."""
    trial = verdict.trial
    assert trial is not None
    model, stretches = _with_slopes(trial), trial.training.stretches
    others = [e for e in loop.after.model.effects if e.name not in {winner.name, *(o.name for o in model.effects)}]
    if others:
        # Found later, beside what is tied.
        training = trial.training
        model = fit(
            model.with_effects(*others),
            stretches,
            fitted_paths(model.with_effects(*others)),
            replace(loop.setting.segmentation, substeps=loop.after_substeps),
            start=Start(training.covariance),
        ).model
    return _explanation(verdict.name, model, stretches, hold=trial.hold)


def _with_slopes(trial: Trial) -> Model:
    """The fitted model, whose shapes that ran to zero are put where a motion still has derivatives by them: friction
    that turns within no time has none."""
    begun, model = trial.training.problem.model, trial.model
    known = model.parameters()
    least = {p: _SHARPEST * float(begun.get(p)) for p in fitted_paths(model) if known[p][1].role == "shape"}
    return model.replace({p: s for p, s in least.items() if known[p][1].positive and float(model.get(p)) < s})


def _bench(
    model: Model,
    stretches: Sequence[Stretch],
    limits: Mapping[str, float] | None,
    *,
    noise: Float[Array, "outputs outputs"],
    halo: int,
    substeps: int,
) -> Bench:
    """How the next experiment is simulated: from rest where the first log started, in the logs' mean temperature."""
    motor = stretches[0].experiment.motor_angle
    return Bench(
        motor_angle=0.0 if motor is None else float(motor[stretches[0].start]),
        noise=noise,
        limits=replace(reached(stretches, most_samples=_USUAL_SAMPLES), **(limits or {})),
        halo=halo,
        substeps=substeps,
        temperature=scales(stretches, model).temperature,
    )


def _starts(bench: Bench, model: Model, stretches: Sequence[Stretch]) -> tuple[Excitation, ...]:
    first = stretches[0]
    logged = np.asarray(first.experiment.torque.coefficients)[first.start : first.stop, 0]
    return excitations(bench.limits, model, logged=logged)


class _Judge(eqx.Module):
    """The fit that tells how far a rival stays from what another model makes, by programs that the loop has used."""

    bench: Bench
    segmentation: Segmentation = eqx.field(static=True)

    def ratio(self, rival: Explanation, stretches: Sequence[Stretch]) -> float:
        """The log-likelihood ratio to be expected against a rival, where the measured outputs are another model's."""
        found = self.fitted(rival, stretches)
        white = np.asarray(found.error) @ np.asarray(whitening(self.bench.noise)).T
        return 0.5 * float(np.sum(white**2))

    def fitted(self, model: Explanation, stretches: Sequence[Stretch], *, hold_parameters: bool = False) -> Fit:
        """A fit of simulations as long as the stretches, under the weights of the measurement noise."""
        # As many segments as the loop's where these are enough.
        own, horizon = self.segmentation, max(len(s) for s in stretches)
        count = max(own.count or 0, segment_count(stretches, own.length or segment_length(own.horizon)))
        return fit(
            model.model,
            stretches,
            model.free.paths,
            replace(own, horizon=horizon, count=count),
            start=Start(self.bench.noise),
            strategy=Strategy(reweigh=False, hold_parameters=hold_parameters),
        )


def _on_logs(
    judge: _Judge, found: Explanation, rival: Explanation, pair: tuple[Verdict, Verdict]
) -> tuple[float, float] | None:
    """The ratios to be expected of the logs; None where a simulation along them leaves the numbers."""
    ratios = []
    sides = tuple(zip((found, rival), pair, strict=True))
    for (truth, of_truth), (other, of_other) in (sides, sides[::-1]):
        assert of_truth.trial is not None and of_other.trial is not None
        simulated = as_followed(judge.fitted(truth, of_truth.trial.training.stretches, hold_parameters=True))
        if not all(np.isfinite(s.experiment.measured).all() for s in simulated):
            return None
        # The other model may see the torque under another hold.
        logs = zip(of_other.trial.training.stretches, simulated, strict=True)
        ratios.append(judge.ratio(other, [_with_measured(s, made.experiment.measured) for s, made in logs]))
    return ratios[0], ratios[1]


def _with_measured(stretch: Stretch, measured: Float[np.ndarray, "samples outputs"]) -> Stretch:
    return replace(stretch, experiment=replace(stretch.experiment, measured=measured))


def _on_proposal(
    judge: _Judge, best: Candidate, found: Explanation, rival: Explanation, of_rival: Response
) -> tuple[float, float]:
    """The ratios to be expected of the proposal."""
    of_found = best.evaluation.own[0]
    one = judge.ratio(rival, [_simulated(best.command, of_found, rival.hold, judge.bench)])
    return one, judge.ratio(found, [_simulated(best.command, of_rival, found.hold, judge.bench)])


def _simulated(command: Float[np.ndarray, " samples"], truth: Response, hold: Hold, bench: Bench) -> Stretch:
    """The proposal as a log of what a model makes of it."""
    time = np.arange(command.size) * bench.limits.time_step
    outputs = in_own_units(truth.outputs, bench)
    warm = None if bench.temperature is None else sampled(time, np.full(time.size, bench.temperature), hold="linear")
    experiment = Experiment(
        name="the next experiment",
        time=time,
        torque=sampled(time, command, hold=hold),
        load_torque=None,
        measured=outputs,
        motor_angle=None,
        temperature=warm,
    )
    return Stretch(experiment, 0, time.size)


def _gathered(of: Refit, best: Candidate) -> Float[np.ndarray, " samples"]:
    """What stays after a refit, squared and summed up to each sample."""
    return np.cumsum(np.sum(of.left.reshape(best.command.size, -1) ** 2, axis=1))


def _proposal(
    best: Candidate,
    bench: Bench,
    found: Explanation,
    *,
    separations: tuple[Separation, ...] = (),
    precision: Precision | None = None,
) -> NextExperiment:
    own = best.evaluation.own[0]
    return NextExperiment(
        time=np.arange(best.command.size) * bench.limits.time_step,
        command=best.command,
        limits=bench.limits,
        begins_like=best.excitation.name,
        found=found.name,
        motor_angle=bench.motor_angle,
        dynamic_error=in_own_units(own.outputs, bench)[:, -1],
        motor_speed=own.motion[:, 0] * bench.limits.speed if isinstance(found.model, TwoInertiaModel) else None,
        separations=separations,
        precision=precision,
    )
