"""What a sweep's route is checked on, and how far it was right."""

import dataclasses

import numpy as np
from jaxtyping import Int

from hdjax.sweep.request import Request

SAMPLED = 64
"""Points that a route is chosen on, and as many others that it is checked on."""


@dataclasses.dataclass(frozen=True)
class Check:
    """A route against the reference on points that it was not chosen on.

    Attributes:
        points: how many were drawn.
        unfinished: how many of them the reference could not integrate.
        error: largest error, as a part of each motion's largest |x|.
        median: the median over the points.
        reference: what the reference was.
    """

    points: int
    unfinished: int
    error: float
    median: float
    reference: str


def drawn_points(request: Request) -> tuple[Int[np.ndarray, " pilot"], Int[np.ndarray, " check"]]:
    """Points to choose a route on, and others to check it on; the same where the sweep has too few."""
    random = np.random.default_rng(request.seed)
    size = request.points.size
    if size <= 2 * SAMPLED:
        every = np.arange(size)
        return every[:: -(-size // SAMPLED)], every[-SAMPLED:]
    found = np.unique(random.integers(0, size, 4 * SAMPLED))
    random.shuffle(found)
    return found[:SAMPLED], found[SAMPLED : 2 * SAMPLED]
