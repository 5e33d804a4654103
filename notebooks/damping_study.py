# ---
# jupyter:
#   jupytext:
#     text_representation:
#       format_name: percent
# ---

# %% [markdown]
# # How much damping?
#
# The source document's Table 3 says that more damping lowers the peak of the dynamic error, but "may affect
# efficiency". Here gradients find the mesh damping `B_sp` and the stiffness `K` that trade one for the other.
#
# The drive is the preset with a catalogue-like cubic stiffness. Its motor torque ripples by 0.5 N m. It works where the
# ripple's frequency is 1.6 to 2.4 times the preset's natural frequency, and passes the resonance on its way there.

# %%
import dataclasses

import equinox as eqx
import jax
import matplotlib.pyplot as plt
import numpy as np
import optimistix as optx

jax.config.update("jax_enable_x64", True)
import jax.numpy as jnp

from hdjax import ReducedModel, hdc_40_050
from hdjax.fourier import harmonic_series
from hdjax.response.continuation import frequency_response
from hdjax.response.harmonic_balance import balance
from hdjax.response.resonance import peak

OMEGA_0 = float(hdc_40_050().omega_0)
RIPPLE = 0.5  # N m
WORKING = np.linspace(1.6, 2.4, 65) * OMEGA_0
START = np.array([7160.0, 1e5, 0.5])  # K, alpha, B_sp


def drive(design):
    K, alpha, B_sp = design
    return dataclasses.replace(hdc_40_050(), K=K, alpha=alpha, B_sp=B_sp)


def response(design):
    """The branch through the resonance, and its peak."""
    model, ripple = ReducedModel(drive(design).reduced()), harmonic_series(1.0, RIPPLE)
    # The search needs no gradient: the peak is a root of the live system.
    still = jax.lax.stop_gradient(model)
    branch = frequency_response(still, ripple, 0.5 * OMEGA_0, 3.0 * OMEGA_0, harmonics=5, points=200, steps=300)
    return branch, peak(eqx.tree_at(lambda b: b.system, branch, balance(model, ripple, harmonics=5)))


@jax.jit
def loss(design, omega):
    """Mean power [W] that the mesh damping takes, `B_sp <x'^2>`. Off resonance the linear motion is exact enough."""
    made = drive(design)
    A = made.error_forcing(jnp.asarray(RIPPLE), jnp.asarray(0.0))
    rate = omega * A / jnp.hypot(made.omega_0**2 - omega**2, made.mu * omega)
    return 0.5 * made.B_sp * jnp.mean(rate**2)


# %% [markdown]
# ## What Table 3 says, and what the model says
# Table 3 prints peaks of 2.10 : 1.20 : 0.85 for dampings of 1 : 5 : 10. As slopes `d log(peak) / d log(B_sp)` these
# are -0.35 and -0.50. The model's peak is `A / (mu omega)`, a slope of -1 or 10 : 2 : 1. Hardening weakens it, because
# a higher peak lies at a higher frequency; but however strong, it leaves -1/2, and -0.35 is out of reach.


# %%
@jax.jit
def study(design):
    """The peak, its slopes on logarithmic scales, and the response that it is the peak of."""

    def log_peak(logs):
        branch, top = response(jnp.exp(logs))
        return jnp.log(top.amplitude), (top, branch.omega, branch.amplitude)

    (_, found), slopes = jax.value_and_grad(log_peak, has_aux=True)(jnp.log(design))
    return *found, slopes


print(f"{'B_sp':>5}{'peak [mrad]':>13}{'at [rad/s]':>12}    slopes by K, alpha, B_sp")
for B_sp in (0.3, 1.0, 3.0):
    top, _, _, slopes = study(np.array([7160.0, 1e5, B_sp]))
    print(f"{B_sp:5g}{1e3 * top.amplitude:13.3f}{top.value:12.1f}   {slopes[0]:8.3f}{slopes[1]:8.3f}{slopes[2]:8.3f}")
    assert -1.0 < slopes[2] < -0.5

# %% [markdown]
# A gradient is only worth having if it is right:

# %%
*_, slopes = study(START)
differences = [
    np.log(study(START * np.exp(step))[0].amplitude / study(START * np.exp(-step))[0].amplitude) / 2e-4
    for step in 1e-4 * np.eye(3)
]
print("slopes     ", np.asarray(slopes))
print("differences", np.asarray(differences))
np.testing.assert_allclose(slopes, differences, rtol=1e-6)

# %% [markdown]
# ## Does damping cost anything?
# Averaged over every frequency it does not: what damping takes off the peak it adds on the flanks, and a linear drive
# loses the same whatever its `B_sp`. It costs where the drive works, away from the resonance.

