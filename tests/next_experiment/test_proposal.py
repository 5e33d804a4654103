"""The proposed experiment: its predicted separation against refits of noisy data, its gradient against finite
differences, and its limits in simulation."""

import csv
import dataclasses
import io
from pathlib import Path

import jax.numpy as jnp
import numpy as np
import plotly.graph_objects as go
import pytest

import rig
from fitting.estimation.estimate import Start, Strategy, fit
from fitting.estimation.experiment import Experiment, Stretch, experiment_from_log, split
from fitting.estimation.problem import Segmentation
from fitting.fit_drive import fit_only
from fitting.loop import close_loop
from fitting.next_experiment import command_search, discrimination
from fitting.next_experiment.command_search import Candidate, search
from fitting.next_experiment.discrimination import Bench, Explanation, explanation, refit, respond, signals, start
from fitting.next_experiment.excitation import Limits, excitations, reached
from fitting.next_experiment.proposal import (
    NextExperiment,
    Precision,
    Separation,
    experiment_for_alpha,
    experiment_for_ties,
    tied,
)
from fitting.report import Report
from fitting.report.plots import next_experiment_plot
from fitting.report.proposal import command_table, proposal_dict
from fitting.search_options import SearchOptions
from fitting.uncertainty.standard_errors import uncertainty
from hdjax import Hold, sampled, simulate
from hdjax.effects.friction import MotorFriction, StribeckMotorFriction

NOISE = jnp.diag(jnp.asarray([(rig.MOTOR_NOISE / rig.N) ** 2, 9 * rig.LOAD_NOISE**2]))
NOISE_STD = np.sqrt(np.diag(np.asarray(NOISE)))
LIMITS = Limits(torque=0.5, speed=30.0, travel=0.3, twist=np.inf, duration=0.4, time_step=rig.STEP)
BENCH = Bench(0.0, NOISE, LIMITS, halo=2, substeps=2, temperature=None)
_DRAWS = 16
PATHS = ("K", "alpha", "B_sp")


def with_friction(name: str, excess: float) -> Explanation:
    """A drive with motor friction and a fixed excess near standstill; both models share one compiled program."""
    own = StribeckMotorFriction(T_c=0.01, T_excess=excess, b=0.0, transition=1.0, omega_s=4.0)
    model = rig.drive_model().with_effects(own)
    return explanation(name, model, (*PATHS, "stribeck_motor_friction.T_c"), hold="zero-order")


@pytest.fixture(scope="module")
def rivals() -> tuple[Explanation, Explanation]:
    return with_friction("coulomb", 0.0), with_friction("stribeck", 5e-6)


@pytest.fixture(scope="module")
def proposal(rivals: tuple[Explanation, Explanation]) -> Candidate:
    """The command found from a standard excitation in a few iterations."""
    start, *_ = (e for e in excitations(LIMITS, rivals[0].model, logged=np.zeros(10)) if "triangle" in e.name)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(command_search, "_ITERATIONS", 6)
        found = search(rivals, [start], BENCH, progress=lambda message: None)
    assert found is not None
    return found


def test_limits_are_the_largest_values_of_the_log():
    experiment = rig.drive_experiment(1000)
    training, _ = split([experiment])
    found = reached(rig.drive_model(), training, most_samples=600)
    motion = rig.drive_motion(rig.drive_torque(1000))[:800]
    assert found.torque == np.max(np.abs(rig.drive_torque(1000)[:800]))
    assert found.speed == pytest.approx(np.max(np.abs(motion[:, 2])), rel=0.1)
    assert found.travel == pytest.approx(np.max(np.abs(motion[:, 0])) / rig.N, rel=1e-3)
    assert found.samples == 600 and found.time_step == pytest.approx(rig.STEP)


def test_reduced_log_limits_only_the_forcing():
    stretch = Stretch(rig.reduced_experiment(300), 0, 300)
    found = reached(rig.drive_model(), [stretch], most_samples=1000)
    assert np.isinf([found.speed, found.travel]).all()
    (first, *_) = excitations(found, rig.reduced_model(), logged=np.zeros(10))
    assert np.max(np.abs(first.command(first.coefficients))) == pytest.approx(0.98 * found.torque)


