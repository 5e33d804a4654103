"""Test functions of the weak form, and inner products of signals with them."""

import functools

import numpy as np
from jaxtyping import Float

WIDTHS = (12, 24, 48, 96, 192, 384)
"""Samples in the support of the test functions."""

TestFunctions = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Functions by row, with first and second derivatives."""


def against(
    signal: Float[np.ndarray, " samples"], functions: Float[np.ndarray, "functions width"], hop: int
) -> Float[np.ndarray, " rows"]:
    """Sums of a signal times each function, at windows `hop` samples apart."""
    windows = np.lib.stride_tricks.sliding_window_view(signal, functions.shape[1])[::hop]
    return (windows @ functions.T).ravel()


def solved(
    columns: Float[np.ndarray, "rows columns"], right: Float[np.ndarray, " rows"]
) -> Float[np.ndarray, " columns"]:
    """Least-squares solution, independent of the columns' units; zero for columns of zeros."""
    norm = np.linalg.norm(columns, axis=0)
    norm[norm == 0] = 1.0
    return np.linalg.lstsq(columns / norm, right, rcond=1e-10)[0] / norm


@functools.lru_cache(maxsize=32)
def bump_functions(width: int, dt: float) -> TestFunctions:
    """A bump (1 - s^2)^4 and its modulations, with first and second derivatives, sampled on the window."""
    t = (np.arange(width) - 0.5 * (width - 1)) * dt
    half = 0.5 * width * dt
    s = t / half
    bump = np.polynomial.Polynomial([1, 0, -1]) ** 4
    p, dp, ddp = bump(s), bump.deriv(1)(s) / half, bump.deriv(2)(s) / half**2
    tests, slopes, curvatures = [], [], []
    for k in range(4):
        w = np.pi * k / half
        for phase in (0.0, -0.5 * np.pi) if k else (0.0,):
            c, dc = np.cos(w * t + phase), -w * np.sin(w * t + phase)
            tests.append(p * c)
            slopes.append(dp * c + p * dc)
            curvatures.append(ddp * c + 2 * dp * dc - w**2 * p * c)
    return np.stack(tests), np.stack(slopes), np.stack(curvatures)


def blind_functions(width: int, dt: float) -> TestFunctions:
    """The modulations minus a multiple of the bump, so that their integral is zero."""
    tests, slopes, curvatures = bump_functions(width, dt)
    share = tests[1:].sum(axis=1, keepdims=True) / tests[0].sum()
    return tests[1:] - share * tests[0], slopes[1:] - share * slopes[0], curvatures[1:] - share * curvatures[0]
