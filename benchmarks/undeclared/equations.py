"""The rig's equations of motion in numba, with true signs, gaps and stops, in fixed fine steps.

Dry friction on motor and load is a true sign with stiction: a side at rest stays there while what pulls it is below the
holding torque; one whose rate changes sign within a step is arrested at its end and judged anew. Slipping springs
stop at their limits. Nothing is located in time: the steps are fine enough.
"""

import math

import numba
import numpy as np

from undeclared.mechanism import STATES, Mechanism

_COUNT = len(STATES)
# A record goes to compiled functions by its address; a tuple of as many fields would be copied at every call.
_RECORD = np.dtype([(n, np.asarray(v).dtype, np.shape(v)) for n, v in Mechanism()._asdict().items()])


@numba.njit(cache=True, error_model="numpy")
def _teeth(phi, teeth, slope):
    """Error and its derivative over the motor angle: cubic Hermite, so that one is exactly the other's derivative."""
    n = teeth.size
    gap = 2 * math.pi / n
    place = phi / gap
    i = math.floor(place)
    f = place - i
    a, b = int(i) % n, (int(i) + 1) % n
    e0, e1, d0, d1 = teeth[a], teeth[b], slope[a] * gap, slope[b] * gap
    c2, c3 = 3 * (e1 - e0) - 2 * d0 - d1, 2 * (e0 - e1) + d0 + d1
    return e0 + f * (d0 + f * (c2 + f * c3)), (d0 + f * (2 * c2 + 3 * f * c3)) / gap


@numba.njit(cache=True, error_model="numpy")
def _spring(x, p):
    """Torque of the bare spring at a twist."""
    if p.gap > 0.0:
        x = math.copysign(max(abs(x) - p.gap, 0.0), x)
    if p.slope_2 > 0.0:
        a = abs(x)
        torque = p.k1 * min(a, p.knee_1)
        torque += p.slope_2 * min(max(a - p.knee_1, 0.0), p.knee_2 - p.knee_1)
        torque = math.copysign(torque + p.slope_3 * max(a - p.knee_2, 0.0), x)
    else:
        torque = x * (p.k1 + x * (p.k2 + x * (p.k3 + x * x * p.k5)))
    if p.lopsided != 0.0 and x > 0.0:
        torque += p.lopsided * p.k1 * x
    if p.soft != 0.0:
        torque -= p.soft * p.k1 * x * math.exp(-((x / p.soft_width) ** 2))
    return torque


@numba.njit(cache=True, error_model="numpy")
def _mesh(x, v, phi, w, y, warm, p, out):
    """Torque between the sides, and what its change with the motor angle does to the motor; its memory's rates."""
    torque = _spring(x, p)
    if p.warm_k != 0.0:
        torque *= 1.0 + p.warm_k * warm
    if p.sag != 0.0:
        torque -= p.sag * p.k1 * x * w * w / (w * w + p.sag_speed * p.sag_speed)
    reaction = 0.0
    if p.ripple_k != 0.0:
        angle = p.ripple_k_order * phi + p.ripple_k_phase
        torque *= 1.0 + p.ripple_k * math.cos(angle)
        energy = x * x * (0.5 * p.k1 + 0.25 * p.k3 * x * x)
        reaction = p.ripple_k_reacts * p.ripple_k * p.ripple_k_order * math.sin(angle) * energy
    elastic = torque
    viscous = p.c1 * (math.exp(-p.warm_c * warm) if p.warm_c != 0.0 else 1.0)
    if p.gap_damps > 0.0 or abs(x) >= p.gap:
        torque += viscous * v
    torque += v * (p.c2 * abs(v) + p.c3 * v * v + p.cx * x * x) + p.c_lean * abs(v)
    if p.rub > 0.0:
        level = p.rub * (1.0 + p.rub_load * abs(elastic))
        level *= 1.0 + p.rub_ripple * math.cos(p.rub_order * phi + p.rub_phase)
        torque += level * min(max(v / p.rub_rate, -1.0), 1.0)
    if p.bouc_k > 0.0:
        z = y[6]
        bent = (abs(z) / p.bouc_yield) ** p.bouc_power
        out[6] = v - bent * (p.bouc_share * abs(v) * math.copysign(1.0, z) + (1.0 - p.bouc_share) * v)
        torque += p.bouc_k * z
    for i in range(4):
        if p.slip_k[i] > 0.0:
            z = y[7 + i]
            stopped = abs(z) >= p.slip_d[i] and z * v > 0.0
            out[7 + i] = 0.0 if stopped else v
            torque += p.slip_k[i] * z
    for i in range(2):
        if p.creep_k[i] > 0.0:
            out[13 + i] = (x - y[13 + i]) / p.creep_time[i]
            torque += p.creep_k[i] * (x - y[13 + i])
    return torque, reaction