# %%
everywhere = np.linspace(0.0, 100.0, 1_000_001) * OMEGA_0
for B_sp in (0.3, 1.0, 3.0):
    here, overall = (1e3 * loss(np.array([7160.0, 1e5, B_sp]), omega) for omega in (WORKING, everywhere))
    print(f"B_sp {B_sp:g}: {here:.3f} mW where it works, {overall:.3f} mW over all frequencies")

# %% [markdown]
# ## The best of both
# A stated price: one milliradian of peak is worth one milliwatt of loss. `K` may lie between 4,000 and 12,000 N m/rad,
# `B_sp` between 0.3 and 10 N m s/rad.

# %%
LOWEST, HIGHEST = np.array([4000.0, 1e5, 0.3]), np.array([12_000.0, 1e5, 10.0])


def bounded(z):
    K, B_sp = jax.nn.sigmoid(z)
    return LOWEST * (HIGHEST / LOWEST) ** jnp.stack([K, jnp.zeros_like(K), B_sp])


def cost(z, args):
    _, top = response(bounded(z))
    return 1e3 * (top.amplitude + loss(bounded(z), WORKING))


# The peak is known to about 1e-11 of itself, so a minimum can't be told to better than its root: asking for more than
# 1e-4 leaves the line search with nothing but rounding to judge by.
found = optx.minimise(cost, optx.BFGS(rtol=1e-4, atol=1e-4), jnp.array([0.0, -1.0]), max_steps=200)
optimum = np.asarray(bounded(found.value))
top, omega, size, _ = study(optimum)
peak_best, loss_best = 1e3 * float(top.amplitude), 1e3 * float(loss(optimum, WORKING))
print(f"K = {optimum[0]:.1f} N m/rad, B_sp = {optimum[2]:.4f} N m s/rad, after {int(found.stats['num_steps'])} steps")
print(f"peak {peak_best:.3f} mrad at {float(top.value):.0f} rad/s, loss {loss_best:.3f} mW")
assert top.converged and top.value < WORKING[0]
np.testing.assert_allclose(jax.grad(cost)(found.value, None), 0.0, atol=1e-3)

# %% [markdown]
# Brute force agrees: no design of a grid is better, and the best of them is the optimum's neighbour.

# %%
stiffnesses, dampings = np.geomspace(4000.0, 12_000.0, 13), np.geomspace(0.3, 10.0, 25)
grid = np.array([[(K, 1e5, B_sp) for B_sp in dampings] for K in stiffnesses])
peaks = 1e3 * np.array([[study(design)[0].amplitude for design in row] for row in grid])
losses = 1e3 * np.array([[loss(design, WORKING) for design in row] for row in grid])
nearest = grid[np.unravel_index(np.argmin(peaks + losses), peaks.shape)]
print(f"cost {peak_best + loss_best:.4f}; of the grid {np.min(peaks + losses):.4f} at K = {nearest[0]:.0f}, ", end="")
print(f"B_sp = {nearest[2]:.3f}")
assert peak_best + loss_best <= np.min(peaks + losses)
assert (
    np.abs(np.log(optimum / nearest)) <= np.log([stiffnesses[1] / stiffnesses[0], 2.0, dampings[1] / dampings[0]])
).all()

# %%
figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
for row, shade in zip(range(0, 13, 4), plt.colormaps["viridis"](np.linspace(0.0, 0.9, 4)), strict=True):
    left.loglog(losses[row], peaks[row], ".-", color=shade, lw=1, ms=4, label=f"K = {stiffnesses[row]:.0f} N m/rad")
price = np.linspace(0.05, 0.95, 91) * (peak_best + loss_best)
left.loglog(price, peak_best + loss_best - price, color="0.5", ls="--", label="the optimum's cost")
left.loglog(loss_best, peak_best, "*", color="#D55E00", ms=14, label="optimum")
left.set_xlabel("mean loss where the drive works [mW]")
left.set_ylabel("peak of the dynamic error [mrad]")
left.legend(frameon=False)
_, start_omega, start_size, _ = study(START)
right.semilogy(start_omega, 1e3 * start_size, color="0.5", label="start: K = 7160 N m/rad, B_sp = 0.5 N m s/rad")
right.semilogy(omega, 1e3 * size, color="#D55E00", label="optimum")
right.axvspan(WORKING[0], WORKING[-1], color="#0072B2", alpha=0.12, label="where the drive works")
right.set_xlabel("frequency of the ripple [rad/s]")
right.set_ylabel("largest |x| [mrad]")
right.set_ylim(top=30.0)
right.legend(frameon=False, loc="upper right")
# %% [markdown]
# Table 3 points the right way and is wrong in its figures: damping does up to twice as much as it says (on a
# logarithmic scale), and in this model its price is milliwatts.