def test_standard_excitations_keep_the_limits_of_a_free_drive():
    drive = rig.drive_model(B_sp=3.0)
    for excitation in excitations(LIMITS, drive, logged=rig.drive_torque(900)):
        command = excitation.command(excitation.coefficients)
        assert command.size == LIMITS.samples == 800
        inertia = rig.J_M + rig.J_L / rig.N**2
        speed = np.cumsum(command) * rig.STEP / inertia
        travel = np.cumsum(speed) * rig.STEP / rig.N
        peaks = [np.max(np.abs(command)) / 0.5, np.max(np.abs(speed)) / 30.0, np.max(np.abs(travel)) / 0.3]
        # One of the limits is reached, up to a margin.
        assert max(peaks) == pytest.approx(0.98)
        assert abs(command[0]) < 1e-9


def test_predicted_response_agrees_with_the_simulator(rivals: tuple[Explanation, Explanation], proposal: Candidate):
    truth, _ = rivals
    own = proposal.evaluation.own[0]
    time = np.arange(LIMITS.samples) * rig.STEP
    motion = simulate(truth.model, sampled(time, proposal.command, hold="zero-order"), time, rtol=1e-10, atol=1e-13)
    white = np.asarray(motion.outputs) / NOISE_STD
    # The error of fixed steps of a fifth-order solver is below a hundredth of the noise.
    np.testing.assert_allclose(own.outputs.reshape(-1, 2), white, atol=1e-2)
    np.testing.assert_allclose(own.motion[:, 0] * LIMITS.speed, np.asarray(motion.states)[:, 2], rtol=1e-6, atol=1e-6)


def test_response_derivative_is_accurate_under_sharp_friction():
    """Stick-slip motion with nearly discontinuous friction."""
    blunt = with_friction("coulomb", 0.0)
    model = blunt.model.replace({"stribeck_motor_friction.transition": 1e-12})
    friction = "stribeck_motor_friction.T_c"
    sharp = explanation("sharp", model, (friction,), hold="zero-order")
    command = next(e for e in excitations(LIMITS, model, logged=np.zeros(10)) if "triangle" in e.name)
    shapes = signals(command, hold="zero-order", bench=BENCH)
    found = respond(sharp, start(sharp), command.coefficients, signals=shapes, bench=BENCH)
    assert found.usable

    def outputs(step: float) -> np.ndarray:
        moved = start(sharp) + step * np.eye(start(sharp).size)[0]
        return respond(sharp, moved, command.coefficients, signals=shapes, bench=BENCH).outputs

    by_difference = (outputs(1e-4) - outputs(-1e-4)) / 2e-4
    error = np.linalg.norm(found.by_unknown[:, 0] - by_difference)
    assert error < 0.05 * np.linalg.norm(by_difference)


def test_separation_gradient_agrees_with_finite_differences(
    rivals: tuple[Explanation, Explanation], monkeypatch: pytest.MonkeyPatch
):
    # The envelope theorem holds at the minimum.
    monkeypatch.setattr(discrimination, "_ARRIVED", 1e-9)
    monkeypatch.setattr(discrimination, "_NOTHING", 1e-9)
    truth, rival = rivals
    excitation = excitations(LIMITS, truth.model, logged=np.zeros(10))[0]
    shapes = signals(excitation, hold="zero-order", bench=BENCH)

    def separation(command: np.ndarray, begin: np.ndarray | None = None):
        target = respond(truth, start(truth), command, signals=shapes, bench=BENCH)
        return refit(rival, target, command, signals=shapes, bench=BENCH, begin=begin), target

    at = excitation.coefficients
    found, target = separation(at)
    # The rival's parameters changed, and a residual remains.
    assert np.max(np.abs(found.unknowns - start(rival))) > 1e-3 and found.squares > 1.0
    slope = found.slope(target)
    step = 1e-3
    for i in (0, 2, 7, 20):
        unit = step * (np.arange(at.size) == i)
        up, down = (separation(at + sign * unit, found.unknowns)[0].squares for sign in (1, -1))
        assert slope[i] == pytest.approx((up - down) / (2 * step), rel=1e-3, abs=1e-3 * np.max(np.abs(slope))), i


