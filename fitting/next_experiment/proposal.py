"""The next experiment: a motor torque within limits that separates explanations which the logs do not.

The question is which of two models is right: tied explanations, or a small alpha against none. In addition to the
search's criterion, the usual fit gives the expected separation on the logs and on the proposal.
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
from fitting.estimation.experiment import Experiment, Stretch, whole
from fitting.estimation.free_parameters import fitted_paths
from fitting.estimation.problem import Segmentation, segment_length, typical_scales
from fitting.estimation.scales import scales
from fitting.estimation.segments import segment_count
from fitting.estimation.weighing import whitening
from fitting.next_experiment.command_search import Candidate, is_smooth, largest_twist, search
from fitting.next_experiment.discrimination import Bench, Explanation, Refit, Response, explanation, in_own_units
from fitting.next_experiment.excitation import Excitation, Limits, excitations, reached
from fitting.outcome import FitOnly, Loop, kept_rounds
from fitting.progress import Progress, silent
from fitting.uncertainty.normal_law import NORMAL_95
from hdjax import Hold, Model, TwoInertiaModel, sampled

MOST_SAMPLES = 20_000
"""Samples of the longest command that can be designed."""

# Samples of the longest command by default.
_USUAL_SAMPLES = 4096
# Log-likelihood ratio that is decisive.
_DECIDED = 1e3
# Number of rivals (the closest ones) of one experiment.
_MOST_RIVALS = 3
# Size of the alpha that is tested against none, as a share of the restoring torque at the largest twist of the usual
# commands; and the share of the noise in its search.
_CUBIC_SHARE, _QUIET = 0.01, 0.01
# Least share of a shape parameter's starting value.
_SHARPEST = 0.03


class Separation(eqx.Module):
    """Separation of the found explanation from a rival by experiments.

    Each number is the expected log-likelihood ratio, first if the found one is right, then if the rival is.

    Attributes:
        rival: the rival's form.
        family: its family.
        on_logs: on the fitted logs; None where a free run diverged.
        proposed: on the proposed experiment; None where the logs are decisive, or the rival has no derivatives.
        gathered: the two ratios by column, accumulated along the proposal by the search's criterion; None likewise.
    """

    rival: str = eqx.field(static=True)
    family: str = eqx.field(static=True)
    on_logs: tuple[float, float] | None
    proposed: tuple[float, float] | None
    gathered: Float[np.ndarray, "samples 2"] | None


class Precision(eqx.Module):
    """Precision of alpha in an experiment, under measurement noise alone.

    Attributes:
        fitted: its value in the fit.
        on_logs: standard error on the fitted logs.
        proposed: standard error on the proposed experiment, for a small alpha.
        gathered: accumulated share of the proposal's information about alpha.
        unit: of alpha.
    """

    fitted: float
    on_logs: float
    proposed: float
    gathered: Float[np.ndarray, " samples"]
    unit: str = eqx.field(static=True)

    @property
    def visible(self) -> float:
        """The smallest alpha that would be significantly nonzero in the proposal."""
        return NORMAL_95 * self.proposed


class NextExperiment(eqx.Module):
    """A proposed experiment.

    Attributes:
        time: of the samples [s].
        command: motor torque [N m], or the forcing of a reduced drive.
        limits: that it respects under each explanation.
        begins_like: the typical command from which the search started.
        found: name of the found explanation.
        motor_angle: of the motor at rest at the start [rad].
        dynamic_error: predicted by the found explanation [rad].
        motor_speed: likewise [rad/s]; None for a reduced drive.
        separations: of the found explanation from each rival; empty where alpha is the question.
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
    """Ties: pairs of a found effect and a rival that explains selection data about as well, the closest first."""
    names = {f.name for f in loop.findings}
    pairs = [
        (this.winner, verdict)
        for this in kept_rounds(loop)
        for verdict in this.verdicts
        if verdict.trial is not None and not verdict.separable and verdict.name not in names
    ]
    once = {verdict.name: (winner, verdict) for winner, verdict in reversed(pairs)}
    return tuple(sorted(once.values(), key=lambda pair: -pair[1].gain))[:_MOST_RIVALS]


def experiment_for_ties(
    loop: Loop, limits: Mapping[str, float] | None = None, *, progress: Progress = silent
) -> NextExperiment | None:
    """The experiment that separates a loop's effects from their ties.

    Args:
        loop: the outcome.
        limits: any of [`fitting.next_experiment.excitation.Limits`][] by name; missing ones are those reached in the
            logs.
        progress: receives messages.

    Returns:
        The experiment. None without ties, with a learned torque, or where no command respects the limits.
    """
    pairs = tied(loop)
    if not pairs or loop.unknown is not None:
        return None
    stretches = loop.stretches[0]
    own = loop.after.model
    found = _explanation(_name(loop), own, stretches, hold=loop.hold)
    rivals = [_rival(loop, *pair) for pair in pairs]
    bench = _bench(own, stretches, limits, noise=loop.noise, halo=loop.setting.halo, substeps=loop.after_substeps)
    progress("the next experiment: separation by the logs")
    judge = _Judge(bench, replace(loop.setting.segmentation, substeps=loop.after_substeps))
    told = [_on_logs(judge, found, r, pair) for r, pair in zip(rivals, pairs, strict=True)]
    starts = _starts(bench, own, stretches)
    smooth = [k for k, rival in enumerate(rivals) if is_smooth(rival, starts, bench)]
    if not smooth:
        return None
    # The logs may separate all rivals, though short segments of the loop did not; then all are kept.
    open_ones = [k for k in smooth if not is_decided(told[k])] or smooth
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


