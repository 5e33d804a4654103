"""Check of a sweep's method on random points."""

import dataclasses

import numpy as np
from jaxtyping import Int

from hdjax.sweep.request import Request

SAMPLED = 64
"""Number of points to choose a method, and of others to check it."""


@dataclasses.dataclass(frozen=True)
class Check:
    """Errors of a method against the reference, on points that were not used to choose it.

    Attributes:
        points: number of drawn ones.
        unfinished: number of points that the reference could not integrate.
        error: largest error, as a part of each motion's largest |x|.
        median: the median over the points.
        reference: description of the reference.
    """

    points: int
    unfinished: int
    error: float
    median: float
    reference: str


def drawn_points(request: Request) -> tuple[Int[np.ndarray, " pilot"], Int[np.ndarray, " check"]]:
    """Points to choose a method, and others to check it; the same if the sweep has too few."""
    random = np.random.default_rng(request.seed)
    size = request.points.size
    if size <= 2 * SAMPLED:
        every = np.arange(size)
        return every[:: -(-size // SAMPLED)], every[-SAMPLED:]
    found = np.unique(random.integers(0, size, 4 * SAMPLED))
    random.shuffle(found)
    return found[:SAMPLED], found[SAMPLED : 2 * SAMPLED]
