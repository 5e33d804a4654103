"""Transients of any effects by machine code: fixed steps of the Runge-Kutta methods of diffrax."""

from collections.abc import Hashable, Mapping, Sequence
from typing import Literal

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from hdjax.engine import UntranslatableError, threads, unusable
from hdjax.engine.equations import structure
from hdjax.engine.forced import Drawn, forced
from hdjax.sweep.request import Case, Request, duration
from hdjax.sweep.runge_kutta import twist
from hdjax.sweep.windows import Windows, largest_between

Tableau = Literal["tsit5", "dopri8"]
SOLVERS: dict[Tableau, dfx.AbstractERK] = {"tsit5": dfx.Tsit5(), "dopri8": dfx.Dopri8()}
NAMES: dict[Tableau, str] = {"tsit5": "Tsit5", "dopri8": "Dopri8"}

_MADE: dict[Hashable, int | None] = {}


def address(case: Case, request: Request, tableau: Tableau) -> int | None:
    """Address of the machine code for a request's transients; None if unavailable for this machine or model.

    Args:
        case: the model and its forcing.
        request: of the sweep.
        tableau: the Runge-Kutta method.
    """
    paths = request.points.paths
    key = structure(case, paths, ()), type(case.forcing), request.duration is None, request.peaks, tableau
    if key not in _MADE:
        _MADE[key] = _compiled(case, request, tableau) if unusable() is None else None
    return _MADE[key]


def _compiled(case: Case, request: Request, tableau: Tableau) -> int | None:
    # Modules that need llvmlite are imported only if it is installed.
    from hdjax.engine.transient import made

    arrays, rest = eqx.partition(case, eqx.is_inexact_array)
    leaves, tree = jax.tree.flatten(arrays)
    paths = request.points.paths

    def drawn(numbers: Sequence[Array]) -> Drawn:
        *own, length = numbers[len(paths) :]
        whole = eqx.combine(tree.unflatten(own), rest).at(dict(zip(paths, numbers, strict=False)))
        unit = (1.0, None) if request.periods is None else (None, 1.0)
        return Drawn(whole.model, whole.forcing, length * duration(whole, *unit))

    shapes = [*(() for _ in paths), *(np.shape(leaf) for leaf in leaves), ()]
    try:
        return made(forced(drawn, shapes, twist, largest_between), SOLVERS[tableau], peaks=request.peaks)
    except UntranslatableError:
        return None


def transients_by_code(
    address: int, case: Case, request: Request, values: Mapping[str, Float[np.ndarray, " points"]], substeps: int
) -> Windows:
    """The motions of points from rest.

    Args:
        address: of the machine code for this request.
        case: the model and its forcing.
        request: of the sweep.
        values: parameters of the points, by path.
        substeps: steps in a window.
    """
    from hdjax.engine.transient import run

    columns = [np.asarray(values[path], dtype=float) for path in request.points.paths]
    leaves = jax.tree.leaves(eqx.filter(case, eqx.is_inexact_array))
    length = np.array([request.duration or request.periods])
    same = np.concatenate([*(np.ravel(np.asarray(leaf)) for leaf in leaves), length])
    numbers = np.concatenate([columns, np.broadcast_to(same[:, None], (len(same), len(columns[0])))])
    found = run(address, numbers, windows=request.windows, substeps=substeps, threads=threads())
    return Windows(*map(jnp.asarray, found))
