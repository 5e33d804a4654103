"""A baseline that names effects: greedy choice of weak-form regressors by BIC, as a strong user would script it.

Both equations of motion are multiplied by compact test functions and integrated by parts; every term that is linear in
its parameters is a column. Forward from K, K alpha, B_sp, each step adds the group of columns with the least BIC, until
none lowers it. Nothing is simulated, and internal states and widths are guessed on a small grid.
"""

from collections.abc import Sequence

import numpy as np
from numpy.polynomial import Polynomial
from scipy.signal import lfilter

from undeclared.logs import Table, rate

Column = tuple[np.ndarray, np.ndarray]
"""A term's signal in the motor's equation and in the load's."""

_MOST = 3


def greedy_bic(tables: Sequence[Table], omega_0: float) -> list[str]:
    """Families of the chosen groups, in the order of choice.

    Args:
        tables: the logs to fit.
        omega_0: natural frequency [rad/s], which sets the test functions' width.
    """
    parts = [_weak_log(table, omega_0) for table in tables]
    names = [name for name in parts[0][1] if name != "base"]
    left = np.concatenate([p[0] for p in parts], axis=1)
    groups = {name: np.concatenate([p[1][name] for p in parts], axis=1) for name in ("base", *names)}
    weight = 1 / np.std(left - groups["base"] @ _solve(groups["base"], left, np.ones(2)), axis=1)
    chosen: list[str] = []
    best = _bic(groups["base"], left, weight)
    while len(chosen) < _MOST:
        columns = {
            n: np.concatenate([groups[k] for k in ("base", *chosen, n)], axis=2) for n in names if n not in chosen
        }
        scores = {name: _bic(c, left, weight) for name, c in columns.items()}
        winner = min(scores, key=scores.__getitem__)
        if scores[winner] >= best:
            break
        best = scores[winner]
        chosen.append(winner)
    return list(dict.fromkeys(name.split(":")[0] for name in chosen))


def _solve(columns: np.ndarray, left: np.ndarray, weight: np.ndarray) -> np.ndarray:
    a = (weight[:, None, None] * columns).reshape(-1, columns.shape[-1])
    scale = np.linalg.norm(a, axis=0)
    scale[scale == 0] = 1.0
    return np.linalg.lstsq(a / scale, (weight[:, None] * left).ravel(), rcond=1e-10)[0] / scale


def _bic(columns: np.ndarray, left: np.ndarray, weight: np.ndarray) -> float:
    """Of Gaussian errors with a variance for each equation."""
    error = left - columns @ _solve(columns, left, weight)
    rows = left.shape[1]
    return float(rows * np.sum(np.log(np.mean(error**2, axis=1))) + columns.shape[-1] * np.log(2 * rows))


