"""The loop on quasi-static logs: identified effects, false alarms and look-alikes, on simulated and measured logs."""

from pathlib import Path

import numpy as np
import pytest
import slow_joints
from slow_joints import K, closed, slow_joint
from test_quasi_static_command import lara_drive

from fitting.logs.drive_file import read_drive_file
from fitting.logs.log import read_log
from fitting.quasi_static.attribution import Held
from fitting.quasi_static.form import Form
from fitting.quasi_static.lookalikes import lookalikes
from fitting.quasi_static.loop import QuasiStaticLoop, catalogue, close_loop
from fitting.quasi_static.loop_content import _summary
from fitting.quasi_static.noise_colour import DRAWS, autoregression, noise_of_the_same_colour
from fitting.quasi_static.points import Points, points_of, without_noise
from fitting.quasi_static.preparation import prepare
from fitting.quasi_static.screening import screen
from fitting.quasi_static.stretches import folds
from fitting.quasi_static.twist_model import fit_twist, hold_out, stiffness_of, strengths_of

RIPPLE, WIDTH = 3e-5, 1e-4


def families(loop: QuasiStaticLoop) -> set[str]:
    return {one.family for one in loop.findings}


def figures(loop: QuasiStaticLoop, family: str) -> dict:
    (own,) = (one for one in loop.findings if one.family == family)
    return strengths_of(loop.held.points, loop.after.model, own.forms[0])


NO_EFFECT = [
    {"moves": "held"},
    {"moves": "held", "colour": 0.9, "twist_noise": 2e-5},
    {"moves": "held", "torque_noise": 3.0, "kind": "triangle", "cycles": 6.0},
    {"moves": "held", "torque_noise": 1.0, "twist_noise": 1e-7, "cycles": 3.0},
    {"moves": "one way", "colour": 0.9},
    {"moves": "both ways", "colour": 0.9, "cycles": 5.0},
]


def assert_few_false_alarms(draws: int, most: int, options: dict) -> None:
    alarms = [seed for seed in range(draws) if closed(slow_joint(seed=seed, **options)).decision != "model_sufficient"]
    assert len(alarms) <= most, alarms


@pytest.mark.parametrize("options", NO_EFFECT)
def test_no_effect_is_found_where_none_is_missing(options: dict) -> None:
    # The slow test bounds the rate; the draws of this one are fixed, and have no alarm.
    assert_few_false_alarms(2, 0, options)


@pytest.mark.slow
@pytest.mark.parametrize("options", NO_EFFECT)
def test_false_alarms_are_rare_over_many_draws(options: dict) -> None:
    # Twice the stated 2 % for coloured noise, and two binomial standard deviations.
    assert_few_false_alarms(200, 13, options)


@pytest.mark.parametrize(
    ("family", "effect", "options"),
    [
        ("kinematic_error", slow_joints.ripple(RIPPLE, 2), {"moves": "one way"}),
        ("kinematic_error", slow_joints.ripple(RIPPLE, 2), {"moves": "both ways", "colour": 0.9, "torque_noise": 2.0}),
        ("hysteresis", slow_joints.sliders(WIDTH), {"cycles": 1.6}),
        ("hysteresis", slow_joints.sliders(WIDTH), {"cycles": 5.0, "colour": 0.9, "torque_noise": 2.0}),
        ("stiffness_shape", slow_joints.hardening(1e5), {"cycles": 1.6}),
        ("stiffness_shape", slow_joints.knee(25.0, 1.5), {"cycles": 3.0}),
        ("backlash", slow_joints.play(5e-5), {"cycles": 3.0}),
        ("creep", slow_joints.relaxation(0.3, 0.4), {"cycles": 1.6, "kind": "triangle", "rows": 3000}),
    ],
)
def test_missing_effect_is_identified(family: str, effect: slow_joints.Effect, options: dict) -> None:
    loop = closed(slow_joint([effect], **options))
    assert loop.decision == "effect_found"
    assert loop.findings[0].family == family and families(loop) == {family}
    assert loop.after.rmse < 0.8 * loop.before.rmse
    # At most 1 % of the draws of noise have as large a gain.
    assert loop.findings[0].p_value <= 0.01


