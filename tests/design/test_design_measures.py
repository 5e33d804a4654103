"""Measures of a design against closed forms and scipy, and their gradients against differences."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from hdjax import Drive, TwoInertiaModel, hdc_40_050
from hdjax.design import Case, Excitation
from hdjax.design.closed_measures import Bistability, MotorSpeed, MotorTorque, ResonanceDistance, StaticTwist
from hdjax.design.identification import IdentificationTime, LargestTwist
from hdjax.design.measure import Measure
from hdjax.design.measures import MEASURES
from hdjax.design.settling import SettlingTime
from hdjax.effects.friction import CoulombFriction
from hdjax.effects.kinematic import KinematicError

DRIVE = dataclasses.replace(hdc_40_050(), B_sp=1.0)


def case(alpha: float = 0.0, **torques: float) -> Case:
    return Case(TwoInertiaModel(dataclasses.replace(DRIVE, alpha=alpha)), Excitation(**torques))


def value_and_slopes(measure: Measure, at: Case, paths: tuple[str, ...]) -> tuple[float, np.ndarray, np.ndarray]:
    """Value, slopes by the logarithm of parameters, and the same by central differences."""

    @jax.jit
    def both(logs):
        def value(logs):
            found = measure(at.replace({p: at.parameters()[p][0] * jnp.exp(logs[i]) for i, p in enumerate(paths)}))
            return found, found

        slopes, found = jax.jacfwd(value, has_aux=True)(logs)
        return found, slopes

    zero = jnp.zeros(len(paths))
    found, slopes = both(zero)
    steps = 1e-5 * np.eye(len(paths))
    differences = [(float(both(zero + s)[0]) - float(both(zero - s)[0])) / 2e-5 for s in steps]
    return float(found), np.asarray(slopes), np.array(differences)


def test_case_replaces_parameters_by_dotted_path():
    changed = case(amplitude=1.0).replace({"K": 8000.0, "forcing.omega": 3.0})
    assert float(changed.drive.K) == 8000.0 and float(changed.excitation.omega) == 3.0
    assert float(changed.excitation.amplitude) == 1.0
    with pytest.raises(ValueError, match="`stiffness` is no parameter"):
        case().replace({"stiffness": 1.0})


def test_every_measure_has_name_unit_and_description():
    for name, kind in MEASURES.items():
        assert kind.name == name and kind.unit and kind.says and kind.__doc__


@pytest.mark.parametrize("alpha", [0.0, 1e5, -1e4])
def test_static_twist_is_the_root_of_the_cubic(alpha: float):
    found, slopes, differences = value_and_slopes(StaticTwist(20.0), case(alpha), ("K",))
    roots = np.roots([7160.0 * alpha, 0.0, 7160.0, -20.0]) if alpha else np.array([20.0 / 7160.0])
    real = roots[np.abs(roots.imag) < 1e-9].real
    assert found == pytest.approx(real[np.argmin(np.abs(real))], rel=1e-9)
    np.testing.assert_allclose(slopes, differences, rtol=1e-6)


def test_static_twist_is_nan_above_the_largest_torque_of_a_softening_drive():
    # The torque is largest, 2/3 K/sqrt(3 |alpha|), at x = 1/sqrt(3 |alpha|).
    most = 2.0 / 3.0 * 7160.0 / np.sqrt(3e5)
    assert np.isfinite(float(StaticTwist(0.99 * most)(case(-1e5))))
    assert np.isnan(float(StaticTwist(1.01 * most)(case(-1e5))))


def test_motor_torque_is_least_at_the_inertia_matching_ratio():
    a, T = 30.0, 4.0
    best = np.sqrt((DRIVE.J_l * a + T) / (DRIVE.J_m * a))
    measure = MotorTorque(a, T)
    _, slopes, _ = value_and_slopes(measure, case().replace({"N": best}), ("N",))
    assert abs(slopes[0]) < 1e-12
    assert float(measure(case().replace({"N": best}))) == pytest.approx(
        2.0 * np.sqrt(DRIVE.J_m * a * (DRIVE.J_l * a + T))
    )
    assert float(MotorSpeed(2.0)(case())) == pytest.approx(100.0)


def test_resonance_distance_is_the_log_ratio_of_frequencies():
    w = float(DRIVE.omega_0)
    below = ResonanceDistance(w / 8, w / 4, 2.0)
    found, slopes, _ = value_and_slopes(below, case(), ("K",))
    assert found == pytest.approx(np.log(2.0)) and slopes[0] == pytest.approx(0.5)
    assert float(ResonanceDistance(w / 8, w, 2.0)(case())) == pytest.approx(np.log(0.5))
    held = np.sqrt(7160.0 / 5e-2)
    assert float(ResonanceDistance(held / 4, held / 2, held=True)(case())) == pytest.approx(np.log(2.0))
    assert float(ResonanceDistance(w / 400, w / 200, 2.0, at_load=True)(case())) == pytest.approx(np.log(2.0))


def test_bistability_begins_at_the_forcing_with_three_first_order_amplitudes():
    """Of `(mu^2/4 + (sigma - k a^2)^2) a^2 = A^2/(4 omega_0^2)` as a cubic in a^2: at the least forcing for which the
    cubic has three real roots at some sigma."""
    at = case(1e5, amplitude=0.2)
    ratio = float(Bistability()(at))
    mu, w = float(DRIVE.mu), float(DRIVE.omega_0)
    k, A = 3.0 / 8.0 * w * 1e5, 0.2 / (50.0 * 5.26e-4)

    def three_roots(A: float) -> bool:
        sigmas = mu * np.linspace(0.5, 1.5, 4001)
        return any(
            np.sum(np.abs(r.imag) < 1e-12 * np.abs(r.real)) == 3
            for r in (np.roots([k**2, -2 * k * s, mu**2 / 4 + s**2, -(A**2) / (4 * w**2)]) for s in sigmas)
        )

    assert not three_roots(A / ratio * 0.99) and three_roots(A / ratio * 1.02)


def test_bistability_of_a_linear_drive_is_zero_with_slopes():
    found, slopes, _ = value_and_slopes(Bistability(), case(amplitude=0.2), ("K", "B_sp"))
    assert found == 0.0
    np.testing.assert_array_equal(slopes, 0.0)


def test_settling_time_of_a_linear_drive_follows_its_damping():
    """The swing's energy falls by mu on average: `2 log(twist/band)/mu`."""
    twist, band = 5.0 / 7160.0, 1e-5
    found, slopes, differences = value_and_slopes(SettlingTime(5.0, band), case(), ("B_sp", "K"))
    mu = float(DRIVE.mu)
    # Softened, so that the ripple within a swing (mu/omega_0 = 0.05 of the energy) averages out.
    assert found == pytest.approx(2.0 * np.log(twist / band) / mu, rel=2e-3)
    np.testing.assert_allclose(slopes, differences, rtol=1e-5)
    assert slopes[0] == pytest.approx(-found, rel=2e-3)


