"""One form of an effect: regressors beside the straight line, linear in their strengths.

twist = tau/K + zero of the log + sum of (strength times column)
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from fitting.quasi_static.intervals import Figure
from fitting.quasi_static.points import Points

START = "start"
"""Prefix of the names of initial states, whether shape parameters or strengths."""
REST = "rest"
"""Prefix of the names of a rest's level."""

Columns = Callable[[Points, np.ndarray], np.ndarray]


@dataclass(frozen=True, eq=False)
class Form:
    """One form of an effect.

    Attributes:
        family: Name of the effect, as reports use it.
        name: Of the form.
        columns: Regressors (n, strengths) at points, for given shape parameters.
        strengths: Names of the strengths.
        equation: Its contribution to the twist.
        figures: Its reported figures, as functions of compliance, strengths and shape parameters in a row.
        shapes: Starting values of the shape parameters, in rows of a grid, (grid, shape parameters).
        shape_names: Names of the shape parameters; those that begin with "log " are logarithms.
        range: Least and largest value of each shape parameter, (2, shape parameters).
        sign: Physical sign of the first strength; zero for either.
        of_torque: Whether its regressors depend on the torque, so that a torque error may imitate it.
        includes: Name of the form that it is a generalisation of, and that it replaces in an equation.
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
    includes: str = ""

    @property
    def size(self) -> int:
        """Number of strengths and shape parameters, without initial states."""
        return sum(not name.startswith(START) for name in (*self.strengths, *self.shape_names))

    @property
    def lasting(self) -> int:
        """Number of strengths, the first ones, that are common to all logs; the others belong to one log's start or
        rest."""
        return sum(not name.startswith((START, REST)) for name in self.strengths)


Terms = tuple[tuple[Form, np.ndarray], ...]
"""Forms of an equation, each with its shape parameters."""
