"""One form of an effect: columns beside the straight line, linear in their strengths.

twist = tau/K + zero of the log + sum of (strength times column)
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fitting.quasi_static.intervals import Figure
from fitting.quasi_static.points import Points

START = "start"
"""What names of initial states begin with, be they shape parameters or strengths."""
REST = "rest"
"""What names of a rest's own level begin with."""

Columns = Callable[[Points, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Form:
    """One form of an effect.

    Attributes:
        family: Name of the effect, as reports use it.
        name: Of the form.
        columns: Columns (n, strengths) at points, for given shape parameters.
        strengths: Names of the strengths.
        equation: What it adds to the twist.
        figures: What a reader wants to know of it, from compliance, strengths and shape parameters in a row.
        shapes: Values of the shape parameters to begin with, in rows of a grid, (grid, shape parameters).
        shape_names: Names of the shape parameters; those that begin with "log " are logarithms.
        range: Least and largest value of each shape parameter, (2, shape parameters).
        sign: Sign that physics asks of the first strength; zero for either.
        of_torque: Whether its columns follow the torque, so that an error of the torque may pass for it.
    """

    family: str
    name: str
    columns: Columns
    strengths: tuple[str, ...]
    equation: str
    figures: tuple[Figure, ...] = ()
    shapes: np.ndarray = field(default_factory=lambda: np.zeros((1, 0)))
    shape_names: tuple[str, ...] = ()
    range: np.ndarray = field(default_factory=lambda: np.zeros((2, 0)))
    sign: int = 0
    of_torque: bool = True

    @property
    def size(self) -> int:
        """Number of strengths and shape parameters; where a log begins is none of them."""
        return sum(not name.startswith(START) for name in (*self.strengths, *self.shape_names))

    @property
    def lasting(self) -> int:
        """Number of strengths, the first ones, that hold in any log; the others are of one log's start or rest."""
        return sum(not name.startswith((START, REST)) for name in self.strengths)


Terms = tuple[tuple[Form, np.ndarray], ...]
"""Forms of an equation, each with its shape parameters."""
