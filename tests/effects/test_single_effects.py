"""Single effects against their closed forms and scipy."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from simulated_outputs import BASE, DRIVE, START, STEP, TIME, outputs, rms

from hdjax import Harmonic, ReducedDrive, ReducedModel, sampled, simulate
from hdjax.effects import CATALOGUE, Motion, Scales
from hdjax.effects.actuation import InputDelay
from hdjax.effects.backlash import Backlash, UndampedBacklash
from hdjax.effects.friction import CoulombFriction, MotorFriction, StribeckMotorFriction
from hdjax.effects.kinematic import KinematicError
from hdjax.effects.load import GravityLoad
from hdjax.effects.stiffness import ThreeSlopeStiffness


def test_decay_under_coulomb_friction_has_a_linear_envelope():
    """Each half period of an undamped drive costs 2 T_c / omega_0^2 of amplitude."""
    omega, f = 50.0, 0.02
    friction = CoulombFriction(T_c=f * omega**2, v_0=1e-3 * omega)
    model = ReducedModel(ReducedDrive(mu=0.0, omega_0=omega), (friction,))
    halves = np.arange(21)
    times = np.pi / omega * halves
    found = simulate(model, Harmonic(0.0, 0.0), times, jnp.asarray([1.0, 0.0])).dynamic_error
    # The smoothed sign loses a share of about v_0 / v of each half period's friction.
    np.testing.assert_allclose(found, (-1.0) ** halves * (1 - 2 * f * halves), atol=2e-3)


def test_twist_of_a_slow_unloaded_drive_is_the_negative_kinematic_error():
    """Unloaded and slow, the mesh does not twist: x_s = 0, so x = -e.

    The error's own inertia force is (4 * 1 / 386)^2 = 1e-4 of it, and starts a ringing of the same size.
    """
    a = {"cos_1": 3e-5, "sin_1": -2e-5, "cos_2": 1e-4, "sin_2": 5e-5, "cos_4": 1e-5, "sin_4": 2e-5}

    def e(theta):
        return sum(a[f"cos_{n}"] * np.cos(n * theta) + a[f"sin_{n}"] * np.sin(n * theta) for n in (1, 2, 4))

    slope = 3e-5 * 0 - 2e-5 + 2 * 5e-5 + 4 * 2e-5
    start = jnp.asarray([0.0, e(0.0), 1.0, 1.0 / 50 + slope])
    model = BASE.with_effects(KinematicError(**a))
    found = np.asarray(outputs(model, sampled(np.arange(4000) * STEP, np.zeros(4000), hold="zero-order"), start))
    theta = found[:, 0] * 50
    assert theta[-1] > 3.5
    np.testing.assert_allclose(found[:, 1], -e(theta), atol=2e-3 * np.abs(e(theta)).max())


@pytest.mark.parametrize("stribeck", (False, True))
def test_three_effects_at_once_agree_with_scipy(stribeck):
    """The equations of EFFECTS.md are solved without hdjax."""
    N, J_m, J_l, K, alpha, B = 50.0, 5.26e-4, 5.0e-2, 7160.0, 2e4, 2.0
    T_c, T_excess, b, turn, omega_s = 0.2, 0.15 * stribeck, 0.004, 1.0, 8.0

    def rates(t, y):
        theta_m, theta_l, omega_m, omega_l = y
        e = 1e-4 * np.cos(2 * theta_m) + 4e-5 * np.sin(2 * theta_m) + 3e-5 * np.sin(4 * theta_m)
        de = -2e-4 * np.sin(2 * theta_m) + 8e-5 * np.cos(2 * theta_m) + 1.2e-4 * np.cos(4 * theta_m)
        x = theta_m / N + e - theta_l
        v = (1 / N + de) * omega_m - omega_l
        tau = K * (x + alpha * x**3) + B * v
        level = T_c + T_excess * np.exp(-((omega_m / omega_s) ** 2))
        friction = level * np.tanh(omega_m / turn) + b * omega_m
        gravity = 6.0 * np.sin(theta_l + 0.4)
        return [
            omega_m,
            omega_l,
            (1.5 * np.cos(50 * t + 0.2) - friction - (1 / N + de) * tau) / J_m,
            (tau - gravity) / J_l,
        ]

    if stribeck:
        friction = StribeckMotorFriction(T_c=T_c, T_excess=T_excess, b=b, transition=turn, omega_s=omega_s)
    else:
        friction = MotorFriction(T_c=T_c, b=b, transition=turn)
    model = BASE.with_effects(
        KinematicError(cos_2=1e-4, sin_2=4e-5, sin_4=3e-5),
        friction,
        GravityLoad(sine=6.0 * np.cos(0.4), cosine=6.0 * np.sin(0.4)),
    )
    found = simulate(model, Harmonic(1.5, 50.0, 0.2), TIME, START, rtol=1e-10, atol=1e-13)
    other = solve_ivp(rates, TIME[[0, -1]], np.asarray(START), "DOP853", TIME, rtol=1e-10, atol=1e-13)
    # Some 1e3 steps that err by 1e-10 of angles of order one.
    np.testing.assert_allclose(found.states[:, :2], other.y[:2].T, atol=1e-7)
    np.testing.assert_allclose(found.dynamic_error, other.y[0] / N - other.y[1], atol=1e-8)
    derived = model.effect("gravity_load").derived(DRIVE)
    assert float(derived["m_g_r"][0]) == pytest.approx(6.0)
    assert float(derived["phi"][0]) == pytest.approx(0.4)


def test_kinematic_error_reports_amplitude_and_phase():
    """A cos(n theta + psi), as EFFECTS.md writes it."""
    derived = KinematicError(cos_2=2e-4 * np.cos(0.7), sin_2=-2e-4 * np.sin(0.7)).derived(DRIVE)
    assert float(derived["amplitude_2"][0]) == pytest.approx(2e-4)
    assert float(derived["phase_2"][0]) == pytest.approx(0.7)


def test_three_slope_stiffness_passes_through_the_vendor_table():
    """Size 40, ratio 50 (EFFECTS.md): 54 N m at the first knee, 196 N m at the second, slopes 10 and 14 e4 N m/rad."""
    x1 = 54 / 10e4
    effect = ThreeSlopeStiffness(stiffening_2=0.4, stiffening_3=0.3, x1=x1, gap=(196 - 54) / 14e4)
    drive = eqx.tree_at(lambda d: (d.K, d.alpha), DRIVE, (jnp.asarray(10e4), jnp.asarray(0.0)))

    def torque(x):
        motion = Motion(x=jnp.asarray(x), v=jnp.asarray(0.0))
        return float(drive.mesh_torque(motion.x, motion.v) + effect.torque(motion, drive, jnp.zeros(0)))

    x2 = x1 + (196 - 54) / 14e4
    for x, expected in ((x1 / 2, 27.0), (x1, 54.0), (x2, 196.0), (x2 + 1e-4, 196.0 + 17.0)):
        assert torque(x) == pytest.approx(expected)
        assert torque(-x) == pytest.approx(-expected)
    derived = {name: float(v) for name, (v, _) in effect.derived(drive).items()}
    assert derived == pytest.approx({"K1": 10e4, "K2": 14e4, "K3": 17e4, "T1": 54.0, "T2": 196.0})


def test_backlash_torque_is_zero_inside_its_gap():
    effect = Backlash(b=1e-4)

    def torque(x):
        motion = Motion(x=jnp.asarray(x), v=jnp.asarray(0.0))
        return float(DRIVE.mesh_torque(motion.x, motion.v) + effect.torque(motion, DRIVE, jnp.zeros(0)))

    assert torque(0.9e-4) == pytest.approx(0.0, abs=1e-12)
    for sign in (-1, 1):
        assert torque(sign * 1.1e-3) == pytest.approx(sign * 7160 * (1e-3 + 2e4 * 1e-9))


SWING = Scales(x=4e-4, x_max=1e-3, v=0.1, omega_m=5.0, omega_l=0.1, time_step=1e-3)


@pytest.mark.parametrize(
    "drive",
    [eqx.tree_at(lambda d: d.alpha, DRIVE, jnp.asarray(5e8)), ReducedDrive(mu=3.0, omega_0=90.0, alpha=5e8, gain=20.0)],
    ids=["drive", "reduced"],
)
def test_backlash_imitates_a_strongly_hardening_spring(drive):
    """Outside the gap a linear spring has the torque and slope of the hardening one, at a twist of the motion."""
    starts = Backlash.imitated(drive, SWING)
    for (values, effect), x in zip(starts, jnp.asarray([np.sqrt(2.0) * SWING.x, SWING.x_max]), strict=True):
        stiff = eqx.tree_at(lambda d, v=values: [getattr(d, n) for n in v], drive, list(values.values()))

        def torque(x, stiff=stiff, effect=effect):
            return stiff.mesh_torque(x, jnp.zeros(())) + effect.torque(
                Motion(x=x, v=jnp.zeros(())), stiff, jnp.zeros(0)
            )

        def hardening(x):
            return drive.mesh_torque(x, jnp.zeros(()))

        assert 0.5 * x < float(effect.b) < x and float(stiff.alpha) == 0.0
        assert float(torque(x)) == pytest.approx(float(hardening(x)), rel=1e-9)
        assert float(jax.grad(torque)(x)) == pytest.approx(float(jax.grad(hardening)(x)), rel=1e-9)


@pytest.mark.parametrize("x", (0.0, 1e-4))
def test_backlash_of_no_width_leaves_the_damping(x):
    motion = Motion(x=jnp.asarray(x), v=jnp.asarray(0.2))
    assert float(UndampedBacklash().torque(motion, DRIVE, jnp.zeros(0))) == 0.0


def test_moderately_hardening_spring_is_imitated_by_no_effect():
    hard = eqx.tree_at(lambda d: d.alpha, DRIVE, jnp.asarray(4.5e5))
    assert [form for form in CATALOGUE if form.imitated(hard, SWING)] == []


@pytest.mark.parametrize("fine", (7, 19, 68))
def test_input_delay_equals_a_torque_shifted_in_time(fine):
    """A held torque, `fine` fiftieths of an interval late, against the same torque on a 50 times finer grid.

    Within an interval the delayed jump is smoothed with equal moments up to the third. The remaining difference is
    below 1e-3 of the delay's effect.
    """
    rows = 100
    values = np.random.default_rng(8).normal(size=rows)
    held = sampled(TIME[:rows], values, hold="zero-order")
    late = np.concatenate([np.full(fine, values[0]), np.repeat(values, 50)])[: 50 * rows]
    exact = outputs(BASE, sampled(STEP / 50 * np.arange(50 * rows), late, hold="zero-order"), START)[::50, 1]
    found = outputs(BASE.with_effects(InputDelay(delay=fine * STEP / 50)), held, START, substeps=4)[:, 1]
    undelayed = outputs(BASE, held, START, substeps=4)[:, 1]
    assert rms(found - exact) < 1e-3 * rms(undelayed - exact)


@pytest.mark.parametrize("form", ["position_dependent_motor_friction", "rippling_motor_friction"])
def test_friction_over_the_angle_never_drives_the_motor(form: str):
    """Where its ripple is larger than its mean, there is none."""
    ripple = "cosine" if form.startswith("position") else "cos_1"
    effect = next(f for f in CATALOGUE if f.name == form)(T_c=0.1, transition=0.1, **{ripple: 0.3})
    angles, nothing = jnp.linspace(0.0, 2 * np.pi, 101), jnp.zeros(())

    @jax.vmap
    def power_at(angle, rate):
        return effect.torque(Motion(nothing, nothing, angle, rate), DRIVE, jnp.zeros(0)) * rate

    power = np.concatenate([power_at(angles, jnp.full(angles.shape, rate)) for rate in (-3.0, 3.0)])
    assert np.max(power) <= 0.0 < np.mean(power == 0.0) and np.min(power) < -1.0
