"""A baseline that predicts and names nothing: a polynomial autoregression of the dynamic error with the forcing.

Ridge regression on lagged samples and their cubes, thinned to about a dozen samples a natural period; order and ridge
are chosen by the free run on the last fifth of the training logs.
"""

from collections.abc import Sequence

import numpy as np

from undeclared.logs import Table
from undeclared.predictability import WINDOW

_ORDERS = (2, 4, 8)
_RIDGES = (1e-10, 1e-8, 1e-6, 1e-4)
_SAMPLES_A_PERIOD = 12


def black_box_error(tables: Sequence[Table], omega_0: float) -> float:
    """Rms error of its free run along the held-out log (the last table) [rad]; infinite where it leaves the numbers."""
    thin = max(1, int(2 * np.pi / omega_0 / tables[0].dt / _SAMPLES_A_PERIOD))
    logs = [_thinned(table, thin) for table in tables]
    x_size, f_size = np.std(logs[0][0]), np.std(logs[0][1])
    *seen, held_out = [(x / x_size, f / f_size) for x, f in logs]
    fitted = [(x[: int(0.8 * x.size)], f[: int(0.8 * x.size)]) for x, f in seen]
    judged = [(x[int(0.8 * x.size) :], f[int(0.8 * x.size) :]) for x, f in seen]
    best, coefficients, order = np.inf, None, 0
    for lags in _ORDERS:
        for ridge in _RIDGES:
            found = _fit(fitted, lags, ridge)
            error = max(_free_run_error(found, lags, x, f) for x, f in judged)
            if error < best:
                best, coefficients, order = error, found, lags
    return np.inf if coefficients is None else float(x_size * _free_run_error(coefficients, order, *held_out))


def _thinned(table: Table, thin: int) -> tuple[np.ndarray, np.ndarray]:
    """Every so many samples of x, and the mean of the forcing between them."""
    count = table.x.size // thin
    return table.x[: count * thin : thin], table.forcing[: count * thin].reshape(count, thin).mean(axis=1)


def _features(x: np.ndarray, f: np.ndarray) -> np.ndarray:
    """Of lags (..., order), newest last."""
    v = x[..., -1:] - x[..., -2:-1]
    newest = x[..., -1:]
    return np.concatenate([x, f, newest**3, newest**2, v**3, np.sign(v), newest**2 * v, np.ones_like(v)], axis=-1)


def _fit(logs: Sequence[tuple[np.ndarray, np.ndarray]], order: int, ridge: float) -> np.ndarray:
    rows, targets = [], []
    for x, f in logs:
        lags = np.arange(x.size - order)[:, None] + np.arange(order)
        rows.append(_features(x[lags], f[lags]))
        targets.append(x[order:])
    a, b = np.concatenate(rows), np.concatenate(targets)
    return np.linalg.solve(a.T @ a + ridge * len(a) * np.eye(a.shape[1]), a.T @ b)


def _free_run_error(coefficients: np.ndarray, order: int, x: np.ndarray, f: np.ndarray) -> float:
    """From the first samples, then on its own."""
    run = x.copy()
    for k in range(order, x.size):
        run[k] = _features(run[k - order : k], f[k - order : k]) @ coefficients
        if not abs(run[k]) < 1e3:
            return np.inf
    return float(np.sqrt(np.mean((run - x)[min(WINDOW, x.size // 2) :] ** 2)))
