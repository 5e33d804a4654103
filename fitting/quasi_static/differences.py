"""Central differences of functions of several parameters."""

from collections.abc import Callable

import numpy as np


def slopes(of: Callable[[np.ndarray], np.ndarray | float], at: np.ndarray, steps: np.ndarray) -> np.ndarray:
    """Derivatives of a function with respect to its parameters, (..., parameters).

    Args:
        of: The function.
        at: Parameters, (parameters,).
        steps: To either side, (parameters,).
    """
    ends = [(of(at + move), of(at - move)) for move in np.diag(steps)]
    return np.stack([(up - down) / (2.0 * step) for (up, down), step in zip(ends, steps, strict=True)], axis=-1)
