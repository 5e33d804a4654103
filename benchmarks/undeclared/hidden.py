"""What can be hidden: for each family several forms, each with the range of its strength; its shape is drawn anew.

Ranges follow the vendors' tables and the literature where these give them; torques are shares of what a twist of one
milliradian takes, so that they suit drives of all sizes.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from undeclared.mechanism import Mechanism, table

ARCSEC = np.pi / 648000
Shape = Callable[[float, np.random.Generator, Mechanism], dict]


@dataclass(frozen=True)
class Form:
    """One way in which a drive can differ from its base.

    Attributes:
        family: the name that a report should give.
        name: of the form, the study's own.
        low: least strength; meaning and unit as in the form's line below.
        high: largest strength that is plausible.
        changes: the mechanism's changed parameters, from strength, a generator for the shape, and the base.
        undefined: base parameters that have no one true value beside this form.
        heats: whether it needs a temperature that changes.
        straight: whether it stands in the place of the base's cubic, so that the base has none.
        goes_on: whether it goes on between logs, each of which then begins at another instant of it.
    """

    family: str
    name: str
    low: float
    high: float
    changes: Shape
    undefined: tuple[str, ...] = ()
    heats: bool = False
    straight: bool = False
    goes_on: bool = False


def _phase(random: np.random.Generator) -> float:
    return float(random.uniform(0, 2 * np.pi))


def _sign(random: np.random.Generator) -> float:
    return float(random.choice([-1.0, 1.0]))


def _between(random: np.random.Generator, low: float, high: float) -> float:
    """Log-uniform."""
    return float(np.exp(random.uniform(np.log(low), np.log(high))))


def _teeth(shares: dict[int, float], wobble: float = 0.0) -> Shape:
    """Strength: amplitude of the leading line [rad]."""

    def changes(s, random, base):
        lines = table({n: (s * share, _phase(random)) for n, share in shares.items()})
        return lines | {"wobble": wobble, "wobble_phase": _phase(random)}

    return changes


def _quadratic(s, random, base):
    """Strength: change of stiffness at a twist of 1.5e-3."""
    return {"k2": _sign(random) * s * base.k1 / 1.5e-3}


def _quintic(s, random, base):
    """Strength: share of the torque at a twist of 2e-3."""
    return {"k5": s * base.k1 / 2e-3**4}


def _lopsided(s, random, base):
    """Strength: how much stiffer one side is."""
    return {"lopsided": s}


def _soft(s, random, base):
    """Strength: how much softer the middle is."""
    return {"soft": s, "soft_width": _between(random, 2e-4, 6e-4)}


def _slopes(s, random, base):
    """Strength: K2/K1 - 1."""
    knee, further = random.uniform(4e-4, 7e-4), 1 + random.uniform(0.2, 0.6) * s
    slope = base.k1 * (1 + s)
    return {
        "slope_2": slope,
        "slope_3": slope * further,
        "knee_1": knee,
        "knee_2": knee * random.uniform(2.2, 3.0),
    }


def _gap(damps: float) -> Shape:
    """Strength: half-width [rad]."""
    return lambda s, random, base: {"gap": s, "gap_damps": damps}


def _bouc_wen(power: float | None, share: float | None) -> Shape:
    """Strength: hysteretic stiffness over K."""

    def changes(s, random, base):
        return {
            "bouc_k": s * base.k1,
            "bouc_yield": _between(random, 1e-4, 6e-4),
            "bouc_power": power or random.uniform(1.2, 2.0),
            "bouc_share": share or random.uniform(0.5, 1.0),
        }

    return changes


def _slips(s, random, base):
    """Strength: sum of the slipping springs over K."""
    shares = random.dirichlet(np.full(4, 4.0))
    return {"slip_k": s * base.k1 * shares, "slip_d": np.geomspace(1.0, _between(random, 3.0, 10.0), 4) * 1e-4}


def _rub(load: float = 0.0, ripple: float = 0.0) -> Shape:
    """Strength: share of the load torque."""

    def changes(s, random, base):
        return {
            "rub": s * base.load_torque,
            "rub_load": load / base.load_torque,
            "rub_ripple": ripple,
            "rub_phase": _phase(random),
        }

    return changes


def _viscosity(s: float, random: np.random.Generator, inertia: float) -> float:
    """Viscous drag [N m s/rad] beside dry friction: at its usual strengths, what stops an inertia in some seconds."""
    return s * inertia * _between(random, 0.3, 3.0)


def _dry_motor(s, random, base):
    """Strength: share of the motor torque."""
    level = s * base.motor_torque
    return {"hold_m": level, "slide_m": level, "drag_m": _viscosity(s, random, base.motor_inertia)}


def _stribeck_motor(s, random, base):
    """Strength: share of the motor torque, sliding."""
    level = s * base.motor_torque
    return {
        "slide_m": level,
        "hold_m": level * random.uniform(1.2, 2.0),
        "sink_m": _between(random, 0.2, 4.0),
        "drag_m": _viscosity(s, random, base.motor_inertia),
    }


def _bristles_motor(s, random, base):
    """Strength: share of the motor torque, sliding."""
    level = s * base.motor_torque
    stiffness = level / _between(random, 3e-3, 3e-2)
    return {
        "slide_m": level,
        "hold_m": level * random.uniform(1.0, 1.6),
        "sink_m": _between(random, 0.2, 2.0),
        "bristle_m": stiffness,
        "bristle_drag_m": 0.3 * float(np.sqrt(stiffness * base.motor_inertia)),
        "drag_m": _viscosity(s, random, base.motor_inertia),
    }


def _viscous_motor(s, random, base):
    """Strength: rate at which it stops the bare motor [1/s]."""
    return {"drag_m": s * base.motor_inertia}


def _leaning_motor(s, random, base):
    """Strength: share of the motor torque, larger one way."""
    return _dry_motor(s, random, base) | {"lean_m": _sign(random) * random.uniform(0.1, 0.3)}


def _dry_load(s, random, base):
    """Strength: share of the load torque."""
    level = s * base.load_torque
    return {"hold_l": level, "slide_l": level, "drag_l": _viscosity(s, random, base.load_inertia)}


def _viscous_load(s, random, base):
    """Strength: rate at which it stops the bare load [1/s]."""
    return {"drag_l": s * base.load_inertia}


def _bristles_load(s, random, base):
    """Strength: share of the load torque, sliding."""
    level = s * base.load_torque
    stiffness = level / _between(random, 1e-4, 6e-4)
    return {
        "slide_l": level,
        "hold_l": level * random.uniform(1.0, 1.5),
        "sink_l": _between(random, 0.01, 0.1),
        "bristle_l": stiffness,
        "bristle_drag_l": 0.3 * float(np.sqrt(stiffness * base.load_inertia)),
    }


def _power_damping(field: str) -> Shape:
    """Strength: share of B_sp at 0.3 rad/s and a twist of 1e-3."""

    def changes(s, random, base):
        unit = {"c2": 0.3, "c3": 0.09, "cx": 1e-6}[field]
        return {field: s * base.c1 / unit}

    return changes


def _stiffness_ripple(order: float, reacts: float) -> Shape:
    """Strength: share of K."""
    return lambda s, random, base: {
        "ripple_k": s,
        "ripple_k_order": order,
        "ripple_k_phase": _phase(random),
        "ripple_k_reacts": reacts,
    }


def _rippled_motor(shares: tuple[float, float], orders: tuple[float, float]) -> Shape:
    """Strength: share of the motor torque in the mean."""

    def changes(s, random, base):
        phases = np.array([_phase(random), _phase(random)])
        ripple = {"ripple_m": np.array(shares), "ripple_m_order": np.array(orders), "ripple_m_phase": phases}
        return {"hold_m": s * base.motor_torque, "slide_m": s * base.motor_torque} | ripple

    return changes


def _cogs(shares: dict[int, float]) -> Shape:
    """Strength: leading line's share of the motor torque."""

    def changes(s, random, base):
        amplitude, order, phase = np.zeros(3), np.zeros(3), np.zeros(3)
        for i, (n, share) in enumerate(shares.items()):
            amplitude[i], order[i], phase[i] = s * share * base.motor_torque, n, _phase(random)
        return {"cog": amplitude, "cog_order": order, "cog_phase": phase}

    return changes


