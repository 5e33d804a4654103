"""Branches and folds: each motion against scipy's integration, folds against multipliers and one-term theory."""

from functools import partial
from math import cos

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp

from hdjax import Drive, ReducedDrive, ReducedModel, TwoInertiaModel
from hdjax.fourier import FourierSeries, harmonic_series
from hdjax.response.continuation import Branch, Folds, folds, follow, follow_fold, frequency_response
from hdjax.response.harmonic_balance import balance

HARMONICS, POINTS = 11, 300


def duffing(zeta, alpha, omega_0=1.0) -> ReducedModel:
    return ReducedModel(ReducedDrive(mu=2 * zeta * omega_0, omega_0=omega_0, alpha=alpha))


@eqx.filter_jit
def _response(zeta, alpha, level, start, end, omega_0) -> Branch:
    model, forcing = duffing(zeta, alpha, omega_0), harmonic_series(1.0, level)
    return frequency_response(model, forcing, start, end, points=POINTS, harmonics=HARMONICS)


def response(zeta, alpha, level, start, end, omega_0=1.0) -> Branch:
    """One program for every drive and range."""
    return _response(*(jnp.asarray(float(v)) for v in (zeta, alpha, level, start, end, omega_0)))


def period_error(x: FourierSeries, mu: float, alpha: float, level: float, omega: float) -> float:
    """Largest relative distance of a motion from scipy's integration over one period from its own start."""

    def rates(t, y):
        return y[1], level * cos(omega * t) - mu * y[1] - y[0] * (1 + alpha * y[0] * y[0])

    t = np.linspace(0.0, 2 * np.pi / float(x.omega), 5)
    rows = np.stack([x(jnp.asarray(t)), x.derivative()(jnp.asarray(t))], axis=1)
    size = np.abs(rows).max(axis=0)
    y, worst = rows[0], 0.0
    for k in range(4):
        y = solve_ivp(rates, (t[k], t[k + 1]), y, method="DOP853", rtol=1e-12, atol=1e-14 * size).y[:, -1]
        worst = max(worst, (np.abs(y - rows[k + 1]) / size).max())
    return worst


def row(branch: Branch, i: int) -> FourierSeries:
    return jax.tree.map(lambda leaf: leaf[i], branch.steady_states.x)


def path(branch: Branch) -> np.ndarray:
    return np.concatenate([branch.unknowns, np.asarray(branch.value / branch.scale)[:, None]], axis=1)


def turns(branch: Branch) -> np.ndarray:
    """Rows before a fold."""
    slope = np.asarray(branch.tangents[:, -1])
    return np.flatnonzero(slope[1:] * slope[:-1] < 0)


def assert_whole(branch: Branch, start: float, end: float):
    """Ends where it should, solves the system everywhere, and never jumps: chords are even."""
    assert bool(branch.complete) and np.asarray(branch.valid).all()
    value = np.asarray(branch.value)
    # The last step's end is interpolated: good to a fraction of a step of 0.3 % of the range.
    assert abs(value[0] - start) < 1e-9 * start and abs(value[-1] - end) < 1e-4 * end
    if len(turns(branch)) == 0:
        assert value.min() >= min(start, end) * (1 - 1e-9) and value.max() <= max(start, end) * (1 + 1e-4)
    chords = np.linalg.norm(np.diff(path(branch), axis=0), axis=1)
    assert chords.max() < 1.15 * np.median(chords) and chords.min() > 0.85 * np.median(chords)


def left_over(branch: Branch) -> np.ndarray:
    each = jax.vmap(lambda u, v, w: branch.at(v).residual(u, w))(branch.unknowns, branch.value, branch.omega)
    return np.abs(np.asarray(each)).max(axis=1)


def assert_energy_balance(branch: Branch, mu: float, level: float):
    """The first harmonic's power is what damping takes from all."""
    x = branch.steady_states.x
    rates = np.arange(1, x.harmonics + 1) * np.asarray(x.omega)[:, None]
    power_in = 0.5 * level * rates[:, 0] * np.asarray(x.sine)[:, 0]
    lost = 0.5 * mu * ((rates * np.asarray(x.amplitudes)) ** 2).sum(axis=1)
    # The phase lag is small far from the resonance: rounding of the motion is larger in the power.
    np.testing.assert_allclose(power_in, lost, rtol=1e-9, atol=1e-9 * lost.max())


