"""Relaxation of the twist while a joint rests: identified and estimated, absent where the twist follows the torque."""

from pathlib import Path

import pytest
import slow_joints
from slow_joints import RATIO, Effect, closed, slow_joint
from test_quasi_static_loop import RIPPLE, families

from fitting.logs.drive_file import DriveFile
from fitting.quasi_static.attribution import Held
from fitting.quasi_static.intervals import Known
from fitting.quasi_static.lookalikes import lookalikes
from fitting.quasi_static.loop import QuasiStaticLoop
from fitting.quasi_static.loop_content import loop_report
from fitting.quasi_static.plots import loop_pictures
from fitting.quasi_static.points import points_of
from fitting.quasi_static.preparation import QuasiStaticData
from fitting.quasi_static.report import report_page
from fitting.quasi_static.rests import RestAnalysis, analyse_rests
from fitting.quasi_static.test_part import Parted
from fitting.quasi_static.twist_model import strengths_of

AMPLITUDE, CONSTANT = -5e-5, 0.5
# A joint that turns a weight, and stops for the last third of its log.
STOPS = {"moves": "one way", "kind": "weight", "cycles": 0.4}
SLOWLY_ON = {"torque_noise": 3.0, "cycles": 0.2, "kind": "sine"}


def rest_analysis(effects: list[Effect], **options) -> RestAnalysis:
    """Analyse the rests of a joint that moves one way and stops, beside the linear curve."""
    log, how = slow_joint(effects, **STOPS | options)
    points = points_of([log], [how], RATIO)
    held = Held.of(points)
    found = analyse_rests(held, held.attempt(), seed=0)
    assert found is not None
    return found


def figures(loop: QuasiStaticLoop) -> dict[str, Known]:
    (creep,) = (one for one in loop.findings if one.family == "creep")
    points, model, (form,) = loop.evidence_of(creep)
    return strengths_of(points, model, form)


def test_relaxation_at_rest_is_identified_beside_a_larger_ripple() -> None:
    effects = [slow_joints.ripple(RIPPLE, 2), slow_joints.relaxing_rests(AMPLITUDE, CONSTANT)]
    loop = closed(slow_joint(effects, colour=0.9, **STOPS))
    assert loop.decision == "effect_found" and families(loop) == {"kinematic_error", "creep"}
    known = figures(loop)
    for name, truth in (("time_constant", CONSTANT), ("amplitude_1", AMPLITUDE)):
        # The tolerance allows for noise that is correlated over ten rows.
        assert known[name].value == pytest.approx(truth, rel=0.15)
    (creep,) = (one for one in loop.findings if one.family == "creep")
    assert creep.at_rest is not None
    # Almost only noise remains at rest, on stretches that were not fitted.
    assert creep.at_rest.after.rmse < 1.5 * 4e-6 < 0.7 * creep.at_rest.round.before.rmse


@pytest.mark.slow
def test_relaxation_time_constant_interval_has_nominal_coverage() -> None:
    hits, draws = 0, 100
    for seed in range(draws):
        found = rest_analysis([slow_joints.relaxing_rests(AMPLITUDE, CONSTANT)], seed=seed)
        known = strengths_of(found.points, found.after.model, found.after.model.forms[0])["time_constant"]
        assert known.ci95 is not None
        hits += known.ci95[0] <= CONSTANT <= known.ci95[1]
    # Two binomial standard deviations below 0.95.
    assert hits >= 90


FOLLOWS = [
    {"colour": 0.9, "twist_noise": 2e-5},
    # Torque and twist change slowly, under much noise of the torque.
    SLOWLY_ON,
    {"torque_noise": 3.0, "cycles": 6.0, "kind": "triangle"},
]


def assert_few_relaxations(draws: int, most: int, options: dict) -> None:
    alarms = [seed for seed in range(draws) if rest_analysis([], seed=seed, **options).terms]
    assert len(alarms) <= most, alarms


@pytest.mark.parametrize("options", FOLLOWS)
def test_no_relaxation_is_found_where_the_twist_follows_the_torque(options: dict) -> None:
    # At a false-alarm rate of 1 %, more than one alarm occurs once in 700.
    assert_few_relaxations(6, 1, options)


@pytest.mark.slow
@pytest.mark.parametrize("options", FOLLOWS)
def test_false_relaxations_are_rare_over_many_draws(options: dict) -> None:
    # Twice the 1 % of the second test and of coloured noise, and two binomial standard deviations.
    assert_few_relaxations(200, 8, options)


def test_relaxation_caused_by_torque_noise_is_rejected() -> None:
    """The twist alone shows a relaxation beside a smoothed torque; the test of the torque rejects it."""
    looks = [rest_analysis([], seed=seed, **SLOWLY_ON) for seed in range(4)]
    assert sum(look.round.accepted for look in looks) > 1
    assert not any(look.terms for look in looks)


def test_rests_are_not_analysed_where_the_joint_does_not_stop() -> None:
    assert closed(slow_joint(moves="both ways")).at_rest is None
    assert closed(slow_joint(moves="held")).at_rest is None


def test_rests_are_not_analysed_beyond_the_allowed_number_of_effects() -> None:
    effects = [slow_joints.ripple(RIPPLE, 2), slow_joints.relaxing_rests(AMPLITUDE, CONSTANT)]
    loop = closed(slow_joint(effects, **STOPS), max_effects=1)
    assert families(loop) == {"kinematic_error"} and loop.at_rest is None


def test_load_friction_is_a_lookalike_of_creep_at_rest() -> None:
    log, how = slow_joint(moves="one way")
    points = points_of([log], [how], RATIO)
    assert "load_friction" in dict(lookalikes("creep", points, at_rest=True))
    assert "load_friction" not in dict(lookalikes("creep", points))


def test_report_describes_a_relaxation_at_rest(tmp_path: Path) -> None:
    log, how = slow_joint([slow_joints.relaxing_rests(AMPLITUDE, CONSTANT)], **STOPS)
    loop = closed((log, how))
    data = QuasiStaticData(
        DriveFile(tmp_path / "drive.toml", "joint", RATIO, None, None, None, None, {}), (log,), (how,), {}
    )
    report = loop_report(Parted(data, loop.held.points, ()), loop)
    (effect,) = report["after"]["effects"]
    assert effect["family"] == "creep" and effect["at_rest"]["rests"] == 1
    before, after = (effect["at_rest"][key]["rmse"]["validation"] for key in ("before", "after"))
    assert effect["at_rest"]["gain"] == pytest.approx(1 - after / before)
    assert "While the joint rests" in report["summary"]
    assert "relaxation after a stop" in report_page(report, loop_pictures(loop))
