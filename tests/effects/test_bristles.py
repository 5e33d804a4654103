"""Bristle friction and Maxwell slip against closed forms and a numpy implementation."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdjax import Drive
from hdjax.effects import Effect, Motion, Scales
from hdjax.effects.bristle import bristle_rate, slip_rate
from hdjax.effects.hysteresis import Dahl, MaxwellSlip
from hdjax.effects.presliding import DahlMotorFriction, LuGreLoadFriction, LuGreMeshFriction, LuGreMotorFriction

DRIVE = Drive(N=50.0, J_m=5.26e-4, J_l=5.0e-2, K=7160.0)
NO_LIMIT = 1e-12  # s: a settling time that does not bound the bristles' rate
MOST_STEPS = 700


@eqx.filter_jit
def states_along(effect: Effect, x: jax.Array, rate: jax.Array, step: jax.Array) -> jax.Array:
    """States along a motion whose rate is given at the start, middle and end of each step, by classical Runge-Kutta.

    The motions of twist, motor and load are the same here.
    """

    def at(rate, state):
        return effect.state_rates(Motion(x=rate, v=rate, omega_m=rate, omega_l=rate), state)

    def move(state, rates):
        start, middle, end = rates
        k1 = at(start, state)
        k2 = at(middle, state + 0.5 * step * k1)
        k3 = at(middle, state + 0.5 * step * k2)
        k4 = at(end, state + step * k3)
        state = state + step / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return state, state

    first = effect.initial_state()
    return jnp.concatenate([first[None], jax.lax.scan(move, first, rate)[1]])


def along_sine(effect: Effect, size: float, omega: float, cycles: int, samples: int = 2000):
    """Twist and states over cycles of `size sin(omega t)`."""
    step = 2 * np.pi / omega / samples
    t = step * np.arange(cycles * samples + 1)
    rate = size * omega * np.cos(omega * np.stack([t[:-1], t[:-1] + step / 2, t[1:]], axis=1))
    x = size * np.sin(omega * t)
    return x, np.asarray(states_along(effect, jnp.asarray(x), jnp.asarray(rate), jnp.asarray(step)))


def elastoplastic(x: np.ndarray, limit: float) -> np.ndarray:
    """An ideal element: it follows the twist, cut at its limit."""
    z = np.zeros(x.size)
    for i in range(1, x.size):
        z[i] = np.clip(z[i - 1] + x[i] - x[i - 1], -limit, limit)
    return z


SLIP = MaxwellSlip(k_1=3000.0, k_2=2000.0, k_3=1000.0, yield_twist=6e-4, settling=1e-3)
SPRINGS = ((3000.0, 6e-4), (2000.0, 3e-4), (1000.0, 1.5e-4))


def slip_torque(states: np.ndarray, effect: MaxwellSlip = SLIP) -> np.ndarray:
    motion = Motion(x=jnp.zeros(()), v=jnp.zeros(()))
    return np.asarray(jax.vmap(lambda s: effect.torque(motion, DRIVE, s))(jnp.asarray(states)))


def test_maxwell_slip_is_a_sum_of_elastoplastic_elements():
    """With minor loops, to within the change of the rate over a settling time, since corners are sharp."""
    samples = 4000
    t = np.linspace(0.0, 2 * np.pi, samples + 1)
    x = 1.5e-3 * np.sin(t) + 5e-4 * np.sin(5 * t)
    rate = lambda t: 1.5e-3 * np.cos(t) + 2.5e-3 * np.cos(5 * t)  # noqa: E731
    step = t[1]
    rates = np.stack([rate(t[:-1]), rate(t[:-1] + step / 2), rate(t[1:])], axis=1)
    states = np.asarray(states_along(SLIP, jnp.asarray(x), jnp.asarray(rates), jnp.asarray(step)))
    torque = slip_torque(states)
    ideal = sum(k * elastoplastic(x, d) for k, d in SPRINGS)
    assert np.abs(ideal).max() == pytest.approx(sum(k * d for k, d in SPRINGS))
    assert np.abs(torque - ideal).max() < 2e-3 * np.abs(ideal).max()


def test_maxwell_slip_limits_are_shares_of_the_yield_twist():
    effect = MaxwellSlip(k_1=1.0, k_2=10.0, k_3=100.0, yield_twist=6e-4, share_2=0.7, share_3=0.1, settling=1e-3)
    far = slip_torque(np.full((1, 3), 1.0), effect)
    assert far[0] == pytest.approx(6e-4 * (1.0 + 10.0 * 0.7 + 100.0 * 0.1))


@pytest.mark.parametrize("omega", (0.5, 40.0))
def test_maxwell_slip_loop_area_does_not_depend_on_the_rate(omega):
    """4 sum k_i d_i (X - d_i) at every rate, as long as the settling time is short against the period."""
    size = 2e-3

    def moved(omega):
        effect = eqx.tree_at(lambda e: e.settling, SLIP, jnp.asarray(3e-3 / omega))
        return along_sine(effect, size, omega, cycles=2)

    x, states = moved(omega)
    area = np.trapezoid(slip_torque(states)[-2001:], x[-2001:])
    assert area == pytest.approx(sum(4 * k * d * (size - d) for k, d in SPRINGS), rel=1e-3)
    np.testing.assert_allclose(states, moved(1.0)[1], atol=1e-9 * 6e-4)


def deflections(law, rates: list[float], z: float, limit: float, settling: float, h: float) -> np.ndarray:
    """Deflections after each step of classical Runge-Kutta at these rates."""
    # One program for all lengths; padding after the last rate does not change the results before it.
    padded = np.pad(np.array(rates), (0, MOST_STEPS - len(rates)))
    return np.asarray(padded_deflections(law, jnp.asarray(padded), *map(jnp.asarray, (z, limit, settling, h))))[
        : len(rates)
    ]


@eqx.filter_jit
def padded_deflections(
    law, rates: jax.Array, z: jax.Array, limit: jax.Array, settling: jax.Array, h: jax.Array
) -> jax.Array:
    def step(z, v):
        k1 = law(v, z, limit, settling)
        k2 = law(v, z + h / 2 * k1, limit, settling)
        k3 = law(v, z + h / 2 * k2, limit, settling)
        z = z + h / 6 * (k1 + 2 * k2 + 2 * k3 + law(v, z + h * k3, limit, settling))
        return z, z

    return jax.lax.scan(step, z, rates)[1]


@settings(max_examples=40)
@given(
    rates=st.lists(st.floats(-1e4, 1e4), min_size=2, max_size=60),
    limit=st.floats(1e-7, 1e-1),
    steps=st.floats(0.05, 2.5),
)
def test_slipping_spring_stays_bounded_for_any_rate(rates, limit, steps):
    """It exceeds its limit by no more than the path of a step or of a settling time.

    It is within the limit again once the motion has stopped.
    """
    settling = 1e-3
    h, fastest = steps * settling, max(map(abs, rates))
    z = np.abs(deflections(slip_rate, [*rates, *[0.0] * (5 + int(30 / steps))], 0.0, limit, settling, h))
    assert np.all(z <= limit + 3.0 * fastest * max(h, settling))
    assert z[-1] <= limit + 1e-3 * fastest * settling


def test_dahl_loading_and_unloading_agree_with_the_closed_form():
    """z = d (1 - exp(-x/d)) from rest; on the way back z = -d + (d + z_0) exp(-|dx|/d)."""
    d, size = 4e-4, 1e-3
    effect = Dahl(k=1000.0, yield_twist=d, settling=NO_LIMIT)
    x, states = along_sine(effect, size, 3.0, cycles=1, samples=4000)
    up, back = states[:1001, 0], states[1000:3001, 0]
    np.testing.assert_allclose(up, d * (1 - np.exp(-x[:1001] / d)), atol=1e-9 * d)
    np.testing.assert_allclose(back, -d + (d + up[-1]) * np.exp(-(size - x[1000:3001]) / d), atol=1e-9 * d)
    assert float(effect.derived(DRIVE)["T_c"][0]) == pytest.approx(0.4)


@settings(max_examples=40)
@given(
    rates=st.lists(st.floats(-1e4, 1e4), min_size=2, max_size=60),
    limit=st.floats(1e-7, 1e-1),
    start=st.floats(-1.0, 1.0),
    steps=st.floats(0.05, 1.0),
)
def test_bristle_stays_within_its_limit_for_steps_below_the_settling_time(rates, limit, start, steps):
    """For any limit and any rate."""
    settling = 1e-3
    z = deflections(bristle_rate, rates, limit * start, limit, settling, steps * settling)
    assert np.all(np.abs(z) <= limit * (1 + 1e-2))


@pytest.mark.parametrize("v", (-3.0, 0.02, 7.0))
def test_bristle_law_is_dahls_where_the_settling_time_is_short(v):
    """Where settling is short against the time to yield, the law is Dahl's own."""
    z, d = jnp.asarray(0.3), jnp.asarray(1.0)
    found = bristle_rate(jnp.asarray(v), z, d, jnp.asarray(1e-5))
    assert float(found) == pytest.approx(v - abs(v) * 0.3, rel=1e-8)