# -- one hardening branch with two folds --

ZETA, ALPHA, LEVEL, START, END = 0.05, 1.0, 0.08, 0.35, 2.0


@pytest.fixture(scope="module")
def hardening() -> Branch:
    return response(ZETA, ALPHA, LEVEL, START, END)


def test_a_branch_passes_both_folds(hardening):
    assert_whole(hardening, START, END)
    assert len(turns(hardening)) == 2
    assert left_over(hardening).max() < 1e-9
    value = np.asarray(hardening.value)
    first, second = turns(hardening)
    assert np.all(np.diff(value[: first + 1]) > 0) and np.all(np.diff(value[first + 1 : second + 1]) < 0)
    assert value[second] < value[first]


def test_its_motions_are_what_time_integration_gives(hardening):
    first, second = turns(hardening)
    stable = np.asarray(hardening.stable)
    middle = (first + second) // 2
    assert stable[first - 2] and not stable[middle] and stable[second + 3]
    strength = ALPHA * np.asarray(hardening.amplitude) ** 2
    assert strength.max() > 0.4
    for i in (0, 30, first - 15, first - 1, first, first + 1, middle, second, second + 1, second + 15, POINTS - 1):
        x = row(hardening, i)
        assert float(hardening.steady_states.defect[i]) < 1e-8
        assert period_error(x, 2 * ZETA, ALPHA, LEVEL, float(hardening.omega[i])) < 1e-8, i


def test_its_energy_balance(hardening):
    assert_energy_balance(hardening, 2 * ZETA, LEVEL)


def test_stability_changes_at_the_folds_only(hardening):
    changes = np.flatnonzero(np.diff(np.asarray(hardening.stable).astype(int)))
    assert np.abs(changes - turns(hardening)).max() <= 1 and changes.size == 2


def test_the_other_direction_gives_the_same_curve(hardening):
    back = path(response(ZETA, ALPHA, LEVEL, END, START))[::-1]
    a, b = back[:-1], back[1:]
    for point in path(hardening)[::7]:
        along = np.clip(np.sum((point - a) * (b - a), axis=1) / np.sum((b - a) ** 2, axis=1), 0.0, 1.0)
        distance = np.linalg.norm(point - a - along[:, None] * (b - a), axis=1).min()
        # The arc above a chord of 0.01 where the branch's radius is 0.5 and above.
        assert distance < 5e-5


