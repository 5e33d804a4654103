"""The rig's parameters: a drive on its bench and all that can be wrong with it, in the rig's own terms."""

from typing import NamedTuple

import numpy as np
from scipy.signal import lfilter

KNOTS = 720
"""Knots of a table over one motor revolution."""

STATES = (
    "motor_angle motor_rate load_angle load_rate third_angle third_rate bouc_wen "
    "slip_1 slip_2 slip_3 slip_4 motor_bristle load_bristle creep_1 creep_2 lagged_torque "
    "wheel_angle wheel_rate tie"
).split()

_NONE_2, _NONE_3, _NONE_4 = np.zeros(2), np.zeros(3), np.zeros(4)


class Mechanism(NamedTuple):
    """One drive. Torques in N m, angles in rad; every default means "not there".

    The first six are the base; `k1`, `k3`, `c1` are K, K alpha and B_sp. What follows stands in the order of the
    torque's road from the amplifier to the encoders.
    """

    ratio: float = 50.0
    motor_inertia: float = 5e-4
    load_inertia: float = 5e-2
    k1: float = 7000.0
    k3: float = 0.0
    c1: float = 0.3
    # Amplifier: gain u + bias, where nothing comes of a u below a threshold [N m] and a large one saturates [1/(N m)];
    # behind a dead time [s], a lag [s], a ramp between commands (0 or 1).
    gain: float = 1.0
    bias: float = 0.0
    saturates: float = 0.0
    nothing_below: float = 0.0
    dead_time: float = 0.0
    lag: float = 0.0
    ramp: float = 0.0
    # When the log begins [s], on the clock of what comes back in time.
    begun: float = 0.0
    # Motor: dry friction that holds and slides (with a Stribeck rate, a lean to one side, a ripple), or bristles; drag,
    # windage; a torque that drifts [N m/s], one that hums; cogging lines; a wheel on a soft coupling.
    hold_m: float = 0.0
    slide_m: float = 0.0
    sink_m: float = 1.0
    lean_m: float = 0.0
    ripple_m: np.ndarray = _NONE_2
    ripple_m_order: np.ndarray = _NONE_2
    ripple_m_phase: np.ndarray = _NONE_2
    bristle_m: float = 0.0
    bristle_drag_m: float = 0.0
    drag_m: float = 0.0
    windage: float = 0.0
    drift: float = 0.0
    hum: float = 0.0
    hum_rate: float = 0.0
    hum_phase: float = 0.0
    cog: np.ndarray = _NONE_3
    cog_order: np.ndarray = _NONE_3
    cog_phase: np.ndarray = _NONE_3
    wheel_inertia: float = 0.0
    wheel_stiffness: float = 0.0
    wheel_damping: float = 0.0
    # Teeth: error at KNOTS angles of the motor, and its slope there; modulated once per output revolution.
    teeth: np.ndarray = np.zeros(KNOTS)
    teeth_slope: np.ndarray = np.zeros(KNOTS)
    wobble: float = 0.0
    wobble_phase: float = 0.0
    # Spring: gap, other powers, lopsidedness, soft centre, three slopes, ripple over the motor's angle, sag with its
    # speed.
    gap: float = 0.0
    gap_damps: float = 1.0
    k2: float = 0.0
    k5: float = 0.0
    lopsided: float = 0.0
    soft: float = 0.0
    soft_width: float = 1.0
    slope_2: float = 0.0
    slope_3: float = 0.0
    knee_1: float = 1.0
    knee_2: float = 2.0
    ripple_k: float = 0.0
    ripple_k_order: float = 2.0
    ripple_k_phase: float = 0.0
    ripple_k_reacts: float = 1.0
    sag: float = 0.0
    sag_speed: float = 1.0
    # Losses of the mesh: dry with a sharp sign (saturated within rub_rate), growing with load, rippled; powers of rate;
    # more one way.
    rub: float = 0.0
    rub_load: float = 0.0
    rub_rate: float = 5e-4
    rub_ripple: float = 0.0
    rub_order: float = 2.0
    rub_phase: float = 0.0
    c2: float = 0.0
    c3: float = 0.0
    cx: float = 0.0
    c_lean: float = 0.0
    # Memory of the mesh: Bouc-Wen, four slipping springs, two relaxing ones.
    bouc_k: float = 0.0
    bouc_yield: float = 1.0
    bouc_power: float = 1.0
    bouc_share: float = 0.5
    slip_k: np.ndarray = _NONE_4
    slip_d: np.ndarray = _NONE_4
    creep_k: np.ndarray = _NONE_2
    creep_time: np.ndarray = np.ones(2)
    # Heat, per kelvin above the reference.
    warm_k: float = 0.0
    warm_c: float = 0.0
    # Load: friction likewise, weight, tether to the ground, three lobes in a turn, an inertia that swings, unlogged
    # pushes, a third inertia, a tie to the ground that gives way in time.
    hold_l: float = 0.0
    slide_l: float = 0.0
    sink_l: float = 1.0
    bristle_l: float = 0.0
    bristle_drag_l: float = 0.0
    drag_l: float = 0.0
    weight: float = 0.0
    weight_phase: float = 0.0
    tether: float = 0.0
    lobes: float = 0.0
    lobes_phase: float = 0.0
    swing: float = 0.0
    swing_phase: float = 0.0
    push: float = 0.0
    push_amplitude: np.ndarray = _NONE_2
    push_rate: np.ndarray = _NONE_2
    push_phase: np.ndarray = _NONE_2
    third_inertia: float = 0.0
    third_stiffness: float = 0.0
    third_damping: float = 0.0
    tie: float = 0.0
    tie_time: float = 1.0
    # Encoders: what each reads beyond the angle.
    motor_disc: float = 0.0
    motor_disc_order: float = 1.0
    motor_disc_phase: float = 0.0
    load_disc: float = 0.0
    load_disc_order: float = 1.0
    load_disc_phase: float = 0.0
    load_zero: float = 0.0
    # The log of the commanded torque: samples by which it is late, and the lag of its filter [s].
    log_late: int = 0
    log_lag: float = 0.0

    @property
    def compliance(self) -> float:
        """c of x'' + c (torque) = forcing [1/(kg m^2)]."""
        return 1 / (self.ratio**2 * self.motor_inertia) + 1 / self.load_inertia

    @property
    def load_torque(self) -> float:
        """What a twist of one milliradian takes, at the output [N m]: the measure of torques on this drive."""
        return 1e-3 * self.k1

    @property
    def motor_torque(self) -> float:
        """The same at the motor [N m]."""
        return self.load_torque / self.ratio

    @property
    def omega_0(self) -> float:
        """Natural frequency [rad/s]."""
        return float(np.sqrt(self.compliance * self.k1))