def test_no_form_is_said_to_be_tried_without_a_search() -> None:
    loop = closed(slow_joint([slow_joints.hardening(1e5)], cycles=1.6), max_effects=0)
    assert loop.rounds == () and loop.forms_tried == 0
    report = {"after": {"effects": []}, "before": {"rmse": {"test": 1e-5}}, "judged_on": "test", "forms_tried": 0}
    left = {"depends_on": None, "times_noise": 9.0}
    said = _summary(report | {"decision": "unexplained", "unexplained": left})
    assert said.startswith("Something is missing: no form of missing physics was tried.")


def test_motor_friction_is_identified_and_estimated() -> None:
    loop = closed(slow_joint(moves="both ways", cycles=3.0, friction=slow_joints.coulomb(4.0)))
    assert families(loop) == {"motor_friction"}
    low, high = figures(loop, "motor_friction")["friction"].ci95 or (0.0, 0.0)
    assert low < 4.0 < high and high - low < 2.0


def test_motor_friction_of_a_joint_that_moves_one_way_is_not_claimed() -> None:
    """It shows at the stop alone, which does not determine its size."""
    loop = closed(slow_joint(moves="one way", cycles=3.0, friction=slow_joints.coulomb(4.0)))
    assert families(loop) == set() and loop.dropped and loop.decision == "unexplained"


def test_ripple_amplitude_phase_and_stiffness_are_estimated() -> None:
    loop = closed(slow_joint([slow_joints.ripple(RIPPLE, 2, phase=0.7)], moves="both ways"))
    known = figures(loop, "kinematic_error")
    assert known["amplitude_2"].value == pytest.approx(RIPPLE, rel=0.03)
    assert known["phase_2"].value == pytest.approx(0.7, abs=0.05)
    assert all(known[name].identifiable for name in known)
    # Smoothing reduces the torque's peaks by 1e-4.
    assert stiffness_of(loop.held.points, loop.after.model)["K"].value == pytest.approx(K, rel=1e-3)


@pytest.mark.parametrize(("share", "order", "moves"), [(0.4, 1, "both ways"), (1.0, 2, "one way")])
def test_kinematic_error_behind_a_share_of_the_twist_is_no_stiffness_ripple(
    share: float, order: int, moves: str
) -> None:
    """Its phase shifts with the torque, which to first order is a stiffness that depends on the angle."""
    loop = closed(slow_joint([slow_joints.ripple(1e-4, order, share=share)], moves=moves, cycles=1.6))
    assert families(loop) == {"kinematic_error"} and len(loop.findings[0].forms) == 1
    known = figures(loop, "kinematic_error")
    assert known[f"amplitude_{order}"].value == pytest.approx(1e-4, rel=0.02)
    estimate = known[f"share_of_twist_{order}"]
    # Three standard errors, of 0.02 at most.
    assert estimate.value == pytest.approx(share, abs=0.06) and estimate.identifiable


def test_stiffness_ripple_beside_a_kinematic_error_is_identified() -> None:
    effects = [slow_joints.ripple(1e-4, 2), slow_joints.soft_spots(0.03, 2)]
    loop = closed(slow_joint(effects, moves="both ways", cycles=1.6))
    assert families(loop) == {"kinematic_error", "position_dependent_stiffness"}
    assert figures(loop, "position_dependent_stiffness")["amplitude_2"].value == pytest.approx(0.03, rel=0.1)


def test_ripple_amplitude_interval_has_nominal_coverage() -> None:
    hits = 0
    for seed in range(40):
        log = slow_joint([slow_joints.ripple(RIPPLE, 2)], moves="one way", colour=0.9, twist_noise=2e-5, seed=seed)
        points = points_of([log[0]], [log[1]], slow_joints.RATIO)
        (form,) = (f for f in catalogue(points) if f.name == "order 2 of the motor")
        known = strengths_of(points, fit_twist(points, ((form, np.zeros(0)),)), form)["amplitude_2"]
        assert known.ci95 is not None
        hits += known.ci95[0] <= RIPPLE <= known.ci95[1]
    # Two binomial standard deviations below 0.95.
    assert hits >= 35