def _weight(s, random, base):
    """Strength: m g r over the load torque."""
    return {"weight": s * base.load_torque, "weight_phase": _phase(random)}


def _pushes(count: int, steady: bool) -> Shape:
    """Strength: amplitude over the load torque."""

    def changes(s, random, base):
        level = s * base.load_torque
        amplitude = np.array([level, 0.6 * level if count == 2 else 0.0])
        rate = base.omega_0 * np.exp(random.uniform(np.log(0.05), np.log(1.5), size=2))
        phase = random.uniform(0, 2 * np.pi, size=2)
        push = _sign(random) * level if steady else 0.0
        return {"push": push, "push_amplitude": amplitude, "push_rate": rate, "push_phase": phase}

    return changes


def _third(low: float, high: float) -> Shape:
    """Strength: third inertia over the load's."""

    def changes(s, random, base):
        inertia, omega = s * base.load_inertia, base.omega_0 * _between(random, low, high)
        loss = 2 * random.uniform(0.01, 0.05) * omega * inertia
        return {"third_inertia": inertia, "third_stiffness": omega**2 * inertia, "third_damping": loss}

    return changes


def _warm_spring(s, random, base):
    """Strength: softening [1/K]."""
    return {"warm_k": -s}


def _warm_oil(s, random, base):
    """Strength: exponent of the damping [1/K]."""
    return {"warm_c": s}