def test_model_is_not_separated_from_itself(rivals: tuple[Explanation, Explanation]):
    truth, _ = rivals
    excitation = excitations(LIMITS, truth.model, logged=np.zeros(10))[0]
    shapes = signals(excitation, hold="zero-order", bench=BENCH)
    at = excitation.coefficients
    target = respond(truth, start(truth), at, signals=shapes, bench=BENCH)
    away = start(truth) + 0.02 * np.append(np.ones(4), np.zeros(4))
    same = refit(truth, target, at, signals=shapes, bench=BENCH, begin=away)
    before = target.outputs - respond(truth, away, at, signals=shapes, bench=BENCH).outputs
    assert before @ before > 1e3 and same.squares < 1e-3


def test_command_search_increases_the_separation_within_the_limits(
    rivals: tuple[Explanation, Explanation], proposal: Candidate
):
    excitation = proposal.excitation
    shapes = signals(excitation, hold="zero-order", bench=BENCH)
    begun = excitation.coefficients
    target = respond(rivals[0], start(rivals[0]), begun, signals=shapes, bench=BENCH)
    before = refit(rivals[1], target, begun, signals=shapes, bench=BENCH).squares
    assert proposal.evaluation.forward[0].squares > 1.3 * before
    assert np.max(np.abs(proposal.command)) <= LIMITS.torque
    time = np.arange(LIMITS.samples) * rig.STEP
    for rival in rivals:
        motion = simulate(rival.model, sampled(time, proposal.command, hold="zero-order"), time)
        states = np.asarray(motion.states)
        assert np.max(np.abs(states[:, 2])) <= LIMITS.speed * 1.001
        assert np.max(np.abs(states[:, 0])) / rig.N <= LIMITS.travel * 1.001


def test_predicted_likelihood_ratio_agrees_with_refits_to_noisy_data(
    rivals: tuple[Explanation, Explanation], proposal: Candidate
):
    """Data of the rig's own equations; both models are refitted for each draw of the noise."""
    command = proposal.evaluation.coefficients
    shapes = signals(proposal.excitation, hold="zero-order", bench=BENCH)
    ratios = []
    for seed in range(_DRAWS):
        white = measured(proposal.command, seed) / NOISE_STD
        data = dataclasses.replace(proposal.evaluation.own[0], outputs=white.ravel())
        truth, rival = (refit(r, data, command, signals=shapes, bench=BENCH).squares for r in rivals)
        ratios.append(0.5 * (rival - truth))
    promised = 0.5 * proposal.evaluation.forward[0].squares
    # The variance of the ratio is twice its mean; both models have the same number of parameters.
    assert promised > 5.0
    assert np.mean(ratios) == pytest.approx(promised, abs=3 * np.sqrt(2 * promised / _DRAWS))


@pytest.mark.slow
def test_predicted_likelihood_ratio_agrees_with_the_fit_of_logs(
    rivals: tuple[Explanation, Explanation], proposal: Candidate
):
    data = [stretch_of(proposal.command, measured(proposal.command, 0))]
    squares = []
    for r in rivals:
        found = fit(
            r.model,
            data,
            r.free.paths,
            Segmentation(LIMITS.samples, substeps=2),
            start=Start(covariance=NOISE),
            strategy=Strategy(reweigh=False),
        )
        squares.append(float(np.sum((np.asarray(found.error) / NOISE_STD) ** 2)))
    promised = 0.5 * proposal.evaluation.forward[0].squares
    assert 0.5 * (squares[1] - squares[0]) == pytest.approx(promised, abs=3 * np.sqrt(2 * promised))