@pytest.mark.parametrize("form", (LuGreMotorFriction, LuGreLoadFriction))
@pytest.mark.parametrize("omega", (-30.0, -2.0, 0.5, 5.0, 80.0))
def test_lugre_friction_at_constant_speed_is_the_stribeck_curve(form, omega):
    """Friction of EFFECTS.md, `(T_c + (T_s - T_c) exp(-(w/w_s)^2)) sgn w + b w`, once the bristles have bent."""
    effect = form(T_c=0.2, b=0.01, excess=0.5, omega_s=4.0, bend=1e-3, tau=0.02, settling=1e-4)
    rate = np.full((400, 3), omega)
    step = 0.3 * np.hypot(1e-3 / omega, 1e-4)  # of the time within which it bends
    (bent,) = np.asarray(states_along(effect, jnp.zeros(401), jnp.asarray(rate), jnp.asarray(step)))[-1]
    turning = jnp.asarray(omega)
    motion = Motion(x=jnp.zeros(()), v=jnp.zeros(()), omega_m=turning, omega_l=turning)
    torque = float(effect.torque(motion, DRIVE, jnp.asarray([bent])))
    level = 0.2 + 0.1 * np.exp(-((omega / 4.0) ** 2))
    assert torque == pytest.approx(-level * np.sign(omega) - 0.01 * omega, rel=1e-6)
    derived = {name: float(v) for name, (v, _) in effect.derived(DRIVE).items()}
    assert derived == pytest.approx({"sigma_0": 200.0, "sigma_1": 4.0, "T_s": 0.3})
    # The initial state of a turning shaft is its steady state.
    assert float(effect.initial_state(motion)[0]) == pytest.approx(bent, rel=1e-6)