def is_decided(ratios: tuple[float, float] | None) -> bool:
    """Whether simulations as long as the logs separate two explanations, whichever is right."""
    return ratios is not None and min(ratios) > _DECIDED


def experiment_for_alpha(
    fitted: FitOnly,
    experiments: Sequence[Experiment],
    limits: Mapping[str, float] | None = None,
    *,
    progress: Progress = silent,
) -> NextExperiment | None:
    """The experiment that determines alpha best.

    Args:
        fitted: a fit.
        experiments: its logs.
        limits: see [`experiment_for_ties`][].
        progress: receives messages.

    Returns:
        The experiment; None where alpha is identifiable from the logs, or where no command respects the limits.
    """
    estimate = fitted.account.uncertainty.estimates.get("alpha")
    if estimate is None or estimate.identifiable:
        return None
    stretches = whole(experiments)
    paths = [p for p in fitted.account.uncertainty.estimates if p != "alpha"]
    without = explanation("no alpha", fitted.account.model.replace({"alpha": 0.0}), paths, hold=fitted.hold)
    # A small alpha, in the linear range, is tested with smaller noise; the effect of noise is proportional to it.
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
    """The final model with a rival in place of the effect that it is tied with."""
    trial = verdict.trial
    assert trial is not None
    model, stretches = _with_slopes(trial), trial.training.stretches
    others = [e for e in loop.after.model.effects if e.name not in {winner.name, *(o.name for o in model.effects)}]
    if others:
        # Found after the tied effect.
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
    """The fitted model, with vanishing shape parameters increased so that the motion has derivatives by them; friction
    that reverses abruptly has none."""
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
    """Settings of the next experiment: from rest at the first log's start, at the logs' mean temperature."""
    motor = stretches[0].experiment.motor_angle
    return Bench(
        motor_angle=0.0 if motor is None else float(motor[stretches[0].start]),
        noise=noise,
        limits=replace(reached(model, stretches, most_samples=_USUAL_SAMPLES), **(limits or {})),
        halo=halo,
        substeps=substeps,
        temperature=scales(stretches, model).temperature,
    )


def _starts(bench: Bench, model: Model, stretches: Sequence[Stretch]) -> tuple[Excitation, ...]:
    first = stretches[0]
    logged = np.asarray(first.experiment.torque.coefficients)[first.start : first.stop, 0]
    return excitations(bench.limits, model, logged=logged)


class _Judge(eqx.Module):
    """The fit that measures a rival's distance from another model's response, with compiled programs of the loop."""

    bench: Bench
    segmentation: Segmentation = eqx.field(static=True)

    def ratio(self, rival: Explanation, stretches: Sequence[Stretch]) -> float:
        """The expected log-likelihood ratio against a rival, with another model's outputs as measured ones."""
        found = self.fitted(rival, stretches)
        white = np.asarray(found.error) @ np.asarray(whitening(self.bench.noise)).T
        return 0.5 * float(np.sum(white**2))

    def fitted(self, model: Explanation, stretches: Sequence[Stretch], *, hold_parameters: bool = False) -> Fit:
        """A fit over horizons as long as the stretches, with the weights of the measurement noise."""
        # The loop's number of segments, if sufficient.
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
    """The expected ratios on the logs; None where a simulation diverges."""
    ratios = []
    sides = tuple(zip((found, rival), pair, strict=True))
    for (truth, of_truth), (other, of_other) in (sides, sides[::-1]):
        assert of_truth.trial is not None and of_other.trial is not None
        simulated = as_followed(judge.fitted(truth, of_truth.trial.training.stretches, hold_parameters=True))
        if not all(np.isfinite(s.experiment.measured).all() for s in simulated):
            return None
        # The other model may have another hold of the torque.
        logs = zip(of_other.trial.training.stretches, simulated, strict=True)
        ratios.append(judge.ratio(other, [_with_measured(s, made.experiment) for s, made in logs]))
    return ratios[0], ratios[1]


def _with_measured(stretch: Stretch, made: Experiment) -> Stretch:
    own = {"measured": made.measured, "weight": made.weight, "moved": made.moved}
    return replace(stretch, experiment=replace(stretch.experiment, **own))


def _on_proposal(
    judge: _Judge, best: Candidate, found: Explanation, rival: Explanation, of_rival: Response
) -> tuple[float, float]:
    """The expected ratios on the proposal."""
    of_found = best.evaluation.own[0]
    one = judge.ratio(rival, [_simulated(best.command, of_found, rival.hold, judge.bench)])
    return one, judge.ratio(found, [_simulated(best.command, of_rival, found.hold, judge.bench)])


def _simulated(command: Float[np.ndarray, " samples"], truth: Response, hold: Hold, bench: Bench) -> Stretch:
    """The proposal as a log of a model's response."""
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
    """Squared residual of a refit, accumulated up to each sample."""
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
        dynamic_error=own.twist,
        motor_speed=own.motion[:, 0] * bench.limits.speed if isinstance(found.model, TwoInertiaModel) else None,
        separations=separations,
        precision=precision,
    )