def test_two_missing_effects_are_both_identified() -> None:
    effects = [slow_joints.ripple(RIPPLE, 2), slow_joints.hardening(1e5)]
    loop = closed(slow_joint(effects, moves="both ways", cycles=1.6))
    assert families(loop) == {"kinematic_error", "stiffness_shape"}
    assert loop.after.rmse < 2.0 * loop.held.points.twist_noise
    assert closed(slow_joint(effects, moves="both ways", cycles=1.6), max_effects=1).findings[0].family in families(
        loop
    )


def test_orders_of_a_kinematic_error_are_one_effect() -> None:
    effects = [slow_joints.ripple(RIPPLE, 2), slow_joints.ripple(0.5 * RIPPLE, 4)]
    loop = closed(slow_joint(effects, moves="one way"), max_effects=1)
    assert [one.family for one in loop.findings] == ["kinematic_error"]
    assert [form.name for form in loop.findings[0].forms] == ["order 2 of the motor", "order 4 of the motor"]


def test_only_the_linear_curve_is_fitted_when_no_effect_is_allowed() -> None:
    loop = closed(slow_joint([slow_joints.sliders(WIDTH)]), max_effects=0)
    assert not loop.findings and loop.after is loop.before
    # The hysteresis remains, and a smooth function of torque or its rate explains a part of it.
    assert loop.decision == "unexplained" and loop.left is not None


def test_residual_that_no_form_explains_is_unexplained() -> None:
    def dent(motion: slow_joints.JointMotion) -> np.ndarray:
        angle = motion.motor / slow_joints.RATIO
        return 4e-5 * np.exp(-(((angle - np.mean(angle)) / 0.05) ** 2))

    loop = closed(slow_joint([dent], moves="both ways", cycles=7.3))
    assert loop.decision == "unexplained"
    assert loop.left is not None and loop.left.depends_on == "load angle"


def test_slow_residual_unrelated_to_any_signal_is_unexplained() -> None:
    def wander(motion: slow_joints.JointMotion) -> np.ndarray:
        count = len(motion.motor)
        return 3e-4 * np.sin(3.7 * 2 * np.pi * np.arange(count) / count + 1.0)

    loop = closed(slow_joint([wander], cycles=5.0))
    assert loop.left is None and not loop.findings
    assert loop.decision == "unexplained"


def test_logs_of_one_drive_are_attributed_together() -> None:
    logs = [slow_joint([slow_joints.sliders(WIDTH)], seed=seed, name=f"log {seed}", cycles=1.6) for seed in range(3)]
    loop = closed(*logs)
    assert families(loop) == {"hysteresis"}
    assert figures(loop, "hysteresis")["width"].value == pytest.approx(WIDTH, rel=0.1)


def test_loop_is_reproducible_with_equal_seed() -> None:
    one, other = (closed(slow_joint([slow_joints.sliders(WIDTH)]), seed=3) for _ in range(2))
    assert one.after.rmse == other.after.rmse and one.findings[0].p_value == other.findings[0].p_value


def test_held_out_fold_does_not_influence_its_prediction() -> None:
    log, how = slow_joint([slow_joints.sliders(WIDTH)])
    points = points_of([log], [how], None)
    (form, *_) = (f for f in catalogue(points) if f.family == "hysteresis")
    fold = np.arange(len(points.twist)) * 5 // len(points.twist)
    changed = points.twist + np.where(fold == 2, 1e-3, 0.0)
    other = Points(**{**fields_of(points), "twist": changed})
    before, after = (hold_out(p, fit_twist(points, ((form, form.shapes[4]),)), fold) for p in (points, other))
    np.testing.assert_allclose((after - before)[fold == 2], 1e-3, rtol=1e-6)


def fields_of(points: Points) -> dict:
    return {name: getattr(points, name) for name in points.__dataclass_fields__}


