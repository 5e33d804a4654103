"""Multiple scales against frequency equations, linear limits, harmonic balance and scipy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from phasors import balanced, phasors
from scipy.integrate import solve_ivp

from hdjax.drive import Drive, ReducedDrive
from hdjax.response.multiple_scales import (
    PrimaryResonance,
    Resonance,
    SubharmonicResonance,
    SuperharmonicResonance,
    first_order,
    printed_error_forcing,
    printed_primary,
    printed_subharmonic,
    printed_superharmonic,
    second_order,
)

W0 = 2.0
KINDS = (PrimaryResonance, SuperharmonicResonance, SubharmonicResonance)
# Where all of them have three branches: mu, alpha, A, sigma at epsilon = 1.
BENT = {
    PrimaryResonance: (0.2, 3.0, 0.5, 0.9),
    SuperharmonicResonance: (0.08, 1.2, 2.0, 1.07),
    SubharmonicResonance: (0.2, 1.5, 16.0, 2.4),
}


def resonance(kind: type[Resonance], epsilon: float = 1.0, sign: float = 1.0) -> tuple[Resonance, float]:
    """A resonance with its small quantities multiplied by `epsilon`, and a frequency."""
    mu, alpha, A, sigma = BENT[kind]
    A = epsilon * A if kind is PrimaryResonance else A
    drive = ReducedDrive(mu=epsilon * mu, omega_0=W0, alpha=sign * epsilon * alpha)
    made = kind(drive, A)
    return made, float(made.omega(sign * epsilon * sigma))


def equation_residual(kind: type[Resonance], made: Resonance, sigma: float, a: np.ndarray) -> np.ndarray:
    """The frequency equation of DESIGN 2.3 for a > 0, relative to its largest term."""
    mu, alpha, A = (float(v) for v in (made.drive.mu, made.drive.alpha, made.A))
    if kind is PrimaryResonance:
        left, right = (mu**2 / 4 + (sigma - 3 / 8 * W0 * alpha * a**2) ** 2) * a**2, A**2 / (4 * W0**2)
    elif kind is SuperharmonicResonance:
        C = 9 * A / (8 * W0**2)
        left = mu**2 / 4 * a**2 + (sigma * a - 3 / 4 * W0 * alpha * C**2 * a - 3 / 8 * W0 * alpha * a**3) ** 2
        right = (W0 * alpha * C**3 / 8) ** 2
    else:
        C = -A / (8 * W0**2)
        left = 9 / 4 * mu**2 + (sigma - 9 / 4 * W0 * alpha * C**2 - 9 / 8 * W0 * alpha * a**2) ** 2
        right = (9 / 8 * W0 * alpha * C * a) ** 2
    return (left - right) / right


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("kind", KINDS)
def test_branches_solve_the_frequency_equation(kind, sign):
    made, omega = resonance(kind, sign=sign)
    branches = made.branches(omega)
    assert bool(jnp.all(branches.exists))
    assert list(branches.stable) == [True, False, True]
    a = np.asarray(branches.amplitude)
    assert np.all(np.diff(a) > 0)
    sigma = float(made.sigma(omega))
    solved = a[a > 0]
    assert solved.size == (2 if kind is SubharmonicResonance else 3)
    # Rounding of the cubic's roots, enlarged by the steepness of its sides.
    np.testing.assert_allclose(equation_residual(kind, made, sigma, solved), 0, atol=1e-11)
    for value in solved:
        points = made.detuning(value)
        assert bool(jnp.all(points.exists))
        assert np.min(np.abs(np.asarray(points.sigma) - sigma)) < 1e-12


@pytest.mark.parametrize("branch", [0, 1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_errors_fall_with_the_order_of_the_expansion(kind, branch):
    epsilons = np.logspace(-1.5, -3.5, 5)
    errors = []
    for epsilon in epsilons:
        made, omega = resonance(kind, epsilon)
        states = [solve(made, omega) for solve in (first_order, second_order)]
        assert bool(states[1].branches.exists[branch])
        found = [phasors(s.series(branch)) for s in states]
        exact = balanced(made.drive, omega / made.forcing, {made.forcing: float(made.A)}, found[1])
        errors.append([np.linalg.norm(X - exact) / np.linalg.norm(exact) for X in found])
    slopes = np.diff(np.log(errors), axis=0) / np.diff(np.log(epsilons))[:, None]
    # Limited by the next order at the largest epsilon, and by the harmonic balance at the smallest.
    np.testing.assert_allclose(slopes[-1], [1, 2], atol=0.05)
    np.testing.assert_allclose(slopes.mean(axis=0), [1, 2], atol=0.25)
    assert errors[-1][1] < 1e-2 * errors[-1][0]


@pytest.mark.parametrize("kind", KINDS)
def test_second_order_series_is_the_steady_motion(kind):
    """A solution of the equation of motion, started on the second-order series, stays on it for a period."""
    made, omega = resonance(kind, 1e-3)
    states = second_order(made, omega)
    series = states.series(2)
    np.testing.assert_allclose(jnp.max(series.amplitudes[made.response - 1]), states.branches.amplitude[2], rtol=1e-14)
    rate = series.derivative()
    mu, alpha, A = (float(v) for v in (made.drive.mu, made.drive.alpha, made.A))

    def motion(t: float, y: np.ndarray) -> list[float]:
        return [y[1], A * np.cos(omega * t) - mu * y[1] - W0**2 * (y[0] + alpha * y[0] ** 3)]

    t = np.linspace(0.0, 2 * np.pi * made.forcing / omega, 9)
    start = [float(series(jnp.asarray(0.0))), float(rate(jnp.asarray(0.0)))]
    y = solve_ivp(motion, (0.0, t[-1]), start, "DOP853", t, rtol=1e-11, atol=1e-13).y[0]
    # The effect of the force neglected after order epsilon^2, over one period.
    np.testing.assert_allclose(jax.vmap(series)(jnp.asarray(t)), y, atol=3e-5)


def test_linear_limit_agrees_with_the_closed_form():
    errors = []
    for epsilon in (1e-2, 1e-3):
        drive = ReducedDrive(mu=0.2 * epsilon, omega_0=W0, alpha=0.0)
        made = PrimaryResonance(drive, 0.5 * epsilon)
        omega = W0 + 0.3 * epsilon
        exact = 0.5 * epsilon / (W0**2 - omega**2 + 1j * float(drive.mu) * omega)
        states = [first_order(made, omega), second_order(made, omega)]
        assert list(states[0].branches.exists).count(True) == 1
        assert not bool(jnp.any(made.folds().exists))
        branch = int(jnp.argmax(states[0].branches.exists))
        errors.append([abs(phasors(s.series(branch))[0] / exact - 1) for s in states])
    assert 9 < errors[0][0] / errors[1][0] < 11
    # The second order is exact for a linear drive.
    assert max(errors[0][1], errors[1][1]) < 1e-12


def test_secondary_resonances_of_a_linear_drive_have_zero_amplitude():
    for kind in (SuperharmonicResonance, SubharmonicResonance):
        made = kind(ReducedDrive(mu=0.1, omega_0=W0, alpha=0.0), 1.0)
        omega = float(made.omega(0.1))
        branches = made.branches(omega)
        assert float(jnp.max(branches.amplitude)) == 0.0
        assert int(jnp.sum(branches.exists)) == 1
        series = second_order(made, omega).series(int(jnp.argmax(branches.exists)))
        exact = 1.0 / (W0**2 - omega**2)
        np.testing.assert_allclose(series.cosine[made.forcing - 1], exact, rtol=1e-12)


def test_peak_agrees_with_the_closed_form_and_the_branches():
    # DESIGN 2.2: 10 N m on the motor of the source document's Table 1.
    drive = Drive(N=50.0, J_m=5.26e-4, J_l=5.0e-2, K=7160.0, alpha=0.1, B_sp=0.017)
    A = 10.0 / (50.0 * 5.26e-4)
    made = PrimaryResonance(drive, A)
    peak = made.peak()
    np.testing.assert_allclose(peak.amplitude, A / (float(drive.mu) * float(drive.omega_0)), rtol=1e-14)
    assert round(float(peak.amplitude), 2) == 2.79
    np.testing.assert_allclose(peak.omega, drive.omega_0 + made.backbone(peak.amplitude), rtol=1e-14)
    for kind in (PrimaryResonance, SuperharmonicResonance):
        made, _ = resonance(kind)
        sweep = jax.vmap(made.branches)(jnp.linspace(made.omega(-1.0), made.peak().omega, 400))
        # The narrow peak lies at the last frequency.
        np.testing.assert_allclose(jnp.max(sweep.amplitude), made.peak().amplitude, rtol=1e-6)
    assert not bool(resonance(SubharmonicResonance)[0].peak().exists)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("kind", KINDS)
def test_folds_lie_where_the_detuning_curve_turns(kind, sign):
    made, _ = resonance(kind, sign=sign)
    folds = made.folds()
    assert int(jnp.sum(folds.exists)) == (1 if kind is SubharmonicResonance else 2)
    # A hardening curve turns on its right side, but the sub-harmonic's begins on its left.
    side = int((sign > 0) != (kind is SubharmonicResonance))

    def sigma(a):
        return made.detuning(a).sigma[side]

    for a, at, omega, exists in zip(folds.amplitude, folds.sigma, folds.omega, folds.exists, strict=True):
        if not exists:
            assert float(a) == float(at) == float(omega) == 0.0
            continue
        np.testing.assert_allclose(sigma(a), at, rtol=1e-9)
        # Relative to a slope of size sigma/a; the square root of the room is steep next to the peak.
        np.testing.assert_allclose(jax.grad(sigma)(a) * a / at, 0, atol=1e-6)
        counts = [int(jnp.sum(made.branches(omega * (1 + d)).exists)) for d in (-1e-6, 1e-6)]
        assert sorted(counts) == [1, 3]


def test_folds_exist_only_above_the_critical_forcing():
    """Two folds appear at `|q| (A/2 omega_0)^2 = 8/(3 sqrt 3) (mu/2)^3`: Duffing's critical amplitude."""
    drive = ReducedDrive(mu=0.2, omega_0=W0, alpha=3.0)
    critical = np.sqrt(8 / (3 * np.sqrt(3)) * 0.1**3 / (3 / 8 * W0 * 3.0)) * 2 * W0
    for factor, wanted in ((0.999, False), (1.001, True)):
        folds = PrimaryResonance(drive, factor * critical).folds()
        assert list(folds.exists) == [wanted, wanted]
    np.testing.assert_allclose(folds.sigma, np.sqrt(3) * 0.1, rtol=2e-2)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_subharmonic_exists_between_its_forcing_limits(sign):
    made, omega = resonance(SubharmonicResonance, sign=sign)
    limits = made.existence(omega)
    assert bool(limits.exists)
    np.testing.assert_allclose(limits.A, 8 * W0**2 * limits.C, rtol=1e-14)
    for A, outwards in zip(limits.A, (-1, 1), strict=True):
        for step, wanted in ((1e-6, False), (-1e-6, True)):
            branches = SubharmonicResonance(made.drive, A * (1 + outwards * step)).branches(omega)
            assert list(branches.exists) == [True, wanted, wanted]
    # Nayfeh & Mook section 4.1.4: sigma^2 >= 63/4 mu^2, at one amplitude only where equal; sigma follows alpha's sign.
    least = np.sqrt(63 / 4) * float(made.drive.mu) * sign
    assert bool(made.existence(made.omega(1.001 * least)).exists)
    assert not bool(made.existence(made.omega(0.999 * least)).exists)
    assert not bool(made.existence(made.omega(-1.001 * least)).exists)
    assert not bool(jnp.any(made.existence(made.omega(-least)).A))


