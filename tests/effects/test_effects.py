"""Laws that every effect of the catalogue obeys: zero strength, derivatives and energy."""

import functools

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

import hdjax.effects
from fitting.estimation.engines import linearise, with_engine
from fitting.estimation.experiment import Experiment, Stretch
from fitting.estimation.free_parameters import FreeParameters
from fitting.estimation.residual import Problem, Unknowns
from fitting.estimation.segments import cut
from hdjax import Drive, Harmonic, ReducedDrive, ReducedModel, TwoInertiaModel, sampled, simulate
from hdjax.effects import CATALOGUE, Motion, Scales
from hdjax.effects.actuation import InputDelay
from hdjax.effects.backlash import Backlash
from hdjax.effects.creep import Creep
from hdjax.effects.friction import CoulombFriction, MotorFriction, StribeckMotorFriction
from hdjax.effects.hysteresis import BoucWen, SharpBoucWen
from hdjax.effects.kinematic import KinematicError
from hdjax.effects.load import GravityLoad
from hdjax.effects.position import ConservativePositionDependentStiffness
from hdjax.effects.resonance import ExtraResonance, ResonanceBesideLoad
from hdjax.effects.stiffness import ThreeSlopeStiffness
from hdjax.parameters import own_parameters
from hdjax.simulate import march

# A drive like the preset with a cubic term of one per cent; its initial transient decays within the record.
DRIVE = Drive(N=50.0, J_m=5.26e-4, J_l=5.0e-2, K=7160.0, alpha=2e4, B_sp=2.0)
STEP = 1e-3
TIME = STEP * np.arange(200)
# The slow part turns the motor by half a revolution and back; the fast ones shake the mesh near omega_0 = 386 rad/s.
TORQUE = sampled(
    TIME,
    1.5 * np.cos(50 * TIME) + 0.8 * np.sin(330 * TIME) + 0.5 * np.sin(410 * TIME + 1.0),
    hold="linear",
)
# It rises by ten kelvin over the record; the base drive does not depend on it.
TEMPERATURE = sampled(TIME, 300.0 + 50.0 * TIME, hold="linear")
START = jnp.asarray([0.3, 0.007, 5.0, 0.2])


def outputs_and_slopes(model, torque, start, substeps=1, settled=None):
    """Outputs of a simulation and their derivatives by each parameter of the last effect, by dotted path.

    The drive's states start at `start`. States of effects start where those of the model `settled` are, by default of
    the model itself. It runs by machine code, which agrees with XLA for every form (`test_engine_march.py`) and
    compiles sooner.
    """
    count = torque.knots.size - 1
    warmth = eqx.tree_at(lambda s: s.coefficients, torque, jnp.zeros((count, 1)) + 300.0)
    if torque.knots.size == TEMPERATURE.knots.size:
        warmth = TEMPERATURE
    knots = np.asarray(torque.knots)
    log = Experiment("rig", knots[:-1], torque, None, np.zeros((count, 2)), None, temperature=warmth)
    paths = tuple(f"{e.name}.{name}" for e in model.effects[-1:] for name, _ in own_parameters(e))
    nothing = jnp.zeros(len(paths))
    free = FreeParameters(paths, (False,) * len(paths), jnp.ones(len(paths)), nothing, nothing)
    states = (model if settled is None else settled).settled(start)[None]
    weights = jnp.eye(2), jnp.ones(len(paths)), jnp.ones(states.shape[1])
    problem = Problem(model, free, cut([Stretch(log, 0, count)], count), *weights, substeps=substeps)
    found = linearise(with_engine(problem), Unknowns(free.pack(model), states))
    rows = slice(2 * count)
    slopes = -np.asarray(found.by_parameter)[0, rows].reshape(count, 2, len(paths))
    return -np.asarray(found.residual)[0, rows].reshape(count, 2), dict(
        zip(paths, np.moveaxis(slopes, 2, 0), strict=True)
    )


