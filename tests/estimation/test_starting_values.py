"""Starting values from the weak form, without any prior values, are near the truth."""

import numpy as np
import pytest

import rig
from fitting.errors import DataError
from fitting.estimation.experiment import Experiment, Stretch, experiment_from_log
from fitting.estimation.starting_values import _weak_form, starting_models

COUNT = 3000
C = (rig.N**2 * rig.J_M + rig.J_L) / (rig.N**2 * rig.J_M * rig.J_L)
PLACEHOLDER = rig.drive_model(K=1.0, alpha=0.0, B_sp=0.0)
REDUCED_PLACEHOLDER = rig.reduced_model(mu=1.0, omega_0=1.0, alpha=0.0, gain=1.0)


def whole(experiment: Experiment) -> list[Stretch]:
    return [Stretch(experiment, 0, len(experiment))]


def drawn_drive(stiffness: float, zeta: float, seed: int) -> tuple[Experiment, float]:
    """A log of a drive that hardens by some ten percent at full twist, and its alpha."""
    omega_0 = np.sqrt(C * stiffness)
    f_0 = omega_0 / (2 * np.pi)
    step = 1.0 / (25.0 * f_0)
    torque = rig.multisine(COUNT, step, rms=3e-5 * stiffness, low=0.1 * f_0, high=1.5 * f_0, seed=seed)
    linear = rig.drive_motion(torque, stiffness=stiffness, alpha=0.0, damping=2 * zeta * omega_0 / C, step=step)
    alpha = 0.1 / np.max(np.abs(linear[:, 0] / rig.N - linear[:, 1])) ** 2
    motion = rig.drive_motion(torque, stiffness=stiffness, alpha=alpha, damping=2 * zeta * omega_0 / C, step=step)
    log = rig.drive_log(motion, torque, seed=seed, step=step)
    return experiment_from_log(log, hold="zero-order", N=rig.N), alpha


@pytest.mark.parametrize("stiffness", [1e3, 1e4, 1e5])
@pytest.mark.parametrize("zeta", [0.003, 0.02, 0.1])
def test_starting_stiffness_is_within_ten_percent_of_the_truth(stiffness: float, zeta: float):
    experiment, _ = drawn_drive(stiffness, zeta, seed=int(1e4 * zeta))
    found = starting_models(PLACEHOLDER, whole(experiment))
    away = [abs(float(m.get("K")) / stiffness - 1.0) for m in found]
    assert min(away) < 0.1, away
    # Each start costs one fit, so that there are few and no two are equal.
    assert len(found) <= 12
    K = np.sort([float(m.get("K")) for m in found])
    assert (np.diff(np.log(K)) > 0.03).all()
    for model in found:
        assert float(model.get("B_sp")) > 0
        assert float(model.get("J_m")) == rig.J_M


def test_starting_alpha_and_damping_have_the_right_size():
    stiffness, zeta = 1e4, 0.03
    experiment, alpha = drawn_drive(stiffness, zeta, seed=5)
    found = starting_models(PLACEHOLDER, whole(experiment))
    best = min(found, key=lambda m: abs(np.log(float(m.get("K")) / stiffness)))
    assert 0.3 * alpha < float(best.get("alpha")) < 3.0 * alpha
    damping = 2 * zeta * np.sqrt(stiffness / C)
    assert 0.3 * damping < float(best.get("B_sp")) < 3.0 * damping


def test_starting_values_do_not_depend_on_an_offset_of_both_angles():
    torque = rig.drive_torque(COUNT)
    motion = rig.drive_motion(torque)
    motion[:, :2] += np.array([rig.N * 3.0, 3.0])
    experiment = experiment_from_log(rig.drive_log(motion, torque), hold="zero-order", N=rig.N)
    found = starting_models(PLACEHOLDER, whole(experiment))
    assert min(abs(float(m.get("K")) / rig.K - 1.0) for m in found) < 0.1


def test_load_equation_gives_stiffness_without_the_motor_torque():
    log = rig.drive_log(rig.drive_motion(rig.drive_torque(COUNT)), rig.drive_torque(COUNT, rms=1.5, seed=9))
    stretches = whole(experiment_from_log(log, hold="zero-order", N=rig.N))
    found = _weak_form(PLACEHOLDER, stretches, 96, "load")
    assert found is not None
    assert float(found.get("K")) == pytest.approx(rig.K, rel=0.02)


@pytest.mark.parametrize("gain", [rig.GAIN, -rig.GAIN])
def test_starting_values_of_a_reduced_log_are_near_the_truth(gain: float):
    experiment = rig.reduced_experiment(COUNT, noise=1e-4, gain=gain)
    found = starting_models(REDUCED_PLACEHOLDER, whole(experiment))
    best = min(found, key=lambda m: abs(np.log(float(m.get("omega_0")) / rig.OMEGA_0)))
    assert float(best.get("omega_0")) == pytest.approx(rig.OMEGA_0, rel=0.05)
    assert float(best.get("gain")) == pytest.approx(gain, rel=0.1)
    assert float(best.get("mu")) == pytest.approx(rig.MU, rel=0.5)
    assert float(best.get("alpha")) == pytest.approx(rig.REDUCED_ALPHA, rel=0.5)


def test_starting_values_use_several_logs_together():
    parts = [Stretch(rig.drive_experiment(700, seed=s), 0, 700) for s in (1, 2)]
    found = starting_models(PLACEHOLDER, parts)
    assert min(abs(float(m.get("K")) / rig.K - 1.0) for m in found) < 0.1


def test_log_with_negative_stiffness_is_refused():
    # Every weak form estimates a negative stiffness.
    torque = rig.drive_torque(COUNT)
    motion = rig.drive_motion(torque, stiffness=-1.0, alpha=0.0, damping=0.0)
    log = rig.drive_log(motion, torque, noise=0.0, name="runaway")
    with pytest.raises(DataError, match="runaway.*check the signs and units of motor_torque"):
        starting_models(PLACEHOLDER, whole(experiment_from_log(log, hold="zero-order", N=rig.N)))


def test_reduced_log_with_exponential_growth_is_refused():
    time = np.arange(COUNT) * rig.REDUCED_STEP
    log = rig.reduced_log(np.cosh(2.0 * (time - time.mean())), rig.reduced_forcing(COUNT))
    with pytest.raises(DataError, match="reduced: the dynamic error does not follow"):
        starting_models(REDUCED_PLACEHOLDER, whole(experiment_from_log(log, hold="zero-order")))


def test_log_shorter_than_the_windows_is_refused():
    experiment = rig.reduced_experiment(30)
    with pytest.raises(DataError):
        starting_models(REDUCED_PLACEHOLDER, whole(experiment))


def test_weak_forms_blind_to_steady_load_give_stiffness_under_gravity():
    """Where gravity exceeds the motor torque, other weak forms give a far too small stiffness or none."""
    torque = np.repeat(0.1 * np.random.default_rng(0).normal(size=20), 300)
    log = rig.drive_log(rig.drive_motion(torque, gravity=20.0), torque, noise=0.1)
    stretches = whole(experiment_from_log(log, hold="zero-order", N=rig.N))
    for equation in ("error", "load"):
        seeing, blind = (_weak_form(PLACEHOLDER, stretches, 24, equation, blind=b) for b in (False, True))
        assert seeing is None or float(seeing.get("K")) < 0.5 * rig.K
        assert blind is not None and float(blind.get("K")) == pytest.approx(rig.K, rel=0.2)
