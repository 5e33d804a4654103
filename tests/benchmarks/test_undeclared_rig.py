"""The simulated rig of the study against scipy, closed forms and the energy balance, and the logs of its cases."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp

pytest.importorskip("numba", reason="the study's rig needs the extra `benchmark`")

from fitting.drive_data import read_rig
from undeclared import drawing
from undeclared.detection import LIMIT, detectability
from undeclared.equations import integrate
from undeclared.hidden import FAMILIES, FORMS, Form, forms_of
from undeclared.mechanism import Mechanism, log_torque, read_encoders, table
from undeclared.noise import Encoders
from undeclared.predictability import own_error
from undeclared.recording import record

DT = 5e-4
BASE = Mechanism(k3=2e7)
START = np.array([0.3, 5.0, 0.3 / 50, -0.2])


def random_torque(count: int, *, rms: float = 0.3, seed: int = 0) -> np.ndarray:
    return rms * np.random.default_rng(seed).normal(size=count)


@pytest.mark.slow
def test_smooth_effects_agree_with_scipy():
    """All effects with a smooth right-hand side at once, with equations written independently here."""
    p = BASE._replace(
        **table({2: (2e-4, 0.7), 1: (1e-4, -0.4)}),
        wobble=0.3,
        wobble_phase=0.2,
        k2=3e5,
        k5=1e12,
        soft=0.1,
        soft_width=4e-4,
        c3=2.0,
        cx=5e4,
        ripple_k=0.05,
        ripple_k_phase=0.5,
        creep_k=np.array([300.0, 0.0]),
        creep_time=np.array([0.05, 1.0]),
        warm_k=-1e-3,
        warm_c=0.02,
        nothing_below=0.05,
        saturates=1.5,
        lag=1e-3,
        gain=0.95,
        bias=0.02,
        drag_m=1e-3,
        drag_l=0.05,
        cog=np.array([0.02, 0.0, 0.0]),
        cog_order=np.array([4.0, 0.0, 0.0]),
        weight=1.5,
        weight_phase=0.3,
        tether=3.0,
        lobes=0.7,
        lobes_phase=0.9,
        swing=0.2,
        swing_phase=0.4,
        sag=0.1,
        sag_speed=5.0,
        drift=0.5,
        hum=0.01,
        hum_rate=300.0,
        hum_phase=0.6,
        push=0.1,
        push_amplitude=np.array([0.5, 0.0]),
        push_rate=np.array([200.0, 0.0]),
        third_inertia=0.01,
        third_stiffness=3000.0,
        third_damping=0.2,
    )
    torque, heat = random_torque(60), 12.0

    def acting(u):
        u = np.sign(u) * max(abs(u) - 0.05, 0.0)
        return 0.95 * u / np.sqrt(1 + (1.5 * u) ** 2) + 0.02

    def inertia(b):
        return 5e-2 * (1 + 0.2 * np.cos(b + 0.4))

    def rates(t, y, u):
        a, w, b, r, c, q, z, s = y
        e = (2e-4 * np.cos(2 * a + 0.7) + 1e-4 * np.cos(a - 0.4)) * (1 + 0.3 * np.cos(b + 0.2))
        e_a = (-4e-4 * np.sin(2 * a + 0.7) - 1e-4 * np.sin(a - 0.4)) * (1 + 0.3 * np.cos(b + 0.2))
        e_b = (2e-4 * np.cos(2 * a + 0.7) + 1e-4 * np.cos(a - 0.4)) * -0.3 * np.sin(b + 0.2)
        x, v = a / 50 + e - b, w * (1 / 50 + e_a) + r * (e_b - 1)
        spring = 7000 * x + 3e5 * x**2 + 2e7 * x**3 + 1e12 * x**5 - 700 * x * np.exp(-((x / 4e-4) ** 2))
        spring = spring * (1 - 1e-3 * heat) - 0.1 * 7000 * x * w**2 / (w**2 + 25)
        tau = spring * (1 + 0.05 * np.cos(2 * a + 0.5)) + 0.3 * np.exp(-0.02 * heat) * v
        tau += 2.0 * v**3 + 5e4 * x**2 * v + 300 * (x - z)
        reaction = 0.1 * np.sin(2 * a + 0.5) * (3500 * x**2 + 0.25 * 2e7 * x**4)
        third = 3000 * (b - c) + 0.2 * (r - q)
        motor = s - (1 / 50 + e_a) * tau + reaction - 1e-3 * w + 0.02 * np.cos(4 * a) + 0.5 * t
        motor += 0.01 * np.sin(300 * t + 0.6)
        held = 3 * b + 1.5 * np.sin(b + 0.3) + 0.7 * np.sin(3 * b + 0.9)
        load = (1 - e_b) * tau + 0.1 + 0.5 * np.sin(200 * t) - 0.05 * r - held - third
        load += 0.5 * 5e-2 * 0.2 * np.sin(b + 0.4) * r**2
        return [w, motor / 5e-4, r, load / inertia(b), q, third / 0.01, (x - z) / 0.05, (acting(u) - s) / 1e-3]

    states, commanded = integrate(p, START, torque, dt=DT, substeps=100, warm=np.full(60, heat))
    assert np.array_equal(commanded, torque)
    y = np.array([*START, START[2], START[3], 0.0, acting(torque[0])])
    for k, u in enumerate(torque):
        assert states[k, [0, 1, 2, 3, 4, 5, 13, 15]] == pytest.approx(y, rel=1e-9, abs=1e-9)
        y = solve_ivp(rates, (k * DT, (k + 1) * DT), y, args=(u,), method="DOP853", rtol=1e-12, atol=1e-14).y[:, -1]


@pytest.mark.slow
def test_bouc_wen_and_bristles_agree_with_scipy():
    """Both have a kink where the rate reverses, which scipy's error control resolves."""
    p = BASE._replace(
        bouc_k=2000.0, bouc_yield=3e-4, bouc_power=1.5, bouc_share=0.7,
        c_lean=0.1, slide_m=0.03, hold_m=0.05, sink_m=2.0, bristle_m=5.0, bristle_drag_m=0.01,
    )  # fmt: skip
    torque = random_torque(40)

    def rates(t, y, u):
        a, w, b, r, z, s = y
        x, v = a / 50 - b, w / 50 - r
        bent = (abs(z) / 3e-4) ** 1.5
        turn = v - bent * (0.7 * abs(v) * np.sign(z) + 0.3 * v)
        slip = w - 5.0 * abs(w) * s / (0.03 + 0.02 * np.exp(-((w / 2.0) ** 2)))
        tau = 7000 * x + 2e7 * x**3 + 0.3 * v + 0.1 * abs(v) + 2000 * z
        return [w, (u - tau / 50 - 5.0 * s - 0.01 * slip) / 5e-4, r, tau / 5e-2, turn, slip]

    states, _ = integrate(p, START, torque, dt=DT, substeps=100)
    y = np.array([*START, 0.0, 0.0])
    for k, u in enumerate(torque):
        # RK4 with 5e-6 s loses its order at a kink, which leaves 1e-7 of the motion.
        assert states[k, [0, 1, 2, 3, 6, 11]] == pytest.approx(y, rel=1e-6, abs=1e-7)
        y = solve_ivp(rates, (0, DT), y, args=(u,), method="DOP853", rtol=1e-11, atol=1e-13, max_step=5e-5).y[:, -1]


