"""Lanes of a sweep against SciPy's integrators and closed forms."""

from functools import cache
from math import cos

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hdjax import Drive, Harmonic, ReducedDrive, ReducedModel, TwoInertiaModel
from hdjax.effects import BY_NAME, Scales
from hdjax.sweep.cheapest_route import choose
from hdjax.sweep.points import Points
from hdjax.sweep.request import Case, Request
from hdjax.sweep.runge_kutta import march_steps
from hdjax.sweep.splitting import ABA864, SRKN14, STRANG, march_split, splits
from hdjax.sweep.transients import TransientRoute, transients
from hdjax.sweep.windows import Windows, largest_between

DURATION, WINDOWS = 40.0, 4
_SPLIT = {"backlash": True, "undamped_backlash": False, "smooth_knee_stiffness": True, "quadratic_damping": False}
# mu, omega_0, alpha, amplitude, omega, phase, offset
CASES = {
    "hardening": (0.05, 1.0, 0.5, 0.3, 0.9, 0.4, 0.0),
    "softening": (0.1, 1.3, -0.1, 0.2, 0.7, 0.0, 0.0),
    "offset": (0.1, 1.0, 0.3, 0.3, 1.4, -1.0, 0.2),
    "overdamped": (3.0, 1.0, 0.5, 1.0, 0.8, 0.0, 0.0),
    "critically damped": (2.0, 1.0, 0.5, 1.0, 0.8, 0.0, 0.0),
    "undamped at resonance": (0.0, 1.0, 0.01, 0.05, 1.0, 0.0, 0.0),
}


def posed(case: str) -> tuple[ReducedModel, Harmonic]:
    mu, omega_0, alpha, amplitude, omega, phase, offset = CASES[case]
    drive = ReducedDrive(mu=mu, omega_0=omega_0, alpha=alpha)
    return ReducedModel(drive), Harmonic(amplitude, omega, phase, offset)


@cache
def scipy_solution(case: str) -> Windows:
    mu, omega_0, alpha, amplitude, omega, phase, offset = CASES[case]

    def field(t, y):
        push = amplitude * cos(omega * t + phase) + offset
        return [y[1], push - mu * y[1] - omega_0**2 * (y[0] + alpha * y[0] ** 3)]

    found = solve_ivp(field, (0.0, DURATION), [0.2, -0.1], "DOP853", rtol=1e-12, atol=1e-13, dense_output=True)
    times = np.linspace(0.0, DURATION, 40_001)
    x, v = found.sol(times)
    step = 40_000 // WINDOWS
    peak = [np.max(np.abs(x[i * step : (i + 1) * step + 1])) for i in range(WINDOWS)]
    return Windows(jnp.asarray(x[step::step]), jnp.asarray(v[step::step]), jnp.asarray(peak))


@eqx.filter_jit
def run(model, forcing, state, duration, substeps, method) -> Windows:
    options = {"windows": WINDOWS, "substeps": substeps, "peaks": True}
    if method is None:
        return march_steps(model, forcing, state, duration, **options)
    return march_split(model, forcing, state, duration, method=method, **options)


def error(case: str, method, substeps: int) -> float:
    start, exact = jnp.asarray([0.2, -0.1]), scipy_solution(case)
    found = run(*posed(case), start, jnp.asarray(DURATION), jnp.asarray(substeps), method)
    size = float(jnp.max(exact.peak))
    return max(float(jnp.max(jnp.abs(a - b))) for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(exact))) / size  # noqa: B905


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("method", [ABA864, None], ids=["splitting", "Tsit5"])
def test_sweep_lanes_agree_with_scipy(case, method):
    # Errors are those of the dense search for the largest |x| on SciPy's side, (omega dt)^2 / 8 = 1e-7, and the steps.
    assert error(case, method, 100) < 1e-6


