"""Identifiability, compared with other logs, with refits at other values and with closed-form structure."""

import re
from dataclasses import replace

import equinox as eqx
import numpy as np
import pytest

import rig
from fitting.estimation.estimate import Fit, Start, Strategy, fit
from fitting.estimation.experiment import Experiment, Stretch, experiment_from_log
from fitting.estimation.problem import Segmentation
from fitting.uncertainty import identifiability as module
from fitting.uncertainty.held_values import _held_one
from fitting.uncertainty.identifiability import (
    at_bound,
    identifiability,
    needed_samples,
    needed_twist,
    outside_domain,
    reason,
)
from fitting.uncertainty.standard_errors import Estimate, Uncertainty, uncertainty
from hdjax.effects.hysteresis import BoucWen
from hdjax.effects.learned import LearnedMeshTorque
from hdjax.effects.learned_axes import LinearAxis
from hdjax.effects.presliding import LuGreMotorFriction
from hdjax.parameters import ParameterInfo

COUNT, HORIZON, NOISE = 1000, 128, 2e-3
DRIVE_COUNT, DRIVE_HORIZON = 2000, 256


def reduced_fit(experiment: Experiment, paths=("mu", "omega_0", "alpha", "gain"), **start) -> Fit:
    stretches = [Stretch(experiment, 0, len(experiment))]
    return fit(rig.reduced_model(**start), stretches, paths, Segmentation(HORIZON, substeps=2, count=8))


def drive_fit(model, paths=("K", "alpha", "B_sp"), **options) -> Fit:
    stretches = [Stretch(rig.drive_experiment(DRIVE_COUNT), 0, DRIVE_COUNT)]
    return fit(model, stretches, paths, Segmentation(DRIVE_HORIZON, substeps=1, count=8), **options)


@pytest.fixture(scope="module")
def small_twist_fit() -> tuple[Fit, Estimate]:
    """A log whose twist is too small to determine alpha."""
    found = reduced_fit(rig.reduced_experiment(COUNT, noise=NOISE, rms=0.5), alpha=0.0)
    return found, uncertainty(found).estimates["alpha"]


def test_alpha_becomes_identifiable_above_the_needed_twist(small_twist_fit: tuple[Fit, Estimate]):
    _, alpha = small_twist_fit
    assert not alpha.identifiable
    x_max = 0.5 / 10.0 * np.max(np.abs(rig.reduced_experiment(COUNT).measured))
    # At the needed twist, the interval of alpha just reaches zero; both cases are well below and well above it.
    factor = needed_twist(alpha, rig.REDUCED_ALPHA, x_max=1.0)
    seen = {}
    for share in (0.6, 1.7):
        experiment = rig.reduced_experiment(COUNT, noise=NOISE, rms=0.5 * share * factor)
        seen[share] = uncertainty(reduced_fit(experiment, alpha=0.0)).estimates["alpha"]
    assert not seen[0.6].identifiable and seen[1.7].identifiable
    # The error falls with the cube of the twist while the motion is nearly linear; noise estimates differ by 20 %.
    assert seen[0.6].std_classical / seen[1.7].std_classical == pytest.approx((1.7 / 0.6) ** 3, rel=0.2)
    assert f"{max(map(abs, alpha.ci95)) * x_max**2:.2g}" in reason(alpha, x_max=x_max, x_unit="[x]")


def test_needed_samples_grow_with_the_square_of_the_standard_error(small_twist_fit: tuple[Fit, Estimate]):
    _, alpha = small_twist_fit
    assert needed_samples(alpha, 0.5 * alpha.std) == pytest.approx(4 * needed_samples(alpha, alpha.std))
    assert needed_samples(alpha, 0.0) == np.inf == needed_twist(alpha, 0.0, x_max=1.0)