def _gain(s, random, base):
    """Strength: deviation of the gain from one."""
    return {"gain": 1 + _sign(random) * s}


def _bias(s, random, base):
    """Strength: share of the motor torque."""
    return {"bias": _sign(random) * s * base.motor_torque}


def _gain_and_bias(s, random, base):
    """Strength: deviation of the gain, and the bias over the motor torque."""
    return _gain(s, random, base) | _bias(s, random, base)


def _dead_time(s, random, base):
    """Strength: seconds; the solver rounds it to whole steps."""
    return {"dead_time": s}


def _disc(side: str) -> Shape:
    """Strength: error of the reading [rad]."""
    return lambda s, random, base: {f"{side}_disc": s, f"{side}_disc_phase": _phase(random)}


def _creep(two: bool) -> Shape:
    """Strength: relaxing stiffness over K; the times are such that a log of seconds can show them."""

    def changes(s, random, base):
        times = np.array([_between(random, 0.05, 0.3) if two else _between(random, 0.1, 1.5), 1.5])
        return {"creep_k": s * base.k1 * np.array([1.0, 1.0 if two else 0.0]), "creep_time": times}

    return changes


def _windage(s, random, base):
    """Strength: rate at which it slows the bare motor at 1 rad/s [1/s]."""
    return {"windage": s * base.motor_inertia}


def _tether(s, random, base):
    """Strength: its stiffness over K."""
    return {"tether": s * base.k1}


def _lobes(s, random, base):
    """Strength: share of the load torque."""
    return {"lobes": s * base.load_torque, "lobes_phase": _phase(random)}


def _sag(s, random, base):
    """Strength: share of K that a fast motor loses."""
    return {"sag": s, "sag_speed": _between(random, 3.0, 30.0)}


def _drift(s, random, base):
    """Strength: share of the motor torque in a second."""
    return {"drift": _sign(random) * s * base.motor_torque}


def _hum(s, random, base):
    """Strength: amplitude over the motor torque."""
    rate = base.omega_0 * np.exp(random.uniform(np.log(0.05), np.log(1.5)))
    return {"hum": s * base.motor_torque, "hum_rate": rate, "hum_phase": _phase(random)}


def _saturation(s, random, base):
    """Strength: motor torque over the torque at which the amplifier saturates."""
    return {"saturates": s / base.motor_torque}


def _dead_zone(s, random, base):
    """Strength: torque below which nothing comes out, over the motor torque."""
    return {"nothing_below": s * base.motor_torque}


def _swing(s, random, base):
    """Strength: share of the load's inertia that comes and goes over a turn."""
    return {"swing": s, "swing_phase": _phase(random)}


def _wheel(s, random, base):
    """Strength: the wheel's inertia over the motor's."""
    inertia, omega = s * base.motor_inertia, base.omega_0 * _between(random, 0.3, 1.5)
    return {
        "wheel_inertia": inertia,
        "wheel_stiffness": omega**2 * inertia,
        "wheel_damping": 2 * random.uniform(0.02, 0.1) * omega * inertia,
    }