def energy(p: Mechanism, states: np.ndarray) -> np.ndarray:
    """Energy [J] of the springs, gravity, the varying load inertia and the third inertia."""
    a, w, b, r, c, q = states[:, :6].T
    x = a / p.ratio + 2e-4 * np.cos(2 * a) * (1 + p.wobble * np.cos(b)) * np.any(p.teeth) - b
    bent = np.maximum(np.abs(x) - p.gap, 0.0)
    if p.slope_2:
        first, second = np.minimum(bent, p.knee_1), np.clip(bent - p.knee_1, 0, p.knee_2 - p.knee_1)
        third = np.maximum(bent - p.knee_2, 0)
        spring = 0.5 * p.k1 * first**2 + second * (p.k1 * p.knee_1) + 0.5 * p.slope_2 * second**2
        force = p.k1 * p.knee_1 + p.slope_2 * (p.knee_2 - p.knee_1)
        spring += third * force + 0.5 * p.slope_3 * third**2
    else:
        spring = 0.5 * p.k1 * bent**2 + 0.25 * p.k3 * bent**4
    spring = spring * (1 + p.ripple_k * np.cos(p.ripple_k_order * a + p.ripple_k_phase))
    load_inertia = p.load_inertia * (1 + p.swing * np.cos(b + p.swing_phase))
    moving = 0.5 * p.motor_inertia * w**2 + 0.5 * load_inertia * r**2 + 0.5 * p.third_inertia * q**2
    held = 0.5 * p.tether * b**2 - p.weight * np.cos(b + p.weight_phase) - p.lobes * np.cos(3 * b + p.lobes_phase) / 3
    return moving + spring + held + 0.5 * p.third_stiffness * (b - c) ** 2