@pytest.mark.parametrize("v", (-0.3, 0.02))
def test_lugre_friction_of_the_mesh_at_constant_rate_is_a_stribeck_curve(v: float):
    """A torque with the twist's rate, as that of the spring with the twist; viscous friction of the mesh is B_sp."""
    assert LuGreMeshFriction.drawn_against == "v"
    effect = LuGreMeshFriction(T_c=0.2, excess=0.5, omega_s=0.05, bend=1e-5, tau=0.002, settling=1e-5)
    rate = np.full((400, 3), v)
    step = 0.3 * np.hypot(1e-5 / v, 1e-5)
    (bent,) = np.asarray(states_along(effect, jnp.zeros(401), jnp.asarray(rate), jnp.asarray(step)))[-1]
    motion = Motion(x=jnp.zeros(()), v=jnp.asarray(v))
    torque = float(effect.torque(motion, DRIVE, jnp.asarray([bent])))
    assert torque == pytest.approx((0.2 + 0.1 * np.exp(-((v / 0.05) ** 2))) * np.sign(v), rel=1e-6)
    assert float(effect.initial_state(motion)[0]) == pytest.approx(bent, rel=1e-6)


def test_sticking_lugre_friction_is_a_spring_and_a_damper():
    """`sigma_0 z + sigma_1 omega`, for motions far below the deflection at which bristles slip."""
    effect = LuGreMotorFriction(T_c=0.2, excess=0.5, omega_s=4.0, bend=0.1, tau=0.02, settling=NO_LIMIT)
    for z, omega_m in ((1e-6, 1e-4), (-2e-6, 3e-5), (0.0, -1e-4)):
        motion = Motion(x=jnp.zeros(()), v=jnp.zeros(()), omega_m=jnp.asarray(omega_m))
        torque = float(effect.torque(motion, DRIVE, jnp.asarray([z])))
        assert torque == pytest.approx(-2.0 * z - 0.04 * omega_m, rel=1e-4)