def outputs(model, torque, start, substeps=1, settled=None):
    """Outputs of a simulation, as in [`outputs_and_slopes`][]."""
    return outputs_and_slopes(model, torque, start, substeps, settled)[0]


def slopes(model, torque, start):
    """Derivative of the outputs with respect to each parameter of the last effect, by dotted path."""
    return outputs_and_slopes(model, torque, start)[1]


BASE = TwoInertiaModel(DRIVE)


@functools.cache
def base_outputs():
    return np.asarray(outputs(BASE, TORQUE, START))


def rms(x) -> float:
    return float(np.sqrt(np.mean(np.square(x))))


@functools.cache
def scales() -> Scales:
    """Scales of the base model's motion."""
    theta, x = base_outputs().T
    rate = functools.partial(np.gradient, axis=0)
    v, omega = rate(x) / STEP, rate(theta) / STEP
    return Scales(
        x=rms(x),
        x_max=float(np.abs(x).max()),
        v=rms(v),
        omega_m=50 * rms(omega),
        omega_l=rms(omega - v),
        time_step=STEP,
        duration=float(TIME[-1]),
        reduction_ratio=50.0,
        omega_0=386.0,
        temperature=303.0,
        temperature_change=3.0,
        residual_frequencies=(120.0, 260.0),
    )


@functools.cache
def at_strength(form, share: float):
    """The base model with the effect, each of whose strengths alone changes the twist by this share to first order.

    All strengths are positive.
    """
    effect = form.proposals(scales())[0]
    model = BASE.with_effects(effect)
    values = {}
    found = slopes(model, TORQUE, START)
    for name, info in own_parameters(effect):
        if info.role == "strength":
            path = f"{form.name}.{name}"
            slope = np.asarray(found[path])[:, 1]
            assert rms(slope) > 0, f"{path} does nothing at zero strength"
            values[path] = share * rms(base_outputs()[:, 1]) / rms(slope)
    return model.replace(values)


every_form = pytest.mark.parametrize("form", CATALOGUE, ids=lambda form: form.name)


DELAYED = ("input_delay", "input_lag", "motor_encoder_delay")


@every_form
def test_effect_of_zero_strength_is_the_base_model(form):
    for effect in form.proposals(scales()):
        found = np.asarray(outputs(BASE.with_effects(effect), TORQUE, START))
        # Rounding over 200 steps; a delayed torque is late by 1e-9 of a step, which changes the twist by as much.
        error = np.abs(found - base_outputs()).max(axis=0) / np.abs(base_outputs()).max(axis=0)
        assert error.max() < (1e-8 if form.name in DELAYED else 1e-12)


@every_form
def test_effect_changes_the_motion_as_its_derivative_predicts(form):
    """By about a tenth for each strength, according to the derivative at zero."""
    model = at_strength(form, 0.1)
    change = rms(np.asarray(outputs(model, TORQUE, START))[:, 1] - base_outputs()[:, 1]) / rms(base_outputs()[:, 1])
    count = sum(info.role == "strength" for _, info in own_parameters(model.effects[0]))
    assert 0.03 < change < 0.3 * count


@every_form
def test_gradients_by_strength_and_shape_agree_with_differences(form):
    model = at_strength(form, 0.03)
    gradients = slopes(model, TORQUE, START)
    for name, info in own_parameters(model.effects[0]):
        # Bouc-Wen's n is a constant of the form: neither strength nor shape.
        if info.role == "base":
            continue
        path = f"{form.name}.{name}"
        value = float(model.get(path))
        h = 1e-6 * value
        near = (model.replace({path: value + sign * h}) for sign in (1, -1))
        after, before = (outputs(changed, TORQUE, START, settled=model) for changed in near)
        differences = (after - before) / (2 * h) * value
        found = np.asarray(gradients[path]) * value
        # Differences err by rounding, 1e-14 / 1e-6 of the angles, and where a kink lies between the two motions.
        np.testing.assert_allclose(found, differences, atol=1e-8 + 1e-4 * np.abs(found).max())
        assert np.abs(found[:, 1]).max() > 1e-4 * np.abs(base_outputs()[:, 1]).max()