def test_screened_gain_equals_the_gain_of_a_refit() -> None:
    """Inner products give the same as fits that leave out each fold."""
    log, how = slow_joint([slow_joints.hardening(1e5)])
    points = points_of([log], [how], None)
    stretch = np.arange(len(points.twist)) * 7 // len(points.twist)
    held = Held(points, stretch, folds(stretch))
    base = held.attempt()
    (cubic,) = (f for f in catalogue(points) if f.name == "cubic")
    found = screen(points, base.model, [(cubic,)], held.fold, 0)
    refitted = held.attempt(((cubic, np.zeros(0)),))
    assert found.leads[0].gain == pytest.approx(refitted.gain_over(base), rel=1e-6)


def test_autoregression_and_its_draws_agree_with_the_noise_process() -> None:
    random = np.random.default_rng(0)
    truth = np.array([1.0, -1.6, 0.8])
    series = np.zeros(6000)
    for i in range(2, len(series)):
        series[i] = -truth[1] * series[i - 1] - truth[2] * series[i - 2] + random.normal()
    coefficients, variance = autoregression(series[1000:])
    np.testing.assert_allclose(coefficients[:3], truth, atol=0.08)
    assert variance == pytest.approx(1.0, rel=0.05)
    draws = noise_of_the_same_colour(series[1000:], random)
    assert draws.shape == (DRAWS, 5000)
    assert np.std(draws) == pytest.approx(np.std(series[1000:]), rel=0.1)


def test_lines_between_grid_frequencies_are_no_noise() -> None:
    """Draws from the residual of two kinematic errors are no larger than the largest lines that noise may contain."""
    random, at = np.random.default_rng(0), np.arange(1500)
    noise = random.normal(size=len(at))
    lines = 30.0 * (np.sin(2 * np.pi * 95.5 / 1500 * at) + np.sin(2 * np.pi * 191.4 / 1500 * at))
    assert np.std(noise_of_the_same_colour(noise + lines, random)) < 2.0


@pytest.mark.parametrize(("kind", "cycles"), [("sine", 5.0), ("triangle", 5.0), ("triangle", 2.0)])
def test_stated_error_of_the_smoothed_torque_is_unbiased(kind: str, cycles: float) -> None:
    ratios = []
    for seed in range(30):
        log, _ = slow_joint(kind=kind, torque_noise=2.0, cycles=cycles, seed=seed)
        truth, _ = slow_joint(kind=kind, torque_noise=0.0, cycles=cycles, seed=seed)
        assert log.joint_torque is not None and truth.joint_torque is not None
        smooth, error = without_noise(log.joint_torque)
        ratios.append(np.mean((smooth - truth.joint_torque) ** 2) / error**2)
        # At least about half of the noise is removed.
        assert error < 1.2
    # Stein's estimate is unbiased, apart from the choice of the least of several.
    assert 0.8 < np.mean(ratios) < 1.5
    # An effect of the torque counts where it removes more than twice that mean square.
    assert np.mean(np.array(ratios) > 2.0) < 0.1


def test_lookalike_effects_depend_on_the_motion() -> None:
    one_way, both_ways = (
        points_of(*([part] for part in slow_joint(moves=moves)), slow_joints.RATIO)
        for moves in ("one way", "both ways")
    )
    assert {"cogging", "encoder_eccentricity"} <= dict(lookalikes("kinematic_error", both_ways)).keys()
    assert "position_dependent_friction" in dict(lookalikes("kinematic_error", one_way))
    assert "position_dependent_friction" not in dict(lookalikes("kinematic_error", both_ways))
    assert "motor_friction" in dict(lookalikes("hysteresis", both_ways))


def lara8_points(shared: Path, folder: Path, log: str, joint: int, ratio: int, sign: int) -> Points:
    file = folder / "drive.toml"
    file.write_text(lara_drive(joint, ratio, sign), encoding="utf-8")
    drive = read_drive_file(file)
    data = prepare([read_log(shared / f"data/lara8/{log}.csv", drive)], drive, at_rest=True)
    return points_of(data.logs, data.motion, drive.reduction_ratio)


@pytest.fixture(scope="module")
def jogging(shared: Path, tmp_path_factory: pytest.TempPathFactory) -> QuasiStaticLoop:
    """The loop on a log of a joint that moves and rests."""
    return close_loop(lara8_points(shared, tmp_path_factory.mktemp("lara8"), "ML2_jogging_joint_mass", 2, 121, -1))


