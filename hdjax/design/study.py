"""A design study: variables, objective, limits and uncertain parameters."""

import abc
import dataclasses
from collections.abc import Mapping

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdjax.design.case import Case
from hdjax.design.measure import Measure, number
from hdjax.design.response_measures import ResponseMeasure, responses
from hdjax.design.robustness import CRITERIA, Criterion, Draws, worst_share
from hdjax.design.variables import Variable, values
from hdjax.parameters import Scalar
from hdjax.where import where

LANES = 4
"""Default number of designs evaluated in parallel: constant, so that one program serves all."""


class Maker(eqx.Module):
    """Creates the case of a design."""

    @abc.abstractmethod
    def __call__(self, case: Case, chosen: Mapping[str, Array]) -> Case:
        """A case with the design's values, from one with drawn values."""


class Replaced(Maker):
    """The case with the design's values in place of its own."""

    def __call__(self, case: Case, chosen: Mapping[str, Array]) -> Case:
        return case.replace(chosen)


class Term(eqx.Module):
    """A part of the objective, `weight` times a measure; a negative weight maximises it.

    Attributes:
        label: name of the part.
        measure: of the case.
        weight: price of one unit of the measure.
    """

    label: str = eqx.field(static=True)
    measure: Measure
    weight: Scalar = number(1.0)


class Limit(eqx.Module):
    """A constraint: a measure that must be at most, or at least, so much.

    Attributes:
        label: name of the constraint.
        measure: of the case.
        bound: in the measure's unit.
        least: whether the bound is the least rather than the most.
    """

    label: str = eqx.field(static=True)
    measure: Measure
    bound: Scalar = number()
    least: bool = eqx.field(static=True, default=False)

    @property
    def scale(self) -> Array:
        """Size of the bound; 1 for a bound of zero."""
        return where(self.bound == 0.0, 1.0, jnp.abs(self.bound))

    def excess(self, value: Array) -> Array:
        """Excess of a value over the bound, in units of `scale`; positive where the limit is violated."""
        return (self.bound - value if self.least else value - self.bound) / self.scale


class Study(eqx.Module):
    """A design study.

    Attributes:
        case: supplies all that is not a variable.
        variables: of the design.
        terms: of the objective, which is minimised.
        limits: constraints.
        draws: of uncertain parameters; a parameter that is also a variable takes the design's value. None for no
            uncertainty.
        criterion: for objective and constraints over the draws.
        share: of the draws that make up the worst.
        maker: creates a case from the design's values.
    """

    case: Case
    variables: tuple[Variable, ...]
    terms: tuple[Term, ...]
    limits: tuple[Limit, ...] = ()
    draws: Draws | None = None
    criterion: Criterion = eqx.field(static=True, default="expected")
    share: float = eqx.field(static=True, default=0.05)
    maker: Maker = Replaced()

    def __check_init__(self):
        if not self.variables or not self.terms:
            raise ValueError("a study must have a variable and a term of its objective at least")
        labels = [t.label for t in (*self.terms, *self.limits)]
        paths = [v.path for v in self.variables]
        for name in (*labels, *paths):
            if labels.count(name) > 1 or paths.count(name) > 1:
                raise ValueError(f"`{name}` must be named once, but is named twice")
        if self.criterion not in CRITERIA:
            raise ValueError(f"`criterion` must be one of {CRITERIA}, but is {self.criterion!r}")
        if not 0.0 < self.share < 1.0:
            raise ValueError(f"`share` must be between 0 and 1, but is {self.share}")

    def refuse(self) -> None:
        """Refuse a study that is not valid, before the computation.

        Raises:
            ValueError: a path, a range, a draw or a measure does not suit the drive.
        """
        known = self.case.parameters()
        for v in self.variables:
            low, high = known[v.path][1].bounds if v.path in known else (-jnp.inf, jnp.inf)
            if not low <= float(v.low) < float(v.high) <= high:
                raise ValueError(
                    f"`{v.path}` must stay between {low:g} and {high:g}, but its range is {v.low:g} to {v.high:g}"
                )
        middle = self.made(jnp.full(len(self.variables), 0.5), None if self.draws is None else self.draws.values[0])
        for part in (*self.terms, *self.limits):
            part.measure.refuse(middle)

    def made(self, shares: Float[Array, " variables"], draw: Float[Array, " paths"] | None = None) -> Case:
        """The case at shares of the variables' ranges, and a draw."""
        case = self.case if self.draws is None or draw is None else self.case.replace(self.draws.at(draw))
        return self.maker(case, values(self.variables, shares))

    def measured(self, case: Case) -> Float[Array, " parts"]:
        """All measures of a case: those of terms, then of limits."""
        measures = [part.measure for part in (*self.terms, *self.limits)]
        steady = [m for m in measures if isinstance(m, ResponseMeasure)]
        found = iter(responses(case, steady))
        return jnp.stack([next(found) if isinstance(m, ResponseMeasure) else m(case) for m in measures])

    def rows(self, measured: Float[Array, " parts"]) -> Float[Array, " rows"]:
        """Objective and the excess over each limit."""
        objective = sum(t.weight * measured[i] for i, t in enumerate(self.terms))
        excess = [limit.excess(measured[len(self.terms) + i]) for i, limit in enumerate(self.limits)]
        return jnp.stack([jnp.asarray(objective), *excess])

    def judged(self, shares: Float[Array, " variables"]) -> tuple[Array, tuple[Array, Array]]:
        """Rows by the criterion; also the rows and the measures of every draw."""
        if self.draws is None:
            parts = self.measured(self.made(shares))[None]
        else:
            parts = jax.vmap(lambda draw: self.measured(self.made(shares, draw)))(self.draws.values)
        rows = jax.vmap(self.rows)(parts)
        if self.draws is None or self.criterion == "expected":
            judged = jnp.mean(rows, axis=0)
        else:
            judged = jax.vmap(lambda column: worst_share(column, self.share))(rows.T)
        return judged, (judged, parts)


@dataclasses.dataclass(frozen=True)
class Appraisals:
    """Evaluations of designs.

    Attributes:
        rows: objective, then the excess over each limit, by design; NaN where a measure does not exist.
        slopes: of the rows by the shares of the variables' ranges.
        parts: each measure of each draw (one draw without uncertainty).
    """

    rows: Float[np.ndarray, "designs rows"]
    slopes: Float[np.ndarray, "designs rows variables"]
    parts: Float[np.ndarray, "designs draws parts"]


def appraise(study: Study, shares: Float[np.ndarray, "designs variables"], *, lanes: int = LANES) -> Appraisals:
    """Objective, constraints and their gradients of many designs, in batches of `lanes` by one program."""
    found = []
    for start in range(0, len(shares), lanes):
        block = shares[start : start + lanes]
        padded = np.concatenate([block, np.repeat(block[-1:], lanes - len(block), axis=0)])
        rows, slopes, parts = _appraised(study, jnp.asarray(padded))
        found.append([np.asarray(a)[: len(block)] for a in (rows, slopes, parts)])
    rows, slopes, parts = (np.concatenate(column) for column in zip(*found, strict=True))
    return Appraisals(rows, slopes, parts)


@eqx.filter_jit
def _appraised(study: Study, shares: Array) -> tuple[Array, Array, Array]:
    def of_one(row: Array) -> tuple[Array, Array, Array]:
        slopes, (rows, parts) = jax.jacfwd(study.judged, has_aux=True)(row)
        return rows, slopes, parts

    return jax.vmap(of_one)(shares)