@numba.njit(cache=True, error_model="numpy")
def _bristles(w, z, stiffness, drag, hold, slide, sink):
    """LuGre: torque and the bristles' rate."""
    level = slide + (hold - slide) * math.exp(-((w / sink) ** 2))
    rate = w - stiffness * abs(w) * z / level
    return stiffness * z + drag * rate, rate


@numba.njit(cache=True, error_model="numpy")
def _level_m(w, phi, side, p):
    """Dry friction of the motor that slides to `side`; at rest what it can hold."""
    level = p.slide_m + (p.hold_m - p.slide_m) * math.exp(-((w / p.sink_m) ** 2))
    ripple = 0.0
    for i in range(2):
        ripple += p.ripple_m[i] * math.cos(p.ripple_m_order[i] * phi + p.ripple_m_phase[i])
    return level * (1.0 + p.lean_m * side) * max(1.0 + ripple, 0.0)


@numba.njit(cache=True, error_model="numpy")
def _level_l(w, p):
    """Dry friction of the load likewise."""
    return p.slide_l + (p.hold_l - p.slide_l) * math.exp(-((w / p.sink_l) ** 2))


@numba.njit(cache=True, error_model="numpy")
def _amplified(u, p):
    """Torque that the amplifier makes of a command."""
    u = math.copysign(max(abs(u) - p.nothing_below, 0.0), u)
    return p.gain * u / math.sqrt(1.0 + (p.saturates * u) ** 2) + p.bias


@numba.njit(cache=True, error_model="numpy")
def _load_inertia(lam, p):
    """Of the load at an angle, and its derivative."""
    angle = lam + p.swing_phase
    return p.load_inertia * (1.0 + p.swing * math.cos(angle)), -p.load_inertia * p.swing * math.sin(angle)


@numba.njit(cache=True, error_model="numpy")
def _pulls(t, y, u, brake, warm, p, out):
    """Torques on motor and load without their dry friction; rates of all but the two sides' own to `out`."""
    phi, w, lam, r = y[0], y[1], y[2], y[3]
    out[:] = 0.0
    acting = _amplified(u, p)
    if p.lag > 0.0:
        out[15] = (acting - y[15]) / p.lag
        acting = y[15]
    e, de = _teeth(phi, p.teeth, p.teeth_slope)
    swing = 1.0 + p.wobble * math.cos(lam + p.wobble_phase)
    over_motor = 1.0 / p.ratio + de * swing
    over_load = 1.0 + e * p.wobble * math.sin(lam + p.wobble_phase)
    x = phi / p.ratio + e * swing - lam
    torque, reaction = _mesh(x, w * over_motor - r * over_load, phi, w, y, warm, p, out)
    motor = acting + p.drift * t - over_motor * torque + reaction - w * (p.drag_m + p.windage * abs(w))
    if p.hum != 0.0:
        motor += p.hum * math.sin(p.hum_rate * (p.begun + t) + p.hum_phase)
    for i in range(3):
        if p.cog[i] != 0.0:
            motor += p.cog[i] * math.cos(p.cog_order[i] * phi + p.cog_phase[i])
    if p.bristle_m > 0.0:
        rubbed, out[11] = _bristles(w, y[11], p.bristle_m, p.bristle_drag_m, p.hold_m, p.slide_m, p.sink_m)
        motor -= rubbed
    load = over_load * torque + brake + p.push - p.drag_l * r - p.tether * lam
    if p.weight != 0.0:
        load -= p.weight * math.sin(lam + p.weight_phase)
    if p.lobes != 0.0:
        load -= p.lobes * math.sin(3.0 * lam + p.lobes_phase)
    if p.swing != 0.0:
        load -= 0.5 * _load_inertia(lam, p)[1] * r * r
    for i in range(2):
        if p.push_amplitude[i] != 0.0:
            load += p.push_amplitude[i] * math.sin(p.push_rate[i] * (p.begun + t) + p.push_phase[i])
    if p.bristle_l > 0.0:
        rubbed, out[12] = _bristles(r, y[12], p.bristle_l, p.bristle_drag_l, p.hold_l, p.slide_l, p.sink_l)
        load -= rubbed
    if p.third_inertia > 0.0:
        across = p.third_stiffness * (lam - y[4]) + p.third_damping * (r - y[5])
        out[4], out[5] = y[5], across / p.third_inertia
        load -= across
    if p.wheel_inertia > 0.0:
        across = p.wheel_stiffness * (phi - y[16]) + p.wheel_damping * (w - y[17])
        out[16], out[17] = y[17], across / p.wheel_inertia
        motor -= across
    if p.tie > 0.0:
        out[18] = (lam - y[18]) / p.tie_time
        load -= p.tie * (lam - y[18])
    return motor, load