CONSERVATIVE = {
    "teeth": table({2: (2e-4, 0.0)}) | {"wobble": 0.4},
    "ripple": {"ripple_k": 0.1, "ripple_k_phase": 0.3},
    "load": {"weight": 2.0, "weight_phase": 0.4, "tether": 5.0, "lobes": 1.0, "lobes_phase": 0.2},
    "swing": {"swing": 0.2, "swing_phase": 0.4},
    "third": {"third_inertia": 0.01, "third_stiffness": 3000.0},
    "gap": {"gap": 1e-4, "gap_damps": 0.0},
    "slopes": {"k3": 0.0, "slope_2": 9000.0, "slope_3": 12000.0, "knee_1": 4e-4, "knee_2": 9e-4},
}


@pytest.mark.parametrize("name", CONSERVATIVE)
def test_conservative_effects_keep_the_energy(name: str):
    p = BASE._replace(c1=0.0, **CONSERVATIVE[name])
    states, _ = integrate(p, START, np.zeros(400), dt=DT, substeps=100)
    of = energy(p, states)
    assert np.ptp(states[:, 0] / 50 - states[:, 2]) > 5e-4
    # Knees and gaps reduce the order of the integration by two: 2e-7 where the gap is crossed, else 1e-12.
    assert np.ptp(of) < 1e-6 * np.max(np.abs(of))


LOSSES = (
    "hysteresis coulomb_friction motor_friction load_friction nonlinear_damping position_dependent_friction creep"
).split()


@pytest.mark.parametrize("form", [f for f in FORMS if f.family in LOSSES], ids=lambda f: f"{f.family}-{f.name}")
def test_dissipative_effects_lose_energy(form: Form):
    """The final energy is less than without the loss; in between, hysteresis stores energy and returns it."""
    base = BASE._replace(c1=1e-6)
    lossy = base._replace(**form.changes(form.high, np.random.default_rng(0), BASE))
    kept, left = (energy(base, integrate(p, START, np.zeros(600), dt=DT, substeps=100)[0]) for p in (base, lossy))
    assert left[-1] < 0.999 * kept[-1]


@pytest.mark.parametrize("form", FORMS, ids=lambda f: f"{f.family}-{f.name}")
def test_every_form_changes_the_log_except_at_zero_strength(form: Form):
    base = Mechanism()
    torque, warm = random_torque(200), np.full(200, 10.0)

    def log(p: Mechanism, warm: np.ndarray | None = None) -> np.ndarray:
        states, commanded = integrate(p, START, torque, dt=DT, substeps=100, warm=warm)
        return np.column_stack([*read_encoders(p, states), log_torque(p, commanded, DT)])

    def changed(strength: float) -> np.ndarray:
        return log(base._replace(**form.changes(strength, np.random.default_rng(3), base)), warm)

    plain, strong = log(base), changed(form.high)
    assert np.isfinite(strong).all()
    assert np.abs(strong - plain).max() > 1e-7
    if form.low < form.high:
        assert changed(0.0) == pytest.approx(plain, rel=1e-13, abs=1e-13)


def test_dry_friction_sticks_slides_and_stops():
    """A motor without spring, in closed form."""
    p = Mechanism(k1=1e-9, c1=0.0, hold_m=0.05, slide_m=0.04, sink_m=1e-9)
    still, _ = integrate(p, np.zeros(4), np.full(50, 0.0499), dt=DT, substeps=100)
    assert np.all(still[:, :2] == 0.0)
    loose, _ = integrate(p, np.zeros(4), np.full(50, 0.051), dt=DT, substeps=100)
    time = DT * np.arange(50)
    # The first stage of the solver, at rest, has the static friction: an error of a sixth of a step.
    assert loose[:, 1] == pytest.approx((0.051 - 0.04) / 5e-4 * time, abs=2e-5)
    slowing, _ = integrate(p, np.array([0.0, 1.0, 0.0, 0.0]), np.zeros(50), dt=DT, substeps=100)
    assert slowing[:, 1] == pytest.approx(np.maximum(1.0 - 0.04 / 5e-4 * time, 0.0), abs=1e-9)