def test_settling_time_beyond_the_simulation_is_extrapolated():
    soon, late = (eqx.filter_jit(SettlingTime(5.0, 1e-5, turns=turns)) for turns in (60, 12))
    assert float(late(case())) == pytest.approx(float(soon(case())), rel=0.01)


def test_settling_time_is_that_of_the_mesh_beside_a_kinematic_error():
    """The drive comes to rest at an angle at which the encoders show the error."""
    found = SettlingTime(5.0, 5e-5)
    wavy = dataclasses.replace(case(), model=case().model.with_effects(KinematicError(cos_2=1.5e-4)))
    assert float(found(wavy)) == pytest.approx(float(found(case())), rel=0.02)


def test_settling_time_with_friction_agrees_with_scipy_and_is_shorter():
    """`x'' + mu x' + omega_0^2 x = -c T_c sign(x')` from scipy: the last time at which the energy exceeds the band."""
    rough = dataclasses.replace(case(), model=case().model.with_effects(CoulombFriction(T_c=0.1, v_0=4e-3)))
    found = float(SettlingTime(5.0, 1e-4)(rough))
    c, w, mu = (float(getattr(DRIVE, n)) for n in ("c", "omega_0", "mu"))

    def rates(t, y):
        return [y[1], -mu * y[1] - w**2 * y[0] - c * 0.1 * np.tanh(y[1] / 4e-3)]

    time = np.linspace(0.0, 0.4, 40_001)
    x, v = solve_ivp(rates, (0.0, 0.4), [5.0 / 7160.0, 0.0], method="LSODA", t_eval=time, rtol=1e-9, atol=1e-13).y
    above = np.log((0.5 * 7160.0 * x**2 + 0.5 * v**2 / c) / (0.5 * 7160.0 * 1e-8))
    crossing = time[np.flatnonzero(above > 0.0)[-1]]
    # Friction makes the energy fall at a growing rate: the softened crossing is within a quarter of a period.
    assert found == pytest.approx(crossing, abs=0.25 * 2 * np.pi / w)
    assert found < 0.9 * float(SettlingTime(5.0, 1e-4)(case()))


PLAN = IdentificationTime(rate=2000.0, duration=0.3, noise=2e-6, relative_error=0.02)