def test_report_of_a_log_with_small_twist_states_that_alpha_is_not_identifiable(small_twist_fit: tuple[Fit, Estimate]):
    found, _ = small_twist_fit
    result = identifiability(found, uncertainty(found))
    assert set(result.reasons) == {"alpha"}
    assert result.reasons["alpha"].startswith("alpha is not identifiable from these logs: |alpha| is at most")
    assert "they would need a twist above" in result.reasons["alpha"]
    assert result.note("alpha") == result.reasons["alpha"] and result.note("mu") is None
    assert result.bounds == {} and not any(d.sentence for d in result.directions)
    # The only weak direction is that of alpha.
    weakest = result.directions[0]
    assert abs(weakest.weights["alpha"]) > 0.99
    assert [d.std for d in result.directions] == sorted((d.std for d in result.directions), reverse=True)


def test_slow_log_determines_only_ratios_to_the_squared_natural_frequency():
    """Far below its resonance, the oscillator follows `gain u / omega_0^2` with the delay `mu / omega_0^2`."""
    time = np.arange(COUNT) * rig.REDUCED_STEP
    forcing, omega = 300.0 * np.sin(2 * np.pi * 0.25 * time), 2 * np.pi * 0.25
    start = (0.0, 300.0 * rig.GAIN / rig.OMEGA_0**2 * omega)
    motion = rig.reduced_motion(forcing, mu=30.0, state=start)
    experiment = experiment_from_log(rig.reduced_log(motion[:, 0], forcing, noise=5e-3), hold="zero-order")
    found = reduced_fit(experiment, mu=30.0)
    (weak,) = [d for d in identifiability(found, uncertainty(found)).directions if d.sentence is not None]
    # In the weak direction, log gain and log mu change by twice log omega_0; only the delay depends on mu.
    for path in ("gain", "mu"):
        relative = weak.weights[path] * weak.units[path] / float(found.model.get(path))
        assert relative / weak.weights["omega_0"] == pytest.approx(2.0, rel=0.05), path
    assert weak.sentence is not None
    assert "do not separate mu, omega_0 and gain" in weak.sentence
    assert re.search(r"They determine mu omega_0\^-2(\.1)? and gain omega_0\^-2, but no factor alone", weak.sentence)


@pytest.mark.parametrize(
    ("weak", "told"),
    [
        ([(1.0, -1.0, 0.0, 0.0)], ["do not separate mu and omega_0: mu by"]),
        (
            [(1.0, -1.0, 0.0, 0.0), (0.0, 1.0, -1.0, 0.0)],
            ["do not separate mu, omega_0 and alpha: 2 combinations of them are not determined."],
        ),
        ([(1.0, 1.0, 1.0, -1.0)], ["do not separate mu, omega_0, alpha and gain: one combination of them is not"]),
        (
            [(1.0, -1.0, 0.0, 0.0), (0.0, 0.0, 2.0, -1.0)],
            ["separate alpha and gain: alpha by", "separate mu and omega"],
        ),
    ],
)
def test_weak_directions_of_the_same_parameters_are_told_together(
    small_twist_fit: tuple[Fit, Estimate], weak: list[tuple[float, ...]], told: list[str]
):
    found = small_twist_fit[0]
    covariance = 1e-6 * np.eye(4) + sum(np.outer(axis, axis) for axis in weak)
    given = eqx.tree_at(lambda u: u.covariance, uncertainty(found), covariance)
    sentences = [d.sentence for d in identifiability(found, given).directions if d.sentence is not None]
    assert len(sentences) == len(told)
    assert all(part in sentence for part, sentence in zip(told, sentences, strict=True)), sentences


def test_coefficients_of_a_learned_function_are_not_named():
    """Where all are fitted, a named parameter has the error that the whole covariance gives it."""
    variables, start = (LinearAxis("x"), LinearAxis("v")), rig.reduced_model()
    model = start.with_effects(LearnedMeshTorque.made_of(variables, np.ones((1, 1)), [0.0]))
    stretches = [Stretch(rig.reduced_experiment(COUNT, noise=NOISE), 0, COUNT)]
    paths = ("mu", "omega_0", "gain", "learned_mesh_torque.c_0")
    found = fit(model, stretches, paths, Segmentation(HORIZON, substeps=2, count=8))
    known = uncertainty(found)
    result = identifiability(found, known)
    axes = [np.array(list(d.weights.values())) for d in result.directions]
    covariance = sum(d.std**2 * np.outer(axis, axis) for d, axis in zip(result.directions, axes, strict=True))
    assert [list(d.weights) for d in result.directions] == [list(paths[:3])] * 3
    assert covariance == pytest.approx(known.covariance[:3, :3], rel=1e-6, abs=1e-12)


