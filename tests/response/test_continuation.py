"""Branches and folds: each motion against scipy's integration, folds against multipliers and one-term theory."""

import subprocess
import sys

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from branches import assert_whole, left_over, path, row, turns
from orbits import duffing, duffing_rates, period_error

from hdjax.fourier import harmonic_series
from hdjax.response.continuation import Branch, frequency_response
from hdjax.response.fold import Folds, folds, follow_fold
from hdjax.response.harmonic_balance import balance

HARMONICS, POINTS = 11, 300


def response(p) -> tuple[Branch, Folds]:
    """The branch and its folds over (zeta, alpha, forcing level, start, end, omega_0)."""
    model = duffing(2 * p[0] * p[5], p[1], p[5])
    branch = frequency_response(model, harmonic_series(1.0, p[2]), p[3], p[4], points=POINTS, harmonics=HARMONICS)
    return branch, folds(branch, at_most=2)


def assert_energy_balance(branch: Branch, mu: float, level: float):
    """The power of the first harmonic equals the dissipation of all harmonics."""
    x = branch.steady_states.x
    rates = np.arange(1, x.harmonics + 1) * np.asarray(x.omega)[:, None]
    power_in = 0.5 * level * rates[:, 0] * np.asarray(x.sine)[:, 0]
    lost = 0.5 * mu * ((rates * np.asarray(x.amplitudes)) ** 2).sum(axis=1)
    # The phase lag is small far from the resonance: rounding of the motion is larger in the power.
    np.testing.assert_allclose(power_in, lost, rtol=1e-9, atol=1e-9 * lost.max())


# -- every branch of the file is a lane of one program --

ZETA, ALPHA, LEVEL, START, END = 0.05, 1.0, 0.08, 0.35, 2.0
AT = np.array([ZETA, ALPHA, LEVEL, START, END, 1.0])
STEPS = 1e-6 * np.eye(6)[[0, 1, 2, 5]]
# Where one term has a cusp, and a forcing above it: nonlinearity that is weak beside one, not beside the damping.
WEAK_ZETA, KAPPA = 1e-3, 1e-3
CRITICAL = np.sqrt(32 * WEAK_ZETA**3 / (3 * np.sqrt(3) * KAPPA))
WEAK = np.array([WEAK_ZETA, KAPPA * 8 / 3, 1.6 * CRITICAL, 0.95, 1.05, 1.0])

NAMED = {
    "hardening": AT,
    "backwards": AT[[0, 1, 2, 4, 3, 5]],
    "in rad/s": AT * np.array([1.0, 1e5, 385.0**2 * 1e-5**0.5, 385.0, 385.0, 385.0]),
    "softening": np.array([0.02, -0.1, 0.05, 1.4, 0.5, 1.0]),
    "strong": np.array([0.05, 10.0, 1.0, 10.0, 1.5, 1.0]),
    # Peaks of alpha x^2 = 0.025 and 1.3 with a phasor circle that is 1e-4 of the frequency wide.
    "light": np.array([1e-4, 1e-3, 1e-3, 0.5, 1.5, 1.0]),
    "light, backwards": np.array([1e-4, 1e-3, 1e-3, 1.5, 0.5, 1.0]),
    "light and strong": np.array([1e-4, 0.1, 1e-3, 0.5, 2.2, 1.0]),
    "light, softening": np.array([1e-4, -1e-2, 1e-3, 1.5, 0.5, 1.0]),
    "weak": WEAK,
    "no start": np.array([0.05, 10.0, 1.0, 0.3, 1.0, 1.0]),
    **{f"{sign}{j}": AT + s * STEPS[j] for sign, s in (("+", 1), ("-", -1)) for j in range(4)},
}
RANDOM = 40


def random_parameters() -> np.ndarray:
    """Both signs; alpha x^2 at the peak from 1e-3 to 0.2 and, where it hardens, 3."""
    rng = np.random.default_rng(5)
    zeta = 10 ** rng.uniform(-3, -0.7, RANDOM)
    softens = rng.random(RANDOM) < 0.5
    strength = np.where(softens, -(10 ** rng.uniform(-3, -0.7, RANDOM)), 10 ** rng.uniform(-3, 0.5, RANDOM))
    end = 2.0 + 0.45 * np.maximum(strength, 0.0)
    return np.stack([zeta, strength, 2 * zeta, np.full(RANDOM, 0.4), end, np.ones(RANDOM)], axis=1)