def table(lines: dict[int, tuple[float, float]]) -> dict[str, np.ndarray]:
    """Tooth tables of a sum of harmonics, order -> (amplitude, phase)."""
    angle = 2 * np.pi * np.arange(KNOTS) / KNOTS
    teeth = sum((a * np.cos(n * angle + p) for n, (a, p) in lines.items()), start=np.zeros(KNOTS))
    slope = sum((-n * a * np.sin(n * angle + p) for n, (a, p) in lines.items()), start=np.zeros(KNOTS))
    return {"teeth": teeth, "teeth_slope": slope}


def read_encoders(mechanism: Mechanism, states: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What noiseless encoders read [rad], motor and load."""
    m, phi, lam = mechanism, states[:, 0], states[:, 2]
    motor = phi + m.motor_disc * np.sin(m.motor_disc_order * phi + m.motor_disc_phase)
    return motor, lam + m.load_disc * np.sin(m.load_disc_order * lam + m.load_disc_phase) + m.load_zero


def log_torque(mechanism: Mechanism, commanded: np.ndarray, dt: float) -> np.ndarray:
    """What the log says of a torque that is held over each sampling interval [s]."""
    late = np.concatenate([np.full(mechanism.log_late, commanded[0]), commanded])[: commanded.size]
    if mechanism.log_lag == 0.0:
        return late
    kept = np.exp(-dt / mechanism.log_lag)
    return lfilter([0.0, 1 - kept], [1.0, -kept], late, zi=late[:1])[0]
