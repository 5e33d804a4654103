"""Transients of drives with effects by machine code, against adaptive steps of diffrax."""

import dataclasses

import numpy as np
import pytest

from hdjax import Drive, Harmonic, TwoInertiaModel
from hdjax.effects import BY_NAME, CATALOGUE, ActuatorEffect, Effect, Scales
from hdjax.engine.kernel import one_thread
from hdjax.forcing import Chirp
from hdjax.sweep import machine_code
from hdjax.sweep.cheapest_route import choose
from hdjax.sweep.points import Points
from hdjax.sweep.request import Case, Request
from hdjax.sweep.transients import TransientRoute, transients

DRIVE = Drive(N=50.0, J_m=5.26e-4, J_l=0.05, K=7160.0, alpha=20.0, B_sp=0.2)
SCALES = Scales(
    x=1e-3, x_max=3e-3, v=0.4, omega_m=20.0, omega_l=0.4, time_step=1e-3, duration=1.0, reduction_ratio=50.0
)
POINTS = Points({"K": np.linspace(6e3, 8e3, 3), "forcing.phase": np.linspace(0.0, 1.5, 5)})
HARMONIC = Harmonic(2.0, 385.0, 0.3, 0.1)
# Actuator effects change a logged torque, which a sweep's forcing is not; thermal effects need a temperature.
FORMS = [f for f in CATALOGUE if not issubclass(f, ActuatorEffect) and f.proposals(SCALES)]
FEW = ("motor_friction", "bouc_wen", "load_disturbance")

# Where the torque's slope jumps, steps lose their order.
SHARP = ("three_slope_stiffness", "load_dependent_friction", "backlash", "undamped_backlash")


def case_with(form: type[Effect]) -> Case:
    """A drive with an effect that changes its motion."""
    effect = (*form.typical(SCALES), *form.proposals(SCALES))[0]
    model = TwoInertiaModel(DRIVE, (effect,))
    own = {path: float(value) for path, (value, _) in model.parameters().items() if path.startswith(effect.name)}
    return Case(model.replace({path: 1e-3 for path, value in own.items() if value == 0.0}), HARMONIC)


def requested(**options) -> Request:
    settings = {"duration": 0.1, "windows": 2} | options
    return Request(POINTS, "transient", ("final", "peak"), **settings)


def difference(case: Case, request: Request, route: TransientRoute) -> float:
    """Difference from adaptive steps, relative to the largest twist."""
    values = request.points.values(np.arange(request.points.size))
    exact, reached = transients(case, request, TransientRoute("adaptive", 200, tolerance=1e-11), values)
    found, finite = transients(case, request, route, values)
    assert reached.all() and finite.all()
    size = np.max(exact.peak)
    parts = {"x": size, "peak": size, "v": 385.0 * size}
    return max(float(np.max(np.abs(getattr(found, n) - getattr(exact, n)) / unit)) for n, unit in parts.items())


@pytest.mark.parametrize(
    "form", [pytest.param(f, marks=[] if f.name in FEW else pytest.mark.slow, id=f.name) for f in FORMS]
)
def test_transient_of_every_effect_agrees_with_adaptive_steps(form: type[Effect]):
    steps, bound = (1000, 5e-3) if form.name in SHARP else (100, 2e-5)
    assert difference(case_with(form), requested(), TransientRoute("dopri8", steps, by_code=True)) < bound


@pytest.mark.parametrize("method", ["tsit5", "dopri8"])
def test_transient_under_a_chirp_agrees_with_adaptive_steps(method):
    chirp = Chirp(amplitude=2.0, omega_start=200.0, omega_end=600.0, duration=0.1)
    request = dataclasses.replace(requested(), points=Points({"K": POINTS.axes["K"]}))
    case = Case(TwoInertiaModel(DRIVE), chirp)
    assert difference(case, request, TransientRoute(method, 400, by_code=True)) < 1e-7


def test_duration_in_periods_follows_the_forcing_of_each_point():
    points = Points({"forcing.omega": np.linspace(300.0, 450.0, 5)})
    request = dataclasses.replace(requested(), points=points, duration=None, periods=5.0)
    case = Case(TwoInertiaModel(DRIVE), HARMONIC)
    assert difference(case, request, TransientRoute("dopri8", 100, by_code=True)) < 1e-8


def test_point_is_bitwise_independent_of_other_points_and_threads():
    """Results are compared with those of fewer points, and of one thread."""
    case, request = case_with(next(f for f in FORMS if f.name == "motor_friction")), requested()
    route = TransientRoute("tsit5", 40, by_code=True)
    whole, _ = transients(case, request, route, request.points.values(np.arange(15)))
    few, _ = transients(case, request, route, request.points.values(np.array([11, 3])))
    with one_thread():
        alone, _ = transients(case, request, route, request.points.values(np.arange(15)))
    np.testing.assert_array_equal(few.x, whole.x[np.array([11, 3])])
    for name in ("x", "v", "peak"):
        np.testing.assert_array_equal(getattr(alone, name), getattr(whole, name))


def test_transients_fall_back_to_xla_without_machine_code(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(machine_code, "_MADE", {})
    monkeypatch.setattr(machine_code, "unusable", lambda: "llvmlite is not installed")
    case, request = case_with(next(f for f in FORMS if f.name == "quadratic_damping")), requested()
    route, check = choose(case, request)
    assert not route.by_code and route.method == "tsit5" and check.error <= request.tolerance
    with pytest.raises(RuntimeError, match="missing here"):
        transients(case, request, TransientRoute("dopri8", 10, by_code=True), request.points.values(np.arange(2)))


def test_effect_on_the_logged_torque_is_refused():
    case = Case(TwoInertiaModel(DRIVE, (BY_NAME["torque_bias"](),)), HARMONIC)
    with pytest.raises(ValueError, match="torque_bias"):
        case.require(requested())