def measured(command: np.ndarray, seed: int) -> np.ndarray:
    """Encoder readings of the rig with motor friction."""
    motion = rig.drive_motion(command, motor_friction=(0.01, 1.0))
    outputs = np.stack([motion[:, 0] / rig.N, motion[:, 0] / rig.N - motion[:, 1]], axis=1)
    return outputs + NOISE_STD * np.random.default_rng(seed).normal(size=outputs.shape)


def stretch_of(command: np.ndarray, measured: np.ndarray) -> Stretch:
    time = np.arange(command.size) * rig.STEP
    torque = sampled(time, command, hold="zero-order")
    return Stretch(Experiment("proposal", time, torque, None, measured, None), 0, time.size)


def proposed(precision: Precision | None = None, **ratios) -> NextExperiment:
    time = np.arange(5) * 0.1
    separations = (
        () if precision else (Separation("rival", "motor_friction", **ratios, gathered=np.outer(time, [1.0, 2.0])),)
    )
    return NextExperiment(
        time=time,
        command=np.sin(time),
        limits=LIMITS,
        begins_like="a slow triangle",
        found="found",
        motor_angle=0.1,
        dynamic_error=1e-5 * time,
        motor_speed=time,
        separations=separations,
        precision=precision,
    )


UNITS = {"dynamic_error": "rad", "forcing": "N m"}


@pytest.mark.parametrize(
    ("ratios", "words"),
    [
        ({"on_logs": (0.2, 0.3), "proposed": (50.0, 60.0)}, ["50 (the logs: 0.20)", "60 (the logs: 0.30)"]),
        ({"on_logs": (0.0, 0.3), "proposed": (0.0, 60.0)}, ["rival can imitate found"]),
        ({"on_logs": (0.0, 0.0), "proposed": (0.01, 0.02)}, ["free, each can imitate the other. That is not decisive"]),
        ({"on_logs": None, "proposed": (1.0, 2.0)}, ["the logs: unknown", "5.0 times the duration"]),
        ({"on_logs": (1e7, 2e4), "proposed": None}, ["already separate", "above 1e+06", "no new experiment"]),
        ({"on_logs": None, "proposed": None}, ["not smooth enough"]),
    ],
)
def test_proposal_states_how_well_a_tie_is_separated(ratios, words):
    told = proposal_dict(proposed(**ratios), UNITS, logs_reach=1e-5)
    assert told is not None
    (sentence,) = told["says"]
    assert all(w in sentence for w in words), sentence


@pytest.mark.parametrize(("fitted", "torque"), [(50.0, None), (0.5, 0.5 * np.cbrt(1.959964 * 2.0 / 0.5))])
def test_proposal_states_the_standard_error_of_alpha(fitted: float, torque: float | None):
    told = proposal_dict(proposed(Precision(fitted, 40.0, 2.0, np.ones(5), "rad^-2")), UNITS, logs_reach=1e-5)
    assert told is not None and told["question"] == "alpha"
    assert "from 40 rad^-2 on the logs to 2 rad^-2" in told["says"][0]
    assert told["alpha"]["visible"] == pytest.approx(3.92, rel=1e-3)
    # Twice the torque makes an eighth of alpha significant.
    assert told["alpha"]["needed_torque"] == (None if torque is None else pytest.approx(torque))
    assert ("No excitation within the limits" in told["says"][0]) == (torque is not None)


def test_proposed_command_is_written_as_a_table():
    rows = list(csv.reader(io.StringIO(command_table(proposed(on_logs=None, proposed=(1.0, 1.0))))))
    assert rows[0] == ["time", "motor_torque"]
    values = np.array(rows[1:], dtype=float)
    np.testing.assert_allclose(values, np.stack([np.arange(5) * 0.1, np.sin(np.arange(5) * 0.1)], axis=1), rtol=1e-8)