@pytest.mark.parametrize(
    ("kind", "derivative"),
    [pytest.param(PrimaryResonance, jax.jacrev, marks=pytest.mark.slow), (SuperharmonicResonance, jax.jacfwd)],
)
def test_derivatives_by_parameters_agree_with_differences(kind, derivative):
    mu, alpha, A, sigma = BENT[kind]

    def figures(p):
        made = kind(ReducedDrive(mu=p[0], omega_0=p[1], alpha=p[2]), p[3])
        peak, folds = made.peak(), made.folds()
        states = second_order(made, made.omega(0.1 * sigma)).branches
        branches = made.branches(p[4])
        return jnp.concatenate(
            [jnp.stack([peak.amplitude, peak.omega]), folds.omega, branches.amplitude, branches.phase, states.amplitude]
        )

    p = jnp.array([mu, W0, alpha, A, float(resonance(kind)[1])])
    jacobian = jax.jit(derivative(figures))(p)
    assert bool(jnp.all(jnp.isfinite(jacobian)))
    steps = 1e-6 * jnp.diag(p)
    ends = jax.jit(jax.vmap(figures))(jnp.concatenate([p[None] + steps, p[None] - steps]))
    differences = (ends[: p.size] - ends[p.size :]).T / (2e-6 * p[None])
    # Truncation of the squared step next to the folds, where curves are steep, and rounding of 1e-16/1e-6.
    np.testing.assert_allclose(jacobian, differences, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize("solve", [first_order, second_order])
@pytest.mark.parametrize("kind", KINDS)
def test_jit_and_vmap_do_not_change_the_solutions(kind, solve):
    made, omega = resonance(kind, 0.1)
    omegas = omega * jnp.array([0.9, 1.0, 1.01])
    loop = [solve(made, float(w)) for w in omegas]
    batch = jax.jit(jax.vmap(solve, in_axes=(None, 0)))(made, omegas)
    for i, one in enumerate(loop):
        for wanted, got in zip(jax.tree.leaves(one), jax.tree.leaves(batch), strict=True):
            np.testing.assert_allclose(wanted, got[i], rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", KINDS)
def test_results_are_finite_for_all_parameters(kind):
    for mu in (0.0, 0.1):
        for alpha in (-1.0, 0.0, 1.0):
            for A in (0.0, 1.0):
                made = kind(ReducedDrive(mu=mu, omega_0=W0, alpha=alpha), A)
                for sigma in (-0.3, 0.0, 0.3):
                    omega = made.omega(sigma)
                    parts = (made.branches(omega), made.peak(), made.folds(), made.detuning(0.0), made.detuning(0.1))
                    states = (first_order(made, omega), second_order(made, omega))
                    for leaf in jax.tree.leaves((parts, states)):
                        assert bool(jnp.all(jnp.isfinite(leaf))), (mu, alpha, A, sigma)


def test_printed_equations_are_reproduced_as_printed():
    drive = Drive(N=50.0, J_m=5.26e-4, J_l=5.0e-2, K=7160.0, alpha=0.1, B_sp=0.017)
    np.testing.assert_allclose(
        printed_error_forcing(drive, 10.0, 0.0), drive.error_forcing(jnp.asarray(10.0), jnp.asarray(0.0)), rtol=1e-14
    )
    np.testing.assert_allclose(
        50.0 * printed_error_forcing(drive, 0.0, 1.0), drive.error_forcing(jnp.asarray(0.0), jnp.asarray(1.0))
    )
    made, _ = resonance(PrimaryResonance)
    assert float(printed_primary(made.drive, made.A, W0)) == 0.0
    linear = ReducedDrive(mu=0.2, omega_0=W0, alpha=0.0)
    np.testing.assert_allclose(
        printed_primary(linear, 0.5, 2.1), jnp.max(PrimaryResonance(linear, 0.5).branches(2.1).amplitude), rtol=1e-12
    )
    np.testing.assert_allclose(printed_primary(linear, 0.5, W0), 0.5 / (0.2 * W0), rtol=1e-14)
    made, omega = resonance(SuperharmonicResonance)
    mirrored = printed_superharmonic(made.drive, made.A, 2 * W0 / 3 - omega)
    np.testing.assert_allclose(mirrored.amplitude, made.branches(omega).amplitude, rtol=1e-9)
    made, omega = resonance(SubharmonicResonance)
    a, exists = printed_subharmonic(made.drive, made.A, omega)
    assert bool(exists[2])
    mu, alpha, C, sigma = (float(v) for v in (made.drive.mu, made.drive.alpha, made.C, made.sigma(omega)))
    inner = sigma - 9 / 8 * W0 * alpha * C**2 - 9 / 4 * W0**2 * alpha * float(a[2]) ** 2
    np.testing.assert_allclose(9 / 4 * mu**2 + inner**2, (9 / 8 * W0 * alpha * C) ** 2, rtol=1e-12)
