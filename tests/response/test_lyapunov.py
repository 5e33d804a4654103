"""The energy of the unforced dynamic error against simulated motions."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy.integrate import cumulative_simpson

from hdjax import Drive, ReducedDrive, hdc_40_050
from hdjax.response.lyapunov import (
    critical_energy,
    energy,
    energy_rate,
    in_basin_estimate,
    phase_portrait,
    saddle,
)

TIMES = jnp.linspace(0.0, 60.0, 1201)


def oscillator(alpha: float, mu: float = 0.3) -> ReducedDrive:
    return ReducedDrive(mu=mu, omega_0=1.5, alpha=alpha)


def ring(radius: float, n: int = 16) -> Array:
    angles = jnp.linspace(0.0, 2 * jnp.pi, n, endpoint=False)
    return radius * jnp.stack([jnp.cos(angles), 1.5 * jnp.sin(angles)], axis=-1)


@pytest.mark.parametrize("alpha", (0.0, 2.0, -0.5))
def test_energy_falls_by_the_work_of_the_damper(alpha):
    drive = oscillator(alpha)
    portrait = phase_portrait(drive, ring(0.7), TIMES)
    found = np.asarray(portrait.energy)
    assert not np.asarray(portrait.escaped).any()
    # It is stationary where v = 0: rounding of 1e-8 steps.
    assert np.diff(found, axis=1).max() < 1e-8
    lost = cumulative_simpson(np.asarray(energy_rate(drive, portrait.v)), x=np.asarray(TIMES), initial=0.0)
    # Simpson's rule at 0.1 rad a step.
    np.testing.assert_allclose(found, found[:, :1] + lost, atol=1e-5)


@pytest.mark.parametrize("alpha", (2.0, -0.5))
def test_energy_rate_is_the_gradient_along_the_motion(alpha):
    """`V' = dV/dx v + dV/dv v'` with the equation's own v'."""
    drive = oscillator(alpha)
    x, v = jnp.asarray(0.4), jnp.asarray(-0.7)
    slope_x, slope_v = jax.grad(lambda x, v: energy(drive, x, v), argnums=(0, 1))(x, v)
    np.testing.assert_allclose(slope_x * v - slope_v * drive.mesh_torque(x, v), energy_rate(drive, v), rtol=1e-12)


def test_saddles_are_equilibria_at_the_critical_energy():
    drive = oscillator(-4.0)
    assert float(saddle(drive)) == 0.5
    nothing = jnp.asarray(0.0)
    assert float(drive.mesh_torque(saddle(drive), nothing)) == pytest.approx(0.0, abs=1e-15)
    assert float(critical_energy(drive)) == pytest.approx(1.5**2 / 16)
    assert float(energy(drive, saddle(drive), nothing)) == pytest.approx(float(critical_energy(drive)))
    for alpha in (0.0, 1.0):
        assert np.isposinf([saddle(oscillator(alpha)), critical_energy(oscillator(alpha))]).all()


@pytest.mark.slow
def test_all_motions_from_the_basin_estimate_come_to_rest():
    drive = oscillator(-1.0)
    x, v = jnp.meshgrid(jnp.linspace(-1.4, 1.4, 15), jnp.linspace(-2.1, 2.1, 15), indexing="ij")
    starts = jnp.stack([x.ravel(), v.ravel()], axis=-1)
    inside = np.asarray(in_basin_estimate(drive, starts[:, 0], starts[:, 1]))
    portrait = phase_portrait(drive, starts, TIMES)
    rests = np.asarray(jnp.hypot(portrait.x[:, -1], portrait.v[:, -1])) < 0.01  # exp(-mu t / 2) is 1e-4
    assert inside.sum() > 25
    assert rests[inside].all() and not np.asarray(portrait.escaped)[inside].any()
    assert np.asarray(portrait.escaped)[~inside].any()
    assert rests[~inside].any()  # the estimate is smaller than the basin
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(portrait))


def test_basin_estimate_excludes_low_energies_beyond_the_saddles():
    """V falls without bound there: the condition on x is needed."""
    drive = oscillator(-1.0)
    beyond, nothing = jnp.asarray([1.2, 3.0]), jnp.zeros(2)
    assert np.asarray(energy(drive, beyond, nothing) < critical_energy(drive)).all()
    assert not np.asarray(in_basin_estimate(drive, beyond, nothing)).any()


def test_basin_estimate_is_the_plane_for_hardening_and_empty_without_damping():
    far, nothing = jnp.asarray([1e6, -1e6]), jnp.zeros(2)
    for alpha in (0.0, 1.0):
        assert np.asarray(in_basin_estimate(oscillator(alpha), far, far)).all()
        assert not np.asarray(in_basin_estimate(oscillator(alpha, mu=0.0), nothing, nothing)).any()


def test_phase_portrait_has_the_critical_level_and_the_nullcline():
    drive = oscillator(-1.0)
    portrait = phase_portrait(drive, ring(0.5), TIMES)
    grid, level = np.asarray(portrait.grid), np.asarray(portrait.level)
    inside = np.abs(grid) < 1.0
    on_level = energy(drive, portrait.grid[inside], portrait.level[inside])
    np.testing.assert_allclose(on_level, critical_energy(drive), rtol=1e-12)
    assert (level[~inside] == 0.0).all() and grid.max() > 1.0
    np.testing.assert_allclose(drive.mesh_torque(portrait.grid, portrait.nullcline), 0.0, atol=1e-12)
    undamped = phase_portrait(oscillator(1.0, mu=0.0), ring(0.5), TIMES)
    assert np.isinf(undamped.nullcline).all() and (np.asarray(undamped.level) == 0.0).all()
    np.testing.assert_allclose(undamped.energy, undamped.energy[:, :1] * jnp.ones_like(undamped.energy), rtol=1e-5)


def test_phase_portrait_reaches_as_far_as_its_motions():
    sent = phase_portrait(oscillator(1.0), jnp.tile(jnp.asarray([0.0, 0.5]), (16, 1)), TIMES)
    assert float(sent.grid[-1]) == float(jnp.max(jnp.abs(sent.x))) > 0.2


def test_energy_of_a_drive_equals_that_of_its_reduced_equation():
    drive: Drive = hdc_40_050()
    x, v = jnp.asarray([1e-3, 2e-3]), jnp.asarray([0.1, -0.3])
    np.testing.assert_allclose(energy(drive, x, v), energy(drive.reduced(), x, v), rtol=1e-14)
    # In joule, by 1/c: the spring's own energy.
    spring = energy(drive, x, jnp.zeros(2)) / drive.c
    np.testing.assert_allclose(spring, 7160 * (x**2 / 2 + 0.1 * x**4 / 4), rtol=1e-12)
    times, start = jnp.linspace(0.0, 0.1, TIMES.size), 1e-3 * ring(1.0)
    a, b = (phase_portrait(d, start, times) for d in (drive, drive.reduced()))
    np.testing.assert_allclose(a.x, b.x, rtol=1e-12)


def test_critical_energy_is_the_same_in_lanes_and_has_finite_gradients():
    alphas = jnp.asarray([-1.0, 0.0, 1.0])

    def estimate(alpha: Array) -> tuple[Array, Array]:
        drive = ReducedDrive(mu=0.3, omega_0=1.5, alpha=alpha)
        return critical_energy(drive), in_basin_estimate(drive, jnp.asarray(0.9), jnp.asarray(0.4))

    together = jax.jit(jax.vmap(estimate))(alphas)
    for k, alpha in enumerate(alphas):
        np.testing.assert_allclose([t[k] for t in together], [float(e) for e in estimate(alpha)], rtol=1e-14)
    slopes = jax.vmap(jax.grad(lambda alpha: estimate(alpha)[0]))(alphas)
    assert float(slopes[0]) == pytest.approx(1.5**2 / 4) and np.isfinite(np.asarray(slopes)).all()