def test_dead_time_shifts_the_response():
    torque = np.concatenate([np.zeros(20), random_torque(60)])
    late, _ = integrate(BASE._replace(dead_time=3 * DT), np.zeros(4), torque, dt=DT, substeps=50)
    prompt, _ = integrate(BASE, np.zeros(4), torque, dt=DT, substeps=50)
    assert late[3:, :4] == pytest.approx(prompt[:-3, :4], rel=1e-12, abs=1e-15)


def test_filtered_log_is_the_filter_of_a_held_torque_at_the_samples():
    torque, lag, fine = random_torque(60), 0.7 * DT, 200
    held = np.repeat(torque, fine)
    state, filtered = torque[0], []
    for value in held:
        filtered.append(state)
        state += (value - state) * -np.expm1(-DT / fine / lag)
    found = log_torque(BASE._replace(log_lag=lag, log_late=2), torque, DT)
    assert found[2:] == pytest.approx(np.array(filtered[::fine])[:-2], abs=1e-12)


@pytest.mark.parametrize(
    "form",
    [
        forms_of("motor_friction")[0],
        forms_of("load_friction")[0],
        forms_of("coulomb_friction")[0],
        forms_of("backlash")[0],
    ],
    ids=lambda f: f.family,
)
def test_solver_steps_are_fine_enough_for_nonsmooth_effects(form: Form):
    """Halving the step changes the twist by much less than an encoder's noise of 1e-6 rad."""
    p = BASE._replace(**form.changes(0.3 * form.high, np.random.default_rng(0), BASE))
    runs = [
        integrate(p, np.zeros(4), np.repeat(random_torque(50), 12), dt=DT, substeps=n)[0]
        for n in (int(DT / drawing.FINEST), 2 * int(DT / drawing.FINEST))
    ]
    first, second = (states[:, 0] / 50 - states[:, 2] for states in runs)
    assert np.std(first) > 5e-5
    assert np.sqrt(np.mean((first - second) ** 2)) < 1e-7


WHITE = Encoders((1e-5, 1e-6), (0.0, 0.0), 0.0)


def detectability_of(p: Mechanism, encoders: Encoders = WHITE) -> float:
    torque = np.repeat(random_torque(400), 5)
    states, _ = integrate(p, np.zeros(4), torque, dt=DT, substeps=20)
    readings = np.column_stack(read_encoders(p, states))
    return detectability(BASE, [(states, readings, torque, np.zeros(2000))], encoders=encoders, dt=DT)


def test_detectability_measures_the_residual_after_a_refit():
    one = detectability_of(BASE._replace(bias=0.01))
    assert one > 1.0
    assert detectability_of(BASE._replace(bias=0.02)) == pytest.approx(2 * one, rel=0.05)
    twice = replace(WHITE, noise=(2e-5, 2e-6))
    assert detectability_of(BASE._replace(bias=0.01), twice) == pytest.approx(one / 2, rel=1e-3)
    # Changes of stiffness or damping alone are not detectable as an effect.
    assert detectability_of(BASE) < 1e-2
    assert detectability_of(BASE._replace(k1=7007.0, c1=0.303)) < 0.05


@pytest.mark.parametrize("memory", [0.0, 0.6])
def test_detectability_of_one_wrong_sample_agrees_with_the_closed_form(memory: float):
    """The inverse covariance of a first-order autoregression is tridiagonal."""
    states, _ = integrate(BASE, np.zeros(4), random_torque(400), dt=DT, substeps=20)
    readings = np.column_stack(read_encoders(BASE, states))
    readings[100, 1] += 1e-4
    encoders = replace(WHITE, memory=memory, white=0.0)
    found = detectability(BASE, [(states, readings, random_torque(400), np.zeros(400))], encoders=encoders, dt=DT)
    # A fifth of the squared error counts.
    distance = 100 * np.sqrt((1 + memory**2) / (1 - memory**2))
    assert found == pytest.approx(distance * np.sqrt(0.2) / LIMIT, rel=0.05)


def test_diverging_motion_is_detectable_without_limit():
    states, _ = integrate(BASE, np.zeros(4), random_torque(400), dt=DT, substeps=20)
    readings = np.column_stack(read_encoders(BASE, states))
    readings[200:] = np.nan
    assert detectability(BASE, [(states, readings, random_torque(400), np.zeros(400))], encoders=WHITE, dt=DT) == np.inf