@pytest.fixture(scope="module")
def lanes() -> tuple[Branch, Folds]:
    rows = jnp.asarray(np.concatenate([np.stack(list(NAMED.values())), random_parameters()]))
    # As numpy arrays, which are sliced without compilation.
    return jax.device_get(eqx.filter_jit(eqx.filter_vmap(response))(rows))


def lane(lanes, name: str | int):
    """One lane by its name, or by its number among those of random parameters."""
    i = list(NAMED).index(name) if isinstance(name, str) else len(NAMED) + name
    return jax.tree.map(lambda leaf: leaf[i], lanes)


@pytest.fixture(scope="module")
def hardening(lanes) -> Branch:
    return lane(lanes, "hardening")[0]


def test_branch_of_a_hardening_drive_passes_both_folds(hardening):
    assert_whole(hardening, START, END)
    assert len(turns(hardening)) == 2
    assert left_over(hardening).max() < 1e-9
    value = np.asarray(hardening.value)
    first, second = turns(hardening)
    assert np.all(np.diff(value[: first + 1]) > 0) and np.all(np.diff(value[first + 1 : second + 1]) < 0)
    assert value[second] < value[first]


def test_branch_motions_agree_with_time_integration(hardening):
    """Also on the unstable part, and beside the folds."""
    first, second = turns(hardening)
    stable = np.asarray(hardening.stable)
    middle = (first + second) // 2
    assert stable[first - 2] and not stable[middle] and stable[second + 3]
    assert ALPHA * float(jnp.max(hardening.amplitude)) ** 2 > 0.4
    for i in (0, 30, first - 15, first - 1, first, first + 1, middle, second, second + 1, second + 15, POINTS - 1):
        assert float(hardening.steady_states.defect[i]) < 1e-8
        assert (
            period_error(duffing_rates(2 * ZETA, ALPHA, LEVEL, float(hardening.omega[i])), row(hardening, i)) < 1e-8
        ), i
    # Stability changes at the folds only.
    changes = np.flatnonzero(np.diff(stable.astype(int)))
    assert changes.size == 2 and np.abs(changes - turns(hardening)).max() <= 1


def test_branch_satisfies_the_energy_balance(hardening):
    assert_energy_balance(hardening, 2 * ZETA, LEVEL)


def test_branch_is_the_same_in_both_directions(lanes, hardening):
    back = path(lane(lanes, "backwards")[0])[::-1]
    a, b = back[:-1], back[1:]
    for point in path(hardening)[::7]:
        along = np.clip(np.sum((point - a) * (b - a), axis=1) / np.sum((b - a) ** 2, axis=1), 0.0, 1.0)
        distance = np.linalg.norm(point - a - along[:, None] * (b - a), axis=1).min()
        # The arc above a chord of 0.01 where the branch's radius is 0.5 and above.
        assert distance < 5e-5


def test_branch_scales_with_the_units(lanes, hardening):
    """A drive of 385 rad/s with alpha 1e5 1/rad^2, whose forcing is scaled alike."""
    branch = lane(lanes, "in rad/s")[0]
    np.testing.assert_allclose(branch.value / 385.0, hardening.value, rtol=1e-8)
    np.testing.assert_allclose(branch.amplitude * 1e5**0.5, hardening.amplitude, rtol=1e-8)


@pytest.mark.parametrize("name", ["softening", "light", "light, backwards", "light and strong", "light, softening"])
def test_branches_of_light_damping_or_softening_are_complete(lanes, name):
    zeta, alpha, level, start, end, _ = NAMED[name]
    branch = lane(lanes, name)[0]
    assert_whole(branch, start, end)
    assert_energy_balance(branch, 2 * zeta, level)
    assert len(turns(branch)) == 2
    # Of a hardening drive followed upwards, the fold of higher frequency comes first.
    first, second = np.asarray(branch.value)[turns(branch)]
    assert (first > second) == (end > start) or alpha < 0 or start > end
    # The peak of one term, a = A / (mu omega); the third harmonic dissipates part of the power.
    x = branch.steady_states.x
    i = int(np.argmax(np.asarray(x.amplitudes)[:, 0]))
    assert float(x.amplitudes[i, 0] * branch.omega[i]) == pytest.approx(level / (2 * zeta), rel=0.02)
    for j in (i, *turns(branch)):
        # Over a period of a drive so lightly damped, 1e-8 of the motion is 1e-4 of what the damping does.
        assert period_error(duffing_rates(2 * zeta, alpha, level, float(branch.omega[j])), row(branch, j)) < 1e-7