@numba.njit(cache=True, error_model="numpy")
def rates(t, y, u, brake, warm, side_m, side_l, p, out):
    """Rates of all states while motor and load slide to their sides (1, -1), rest (0) or have no dry friction (2)."""
    motor, load = _pulls(t, y, u, brake, warm, p, out)
    if side_m != 2:
        motor = 0.0 if side_m == 0 else motor - side_m * _level_m(y[1], y[0], side_m, p)
    if side_l != 2:
        load = 0.0 if side_l == 0 else load - side_l * _level_l(y[3], p)
    out[0], out[1] = y[1], motor / p.motor_inertia
    out[2], out[3] = y[3], load / _load_inertia(y[2], p)[0]


@numba.njit(cache=True, error_model="numpy")
def _sides(t, y, u, brake, warm, p, out):
    """Where the two sides' dry friction points in the coming step."""
    dry_m, dry_l = p.slide_m > 0.0 and p.bristle_m == 0.0, p.slide_l > 0.0 and p.bristle_l == 0.0
    side_m = 2 if not dry_m else 1 if y[1] > 0.0 else -1 if y[1] < 0.0 else 0
    side_l = 2 if not dry_l else 1 if y[3] > 0.0 else -1 if y[3] < 0.0 else 0
    if side_m == 0 or side_l == 0:
        motor, load = _pulls(t, y, u, brake, warm, p, out)
        pulled_m, pulled_l = 1 if motor > 0.0 else -1, 1 if load > 0.0 else -1
        if side_m == 0 and abs(motor) > _level_m(0.0, y[0], pulled_m, p):
            side_m = pulled_m
        if side_l == 0 and abs(load) > _level_l(0.0, p):
            side_l = pulled_l
    return side_m, side_l


@numba.njit(cache=True, error_model="numpy")
def _command(commands, k, step, part, substeps, dead, p):
    """Torque at the amplifier, `dead` solver steps late, `part` of a step into step `step` of interval k."""
    at = k * substeps + step - dead
    i = at // substeps
    now, before = commands[max(i, 0)], commands[max(i - 1, 0)]
    if p.ramp == 0.0:
        return now
    return before + (now - before) * ((at - i * substeps) + part) / substeps


@numba.njit(cache=True, error_model="numpy")
def _move(y, by, along, to):
    for i in range(y.size):
        to[i] = y[i] + by * along[i]


@numba.njit(cache=True, error_model="numpy")
def _turned(before, after, side, rubbed):
    """The rate after a step in which it has turned, while dry friction went on pointing as before: from the turn on it
    takes `rubbed` in a whole step the other way; a rate that it would turn back has come to rest."""
    rest = after / (after - before)
    turned = after + 2.0 * side * rubbed * rest
    return turned if turned * side < 0.0 else 0.0