# -- energy --

# Fine enough that Tsit5 errs by 1e-9 where forces are smooth; a step across the edge of a backlash's zone errs by up to
# (omega_0 h)^2 / 2 = 3e-5 of the energy. Five periods of omega_0.
FREE_STEP = 2e-5
FREE_TIME = FREE_STEP * np.arange(4000)
NO_TORQUE = sampled(FREE_TIME, np.zeros(FREE_TIME.size), hold="zero-order")
SPRUNG = jnp.asarray([0.2, 0.7, 3.0, 0.1]).at[0].add(50 * 0.7)  # twisted by 4 mrad off its equilibrium


@eqx.filter_jit
def released(model):
    """States of a drive released from a twist, without torque."""
    state = model.rest().at[:4].set(SPRUNG)
    return march(model, NO_TORQUE, None, state, solver=dfx.Tsit5(), substeps=1)[0]


def spring(x, alpha):
    return x**2 / 2 + alpha * x**4 / 4


def energy(model: TwoInertiaModel, states) -> np.ndarray:
    """Kinetic energy and every potential, by the equations of EFFECTS.md."""
    theta_m, theta_l, omega_m, omega_l, *own = np.asarray(states).T
    value = {path.split(".")[-1]: float(v) for path, (v, _) in model.parameters().items()}
    names = {effect.name for effect in model.effects}
    K, alpha = value["K"], value["alpha"]
    x = theta_m / value["N"] - theta_l
    total = 0.5 * value["J_m"] * omega_m**2 + 0.5 * value["J_l"] * omega_l**2
    if "kinematic_error" in names:
        for n in (1, 2, 4):
            x = x + value[f"cos_{n}"] * np.cos(n * theta_m) + value[f"sin_{n}"] * np.sin(n * theta_m)
    if "kinematic_harmonic" in names:
        x = x + value["cosine"] * np.cos(value["n"] * theta_m) + value["sine"] * np.sin(value["n"] * theta_m)
    if names & {"backlash", "undamped_backlash"}:
        return total + K * spring(np.sign(x) * np.maximum(np.abs(x) - value["b"], 0.0), alpha)
    total = total + K * spring(x, alpha)
    if "quadratic_stiffness" in names:
        total = total + K * value["k2"] * x**3 / 3
    if "quintic_stiffness" in names:
        total = total + K * value["k5"] * x**6 / 6
    if "three_slope_stiffness" in names:
        for stiffening, knee in ((value["stiffening_2"], 0.0), (value["stiffening_3"], value["gap"])):
            total = total + K * stiffening * np.maximum(np.abs(x) - value["x1"] - knee, 0.0) ** 2 / 2
    if "gravity_load" in names:
        total = total - value["sine"] * np.cos(theta_l) + value["cosine"] * np.sin(theta_l)
    if "smooth_knee_stiffness" in names:
        knee, width = value["knee"], value["width"]

        def area(u):
            root = np.sqrt(u**2 + width**2)
            return (u**2 + u * root + width**2 * np.log(u + root)) / 4

        total = total + K * value["stiffening"] * (area(x - knee) + area(-x - knee))
    if "constant_load" in names:
        total = total - value["constant"] * theta_l
    if "cogging" in names:
        for n in (1, 2, 4):
            total = total - (value[f"cos_{n}"] * np.sin(n * theta_m) - value[f"sin_{n}"] * np.cos(n * theta_m)) / n
    if "single_order_cogging" in names:
        n = value["n"]
        total = total - (value["cosine"] * np.sin(n * theta_m) - value["sine"] * np.cos(n * theta_m)) / n
    if "kinematic_sidebands" in names:
        for side, n in (("below", 2 - 1 / 50), ("above", 2 + 1 / 50)):
            a, b = value[f"cos_{side}"], value[f"sin_{side}"]
            shifted = a * np.cos(n * theta_m) + b * np.sin(n * theta_m)
            total = total + K * (spring(x + shifted, alpha) - spring(x, alpha))
            x = x + shifted
    if "conservative_position_dependent_stiffness" in names:
        n = value["n"]
        ripple = value["cosine"] * np.cos(n * theta_m) + value["sine"] * np.sin(n * theta_m)
        total = total + K * spring(x, alpha) * ripple
    if names & {"bouc_wen", "sharp_bouc_wen"}:
        total = total + value["k"] * own[0] ** 2 / 2
    if "creep" in names:
        total = total + value["k"] * (x - own[0]) ** 2 / 2
    if names & {"extra_resonance", "resonance_beside_load"}:
        J_3 = value["mass_ratio"] * value["J_l"]
        total = total + J_3 * (value["omega_3"] ** 2 * own[0] ** 2 + own[1] ** 2) / 2
    if "extra_resonance" in names:
        total = total - J_3 * omega_l**2 / 2
    return total