def test_branch_of_a_strong_nonlinearity_is_complete(lanes):
    """alpha x^2 is 37 at the peak. From above, since below are super-harmonic resonances of every order."""
    branch = lane(lanes, "strong")[0]
    assert_whole(branch, 10.0, 1.5)
    assert len(turns(branch)) == 2 and float(10.0 * jnp.max(branch.amplitude) ** 2) > 35
    i = int(np.argmax(np.asarray(branch.amplitude)))
    # Eleven harmonics err by a few 1e-7 there.
    assert period_error(duffing_rates(0.1, 10.0, 1.0, float(branch.omega[i])), row(branch, i)) < 1e-5


def test_branches_of_random_parameters_are_complete(lanes):
    several = 0
    for i, (zeta, _, level, start, end, _) in enumerate(random_parameters()):
        branch = lane(lanes, i)[0]
        assert_whole(branch, start, end)
        several += len(turns(branch)) >= 2
        assert_energy_balance(branch, 2 * zeta, level)
        x = branch.steady_states.x
        j = int(np.argmax(np.asarray(x.amplitudes)[:, 0]))
        # The amplitude in quadrature, and so the peak, agrees with one term up to damping and the third harmonic.
        assert float(x.amplitudes[j, 0] * branch.omega[j]) == pytest.approx(level / (2 * zeta), rel=0.05)
    assert several >= 15


def test_branch_without_a_first_motion_is_reported_as_incomplete(lanes):
    """Far below a strong nonlinearity's resonance, where Newton's method finds no motion."""
    branch, found = lane(lanes, "no start")
    assert not bool(branch.complete) and not np.asarray(branch.valid).any() and not np.asarray(found.exists).any()
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((branch.value, branch.unknowns, found.value)))


# -- folds --


def test_floquet_multiplier_is_one_at_a_fold(lanes, hardening):
    found = lane(lanes, "hardening")[1]
    assert np.asarray(found.exists).all()
    # As if the folds were rows of the branch.
    index = np.zeros(POINTS, int)
    index[1] = 1
    at = eqx.tree_at(
        lambda b: (b.value, b.omega, b.unknowns),
        hardening,
        (found.value[index], found.value[index], found.unknowns[index]),
    )
    multipliers = np.asarray(at.multipliers)[:2]
    assert np.abs(multipliers - 1.0).min(axis=1).max() < 1e-7
    assert np.abs(np.asarray(hardening.multipliers)[0] - 1.0).min() > 1e-3
    # No motion lies beyond a fold, and the nearest ones lie just before it.
    value = np.asarray(hardening.value)
    first, second = turns(hardening)
    assert 0 <= float(found.value[0]) - value[:second].max() < 1e-4
    assert 0 <= value[first:].min() - float(found.value[1]) < 1e-4