@pytest.fixture(scope="module")
def fitted_drive() -> Fit:
    return drive_fit(rig.drive_model(K=0.9 * rig.K, alpha=0.0))


def test_sensitivity_to_a_fixed_inertia_equals_that_of_a_refit(fitted_drive: Fit):
    found = uncertainty(fitted_drive)
    result = identifiability(fitted_drive, found)
    assert [h.path for h in result.held] == ["J_m", "J_l"]
    for held in result.held:
        # A step small enough to be linear, at the same weights.
        moved = fitted_drive.model.replace({held.path: (1 + 1e-4) * held.value})
        wrong = drive_fit(moved, start=Start(fitted_drive.covariance), strategy=Strategy(reweigh=False))
        for path in ("K", "alpha", "B_sp"):
            value = found.estimates[path].value
            change = float(wrong.model.get(path)) / value - 1.0
            # The iteration stops at a thousandth of a standard error or so.
            tolerance = 0.05 * abs(change) + 0.02 * found.estimates[path].std / abs(value)
            assert 0.01 * held.changes[path] == pytest.approx(change, abs=tolerance), (held.path, path)
            assert held.path != "J_l" or path != "K" or abs(change) > 10 * tolerance
        assert f"if it is 1 % too large there, that changes K by {100 * held.changes['K']:+.2g} %" in held.sentence


@pytest.mark.slow
def test_predicted_errors_with_a_free_inertia_equal_those_of_a_refit(fitted_drive: Fit):
    result = identifiability(fitted_drive, uncertainty(fitted_drive))
    wider = uncertainty(drive_fit(fitted_drive.model, ("K", "alpha", "B_sp", "J_l"))).estimates
    held = uncertainty(fitted_drive).estimates
    told = result.held[1].std_if_free
    for path in ("K", "B_sp"):
        # Growth of the classical errors; robust errors are themselves uncertain by 20 %.
        growth = wider[path].std_classical / held[path].std_classical
        assert told[path] * held[path].value / held[path].std == pytest.approx(growth, rel=0.35), path
    assert told["K"] > held["K"].std / held["K"].value


def test_parameter_near_zero_is_reported_at_its_bound(fitted_drive: Fit):
    gone = eqx.tree_at(lambda f: f.model, fitted_drive, fitted_drive.model.replace({"K": 1e-5 * rig.K}))
    result = identifiability(gone, uncertainty(fitted_drive))
    assert set(result.bounds) == {"K"}
    assert result.bounds["K"].startswith("K went from") and "its bound at zero" in result.bounds["K"]
    assert result.note("K") == result.bounds["K"]
    assert identifiability(fitted_drive, uncertainty(fitted_drive)).bounds == {}


def test_bounds_in_si_units_are_ignored_for_a_reduced_log():
    stretches = [Stretch(rig.reduced_experiment(COUNT, noise=NOISE), 0, COUNT)]
    model = rig.reduced_model().with_effects(BoucWen(k=0.01, memory_twist=0.2))
    found = fit(
        model,
        stretches,
        ["bouc_wen.k", "bouc_wen.memory_twist"],
        Segmentation(HORIZON),
        strategy=Strategy(hold_parameters=True),
    )
    assert (
        float(found.model.get("bouc_wen.memory_twist")) > found.model.parameters()["bouc_wen.memory_twist"][1].bounds[1]
    )
    assert "bouc_wen.memory_twist" not in identifiability(found, uncertainty(found)).bounds
    # What is told of an effect has the log's units too.
    gone = eqx.tree_at(lambda f: f.model, found, found.model.replace({"bouc_wen.memory_twist": 1e-6}))
    assert (
        "to 1e-06 [x], its bound at zero" in identifiability(gone, uncertainty(found)).bounds["bouc_wen.memory_twist"]
    )