CONSERVATIVE = ("stiffness_shape", "backlash", "kinematic_error", "gravity_load", "cogging")
DISSIPATIVE = (
    "coulomb_friction",
    "motor_friction",
    "load_friction",
    "nonlinear_damping",
    "hysteresis",
    "creep",
    "extra_resonance",
)
STORE_IS_KNOWN = (BoucWen, SharpBoucWen, Creep, ExtraResonance, ResonanceBesideLoad)


def forms_of(families):
    return pytest.mark.parametrize("form", [f for f in CATALOGUE if f.family in families], ids=lambda form: form.name)


@functools.cache
def lossless(form, share=0.2):
    model = at_strength(form, share).replace({"B_sp": 0.0})
    return model, np.asarray(released(model))


@pytest.mark.parametrize(
    "form",
    [*(f for f in CATALOGUE if f.family in CONSERVATIVE), ConservativePositionDependentStiffness],
    ids=lambda form: form.name,
)
def test_conservative_effect_keeps_the_energy(form):
    model, states = lossless(form)
    found = energy(model, states)
    exchanged = np.ptp(energy(model.without_effect(form.name), states))
    assert exchanged > 1e-3 * found[0]  # the effect takes part
    kinks = form.family in ("backlash", "stiffness_shape")
    np.testing.assert_allclose(found, found[0], atol=(1e-4 if kinks else 1e-8) * abs(found[0]))


@forms_of(DISSIPATIVE)
def test_dissipative_effect_loses_energy(form):
    model, states = lossless(form)
    found = energy(model, states)
    # A light third inertia or a slow creep takes little in five periods.
    assert found[-1] < (0.999 if form.family in ("creep", "extra_resonance") else 0.97) * found[0]
    # A form with hidden states stores some energy and returns it.
    if not form.states or form in STORE_IS_KNOWN:
        assert np.all(np.diff(found) < 1e-9 * found[0])


# -- what is special to one effect --


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


