"""Logs become experiments and segments in which each sample occurs exactly once."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import rig
from fitting.errors import DataError
from fitting.estimation.experiment import Experiment, Stretch, experiment_from_log, experiments_from_log, split
from fitting.estimation.scales import scales
from fitting.estimation.segments import cut, segment_count

COUNT = 47
LOAD_TORQUE = np.linspace(3.0, -2.0, COUNT)


def log(count: int = COUNT):
    time = np.arange(count)
    motion = np.stack([50.0 * np.sin(time), np.cos(time)], axis=1)
    return rig.drive_log(motion, 1.0 + 0.1 * time**2, noise=0.0)


def experiment(hold: str = "linear", *, load: bool = False, count: int = COUNT) -> Experiment:
    logged = replace(log(count), load_torque=LOAD_TORQUE) if load else log(count)
    return experiment_from_log(logged, hold=hold, N=rig.N)


def test_outputs_of_a_drive_log_are_motor_angle_over_ratio_and_twist():
    found = experiment()
    logged = log()
    assert len(found) == COUNT
    np.testing.assert_array_equal(found.measured[:, 0], logged.motor_angle / rig.N)
    np.testing.assert_array_equal(found.measured[:, 1], logged.dynamic_error)
    np.testing.assert_array_equal(found.motor_angle, logged.motor_angle)
    assert found.load_torque is None
    assert found.time_step == pytest.approx(rig.STEP, rel=1e-12)


def test_reduced_log_has_one_output_and_no_motor_angle():
    found = rig.reduced_experiment(40)
    assert found.measured.shape == (40, 1)
    assert found.motor_angle is None


def test_segments_reassemble_the_log_and_padding_has_weight_zero():
    source = experiment()
    segments = cut([Stretch(source, 0, COUNT)], 10)
    weight = np.asarray(segments.weight)
    assert weight.shape == (5, 10)
    np.testing.assert_array_equal(weight.sum(axis=1), [10, 10, 10, 10, 7])
    assert float(segments.count) == COUNT
    np.testing.assert_array_equal(np.asarray(segments.measured)[weight > 0], source.measured)
    np.testing.assert_allclose(np.asarray(segments.torque.knots)[:, :-1][weight > 0], source.time, atol=1e-15)


@settings(max_examples=12)
@given(
    start=st.integers(0, COUNT - 1),
    extent=st.integers(1, COUNT),
    length=st.integers(1, COUNT + 5),
    halo=st.integers(0, 12),
)
def test_segments_keep_torque_and_outputs_of_each_sample(start: int, extent: int, length: int, halo: int):
    source = experiment(load=True)
    stop = min(start + extent, COUNT)
    segments = cut([Stretch(source, start, stop)], length, halo=halo)
    present = np.asarray(segments.weight) > 0
    knots = np.asarray(segments.torque.knots)
    assert knots.shape[1] == length + halo + 1
    assert (np.diff(knots, axis=1) > 0).all()
    np.testing.assert_array_equal(np.asarray(segments.measured)[present], source.measured[start:stop])
    own = np.asarray(segments.torque.coefficients)[:, halo:]
    expected = np.asarray(source.torque.coefficients)[start:stop]
    np.testing.assert_array_equal(own[present], expected)
    load = segments.load_torque
    np.testing.assert_array_equal(np.asarray(load.coefficients)[present][:, 0], LOAD_TORQUE[start:stop])
    np.testing.assert_array_equal(np.asarray(load.knots), knots[:, halo:])


def test_halo_holds_the_torque_before_each_segment():
    source = experiment()
    halo = 4
    segments = cut([Stretch(source, 20, 40)], 10, halo=halo)
    torque = np.asarray(segments.torque.coefficients)[:, :, 0]
    logged = log().motor_torque
    np.testing.assert_allclose(torque[0], logged[16:30], rtol=1e-14)
    np.testing.assert_allclose(torque[1], logged[26:40], rtol=1e-14)
    np.testing.assert_allclose(segments.torque.knots[0], source.time[16:31], atol=1e-15)


def test_first_torque_is_held_before_the_log_starts():
    source = experiment("linear")
    segments = cut([Stretch(source, 0, 20)], 20, halo=6)
    knots = np.asarray(segments.torque.knots[0])
    np.testing.assert_allclose(np.diff(knots), rig.STEP, rtol=1e-9)
    assert knots[6] == source.time[0]
    coefficients = np.asarray(segments.torque.coefficients[0])
    np.testing.assert_array_equal(coefficients[:6, 0], log().motor_torque[0])
    assert (coefficients[:6, 1:] == 0).all()
    assert (coefficients[7:, 1] != 0).all()


def test_last_torque_is_held_after_the_log_ends():
    segments = cut([Stretch(experiment("cubic"), 40, COUNT)], 20)
    beyond = np.asarray(segments.torque.coefficients)[0, COUNT - 40 :]
    assert (beyond[:, 1:] == 0).all()
    np.testing.assert_array_equal(beyond[:, 0], log().motor_torque[-1])
    np.testing.assert_allclose(np.diff(segments.torque.knots[0]), rig.STEP, rtol=1e-9)


def test_segments_of_several_logs_stay_separate():
    first, second = experiment(count=COUNT), experiment(count=31)
    segments = cut([Stretch(first, 5, COUNT), Stretch(second, 0, 31)], 10)
    present = np.asarray(segments.weight) > 0
    np.testing.assert_array_equal(present.sum(axis=1)[:9], [10, 10, 10, 10, 2, 10, 10, 10, 1])
    np.testing.assert_array_equal(
        np.asarray(segments.measured)[present], np.concatenate([first.measured[5:], second.measured])
    )


def test_segments_beyond_the_data_have_weight_zero():
    source = experiment()
    segments = cut([Stretch(source, 0, COUNT)], 10, count=7, halo=2)
    assert segments.weight.shape == (7, 10)
    assert float(segments.count) == COUNT
    assert (np.asarray(segments.weight)[5:] == 0).all()
    assert np.isfinite(np.asarray(segments.torque.coefficients)).all()


@pytest.mark.parametrize(("length", "needed", "expected"), [(47, 1, 1), (6, 8, 8), (5, 10, 16), (2, 24, 32)])
def test_segment_count_is_exact_up_to_eight_and_then_a_multiple_of_sixteen(length: int, needed: int, expected: int):
    stretch = Stretch(experiment(), 0, COUNT)
    assert -(-COUNT // length) == needed
    assert segment_count([stretch], length) == expected
    assert cut([stretch], length).weight.shape[0] == expected


def test_split_selects_the_end_of_each_log():
    experiments = [experiment(), experiment(count=30)]
    training, selection = split(experiments, held_out=0.2)
    assert [(s.start, s.stop) for s in training] == [(0, 38), (0, 24)]
    assert [(s.start, s.stop) for s in selection] == [(38, 47), (24, 30)]
    assert [s.name for s in training] == ["log", "log"]
    assert len(training[0]) + len(selection[0]) == COUNT


def test_scales_match_the_closed_form_of_a_sine():
    time = np.arange(4000) * rig.STEP
    omega, twist, swing = 40.0, 2e-3, 0.3
    load = swing * np.sin(3.0 * time)
    x = twist * np.sin(omega * time) + 5.0
    motion = np.stack([rig.N * (load + x), load], axis=1)
    logged = rig.drive_log(motion, np.zeros(time.size), noise=0.0)
    found = scales([Stretch(experiment_from_log(logged, hold="linear", N=rig.N), 0, 4000)])
    # The log has no whole number of periods, and slopes are taken over eight samples.
    assert found.x == pytest.approx(twist / np.sqrt(2), rel=0.01)
    assert found.x_max == pytest.approx(twist, rel=0.05)
    assert found.v == pytest.approx(omega * twist / np.sqrt(2), rel=0.01)
    rate = np.sqrt((omega * twist) ** 2 + (3.0 * swing) ** 2) / np.sqrt(2)
    assert found.omega_m == pytest.approx(rig.N * rate, rel=0.05)
    assert found.omega_l == pytest.approx(rate, rel=0.05)
    assert found.time_step == pytest.approx(rig.STEP)


def test_scales_use_only_samples_of_their_stretch():
    source = experiment(count=200)
    spoiled = source.measured.copy()
    spoiled[100:] = np.nan
    clean = scales([Stretch(source, 0, 100)])
    blind = scales([Stretch(replace(source, measured=spoiled), 0, 100)])
    assert blind == clean


def log_without_rows(kept: np.ndarray, count: int = 1000, **changes):
    """A log of smooth motion and torque without some of its rows."""
    logged = replace(log(count), motor_torque=np.sin(0.05 * np.arange(count)))
    columns = {k: v[kept] for k, v in vars(logged).items() if isinstance(v, np.ndarray)}
    return replace(logged, **columns, **changes), logged


def test_missing_samples_are_interpolated_with_weight_zero():
    kept = np.delete(np.arange(1000), [300, 301, 700])
    short, whole = log_without_rows(kept)
    found = experiment_from_log(short, hold="zero-order", N=rig.N)
    np.testing.assert_allclose(found.time, whole.time, atol=1e-12)
    np.testing.assert_array_equal(np.flatnonzero(found.weight == 0), [300, 301, 700])
    np.testing.assert_array_equal(found.rows, found.weight > 0)
    np.testing.assert_array_equal(found.measured[kept, 0], whole.motor_angle[kept] / rig.N)
    # A cubic through samples 1.5 to 2.5 steps away errs by some (0.05 * 2.5)^4 / 24.
    np.testing.assert_allclose(np.asarray(found.torque.coefficients)[:, 0], whole.motor_torque, atol=2e-5)
    segments = cut([Stretch(found, 0, 1000)], 100)
    assert float(segments.count) == 997
    assert np.isfinite(np.asarray(segments.measured)).all()


def test_unknown_torques_put_no_samples_beside_their_rows():
    logged = replace(log(1000), motor_torque=np.sin(0.05 * np.arange(1000)))
    known = np.ones(1000, dtype=bool)
    known[[100, 101, 102, 500, 700, 701]] = False
    found = experiment_from_log(replace(logged, input_known=known), hold="zero-order", N=rig.N)
    np.testing.assert_array_equal(found.time, logged.time)
    np.testing.assert_allclose(np.asarray(found.torque.coefficients)[:, 0], logged.motor_torque, atol=2e-5)


def test_scales_of_logs_with_different_rates_are_those_of_each():
    time = np.arange(4000) * rig.STEP
    load = 0.3 * np.sin(3.0 * time)
    motion = np.stack([rig.N * (load + 2e-3 * np.sin(40.0 * time)), load], axis=1)
    slow = rig.drive_log(motion, np.zeros(time.size), noise=0.0)
    quick = replace(slow, time=0.1 * slow.time)
    both = [Stretch(experiment_from_log(one, hold="linear", N=rig.N), 0, 4000) for one in (slow, quick)]
    alone, together = scales(both[:1]), scales(both)
    for name in ("v", "omega_m", "omega_l"):
        # The quick log is the slow one played ten times as fast.
        assert getattr(together, name) == pytest.approx(getattr(alone, name) * np.sqrt((1 + 100) / 2), rel=1e-9)


def test_log_without_gaps_is_unchanged_and_has_no_weights():
    plain = experiment()
    assert plain.weight is None and plain.rows is None
    np.testing.assert_array_equal(plain.time, log().time)


def test_pieces_of_a_log_become_independent_experiments():
    short, _ = log_without_rows(np.delete(np.arange(1000), np.arange(400, 500)), pieces=((0, 400), (400, 900)))
    first, second = experiments_from_log(short, hold="cubic", N=rig.N)
    assert (first.name, second.name) == ("log, part 1", "log, part 2")
    assert (len(first), len(second)) == (400, 500)
    alone = experiment_from_log(log_without_rows(np.arange(500, 1000))[0], hold="cubic", N=rig.N)
    np.testing.assert_array_equal(second.torque.coefficients, alone.torque.coefficients)
    np.testing.assert_array_equal(second.measured, alone.measured)


def test_invalid_samples_have_weight_zero_and_are_replaced():
    trusted = np.ones(1000, dtype=bool)
    trusted[[5, 6, 990]] = False
    logged, whole = log_without_rows(np.arange(1000), trusted=trusted)
    wild = np.where(trusted, logged.dynamic_error, 1e3)
    found = experiment_from_log(replace(logged, dynamic_error=wild), hold="zero-order", N=rig.N)
    np.testing.assert_array_equal(np.flatnonzero(found.weight == 0), [5, 6, 990])
    assert np.max(np.abs(found.measured[:, 1])) <= np.max(np.abs(whole.dynamic_error))
    training, selection = split([found])
    assert training[0].weight.sum() + selection[0].weight.sum() == 997
    assert training[0].weight.sum() == pytest.approx(0.8 * 997, abs=1)
    assert len(training[0].beginning(10)) == 12
    assert len(Stretch(found, 0, 8).beginning(10)) == 8


def test_samples_after_the_last_known_output_have_weight_zero():
    logged, _ = log_without_rows(np.arange(1000), outputs_until=50)
    found = experiment_from_log(logged, hold="zero-order", N=rig.N)
    np.testing.assert_array_equal(np.flatnonzero(found.weight), np.arange(50))
    whole = Stretch(found, 0, 1000)
    assert len(whole.beginning(50)) == 50 and len(whole.beginning(80)) == 50
    assert np.ptp(found.measured[50:, 1]) == 0


def test_log_of_mostly_gaps_is_refused():
    short, _ = log_without_rows(np.arange(1000))
    late = short.time + 10.0 * (np.arange(1000) > 500)
    with pytest.raises(DataError, match="mostly gaps"):
        experiment_from_log(replace(short, time=late), hold="zero-order", N=rig.N)


def test_load_torque_hold_is_constant_for_zero_order_else_linear():
    held, lines = (experiment(hold, load=True).load_torque for hold in ("zero-order", "cubic"))
    assert held is not None and lines is not None
    step = np.diff(np.asarray(lines.knots))[:-1]
    slope = np.diff(LOAD_TORQUE) / step
    np.testing.assert_array_equal(np.asarray(held.coefficients)[:, 1:], 0.0)
    np.testing.assert_allclose(np.asarray(lines.coefficients)[:-1, 1], slope, rtol=1e-9)
    np.testing.assert_array_equal(np.asarray(held.coefficients)[:, 0], np.asarray(lines.coefficients)[:, 0])
