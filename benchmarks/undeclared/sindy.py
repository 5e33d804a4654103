"""A baseline from the literature: sparse regression of x'' by PySINDy, where that is installed.

Brunton, Proctor, Kutz 2016 (PNAS 113, 3932); de Silva et al. 2020 (JOSS 5, 2104).
"""

from collections.abc import Sequence
from importlib.util import find_spec

import numpy as np

from undeclared.logs import Table, rate

_THRESHOLDS = (0.003, 0.01, 0.03, 0.1)


def _sign(signal):
    return np.sign(signal)


def sindy_is_there() -> bool:
    """Whether PySINDy can be imported."""
    return find_spec("pysindy") is not None


def sindy_error(tables: Sequence[Table], omega_0: float) -> tuple[float, list[str]]:
    """Rms error of its free run along the held-out log (the last table) [rad], and the terms that it kept.

    x and v are measured and smoothed in scaled units; the library holds polynomials to the third degree, signs, and the
    forcing. The threshold is the one whose free run along the second log is best.
    """
    import pysindy

    size, force = np.std(tables[0].x), np.std(tables[0].forcing)
    span = 0.3 * 2 * np.pi / omega_0
    scaled = []
    for table in tables:
        x = table.x / size
        v = rate(table.x, table.dt, span) / (size * omega_0)
        scaled.append((np.column_stack([x, v]), table.forcing[:, None] / force))
    dt = tables[0].dt * omega_0
    best, kept, errors = np.inf, None, None
    for threshold in _THRESHOLDS:
        library = pysindy.PolynomialLibrary(degree=3) + pysindy.CustomLibrary(
            [_sign], function_names=[lambda name: f"sgn({name})"]
        )
        model = pysindy.SINDy(
            optimizer=pysindy.STLSQ(threshold=threshold),
            feature_library=library,
            differentiation_method=pysindy.SmoothedFiniteDifference(),
        )
        model.fit([s for s, _ in scaled[:2]], t=dt, u=[u for _, u in scaled[:2]], feature_names=["x", "v", "f"])
        weights, names = np.asarray(model.coefficients())[1], model.get_feature_names()
        terms = [(n, w) for n, w in zip(names, weights, strict=True) if w]
        error = _free_run_error(terms, *scaled[1], dt)
        if error < best:
            best, kept = error, [n for n, _ in terms]
            errors = _free_run_error(terms, *scaled[2], dt)
    return (np.inf, []) if errors is None or kept is None else (float(size * errors), kept)


def _free_run_error(terms: Sequence[tuple[str, float]], states: np.ndarray, forcing: np.ndarray, dt: float) -> float:
    """Of x'' = sum of terms, by RK4 with the forcing held; x' = v holds by definition."""
    code = [(compile(n.replace("^", "**").replace(" ", "*"), n, "eval"), w) for n, w in terms]

    def slope(y, f):
        known = {"x": y[0], "v": y[1], "f": f, "sgn": np.sign, "__builtins__": {}}
        return np.array([y[1], sum(w * eval(c, known) for c, w in code)])

    y, total = states[0].copy(), 0.0
    for k in range(len(states)):
        total += (y[0] - states[k, 0]) ** 2
        if not total < 1e6 * len(states):
            return np.inf
        f = forcing[k, 0]
        k1 = slope(y, f)
        k2 = slope(y + 0.5 * dt * k1, f)
        k3 = slope(y + 0.5 * dt * k2, f)
        y = y + dt / 6 * (k1 + 2 * (k2 + slope(y + 0.5 * dt * k2, f)) + slope(y + dt * k3, f))
    return float(np.sqrt(total / len(states)))