def _weak_log(table: Table, omega_0: float) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Left sides (2, windows) and groups of columns (2, windows, terms) of one log."""
    half = max(4, int(0.4 * 2 * np.pi / omega_0 / table.dt))
    s, unit = np.linspace(-1, 1, 2 * half + 1), half * table.dt
    bump = Polynomial([1, 0, -1]) ** 6
    plain, steep, curved = bump(s), bump.deriv()(s) / unit, bump.deriv(2)(s) / unit**2
    # The sums integrate a parabola exactly: angles of many revolutions are multiplied by this.
    curved -= np.mean(curved)
    curved *= 2 * np.sum(plain) / np.sum(curved * (unit * s) ** 2)
    # Of what is held between samples, the exact integral.
    held = np.append(np.diff(bump.integ()(s)) * half, 0.0)

    def weak(signal: np.ndarray, kernel: np.ndarray = plain) -> np.ndarray:
        return np.convolve(signal, kernel[::-1], mode="valid")[::half]

    c = table.columns
    brake = c.get("load_torque", np.zeros_like(table.x))
    left = np.stack(
        [
            table.motor_inertia * weak(c["motor_angle"], curved) - weak(c["motor_torque"], held),
            table.load_inertia * weak(c["load_angle"], curved) - weak(brake, held),
        ]
    )
    groups = {
        name: np.stack([np.stack([weak(m) for m, _ in terms], 1), np.stack([weak(load) for _, load in terms], 1)])
        for name, terms in _terms(table, omega_0).items()
    }
    x = table.x - np.mean(table.x)
    # With a constant, since the encoders' zeros are nobody's.
    spring = np.stack([weak(x), weak(x**3), -weak(x, steep), weak(np.ones_like(x))], 1)
    return left, {"base": np.stack([-spring / table.ratio, spring])} | groups


def _terms(table: Table, omega_0: float) -> dict[str, list[Column]]:
    """Groups of terms; a name is a family, with the form behind a colon."""
    c, x = table.columns, table.x - np.mean(table.x)
    phi, lam = c["motor_angle"], c["load_angle"]
    span = 0.3 * 2 * np.pi / omega_0
    v, w, r = (rate(signal, table.dt, span) for signal in (x, phi, lam))
    torque = 0.5 * (c["motor_torque"] + np.roll(c["motor_torque"], 1))
    zero, one = np.zeros_like(x), np.ones_like(x)
    size = float(np.std(x))

    def mesh(*signals: np.ndarray) -> list[Column]:
        return [(-s / table.ratio, s) for s in signals]

    def motor(*signals: np.ndarray) -> list[Column]:
        return [(s, zero) for s in signals]

    def load(*signals: np.ndarray) -> list[Column]:
        return [(zero, s) for s in signals]

    waves = [f(n * phi) for n in (1, 2, 4) for f in (np.cos, np.sin)]
    found = {
        "stiffness_shape:even": mesh(x**2),
        "stiffness_shape:quintic": mesh(x**5),
        "hysteresis:Dahl": mesh(_play(x, 0.3 * size)),
        "hysteresis:wide": mesh(_play(x, size)),
        "coulomb_friction": mesh(np.sign(v)),
        "nonlinear_damping:rate": mesh(v * np.abs(v)),
        "nonlinear_damping:twist": mesh(x**2 * v),
        "motor_friction": motor(np.sign(w), w),
        "load_friction": load(np.sign(r), r),
        "kinematic_error": mesh(*waves),
        "cogging": motor(*waves),
        "position_dependent_stiffness": mesh(*(x * wave for wave in waves[:4])),
        "position_dependent_friction": motor(np.sign(w), *(np.sign(w) * wave for wave in waves[:4])),
        "gravity_load": load(np.cos(lam), np.sin(lam)),
        "torque_sensor:bias": motor(one),
        "torque_sensor:gain": motor(torque),
        "input_delay": motor(np.gradient(torque, table.dt)),
        "extra_resonance": load(rate(rate(r, table.dt, span), table.dt, span)),
        "creep": mesh(_lagged(x, 0.2 / table.dt), _lagged(x, 1.0 / table.dt)),
        "encoder_offset": mesh(one),
        # An error of a reading is a torque that grows with the square of the speed.
        "encoder_eccentricity:motor": motor(*(w**2 * wave for wave in waves[:2])),
        "encoder_eccentricity:load": load(r**2 * np.cos(lam), r**2 * np.sin(lam), np.cos(lam) * w, np.sin(lam) * w),
    }
    for share in (0.1, 0.3, 1.0):
        found[f"backlash:{share}"] = mesh(np.clip(x, -share * size, share * size))
    line = _strongest_line(table, x, v)
    found["load_disturbance"] = load(np.cos(line * c["time"]), np.sin(line * c["time"]))
    if "temperature" in c:
        warm = c["temperature"] - 25.0
        found["temperature"] = mesh(warm * x, warm * v)
    return found


def _play(x: np.ndarray, width: float) -> np.ndarray:
    """A spring that slips at a width."""
    z = np.empty_like(x)
    last, before = 0.0, x[0]
    for i, now in enumerate(x.tolist()):
        last = min(max(last + now - before, -width), width)
        before = now
        z[i] = last
    return z


def _lagged(x: np.ndarray, samples: float) -> np.ndarray:
    keep = np.exp(-1 / samples)
    return lfilter([1 - keep], [1, -keep], x)


def _strongest_line(table: Table, x: np.ndarray, v: np.ndarray) -> float:
    """Rate [rad/s] of the load's strongest line that x and v do not explain."""
    columns = np.column_stack([x, x**3, v])
    push = table.load_inertia * rate(rate(table.columns["load_angle"], table.dt, 0.01), table.dt, 0.01)
    rest = push - columns @ np.linalg.lstsq(columns, push, rcond=None)[0]
    spectrum = np.abs(np.fft.rfft(rest * np.hanning(rest.size)))
    spectrum[:3] = 0
    return float(2 * np.pi * np.argmax(spectrum) / (rest.size * table.dt))
