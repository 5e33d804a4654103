"""Points of a sweep: a grid of axes, and a joint sample of further parameters."""

import dataclasses
import math
from collections.abc import Mapping
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import qmc

Spacing = Literal["linear", "log"]
Rule = Literal["latin-hypercube", "sobol", "random"]
RULES: tuple[Rule, ...] = get_args(Rule)
SAMPLE = "sample"


@dataclasses.dataclass(frozen=True)
class Points:
    """Points of a sweep: every combination of the axes' values, with every row of the sample.

    Attributes:
        axes: values of each axis by parameter path, in the order of the result's dimensions.
        sample: columns of equal length by parameter path; a further dimension `sample`.
    """

    axes: Mapping[str, Float[np.ndarray, " values"]] = dataclasses.field(default_factory=dict)
    sample: Mapping[str, Float[np.ndarray, " rows"]] = dataclasses.field(default_factory=dict)

    def __post_init__(self):
        for name, values in (*self.axes.items(), *self.sample.items()):
            if values.ndim != 1 or values.size == 0 or not np.isfinite(values).all():
                raise ValueError(f"`{name}` must be a list of finite numbers with at least one, but is {values!r}")
        both = sorted(set(self.axes) & set(self.sample))
        if both:
            raise ValueError(f"`{both[0]}` must be an axis or a column of the sample, but is both")
        if len({len(v) for v in self.sample.values()}) > 1:
            raise ValueError("`sample` must have columns of equal length")
        if not self.axes and not self.sample:
            raise ValueError("a sweep must have an axis or a sample, but has neither")

    @property
    def shape(self) -> dict[str, int]:
        """Length of each dimension by name."""
        found = {name: len(values) for name, values in self.axes.items()}
        if self.sample:
            found[SAMPLE] = len(next(iter(self.sample.values())))
        return found

    @property
    def size(self) -> int:
        """Number of points."""
        return math.prod(self.shape.values())

    @property
    def paths(self) -> tuple[str, ...]:
        """The parameters that vary."""
        return (*self.axes, *self.sample)

    def column(self, path: str) -> Float[np.ndarray, " values"] | None:
        """All values of a parameter; None if it does not vary."""
        return self.axes.get(path, self.sample.get(path))

    def values(self, points: Int[np.ndarray, " points"]) -> dict[str, Float[np.ndarray, " points"]]:
        """The parameters' values at points, numbered with the last dimension fastest."""
        index = dict(zip(self.shape, np.unravel_index(points, tuple(self.shape.values())), strict=True))
        found = {name: np.asarray(values)[index[name]] for name, values in self.axes.items()}
        return found | {name: np.asarray(column)[index[SAMPLE]] for name, column in self.sample.items()}


def spread_values(start: float, end: float, points: int, spacing: Spacing = "linear") -> Float[np.ndarray, " points"]:
    """Values from `start` to `end`, evenly spaced, linearly or logarithmically."""
    if spacing == "log" and not (start > 0.0 and end > 0.0):
        raise ValueError(f"`start` and `end` must be positive for a log spacing, but are {start} and {end}")
    return np.geomspace(start, end, points) if spacing == "log" else np.linspace(start, end, points)


def drawn(
    ranges: Mapping[str, tuple[float, float, Spacing]], points: int, *, rule: Rule = "latin-hypercube", seed: int = 0
) -> dict[str, Float[np.ndarray, " points"]]:
    """A sample of several parameters at once.

    Args:
        ranges: lower end, upper end and spacing by parameter path.
        points: rows of the sample; a power of two keeps the balance of a Sobol sequence.
        rule: sampling of the unit cube (scipy.stats.qmc).
        seed: of the sample.
    """
    if rule not in RULES:
        raise ValueError(f"`rule` must be one of {RULES}, but is {rule!r}")
    width = len(ranges)
    if rule == "random":
        cube = np.random.default_rng(seed).random((points, width))
    elif rule == "sobol":
        # The next power of two: SciPy warns for other sizes.
        cube = qmc.Sobol(width, rng=seed).random_base2(max(points - 1, 0).bit_length())[:points]
    else:
        cube = qmc.LatinHypercube(width, rng=seed).random(points)
    found = {}
    for column, (name, (start, end, spacing)) in zip(cube.T, ranges.items(), strict=True):
        ends = spread_values(start, end, 2, spacing)
        logarithmic = spacing == "log"
        low, high = np.log(ends) if logarithmic else ends
        at = low + column * (high - low)
        found[name] = np.exp(at) if logarithmic else at
    return found