def _tie(s, random, base):
    """Strength: stiffness of the tie over K."""
    return {"tie": s * base.k1, "tie_time": _between(random, 0.02, 0.3)}


def _leaning_damping(s, random, base):
    """Strength: how much more the mesh damps one way, over B_sp."""
    return {"c_lean": _sign(random) * s * base.c1}


FORMS = (
    Form("kinematic_error", "two lobes", 7.5e-5, 2.9e-4, _teeth({2: 1.0})),
    Form("kinematic_error", "orders 1, 2, 4", 7.5e-5, 2.9e-4, _teeth({2: 1.0, 1: 0.4, 4: 0.3})),
    Form("kinematic_error", "rounded wave", 7.5e-5, 2.9e-4, _teeth({2: 1.0, 4: 0.25, 6: 0.08})),
    Form("kinematic_error", "sidebands", 7.5e-5, 2.9e-4, _teeth({2: 1.0}, wobble=0.3)),
    Form("stiffness_shape", "quadratic", 0.01, 0.15, _quadratic),
    Form("stiffness_shape", "three slopes", 0.2, 0.6, _slopes, ("alpha",), straight=True),
    Form("stiffness_shape", "quintic", 0.02, 0.3, _quintic),
    Form("stiffness_shape", "lopsided", 0.01, 0.1, _lopsided, ("K", "alpha")),
    Form("stiffness_shape", "soft centre", 0.05, 0.3, _soft, ("K", "alpha")),
    Form("backlash", "damped gap", 6 * ARCSEC, 60 * ARCSEC, _gap(1.0)),
    Form("backlash", "free gap", 6 * ARCSEC, 60 * ARCSEC, _gap(0.0)),
    Form("hysteresis", "Bouc-Wen", 0.03, 0.4, _bouc_wen(1.0, None)),
    Form("hysteresis", "Maxwell slip", 0.03, 0.4, _slips, ("K", "alpha", "B_sp")),
    Form("hysteresis", "Dahl", 0.03, 0.4, _bouc_wen(1.0, 1.0)),
    Form("hysteresis", "Bouc-Wen, sharper", 0.03, 0.4, _bouc_wen(None, None)),
    Form("coulomb_friction", "dry", 0.01, 0.15, _rub()),
    Form("coulomb_friction", "growing with load", 0.01, 0.15, _rub(load=0.5)),
    Form("motor_friction", "dry", 0.05, 0.5, _dry_motor),
    Form("motor_friction", "Stribeck", 0.05, 0.4, _stribeck_motor),
    Form("motor_friction", "bristles", 0.05, 0.5, _bristles_motor),
    Form("motor_friction", "viscous", 0.5, 10.0, _viscous_motor),
    Form("motor_friction", "leaning", 0.05, 0.5, _leaning_motor),
    Form("load_friction", "dry", 0.02, 0.4, _dry_load),
    Form("load_friction", "viscous", 0.5, 10.0, _viscous_load),
    Form("load_friction", "bristles", 0.02, 0.4, _bristles_load),
    Form("nonlinear_damping", "rate times its size", 0.1, 2.0, _power_damping("c2")),
    Form("nonlinear_damping", "cubic", 0.1, 2.0, _power_damping("c3")),
    Form("nonlinear_damping", "with twist squared", 0.1, 2.0, _power_damping("cx")),
    Form("position_dependent_stiffness", "two cycles", 5e-3, 0.1, _stiffness_ripple(2.0, 1.0)),
    Form("position_dependent_stiffness", "two cycles, no reaction", 5e-3, 0.1, _stiffness_ripple(2.0, 0.0)),
    Form("position_dependent_stiffness", "one cycle", 5e-3, 0.1, _stiffness_ripple(1.0, 1.0)),
    Form("position_dependent_friction", "motor, two cycles", 0.05, 0.5, _rippled_motor((0.6, 0.0), (2.0, 0.0))),
    Form("position_dependent_friction", "motor, 1 and 2", 0.05, 0.5, _rippled_motor((0.4, 0.4), (1.0, 2.0))),
    Form("position_dependent_friction", "mesh, two cycles", 0.02, 0.15, _rub(ripple=0.6)),
    Form("cogging", "two cycles", 0.02, 0.3, _cogs({2: 1.0})),
    Form("cogging", "orders 1, 2, 4", 0.02, 0.3, _cogs({4: 1.0, 2: 0.5, 1: 0.3})),
    Form("cogging", "one cycle", 0.02, 0.3, _cogs({1: 1.0})),
    Form("gravity_load", "pendulum", 0.03, 0.6, _weight),
    Form("load_disturbance", "a line", 0.01, 0.15, _pushes(1, False)),
    Form("load_disturbance", "two lines", 0.01, 0.15, _pushes(2, False)),
    Form("load_disturbance", "a line and a constant", 0.01, 0.15, _pushes(1, True)),
    Form("load_disturbance", "a line that goes on", 0.01, 0.15, _pushes(1, False), goes_on=True),
    Form("extra_resonance", "flexible load", 0.05, 0.5, _third(0.6, 1.8)),
    Form("extra_resonance", "soft fixture", 0.05, 0.5, _third(0.2, 0.6)),
    Form("temperature", "stiffness", 2e-4, 2e-3, _warm_spring, ("K", "alpha"), heats=True),
    Form("temperature", "damping", 5e-3, 0.05, _warm_oil, ("B_sp",), heats=True),
    Form("torque_sensor", "bias", 0.02, 0.3, _bias),
    Form("torque_sensor", "gain", 0.01, 0.1, _gain),
    Form("torque_sensor", "gain and bias", 0.01, 0.1, _gain_and_bias),
    Form("input_delay", "dead time", 1e-4, 3e-3, _dead_time),
    Form("input_delay", "lag", 1e-4, 3e-3, lambda s, random, base: {"lag": s}),
    Form("input_delay", "ramped commands", 1.0, 1.0, lambda s, random, base: {"ramp": 1.0}),
    Form("input_delay", "late log", 1.0, 4.0, lambda s, random, base: {"log_late": round(s)}),
    Form("input_delay", "filtered log", 1e-4, 3e-3, lambda s, random, base: {"log_lag": s}),
    Form("encoder_offset", "zero of the load's encoder", 3e-6, 2e-4, lambda s, random, base: {"load_zero": s}),
    Form("encoder_eccentricity", "motor disc", 1e-4, 4e-4, _disc("motor")),
    Form("encoder_eccentricity", "load disc", 1e-4, 4e-4, _disc("load")),
    Form("creep", "one time", 0.01, 0.1, _creep(False)),
    Form("creep", "two times", 0.01, 0.08, _creep(True), ("K", "B_sp")),
    Form("unknown", "windage of the motor", 0.01, 0.3, _windage),
    Form("unknown", "tethered load", 1e-4, 3e-3, _tether),
    Form("unknown", "three lobes on the load", 0.03, 0.6, _lobes),
    Form("unknown", "stiffness that sags with speed", 0.02, 0.2, _sag),
    Form("unknown", "drifting torque", 0.01, 0.2, _drift),
    Form("unknown", "saturating amplifier", 0.3, 10.0, _saturation),
    Form("unknown", "dead zone of the amplifier", 3e-3, 0.1, _dead_zone),
    Form("unknown", "load inertia that swings", 0.03, 0.3, _swing),
    Form("unknown", "damping that leans", 0.1, 0.8, _leaning_damping),
    Form("unknown", "hum of the amplifier", 0.01, 0.15, _hum),
    Form("unknown", "hum that goes on", 0.01, 0.15, _hum, goes_on=True),
    Form("unknown", "wheel on a soft coupling", 0.05, 0.5, _wheel),
    Form("unknown", "tie that gives way in time", 3e-4, 0.03, _tie),
)

FAMILIES = tuple(dict.fromkeys(form.family for form in FORMS))

EQUAL = {"torque_sensor": "inertia_error", "input_delay": "sensor_delay"}
"""Families with the very equations of another one: a gain of the torque changes both inertias, K, alpha and B_sp by one
factor; a torque that comes late is an experiment whose two encoders read late."""


def forms_of(family: str) -> tuple[Form, ...]:
    """The forms of a family."""
    return tuple(form for form in FORMS if form.family == family)