@pytest.mark.parametrize(
    ("excess", "ci95", "outside"),
    [
        (0.5, (0.4, 0.6), []),
        (1e9, (1e8, 1e10), ["lugre_motor_friction.excess"]),  # the data need a larger one than there are
        (1e9, (1e-9, 1e27), []),  # they do not determine it
    ],
)
def test_only_what_the_data_determine_can_leave_its_domain(
    small_twist_fit: tuple[Fit, Estimate], excess: float, ci95: tuple[float, float], outside: list[str], monkeypatch
):
    friction = LuGreMotorFriction(T_c=0.1, excess=excess, omega_s=0.1, bend=1e-3, tau=1e-3, settling=1e-4)
    found, alpha = small_twist_fit
    found = eqx.tree_at(lambda f: f.model, found, rig.drive_model().with_effects(friction))
    estimate = replace(alpha, path="lugre_motor_friction.excess", value=excess, ci95=ci95)
    known = Uncertainty({estimate.path: estimate}, *[np.eye(1)] * 3)
    monkeypatch.setattr(module, "uncertainty", lambda fit, **_: known)
    assert outside_domain(found, "lugre_motor_friction") == outside


@pytest.mark.parametrize(
    ("value", "bounds", "start", "stopped"),
    [
        (7160.0, (0.0, 1e9), 7000.0, False),
        (9.95e8, (0.0, 1e9), 7000.0, True),
        (1.1e9, (0.0, 1e9), 7000.0, True),
        (1e-5, (0.0, 1e9), 7000.0, True),
        (1e-5, (0.0, 1e9), 2e-5, False),
        (-0.3, (-np.inf, np.inf), 0.2, False),
        (0.5, (0.5, 2.0), 1.0, True),
    ],
)
def test_at_bound_depends_on_value_bounds_and_start(
    value: float, bounds: tuple[float, float], start: float, stopped: bool
):
    info = ParameterInfo(unit="1", doc="", source="", bounds=bounds, plausible=(0.0, np.inf), role="base")
    assert (at_bound("K", value, info, start=start) is not None) is stopped


@pytest.mark.parametrize(
    ("path", "ci95", "words"),
    [
        ("K", (0.0, 3e4), "K is not identifiable from these logs: it may lie between 0 and 3e+04 rad."),
        ("K", (2.0, np.inf), "it may lie above 2 rad."),
        ("c", (-np.inf, 3.0), "it may lie below 3 rad. For 1 rad to differ from zero they would need 15 times"),
        ("c", (-np.inf, np.inf), "it may lie anywhere. For"),
        ("c", (-1.0, 3.0), "it may be anything up to 3 rad either way. For"),
        (
            "alpha",
            (-1.0, 3.0),
            "alpha x^2 is at most 12 at their largest twist of 2 V. For 1 rad to differ from zero they",
        ),
    ],
)
def test_reason_states_the_interval_of_an_unidentifiable_parameter(path: str, ci95: tuple[float, float], words: str):
    estimate = Estimate(path, 1.0, 2.0, 2.0, ci95, "rad", False)
    assert words in reason(estimate, x_max=2.0, x_unit="V")


def test_reduced_log_has_no_fixed_inertias(small_twist_fit: tuple[Fit, Estimate]):
    found, _ = small_twist_fit
    assert identifiability(found, uncertainty(found)).held == ()


def test_inertia_with_very_large_sensitivity_is_reported_as_critical(fitted_drive: Fit):
    """Where the motor turns far, an error of its inertia is beyond the range of first-order sensitivities."""
    held = _held_one(fitted_drive, "J_m", {"K": -0.23, "alpha": 0.1, "B_sp": 3.8}, {})
    assert held.sentence.endswith("must be correct there: K and B_sp can't compensate an error of 1 %.")