def test_derivatives_of_folds_agree_with_differences(lanes, hardening):
    """By zeta, alpha, forcing and omega_0, against differences of lanes, each with a search of its own."""

    @eqx.filter_jit
    @jax.jacrev
    def slope(p):
        system = balance(duffing(2 * p[0] * p[3], p[1], p[3]), harmonic_series(1.0, p[2]), harmonics=HARMONICS)
        return folds(eqx.tree_at(lambda b: b.system, hardening, system), at_most=2).value

    ends = np.array([[lane(lanes, f"{sign}{j}")[1].value for j in range(4)] for sign in "+-"])
    differences = ((ends[0] - ends[1]) / 2e-6).T
    np.testing.assert_allclose(slope(jnp.asarray(AT[[0, 1, 2, 5]])), differences, rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_derivatives_through_the_search_of_folds_agree_with_differences(lanes, hardening):
    """From the parameters to the folds; a single run equals its lane of the batch."""

    def values(p):
        branch, found = response(p)
        return found.value, (branch, found.value)

    slope, (alone, found) = eqx.filter_jit(jax.jacrev(values, has_aux=True))(jnp.asarray(AT))
    ends = np.array([[lane(lanes, f"{sign}{j}")[1].value for j in range(4)] for sign in "+-"])
    np.testing.assert_allclose(np.asarray(slope)[:, [0, 1, 2, 5]], ((ends[0] - ends[1]) / 2e-6).T, rtol=1e-5, atol=1e-6)
    # Folds do not depend on the ends of the range.
    np.testing.assert_allclose(np.asarray(slope)[:, 3:5], 0.0, atol=1e-9)
    np.testing.assert_allclose(found, lane(lanes, "hardening")[1].value, rtol=1e-10)
    np.testing.assert_allclose(alone.value, hardening.value, rtol=1e-8)
    np.testing.assert_allclose(alone.unknowns, hardening.unknowns, atol=1e-8)


def one_term_folds(zeta: float, kappa: float, level: float) -> list[float]:
    """Shifts sigma of the folds by `(zeta^2 + (sigma - y)^2) y = kappa A^2 / 4`, y = kappa a^2, kappa = 3/8 alpha."""
    push = kappa * level**2 / 4
    shifts = []
    # On a fold also `3 y^2 - 4 sigma y + sigma^2 + zeta^2 = 0`, so that sigma = 2 y -+ sqrt(y^2 - zeta^2).
    for sign in (-1.0, 1.0):
        y = np.linspace(zeta, push / zeta**2, 200_001)
        sigma = 2 * y + sign * np.sqrt(y**2 - zeta**2)
        wrong = (zeta**2 + (sigma - y) ** 2) * y - push
        shifts += sigma[:-1][np.diff(np.sign(wrong)) != 0].tolist()
    return sorted(shifts)


def test_folds_of_a_weak_nonlinearity_agree_with_one_term_theory(lanes):
    _, found = lane(lanes, "weak")
    shifts = np.sort(np.asarray(found.value)) - 1.0
    # Neglected: the shift itself, 5e-3, relative to one.
    np.testing.assert_allclose(shifts, one_term_folds(WEAK_ZETA, KAPPA, 1.6 * CRITICAL), rtol=0.01)


@pytest.mark.slow
def test_followed_folds_meet_at_the_cusp_of_one_term_theory(lanes):
    """At sigma = sqrt(3) zeta, kappa A^2 / 4 = 8 zeta^3 / (3 sqrt(3))."""
    branch, found = lane(lanes, "weak")
    for fold in (0, 1):
        track = follow_fold(branch, fold, "amplitude", 1.0, 0.3, steps=100)
        valid = np.asarray(track.valid)
        factor, omega = np.asarray(track.second)[valid], np.asarray(track.value)[valid]
        assert factor[0] == 1.0 and omega[0] == pytest.approx(float(found.value[fold]), rel=1e-12)
        cusp = int(np.argmin(factor))
        assert 0 < cusp < factor.size - 1
        # A step of 0.08 may miss the lowest point, which in this direction is flat.
        assert factor[cusp] * 1.6 == pytest.approx(1.0, abs=0.01)
        assert omega[cusp] - 1.0 == pytest.approx(np.sqrt(3) * WEAK_ZETA, rel=0.1)
        # Through the cusp, and back up along the other fold.
        rising = np.arange(cusp, factor.size)[: int(np.argmax(factor[cusp:])) + 1]
        assert factor[rising[-1]] > 1.0
        back = np.interp(1.0, factor[rising], omega[rising])
        assert back - 1.0 == pytest.approx(float(found.value[1 - fold]) - 1.0, rel=0.01)


def test_response_import_loads_neither_jaxcont_nor_matplotlib():
    """JaxCont and matplotlib take as long to load as JAX: they are loaded at their first use."""
    code = "import sys, hdjax.response; sys.exit(bool({'jaxcont', 'matplotlib'} & set(sys.modules)))"
    assert subprocess.run([sys.executable, "-c", code], timeout=120).returncode == 0
