"""Torque-twist curves against closed forms, and hysteresis against a spring with a slider solved step by step."""

import numpy as np
import pytest

from fitting.quasi_static.torque_twist import MEMORIES, SHAPES, Curve, Shape, hysteresis_branch, loop, twist

COEFFICIENTS: dict[Shape, np.ndarray] = {
    "linear": np.log([3e4]),
    "cubic": np.array([np.log(3e4), 2e5]),
    "two slopes": np.log([3e4, 4.5e4, 15.0]),
    "three slopes": np.log([3e4, 4.5e4, 6e4, 15.0, 35.0]),
}
TORQUE = np.linspace(-100.0, 100.0, 401)


def test_three_slopes_agree_with_the_formula_of_the_vendors() -> None:
    x, _ = twist("three slopes", COEFFICIENTS["three slopes"], np.array([10.0, 15.0, 30.0, 50.0, 80.0]))
    # Angle = T1/K1 + (T2 - T1)/K2 + (T - T2)/K3, as in the vendors' catalogues.
    first, second = 15 / 3e4, 15 / 3e4 + 35 / 4.5e4
    np.testing.assert_allclose(x, [10 / 3e4, first, first + 15 / 4.5e4, second, second + 30 / 6e4], rtol=1e-14)


@pytest.mark.parametrize("alpha", [3e5, 1e-3, 0.0, -1e4])
def test_cubic_curve_solves_its_equation(alpha: float) -> None:
    x, _ = twist("cubic", np.array([np.log(3e4), alpha]), TORQUE)
    np.testing.assert_allclose(3e4 * (x + alpha * x**3), TORQUE, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("blur", [0.0, 3.0])
def test_curves_are_odd_and_their_slopes_are_derivatives(shape: Shape, blur: float) -> None:
    x, slope = twist(shape, COEFFICIENTS[shape], TORQUE, blur=blur)
    np.testing.assert_allclose(x, -x[::-1], rtol=0, atol=1e-17)
    # Knees at 15 and 50 are left out: the difference there is the mean of two slopes.
    away = (np.abs(np.abs(TORQUE) - 15.0) > 0.6) & (np.abs(np.abs(TORQUE) - 50.0) > 0.6)
    step = 1e-4
    ends = [twist(shape, COEFFICIENTS[shape], TORQUE + s, blur=blur)[0] for s in (step, -step)]
    np.testing.assert_allclose(slope[away], ((ends[0] - ends[1]) / (2 * step))[away], rtol=1e-6)


def test_blurred_curve_is_the_expectation_under_noise() -> None:
    # Gauss-Hermite quadrature with 200 nodes resolves a knee to about 1e-3 of the blur.
    nodes, weights = np.polynomial.hermite_e.hermegauss(200)
    at = np.array([-55.0, -14.0, 0.0, 15.0, 17.0, 48.0])
    sharp, _ = twist("three slopes", COEFFICIENTS["three slopes"], (at[:, None] + 4.0 * nodes).ravel())
    expected = sharp.reshape(len(at), -1) @ weights / np.sum(weights)
    blurred, _ = twist("three slopes", COEFFICIENTS["three slopes"], at, blur=4.0)
    np.testing.assert_allclose(blurred, expected, rtol=0, atol=1e-3 * 4.0 / 3e4)


def slider_torque(x: np.ndarray, K: float, k: float, most: float) -> np.ndarray:
    """Torque of a spring K parallel to a spring k in series with a slider that holds up to `most`."""
    borne, torque = 0.0, []
    for before, now in zip(np.append(x[0], x[:-1]), x, strict=True):
        borne = min(most, max(-most, borne + k * (now - before)))
        torque.append(K * now + borne)
    return np.array(torque)


def test_abrupt_hysteresis_agrees_with_a_spring_beside_a_slider() -> None:
    phase = np.linspace(0.0, 3.0, 3001)
    x = 3e-3 * np.sin(2 * np.pi * phase) * (1.0 - 0.2 * phase)
    K, k, most = 3e4, 9e4, 4.0
    torque = slider_torque(x, K, k, most)
    # The torque between both states of the slider is most (K + k)/k in each direction.
    path = hysteresis_branch("abrupt", torque, most * (K + k) / k, 0.0)
    np.testing.assert_allclose((torque - most * path) / K, x, rtol=0, atol=1e-12)


@pytest.mark.parametrize("memory", MEMORIES)
def test_hysteresis_depends_on_the_path_and_not_on_the_sampling(memory) -> None:
    turns = np.array([0.0, 50.0, -20.0, 30.0, -50.0])
    fine = np.concatenate([np.linspace(a, b, 101)[:-1] for a, b in zip(turns, turns[1:], strict=False)] + [turns[-1:]])
    np.testing.assert_allclose(
        hysteresis_branch(memory, fine, 7.0, 0.3)[::100], hysteresis_branch(memory, turns, 7.0, 0.3), rtol=0, atol=1e-12
    )


def test_loop_width_follows_from_the_friction_torque() -> None:
    curve = Curve("linear", "abrupt", biased=False, drifting=False, logs=1)
    parameters = np.zeros(len(curve.names))
    parameters[[0, curve.places["friction"], curve.places["log reach"]]] = np.log(3e4), 4.0, np.log(6.0)
    torque, rising, falling = loop(curve, parameters, 80.0)
    assert torque[100] == pytest.approx(0.0, abs=1e-12)
    assert falling[100] - rising[100] == pytest.approx(2 * 4.0 / 3e4, rel=1e-12)
    assert falling[-1] == pytest.approx(rising[-1], rel=1e-12)