@pytest.mark.parametrize(("method", "factor"), [(STRANG, 3.0), (ABA864, 10.0), (SRKN14, 30.0)])
def test_halved_steps_reduce_the_error_by_the_order_of_the_method(method, factor):
    # Orders 2, 4 and 6, where alpha x^2 is not small. The largest |x| comes from an interpolant of its own.
    coarse, fine = (
        run(*posed("hardening"), jnp.asarray([0.2, -0.1]), jnp.asarray(DURATION), jnp.asarray(n), method).x
        for n in ((5, 10) if method is SRKN14 else (16, 32))
    )
    exact = scipy_solution("hardening").x
    assert jnp.max(jnp.abs(coarse - exact)) > factor * jnp.max(jnp.abs(fine - exact))


@pytest.mark.parametrize("case", ["hardening", "undamped at resonance"])
def test_single_precision_input_gives_single_precision_results(case):
    model, forcing = jax.tree.map(lambda a: a.astype(jnp.float32), posed(case))
    start = jnp.asarray([0.2, -0.1], dtype=jnp.float32)
    found = run(model, forcing, start, jnp.asarray(DURATION, dtype=jnp.float32), jnp.asarray(50), ABA864)
    assert {a.dtype for a in jax.tree.leaves(found)} == {jnp.dtype(jnp.float32)}
    assert jnp.max(jnp.abs(found.x.astype(float) - scipy_solution(case).x)) < 1e-4


def test_largest_between_finds_the_maximum_of_a_cosine():
    h, t = 0.5, 0.2 - 0.5
    ends = [(np.cos(s), -np.sin(s), -np.cos(s)) for s in (t, t + h)]
    found = largest_between(*[tuple(map(jnp.asarray, e)) for e in ends], jnp.asarray(h))
    # The quintic's error is h^6 / 46080.
    assert abs(float(found) - 1.0) < 4e-7


def drive_case(*effects, alpha: float = 20.0) -> Case:
    drive = Drive(N=50.0, J_m=5.26e-4, J_l=0.05, K=7160.0, alpha=alpha, B_sp=0.2)
    return Case(TwoInertiaModel(drive).with_effects(*effects), Harmonic(2.0, 385.0))


def requested(tolerance: float, outputs=("final",)) -> Request:
    points = Points({"K": np.linspace(6e3, 8e3, 4), "forcing.omega": np.linspace(300.0, 450.0, 20)})
    return Request(points, "transient", outputs, duration=0.1, windows=2, tolerance=tolerance)


@pytest.mark.parametrize(
    ("case", "tolerance", "method"),
    [
        pytest.param(drive_case(alpha=0.1), 1e-3, "strang", marks=pytest.mark.slow),
        pytest.param(drive_case(), 1e-6, "aba864", marks=pytest.mark.slow),
        pytest.param(drive_case(alpha=2e5), 1e-6, "srkn14", marks=pytest.mark.slow),
        (drive_case(BY_NAME["quadratic_damping"](c2=0.1)), 1e-6, "tsit5"),
    ],
    ids=["next to linear, loosely", "nonlinear a little", "strongly nonlinear", "damping by the rate"],
)
def test_cheapest_route_keeps_the_tolerance(case, tolerance, method):
    # The others cost at least half as much again; alpha x^2 is 1e-6, 1e-4 and about 1.
    route, check = choose(case, requested(tolerance))
    assert route.method == method
    assert route.single == (tolerance > 1e-4)
    assert 0.0 < check.error <= tolerance


def test_only_what_depends_on_the_twist_alone_is_split():
    scales = Scales(1e-3, 1e-3, 0.1, 1.0, 1.0, 1e-3)
    for name, kept in _SPLIT.items():
        assert splits(drive_case(BY_NAME[name].proposals(scales)[0]).model, Harmonic(1.0, 1.0)) == kept


def test_splitting_of_two_inertias_agrees_with_adaptive_steps():
    case, request = drive_case(BY_NAME["quadratic_stiffness"](k2=2.0)), requested(1e-6)
    values = request.points.values(np.arange(70))
    exact, reached = transients(case, request, TransientRoute("adaptive", 40), values)
    found, _ = transients(case, request, TransientRoute("aba864", 100), values)
    assert reached.all() and exact.x.shape == (70, 2)
    # The tolerance of the reference is 1e-11 a step.
    np.testing.assert_allclose(found.x, exact.x, rtol=0.0, atol=1e-8 * np.abs(exact.x).max())