def test_identification_time_is_where_scipys_covariance_reaches_the_error():
    """Sensitivities by differences of scipy's motion under the held torque, and the covariance of the least squares."""
    at = case(1e5, amplitude=0.4, omega=420.0)
    found, slopes, differences = value_and_slopes(PLAN, at, ("forcing.amplitude", "forcing.omega"))
    # The crossing has one continuous derivative between samples, so that jumps of the second limit differences.
    np.testing.assert_allclose(slopes, differences, rtol=1e-4)
    time = np.arange(601) / 2000.0
    torque = 0.4 * np.cos(420.0 * time)

    def motion(p: np.ndarray) -> np.ndarray:
        drive = dataclasses.replace(DRIVE, alpha=1e5 * np.exp(p[0]), K=7160.0 * np.exp(p[1]), B_sp=np.exp(p[2]))
        mu, w2, alpha = float(drive.mu), float(drive.omega_0) ** 2, float(drive.alpha)
        state, rows = [p[3], p[4]], []
        for u in torque[:-1]:
            rows.append(state[0])
            push = u / (50.0 * 5.26e-4)
            step = solve_ivp(
                lambda t, y, push=push: [y[1], push - mu * y[1] - w2 * y[0] * (1 + alpha * y[0] ** 2)],
                (0.0, 5e-4),
                state,
                method="DOP853",
                rtol=1e-10,
                atol=1e-14,
            )
            state = step.y[:, -1]
        return np.array(rows)

    steps = np.diag([1e-3, 1e-4, 1e-3, 1e-7, 1e-5])
    slopes = np.stack([(motion(s) - motion(-s)) / (2 * s.max()) for s in steps], axis=1) / 2e-6

    def relative(samples: int) -> float:
        used = slopes[:samples]
        return float(np.sqrt(np.linalg.inv(used.T @ used)[0, 0]))

    reached = next(n for n in range(20, 600) if relative(n) <= 0.02)
    # The weak prior and third-order differences change this by less than a sample.
    assert found * 2000.0 == pytest.approx(reached, abs=1.5)
    assert 40 < reached < 590


def test_identification_time_beyond_the_log_is_extrapolated():
    at = case(1e5, amplitude=0.4, omega=420.0)
    short, long = (IdentificationTime(2000.0, duration, 2e-6, 0.0012) for duration in (0.5, 1.0))
    needed = float(eqx.filter_jit(long)(at))
    assert 0.5 < needed < 1.0
    # The motion still beats, so that information does not accumulate evenly.
    assert float(eqx.filter_jit(short)(at)) == pytest.approx(needed, rel=0.2)


def test_largest_twist_from_rest_is_one_to_two_steady_amplitudes():
    at = case(0.0, amplitude=0.4, omega=300.0)
    A, w, mu = 0.4 / (50.0 * 5.26e-4), float(DRIVE.omega_0), float(DRIVE.mu)
    steady = A / np.hypot(w**2 - 300.0**2, 300.0 * mu)
    found = float(LargestTwist(rate=20_000.0, duration=0.5)(at))
    # From rest the free motion adds at most as much again.
    assert steady < found < 2.0 * steady


@pytest.mark.parametrize(
    ("measure", "at", "message"),
    [
        (MEASURES["peak_error"](slow=100.0, fast=50.0), case(amplitude=1.0), "0 < slow < fast"),
        (MEASURES["peak_error"](slow=50.0, fast=100.0), case(), "needs a torque"),
        (MEASURES["loss"](slow=50.0, fast=100.0, rotating=True), case(), "needs a kinematic error"),
        (MEASURES["fold_distance"](slow=50.0, fast=100.0, reach=1.0), case(amplitude=1.0), "a reach above 1"),
        (ResonanceDistance(50.0, 100.0, order=0.0), case(), "an order above zero"),
        (Bistability(), case().replace({"B_sp": 0.0}), "`bistability` needs damping"),
        (SettlingTime(0.0, 1e-5), case(), "must have a torque"),
        (LargestTwist(100.0, 1.0), case(amplitude=1.0), "raise rate"),
        (IdentificationTime(2000.0, 1.0, 0.0), case(amplitude=1.0), "positive noise"),
        (IdentificationTime(2000.0, 1.0, 1e-6), case(0.0, amplitude=1.0), "alpha is zero"),
    ],
)
def test_measure_refuses_unusable_settings(measure: Measure, at: Case, message: str):
    with pytest.raises(ValueError, match=message):
        measure.refuse(at)


def test_gear_interpolates_the_vendor_table():
    from hdjax.design.vendor import SIZES, gear

    assert [float(gear(s).K) for s in SIZES] == pytest.approx([3400, 8100, 1.3e4, 2.5e4, 5.4e4, 1e5, 2e5, 4.4e5])
    for size in SIZES:
        found = gear(size)
        # The cubic meets the table's torque at the twist where its second slope ends.
        drive = Drive(N=50.0, J_m=1e-3, J_l=1.0, K=found.K, alpha=found.alpha)
        twist = brentq(
            lambda x, d=drive, f=found: float(d.mesh_torque(jnp.asarray(x), jnp.zeros(())) - f.rated), 0, 0.1
        )
        assert 1e-4 < twist < 4e-3
        assert 0.9e5 < float(found.alpha) < 5e5
    assert float(gear(28.0).K) == pytest.approx(2.5e4 * (5.4 / 2.5) ** (np.log(28 / 25) / np.log(32 / 25)))