def test_encoder_noise_has_its_rms_and_colour():
    random = np.random.default_rng(0)
    for encoders in (Encoders((1e-5, 1e-6), (0.0, 0.0), 0.9), Encoders((1e-5, 1e-6), (2e-5, 2e-6), 0.0)):
        error = encoders.read(np.zeros((200000, 2)) + np.linspace(0, 1, 200000)[:, None], random)
        error -= np.linspace(0, 1, 200000)[:, None]
        assert np.std(error, axis=0) == pytest.approx(encoders.rms, rel=0.02)
        neighbours = np.corrcoef(error[1:, 1], error[:-1, 1])[0, 1]
        assert neighbours == pytest.approx(2 / 3 * encoders.memory, abs=0.02)


@pytest.mark.slow
def test_recorded_case_is_readable_and_reproducible(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(drawing, "_SIZES", ((1000.0, (1200, 1200, 800)),) * 3)
    (form,) = [f for f in FORMS if f.name == "stiffness" and f.family == "temperature"]
    case = drawing.Case("try-1", (form,), 5)
    answer = record(drawing.draw(case), tmp_path)
    assert answer == json.loads((tmp_path / "answer.json").read_text())
    assert answer["families"] == ["temperature"]
    assert answer["detection_limits"][0] >= drawing.LEAST
    first, second, last = (tmp_path / f"{name}.csv" for name in ("train_1", "train_2", "heldout"))
    rig = read_rig([first, second], tmp_path / "drive.toml", test=[last])
    assert [e.time.size for e in rig.test["zero-order"]] == [800]
    log = rig.logs[0]
    assert log.time.size == 1200
    assert rig.hold == "zero-order"
    assert log.temperature is not None and 273 < log.temperature.min() < 330
    again = record(drawing.draw(case), tmp_path / "again")
    assert again == answer
    assert (tmp_path / "again" / "train_1.csv").read_bytes() == (tmp_path / "train_1.csv").read_bytes()


def test_faint_cases_are_near_the_detection_limit(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(drawing, "_SIZES", ((1000.0, (1200, 1200, 800)),) * 3)
    drawn = drawing.draw(drawing.Case("try-2", (forms_of("torque_sensor")[0],), 6, faint=True))
    assert drawing.LEAST <= drawn.detectable[0] < 1.5 * drawing.FAINT


def test_own_error_is_proportional_to_the_noise_except_for_chaotic_motion():
    """The error of a linear drive is proportional to the noise of its initial state; with a gap it is far larger."""
    torque = random_torque(4000)
    still = np.zeros(torque.size)

    def off(drive: Mechanism, noise: float) -> float:
        encoders = Encoders((BASE.ratio * noise, noise), (0.0, 0.0), 0.0)
        random = np.random.default_rng(1)
        return own_error(drive, np.zeros(4), torque, encoders, random, dt=DT, substeps=20, brake=still, warm=still)

    linear = BASE._replace(k3=0.0)
    assert off(linear, 1e-6) == pytest.approx(10 * off(linear, 1e-7), rel=1e-3)
    assert off(linear, 1e-6) < 1e-6 < 20e-6 < off(linear._replace(gap=2e-4), 1e-6)


def test_case_lists_cover_all_families_and_pairs_do_not_overlap():
    cases = drawing.single_cases(3 * len(FAMILIES), 0, FAMILIES)
    assert len({c.name for c in cases}) == len(cases)
    assert {c.forms[0].family for c in cases} == set(FAMILIES)
    # A longer study begins with the cases of a shorter one.
    assert cases[:10] == drawing.single_cases(10, 0, FAMILIES)
    for first, second in (case.forms for case in drawing.pair_cases(200, 0)):
        assert first.family != second.family
        changed = [set(f.changes(f.high, np.random.default_rng(0), BASE)) for f in (first, second)]
        assert not changed[0] & changed[1]


def test_dry_friction_reversal_does_not_depend_on_the_step():
    """The error where the rate reverses is at most the friction within one step, for long and short steps."""
    torque = random_torque(400)
    p = BASE._replace(slide_m=1e-4, hold_m=1e-4)
    coarse, fine, without = (
        integrate(mechanism, START, torque, dt=DT, substeps=substeps)[0][:, 0]
        for mechanism, substeps in ((p, 10), (p, 200), (BASE, 200))
    )
    assert np.abs(coarse - fine).max() < 0.02 * np.abs(fine - without).max()