def test_command_search_keeps_the_limit_of_the_twist(
    rivals: tuple[Explanation, Explanation], proposal: Candidate, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(command_search, "_ITERATIONS", 3)
    free = np.max(np.abs(proposal.evaluation.own[0].outputs[1::2])) * NOISE_STD[1]
    least = dataclasses.replace(BENCH, limits=dataclasses.replace(LIMITS, twist=0.5 * float(free)))
    found = search(rivals, [proposal.excitation], least, progress=lambda message: None)
    assert found is not None
    for own in found.evaluation.own:
        assert np.max(np.abs(own.outputs[1::2])) * NOISE_STD[1] <= 0.5 * free * 1.0001
    assert found.merit < proposal.merit


def test_proposal_plot_shows_command_motion_and_separation():
    for made in (
        proposed(on_logs=(0.2, 0.3), proposed=(50.0, 60.0)),
        proposed(Precision(0.5, 40.0, 2.0, np.ones(5), "rad^-2")),
        dataclasses.replace(proposed(on_logs=None, proposed=(1.0, 1.0)), motor_speed=None),
    ):
        drawn = next_experiment_plot(made, unit="rad", forcing_unit="<b>V</b>")
        go.Figure(drawn.figure)
        command, motion, *told = drawn.figure["data"]
        np.testing.assert_allclose(command["y"], made.command, rtol=1e-5)
        np.testing.assert_allclose(motion["y"], 1e6 * made.dynamic_error if made.motor_speed is None else made.time)
        assert len(told) == (2 if made.separations else 1)
        if made.separations:
            np.testing.assert_allclose(told[1]["y"], 2.0 * made.time)
            assert told[0]["name"] == "against rival" and told[1]["line"]["dash"] == "dash"


@pytest.mark.slow
def test_proposed_experiment_identifies_alpha():
    """The amplitude of the log is too small for alpha; a fit under the proposed command identifies it."""
    gentle = rig.reduced_experiment(1200, noise=2e-3, rms=0.5)
    limits = {"torque": 20.0}
    hold: Hold = "zero-order"
    fitted = fit_only(rig.reduced_model(mu=1.0, omega_0=1.0, alpha=0.0, gain=1.0), {hold: (gentle,)}, hold=hold)
    assert not fitted.account.uncertainty.estimates["alpha"].identifiable
    found = experiment_for_alpha(fitted, [gentle], limits)
    assert found is not None and found.precision is not None
    assert np.max(np.abs(found.command)) <= 20.0 * 1.001
    assert found.precision.proposed < 0.1 * found.precision.on_logs
    motion = rig.reduced_motion(found.command, alpha=0.0)
    log = rig.reduced_log(motion[:, 0], found.command, noise=2e-3)
    (again,) = (experiment_from_log(log, hold=hold),)
    refitted = fit(
        rig.reduced_model(alpha=0.0),
        [Stretch(again, 0, len(again))],
        ("mu", "omega_0", "gain", "alpha"),
        Segmentation(len(again)),
    )
    estimate = uncertainty(refitted, torque_noise=False).estimates["alpha"]
    assert estimate.std_classical == pytest.approx(found.precision.proposed, rel=0.2)


@pytest.mark.slow
def test_proposed_experiment_separates_a_tie(tmp_path: Path):
    """Motor friction with and without a peak near standstill is a tie on a short log."""
    log = rig.drive_experiment(2000, motor_friction=(0.01, 1.0), noise=3.0)
    start_model = rig.drive_model(K=1e4, alpha=0.0, B_sp=0.0)
    data: dict[Hold, tuple[Experiment, ...]] = {"zero-order": (log,)}
    forms = (MotorFriction, StribeckMotorFriction)
    loop = close_loop(start_model, data, hold="zero-order", catalogue=forms, search=SearchOptions(1))
    assert [rival.name for _, rival in tied(loop)] == ["stribeck_motor_friction"]
    found = experiment_for_ties(loop)
    assert found is not None
    (separation,) = found.separations
    assert separation.on_logs is not None and separation.proposed is not None
    assert max(separation.proposed) > 20 * max(separation.on_logs)
    paths = Report.of(loop, next_experiment=found).write(tmp_path)
    assert (tmp_path / "next_experiment.csv").read_text() == command_table(found)
    assert "The next experiment" in paths["report.html"].read_text(encoding="utf-8")