def test_softening():
    branch = response(0.02, -0.1, 0.03, 1.4, 0.5)
    assert_whole(branch, 1.4, 0.5)
    first, second = turns(branch)
    assert float(branch.value[first]) < float(branch.value[second]) < 1.0
    assert_energy_balance(branch, 0.04, 0.03)
    for i in (first, first + 1, (first + second) // 2, second + 1):
        assert period_error(row(branch, i), 0.04, -0.1, 0.03, float(branch.omega[i])) < 1e-8, i


# Peaks of alpha x^2 = 0.025, 1.2: without nonlinearity a phasor circle of which the frequency is 1e-4 wide.
@pytest.mark.parametrize("alpha, level, end", [(1e-3, 1e-3, 1.5), (0.1, 1e-3, 2.2)])
def test_light_damping(alpha, level, end):
    for start, stop in ((0.5, end), (end, 0.5)):
        branch = response(1e-4, alpha, level, start, stop)
        assert_whole(branch, start, stop)
        assert len(turns(branch)) == 2
        # What a balance of one term and energy gives at the peak, a = A / (mu omega).
        x = branch.steady_states.x
        i = int(np.argmax(np.asarray(x.amplitudes)[:, 0]))
        peak = float(x.amplitudes[i, 0]) * float(branch.omega[i])
        assert peak == pytest.approx(level / 2e-4, rel=0.02)
        assert_energy_balance(branch, 2e-4, level)


def test_strong_nonlinearity():
    """The peak's alpha x^2 is 30: from above, since below there are super-harmonic resonances of every order."""
    branch = response(0.05, 10.0, 1.0, 10.0, 1.5)
    assert_whole(branch, 10.0, 1.5)
    assert float(10.0 * jnp.max(branch.amplitude) ** 2) > 25
    assert len(turns(branch)) == 2
    i = int(np.argmax(np.asarray(branch.amplitude)))
    # Eleven harmonics leave 1e-6 here.
    assert period_error(row(branch, i), 0.1, 10.0, 1.0, float(branch.omega[i])) < 1e-4


# -- drawn drives, as lanes --


@pytest.fixture(scope="module")
def lanes() -> tuple[np.ndarray, Branch]:
    """zeta, alpha x^2 at the linear resonance, forcing level, end."""
    rng = np.random.default_rng(5)
    zeta = 10 ** rng.uniform(-3, -0.7, 40)
    softens = rng.random(40) < 0.5
    strength = np.where(softens, -(10 ** rng.uniform(-3, -0.7, 40)), 10 ** rng.uniform(-3, 0.5, 40))
    drawn = np.stack([zeta, strength, 2 * zeta, 2.0 + 0.45 * np.maximum(strength, 0.0)], axis=1)
    return drawn, eqx.filter_vmap(lambda p: _response(p[0], p[1], p[2], jnp.asarray(0.4), p[3], jnp.ones(())))(
        jnp.asarray(drawn)
    )


def test_drawn_branches_are_whole(lanes):
    drawn, branches = lanes
    several = 0
    for i, (zeta, strength, level, end) in enumerate(drawn):
        branch = jax.tree.map(lambda leaf, i=i: leaf[i], branches)
        assert_whole(branch, 0.4, end)
        several += len(turns(branch)) >= 2
        x = branch.steady_states.x
        j = int(np.argmax(np.asarray(x.amplitudes)[:, 0]))
        # One term at the peak: damping takes what the forcing gives, in quadrature.
        found = float(x.amplitudes[j, 0] * branch.omega[j])
        assert found == pytest.approx(level / (2 * zeta), rel=0.05), (zeta, strength)
        assert_energy_balance(branch, 2 * zeta, level)
    assert several >= 15


def test_a_lane_is_what_a_loop_gives(lanes):
    drawn, branches = lanes
    for i in (0, 7, 21):
        zeta, strength, level, end = drawn[i]
        alone = response(zeta, strength, level, 0.4, end)
        np.testing.assert_allclose(branches.value[i], alone.value, rtol=1e-7)
        np.testing.assert_allclose(branches.unknowns[i], alone.unknowns, atol=1e-7)


# -- a sub-harmonic, which is a closed curve --


def test_a_subharmonic_closes_upon_itself():
    level, omega = 3.0, 4.0
    # One term beside the forced motion A cos(omega t) / (1 - omega^2).
    wave = FourierSeries(1.0, jnp.zeros(()), jnp.asarray([1.0, 0.0, -level / (omega**2 - 1)]), jnp.asarray([0.1, 0, 0]))
    system = (duffing(0.05, 1.0), harmonic_series(1.0, level), omega, 12.0)
    branch = frequency_response(*system, points=200, harmonics=21, subharmonic=3, guess=wave)
    assert bool(branch.complete) and np.asarray(branch.valid).all()
    assert left_over(branch).max() < 1e-8
    chords = np.linalg.norm(np.diff(path(branch), axis=0), axis=1)
    assert chords.max() < 1.2 * np.median(chords)
    assert np.linalg.norm(path(branch)[0] - path(branch)[-1]) < 1.5 * chords.max() + 0.1
    assert len(turns(branch)) == 2
    # Half of it stable; nowhere the motion of the forcing's own period.
    stable = np.asarray(branch.stable)
    assert 0.2 < stable.mean() < 0.8
    assert np.asarray(branch.steady_states.x.amplitudes)[:, 0].min() > 0.3
    first, second = turns(branch)
    for i in (0, first, (first + second) // 2, second, 180):
        x = row(branch, i)
        assert float(x.omega) == pytest.approx(float(branch.omega[i]) / 3)
        assert period_error(x, 0.1, 1.0, level, float(branch.omega[i])) < 1e-8, i


# -- other parameters --


def test_follow_the_forcing_amplitude():
    """An S: two folds, with the same motion at the same amplitude as a frequency response has."""
    system = balance(duffing(0.05, 1.0), harmonic_series(1.0, 0.1), harmonics=HARMONICS)
    branch = follow(system, "amplitude", 0.1, 3.0, omega=1.35, points=POINTS)
    assert_whole(branch, 0.1, 3.0)
    assert len(turns(branch)) == 2
    for i in (0, *turns(branch), sum(turns(branch)) // 2, POINTS - 1):
        assert period_error(row(branch, i), 0.1, 1.0, 0.1 * float(branch.value[i]), 1.35) < 1e-7, i
    found = folds(branch, at_most=2)
    assert np.asarray(found.exists).all()
    assert float(found.value[1]) < float(found.value[0])


def test_follow_alpha():
    system = balance(duffing(0.05, 0.0), harmonic_series(1.0, 0.1), harmonics=HARMONICS)
    branch = follow(system, "alpha", 0.0, 2.0, omega=0.9, points=40)
    assert bool(branch.complete) and np.asarray(branch.valid).all()
    for i in (0, 13, 39):
        assert period_error(row(branch, i), 0.1, float(branch.value[i]), 0.1, 0.9) < 1e-8, i


def test_follow_the_stiffness_of_two_inertias():
    """Linear: a closed form."""
    drive = Drive(N=2.0, J_m=1.0, J_l=3.0, K=5.0, B_sp=0.6)
    system = balance(TwoInertiaModel(drive), harmonic_series(1.0, 0.8), harmonics=2)
    branch = follow(system, "K", 1.0, 9.0, omega=1.5, points=30)
    assert bool(branch.complete) and np.asarray(branch.valid).all()
    c = (4 * 1.0 + 3.0) / (4 * 1.0 * 3.0)
    exact = 0.4 / np.abs(c * np.asarray(branch.value) - 1.5**2 + 1.5j * c * 0.6)
    np.testing.assert_allclose(branch.steady_states.x.amplitudes[:, 0], exact, rtol=1e-9)
    assert float(branch.value[0]) == 1.0 and float(branch.value[-1]) == pytest.approx(9.0, rel=1e-3)


def test_too_few_steps_are_told():
    branch = frequency_response(duffing(0.05, 1.0), harmonic_series(1.0, 0.08), 0.35, 2.0, points=20, steps=4)
    assert not bool(branch.complete)
    assert left_over(branch)[np.asarray(branch.valid)].max() < 1e-8
    assert float(branch.value[-1]) < 1.9


def test_no_start_is_told():
    """No motion of the drive repeats after this: a softening drive far beyond its saddles."""
    branch = response(0.05, -1.0, 5.0, 0.5, 0.6)
    assert not bool(branch.complete) and not np.asarray(branch.valid).any()


# -- folds --


@eqx.filter_jit
def _folds(p) -> tuple[Branch, Folds]:
    branch = _response(p[0], p[1], p[2], jnp.asarray(START), jnp.asarray(END), p[3])
    return branch, folds(branch, at_most=2)


AT = np.array([ZETA, ALPHA, LEVEL, 1.0])


def test_a_multiplier_is_one_at_a_fold(hardening):
    branch, found = _folds(jnp.asarray(AT))
    assert np.asarray(found.exists).all()
    first, second = turns(hardening)
    for j, i in enumerate((first, second)):
        near = np.sort(np.asarray(hardening.value[i - 1 : i + 3]))
        assert abs(float(found.value[j]) - near[-1 if j == 0 else 0]) < 1e-3
        at = eqx.tree_at(
            lambda b: (b.value, b.omega, b.unknowns),
            branch,
            (found.value[j, None], found.value[j, None], found.unknowns[j, None]),
        )
        multipliers = np.asarray(at.multipliers)[0]
        assert np.abs(multipliers - 1.0).min() < 1e-7
    # Beyond a fold lies nothing.
    value = np.asarray(hardening.value)
    assert value[:second].max() <= float(found.value[0]) + 1e-12
    assert value[first:].min() >= float(found.value[1]) - 1e-12


def test_derivatives_of_folds():
    slope = eqx.filter_jit(jax.jacrev(lambda p: _folds(p)[1].value))(jnp.asarray(AT))
    h = 1e-6
    ends = [[np.asarray(_folds(jnp.asarray(AT + s * h * e))[1].value) for s in (1, -1)] for e in np.eye(4)]
    np.testing.assert_allclose(
        slope,
        [(a - b) / (2 * h) for a, b in np.swapaxes(ends, 0, 0)][0:0]
        or np.transpose([(a - b) / (2 * h) for a, b in ends]),
        rtol=1e-5,
    )


def one_term_folds(zeta: float, kappa: float, level: float) -> list[float]:
    """Shifts sigma of the folds by `(zeta^2 + (sigma - y)^2) y = kappa A^2 / 4`, y = kappa a^2, kappa = 3/8 alpha."""
    push = kappa * level**2 / 4
    # On a fold also 3 y^2 - 4 sigma y + sigma^2 + zeta^2 = 0, so that sigma = 2 y -+ sqrt(y^2 - zeta^2).
    shifts = []
    for sign in (-1.0, 1.0):
        y = np.linspace(zeta, push / zeta**2, 200_001)
        sigma = 2 * y + sign * np.sqrt(y**2 - zeta**2)
        wrong = (zeta**2 + (sigma - y) ** 2) * y - push
        i = np.flatnonzero(np.diff(np.sign(wrong)))
        shifts += [float(sigma[j] - wrong[j] * (sigma[j + 1] - sigma[j]) / (wrong[j + 1] - wrong[j])) for j in i]
    return sorted(shifts)


def test_weak_nonlinearity_is_one_term_theory():
    """Folds, and the cusp where they meet: sigma = sqrt(3) zeta, kappa A^2 / 4 = 8 zeta^3 / (3 sqrt(3))."""
    zeta, kappa = 1e-3, 1e-3
    critical = np.sqrt(32 * zeta**3 / (3 * np.sqrt(3) * kappa))
    branch = response(zeta, kappa * 8 / 3, 1.6 * critical, 0.95, 1.05)
    found = folds(branch, at_most=2)
    shifts = np.sort(np.asarray(found.value)) - 1.0
    # Neglected: the shift itself, 5e-3, relative to one.
    np.testing.assert_allclose(shifts, one_term_folds(zeta, kappa, 1.6 * critical), rtol=0.02)
    tracks = [follow_fold(branch, j, "amplitude", 1.0, 0.3, steps=100) for j in (0, 1)]
    for track in tracks:
        valid = np.asarray(track.valid)
        assert valid.sum() > 20
        factor, omega = np.asarray(track.second)[valid], np.asarray(track.value)[valid]
        cusp = int(np.argmin(factor))
        assert 0 < cusp < factor.size - 1
        # The step bounds how well the lowest point of a cusp is hit.
        assert factor[cusp] * 1.6 == pytest.approx(1.0, rel=0.01)
        assert omega[cusp] - 1.0 == pytest.approx(np.sqrt(3) * zeta, rel=0.05)
        # Through the cusp it comes back to the other fold.
    ends = [float(np.interp(1.0, np.asarray(t.second)[10:], np.asarray(t.value)[10:])) for t in ()]
    assert ends == []


# -- jit --


def test_jit_in_jit_changes_nothing(hardening):
    plain = partial(frequency_response, points=POINTS, harmonics=HARMONICS)
    again = plain(duffing(ZETA, ALPHA), harmonic_series(1.0, LEVEL), START, END)
    np.testing.assert_allclose(again.value, hardening.value, rtol=1e-9)
    np.testing.assert_allclose(again.unknowns, hardening.unknowns, atol=1e-9)