@pytest.mark.parametrize(
    "effect",
    (
        DahlMotorFriction(T_c=0.2, bend=5e-4, settling=NO_LIMIT),
        LuGreMotorFriction(T_c=0.2, excess=1.0, omega_s=1e-2, bend=5e-4, settling=NO_LIMIT),
        LuGreMotorFriction(T_c=0.2, excess=1.0, omega_s=1e-2, bend=5e-4, tau=1e-3, settling=NO_LIMIT),
    ),
    ids=("dahl", "lugre", "lugre_damped"),
)
def test_motor_bristle_friction_returns_no_more_work_than_it_stored(effect):
    angle, states = along_sine(effect, 1e-3, 30.0, cycles=2)
    rate = 1e-3 * 30.0 * np.cos(2 * np.pi * np.linspace(0.0, 2.0, angle.size))

    def torque(omega_m, state):
        return effect.torque(Motion(x=jnp.zeros(()), v=jnp.zeros(()), omega_m=omega_m), DRIVE, state)

    friction = -np.asarray(jax.vmap(torque)(jnp.asarray(rate), jnp.asarray(states)))  # N m, against the motor
    work = np.concatenate([[0.0], np.cumsum(0.5 * (friction[1:] + friction[:-1]) * np.diff(angle))])
    stored = 0.5 * 0.2 * states[:, 0] ** 2 / 5e-4
    lost = work - stored
    # The trapezoid errs by some 1e-6 of the work.
    assert np.all(np.diff(lost) > -1e-6 * work[-1])
    assert lost[-1] > 0.9 * work[-1]


def lugre_torque(effect: LuGreMotorFriction) -> tuple[np.ndarray, np.ndarray]:
    """Torque and motor rate along a motion with slow and quick reversals."""
    step = 2e-4
    t = step * np.arange(4001)
    rate = lambda t: 30.0 * np.cos(60.0 * t) * np.cos(7.0 * t) + 4.0 * np.sin(200.0 * t)  # noqa: E731
    rates = jnp.asarray(rate(np.stack([t[:-1], t[:-1] + step / 2, t[1:]], axis=1)))
    states = states_along(effect, rates[:, 0], rates, jnp.asarray(step))[1:]
    end = rates[:, 2]
    torque = jax.vmap(lambda s, r: effect.torque(Motion(x=r, v=r, omega_m=r), DRIVE, s))(states, end)
    return np.asarray(torque), np.asarray(end)


@pytest.mark.parametrize("damping", [0.1, 1.0, 10.0, 100.0, 1000.0])
def test_proposals_resemble_bristles_of_any_damping(damping: float):
    """Beside viscous friction a proposal explains most of the torque, whether bristles resist by bend or by damping."""
    scales = Scales(
        x=1e-3, x_max=2e-3, v=0.2, omega_m=20.0, omega_l=0.4, time_step=1e-3, reduction_ratio=50.0, omega_0=200.0
    )
    true = LuGreMotorFriction(T_c=1.0, bend=0.01, omega_s=2.0, tau=damping / 200.0, settling=2.5e-4)
    torque, rate = lugre_torque(true)
    shares = []
    for proposal in LuGreMotorFriction.proposals(scales):
        columns = np.stack([lugre_torque(replace(proposal, T_c=1.0))[0], rate], axis=1)
        left = torque - columns @ np.linalg.lstsq(columns, torque, rcond=None)[0]
        shares.append(1.0 - left.var() / torque.var())
    assert max(shares) > 0.9