@jax.jit
def hysteresis_states(effect: BoucWen, x: jax.Array) -> jax.Array:
    """z along a prescribed, piecewise linear twist, by Runge-Kutta steps in the path."""

    def step(z, dx):
        def rate(z):
            return effect.state_rates(Motion(x=dx, v=dx), z)

        k1 = rate(z)
        k2 = rate(z + 0.5 * k1)
        k3 = rate(z + 0.5 * k2)
        k4 = rate(z + k3)
        z = z + (k1 + 2 * k2 + 2 * k3 + k4) / 6
        return z, z[0]

    return jax.lax.scan(step, effect.initial_state(), jnp.diff(x))[1]


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    ratio=st.floats(-0.7, 3.0),
    n=st.floats(1.0, 4.0),
    memory_twist=st.floats(1e-5, 1e-2),
)
def test_bouc_wen_state_never_exceeds_its_yield_twist(seed, ratio, n, memory_twist):
    rng = np.random.default_rng(seed)
    yield_twist = memory_twist * (1 + ratio) ** (-1 / n)
    x = np.interp(np.arange(3000) / 100, np.arange(31), yield_twist * 4 * rng.normal(size=31))
    z = np.asarray(hysteresis_states(BoucWen(k=1.0, memory_twist=memory_twist, ratio=ratio, n=n), jnp.asarray(x)))
    assert np.abs(z).max() <= yield_twist * (1 + 1e-9)
    assert np.abs(z).max() > 0.5 * yield_twist


def test_bouc_wen_with_unit_exponent_agrees_with_the_closed_form():
    """Loading from 0 gives `y (1 - exp(-x/y))`, unloading has the slope `1 + (beta - gamma)|z|`.

    Where gamma < -beta, y is negative and z diverges.
    """
    y = 1e-3
    x = np.linspace(0, 3 * y, 1001)
    effect = BoucWen(k=1.0, memory_twist=y / 0.7, ratio=3 / 7)
    z = np.asarray(hysteresis_states(effect, jnp.asarray(x)))
    np.testing.assert_allclose(z, y * (1 - np.exp(-x[1:] / y)), atol=1e-9 * y)
    hardening = BoucWen(k=1.0, memory_twist=1e-3, ratio=-1.5)
    np.testing.assert_allclose(
        np.asarray(hysteresis_states(hardening, jnp.asarray(x))), 2 * y * (np.exp(x[1:] / (2 * y)) - 1), rtol=1e-9
    )
    unloading = effect.state_rates(Motion(x=jnp.asarray(0.0), v=jnp.asarray(-2.0)), jnp.asarray([0.5 * y]))
    np.testing.assert_allclose(unloading, [-2.0 * (1 + 0.4 * 0.5)], rtol=1e-12)
    derived = {name: float(v) for name, (v, _) in effect.derived(DRIVE).items()}
    assert derived == pytest.approx({"beta": 700.0, "gamma": 300.0})


def loop_area(omega: float) -> float:
    """Area of torque against twist over the third cycle of a harmonic twist."""
    model = BoucWen(k=3000.0, memory_twist=4e-4 / 0.6, ratio=2 / 3)
    t = np.linspace(0, 3 * 2 * np.pi / omega, 3 * 400 + 1)

    @jax.jit
    def settle(times):
        def rate(t, z, args):
            x, v = 1e-3 * jnp.sin(omega * t), 1e-3 * omega * jnp.cos(omega * t)
            return model.state_rates(Motion(x=x, v=v), z)

        return dfx.diffeqsolve(
            dfx.ODETerm(rate), dfx.Tsit5(), times[0], times[-1], times[1], model.initial_state(),
            saveat=dfx.SaveAt(ts=times), stepsize_controller=dfx.PIDController(rtol=1e-8, atol=1e-14),
        ).ys  # fmt: skip

    z = np.asarray(settle(jnp.asarray(t)))[-401:, 0]
    return float(np.trapezoid(3000.0 * z, 1e-3 * np.sin(omega * t[-401:])))


def test_bouc_wen_loop_area_does_not_depend_on_frequency():
    slow, fast = loop_area(1.0), loop_area(30.0)
    assert slow == pytest.approx(fast, rel=1e-5)
    # Less than the parallelogram of an ideal element that slips at the yield, 4 T (x - x_yield), by its round corners.
    assert 0.5 < slow / (4 * 3000 * 4e-4 * (1e-3 - 4e-4)) < 1.0


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


def test_package_exports_every_form():
    assert {form.__name__ for form in CATALOGUE} <= set(hdjax.effects.__all__)