def test_second_order_kinematic_error_of_a_measured_gear_is_identified(jogging: QuasiStaticLoop) -> None:
    loop = jogging
    assert loop.decision == "effect_found" and loop.findings[0].family == "kinematic_error"
    known = figures(loop, "kinematic_error")["amplitude_2"]
    # A spectrum of the log has a line of 0.217 arcmin.
    assert known.ci95 is not None and known.ci95[0] < np.deg2rad(0.217 / 60) < known.ci95[1]
    assert known.value == pytest.approx(np.deg2rad(0.217 / 60), rel=0.1)
    assert loop.after.rmse < 0.7 * loop.before.rmse


def test_relaxation_of_a_measured_gear_at_rest_is_identified(jogging: QuasiStaticLoop) -> None:
    loop = jogging
    assert families(loop) == {"kinematic_error", "creep"}
    (creep,) = (one for one in loop.findings if one.family == "creep")
    points, model, (form,) = loop.evidence_of(creep)
    known = strengths_of(points, model, form)
    # From row 30 of the rest on, an exponential of 0.5 s leaves 1.69 µrad of 10.6; differences of rows have 1.59 µrad.
    assert known["time_constant"].value == pytest.approx(0.5, rel=0.1)
    assert loop.at_rest is not None and loop.at_rest.after.rmse < 2e-6 < 0.3 * loop.at_rest.round.before.rmse
    # The page also states the stiffness with which the twist would follow the logged torque.
    assert loop.at_rest.own_stiffness is not None and 6e4 < loop.at_rest.own_stiffness < 1.2e5


@pytest.mark.parametrize("first", [True, False])
def test_ripple_fitted_to_one_half_predicts_the_other_half(shared: Path, tmp_path: Path, first: bool) -> None:
    points = lara8_points(shared, tmp_path, "ML2_jogging_joint_mass", 2, 121, -1)
    assert points.direction is not None and points.motor_angle is not None
    moving = np.flatnonzero(points.direction != 0)
    halves = moving[: len(moving) // 2], moving[len(moving) // 2 :]
    seen, unseen = halves if first else halves[::-1]
    (form,) = (f for f in catalogue(points) if f.name == "order 2 of the motor")
    ripple = form.columns(points, np.zeros(0))
    slow = np.vander(points.time, 4)
    strengths = np.linalg.lstsq(np.column_stack([ripple, slow])[seen], points.twist[seen], rcond=None)[0][:2]
    # The slow part of the other half is fitted there.
    rest = points.twist[unseen] - slow[unseen] @ np.linalg.lstsq(slow[unseen], points.twist[unseen], rcond=None)[0]
    wave = ripple[unseen] @ strengths
    assert np.var(rest - wave) < 0.6 * np.var(rest)


def test_hysteresis_of_a_measured_held_joint_is_identified(shared: Path, tmp_path: Path) -> None:
    loop = close_loop(lara8_points(shared, tmp_path, "ML1_validate", 2, 121, -1))
    assert loop.decision == "effect_found" and families(loop) == {"hysteresis"}
    # `hdjax fit` gives 220 µrad from other columns and weights.
    low, high = figures(loop, "hysteresis")["width"].ci95 or (0.0, 0.0)
    assert low < 220e-6 < high and low > 0
    assert loop.after.rmse < 0.3 * loop.before.rmse


def test_undetermined_loop_of_a_measured_joint_is_not_claimed(shared: Path, tmp_path: Path) -> None:
    """A bend and a loop are significant together, but the size of the loop is not determined."""
    loop = close_loop(lara8_points(shared, tmp_path, "ML1_validate", 5, 101, 1))
    assert families(loop) == set() and len(loop.dropped) == 2
    assert loop.rounds[0].accepted and loop.after.model.forms == ()


def test_forms_of_the_catalogue_have_unique_names() -> None:
    names = [form.name for form in catalogue(points_of(*([p] for p in slow_joint(moves="both ways")), 100.0))]
    assert len(set(names)) == len(names)
    assert all(isinstance(form, Form) for form in catalogue(points_of(*([p] for p in slow_joint()), None)))