@numba.njit(cache=True, error_model="numpy")
def _integrate(p, start, shaking, follow, pull, brake, warm, dt, substeps):
    count = shaking.size
    h = dt / substeps
    dead = int(round(p.dead_time / h))
    y, kept, commands = start.copy(), np.empty((count, start.size)), np.empty(count)
    k1, k2, k3, k4, at = np.empty((5, start.size))
    for k in range(count):
        kept[k] = y
        commands[k] = shaking[k] + pull[0] * (follow[k, 0] - y[0]) + pull[1] * (follow[k, 1] - y[1])
        for j in range(substeps):
            t = k * dt + j * h
            u0 = _command(commands, k, j, 0.0, substeps, dead, p)
            u1, u2 = u0, u0
            if p.ramp != 0.0:
                u1 = _command(commands, k, j, 0.5, substeps, dead, p)
                u2 = _command(commands, k, j, 1.0, substeps, dead, p)
            at_start_m, at_start_l = y[1], y[3]
            side_m, side_l = _sides(t, y, u0, brake[k], warm[k], p, k1)
            rates(t, y, u0, brake[k], warm[k], side_m, side_l, p, k1)
            _move(y, 0.5 * h, k1, at)
            rates(t + 0.5 * h, at, u1, brake[k], warm[k], side_m, side_l, p, k2)
            _move(y, 0.5 * h, k2, at)
            rates(t + 0.5 * h, at, u1, brake[k], warm[k], side_m, side_l, p, k3)
            _move(y, h, k3, at)
            rates(t + h, at, u2, brake[k], warm[k], side_m, side_l, p, k4)
            for i in range(y.size):
                y[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i])
            if side_m != 2 and y[1] * side_m < 0.0:
                y[1] = _turned(at_start_m, y[1], side_m, h * _level_m(0.0, y[0], -side_m, p) / p.motor_inertia)
            if side_l != 2 and y[3] * side_l < 0.0:
                y[3] = _turned(at_start_l, y[3], side_l, h * _level_l(0.0, p) / _load_inertia(y[2], p)[0])
            for i in range(4):
                if p.slip_k[i] > 0.0:
                    y[7 + i] = min(max(y[7 + i], -p.slip_d[i]), p.slip_d[i])
    return kept, commands


def integrate(
    mechanism: Mechanism,
    start: np.ndarray,
    shaking: np.ndarray,
    *,
    dt: float,
    substeps: int,
    follow: np.ndarray | None = None,
    pull: tuple[float, float] = (0.0, 0.0),
    brake: np.ndarray | None = None,
    warm: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Motion of the mechanism and the commanded torque, at the samples.

    Args:
        mechanism: the drive.
        start: motor angle, motor rate, load angle, load rate at the first sample; the memory is at rest.
        shaking: torque that is commanded whatever the motor does [N m], held over each interval.
        dt: sampling interval [s].
        substeps: Runge-Kutta steps in each.
        follow: motor angle and rate that a slow controller follows, (samples, 2).
        pull: its gains on angle [N m/rad] and rate [N m s/rad].
        brake: torque on the load [N m], held.
        warm: kelvin above the reference.

    Returns:
        States (samples, len(STATES)) and the commanded torque (samples).
    """
    count = shaking.size
    nothing = np.zeros(count)
    y = np.zeros(_COUNT)
    y[:4] = start
    y[4:6] = start[2:]
    first = shaking[0] + (0.0 if follow is None else pull[0] * (follow[0, 0] - y[0]) + pull[1] * (follow[0, 1] - y[1]))
    record = np.array([tuple(mechanism)], _RECORD)[0]
    y[15] = _amplified(first, record)
    return _integrate(
        record,
        y,
        np.ascontiguousarray(shaking, float),
        np.zeros((count, 2)) if follow is None else np.ascontiguousarray(follow, float),
        np.array(pull, float),
        nothing if brake is None else np.ascontiguousarray(brake, float),
        nothing if warm is None else np.ascontiguousarray(warm, float),
        float(dt),
        int(substeps),
    )
