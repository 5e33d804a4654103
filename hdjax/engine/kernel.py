"""A model's machine code, and its calls from JAX programs."""

import contextlib
import dataclasses
import functools
import importlib
import os
import threading
from collections.abc import Hashable, Iterator, Sequence
from contextvars import ContextVar
from typing import Literal, get_args

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from hdjax.dynamics import Model
from hdjax.engine.equations import LOAD, TEMPERATURE, Equations, equations, structure

# Modules that need llvmlite are imported on demand: without it XLA is used.
Mode = Literal["values", "jacobian"]
Wanted = Literal["jacobian", "products", "rows"]
"""Result of a march with derivatives: the Jacobian, products of its columns, or the rows alone."""

_LOCK = threading.Lock()


class Kernel(eqx.Module):
    """Machine code of a model's march.

    Attributes:
        paths: the parameters of its derivatives.
        acting: those of them that change the logged torque.
        signals: inputs other than the torque.
        hidden: number of hidden states.
        jacobian: address of the march with derivatives.
        values: address of the march without; None where it was not requested.
    """

    paths: tuple[str, ...] = eqx.field(static=True)
    acting: tuple[int, ...] = eqx.field(static=True)
    signals: tuple[str, ...] = eqx.field(static=True)
    hidden: int = eqx.field(static=True)
    jacobian: Int[np.ndarray | Array, ""]
    values: Int[np.ndarray | Array, ""] | None


@functools.cache
def unusable() -> str | None:
    """The reason why machine code is unavailable; None where it is available."""
    if jax.default_backend() != "cpu":
        return f"the computation runs on a {jax.default_backend()}"
    try:
        importlib.import_module("hdjax.engine.handler").register()
    except ImportError:
        return "llvmlite is not installed"
    except Exception as error:  # any failure of the compiler on an untested processor
        return f"no machine code can be made on this machine ({type(error).__name__}: {error})"
    return None


@dataclasses.dataclass
class _Made:
    equations: Equations
    addresses: dict[tuple[Mode, Hashable], int] = dataclasses.field(default_factory=dict)


_MADE: dict[Hashable, _Made] = {}


def kernel(
    model: Model,
    paths: Sequence[str],
    *,
    loaded: bool,
    warm: bool = True,
    solver: dfx.AbstractERK,
    values: bool = False,
) -> Kernel:
    """The machine code of a model, compiled once for all models of the same structure.

    Args:
        model: the equations.
        paths: dotted paths of the parameters of the derivatives.
        loaded: whether there is a load torque.
        warm: whether the drive's temperature is known.
        solver: explicit Runge-Kutta solver of diffrax; its tableau is used.
        values: whether to include the march without derivatives.

    Raises:
        ValueError: an effect needs an unknown temperature.
        UntranslatableError: the model uses an unsupported function.
    """
    warm = warm and any(e.needs_temperature for e in model.effects)
    signals = (LOAD,) * loaded + (TEMPERATURE,) * warm
    key = structure(model, paths, signals)
    with _LOCK:
        if key not in _MADE:
            _MADE[key] = _Made(equations(model, paths, signals))
        made = _MADE[key]
        jacobian = _address(made, "jacobian", solver)
        plain = _address(made, "values", solver) if values else None
    return Kernel(tuple(paths), made.equations.acting, signals, len(made.equations.prior.values), jacobian, plain)


def _address(made: _Made, mode: Mode, solver: dfx.AbstractERK) -> np.ndarray:
    key = mode, type(solver)
    if key not in made.addresses:
        from hdjax.engine.handler import register
        from hdjax.engine.machine import compiled
        from hdjax.engine.march import MARCH, March

        register()
        (made.addresses[key],) = compiled(March(made.equations, solver, mode).module, MARCH)
    return np.array(made.addresses[key], dtype=np.int64)


class Lanes(eqx.Module):
    """The data of a march, described at [`hdjax.engine.march.OPERANDS`][].

    Attributes:
        signals: coefficients of the torque, of other inputs, and of the torque's derivatives by the parameters that
            change it.
    """

    free: Float[Array | np.ndarray, " width"]
    slopes: Float[Array | np.ndarray, " width"]
    constants: Float[Array | np.ndarray, " constants"]
    states: Float[Array | np.ndarray, "segments states"]
    knots: Float[Array | np.ndarray, "segments knots"]
    measured: Float[Array | np.ndarray, "segments samples outputs"]
    weight: Float[Array | np.ndarray, "segments samples"]
    joined: Float[Array | np.ndarray, " segments"]
    whitening: Float[Array | np.ndarray, "outputs outputs"]
    settings: Int[Array | np.ndarray, "3"]
    signals: tuple[Float[Array | np.ndarray, "segments _ _"], ...]


class Marched(eqx.Module):
    """Results of a march: whitened rows, final states of segments, and their derivatives on request."""

    rows: Float[Array | np.ndarray, "segments rows"]
    end: Float[Array | np.ndarray, "segments states"]
    by_parameter: Float[Array | np.ndarray, "segments height width"] | None = None
    by_state: Float[Array | np.ndarray, "segments height states"] | None = None
    end_by_parameter: Float[Array | np.ndarray, "segments ends width"] | None = None
    end_by_state: Float[Array | np.ndarray, "segments ends states"] | None = None
    products: Float[Array | np.ndarray, "segments columns columns"] | None = None


def march_lanes(
    address: Int[Array | np.ndarray, ""], lanes: Lanes, hidden: int, mode: Mode, wanted: Wanted = "jacobian"
) -> Marched:
    """March all segments by machine code, inside or outside JAX programs.

    Args:
        address: of the code.
        lanes: the data.
        hidden: number of hidden states.
        mode: with derivatives or without.
        wanted: of a march with derivatives.
    """
    from hdjax.engine.handler import register

    shapes = result_shapes(lanes, hidden, mode, wanted)
    results = [jax.ShapeDtypeStruct(shape, np.dtype("float64")) for shape in shapes]
    call = jax.ffi.ffi_call(register(), results, vmap_method="sequential")
    return Marched(*call(*_operands(address, lanes, wanted)))


def _operands(address: Int[Array | np.ndarray, ""], lanes: Lanes, wanted: Wanted) -> list[Array | np.ndarray]:
    """Operands in the order of [`hdjax.engine.march.OPERANDS`][], followed by the signals."""
    asked = np.array([get_args(Wanted).index(wanted)])
    # Outside a JAX program nothing is compiled.
    library = jnp if isinstance(lanes.settings, Tracer) else np
    operands = vars(lanes) | {"settings": library.concatenate([lanes.settings, asked])}
    return [address, *(operands[f.name] for f in dataclasses.fields(lanes) if f.name != "signals"), *lanes.signals]


def result_shapes(lanes: Lanes, hidden: int, mode: Mode, wanted: Wanted) -> list[tuple[int, ...]]:
    """Shapes of the results of a march, in the order of [`Marched`][]; arguments as in [`march_lanes`][]."""
    segments, samples, outputs = lanes.measured.shape
    states, width = lanes.states.shape[1], lanes.free.shape[0]
    rows = samples * outputs + hidden
    shapes = [(segments, rows), (segments, states)]
    if mode == "jacobian":
        height = rows if wanted == "jacobian" else 0
        ends = 0 if wanted == "rows" else states
        columns = width + states + 1 if wanted == "products" else 0
        shapes += [(segments, height, width), (segments, height, states), (segments, ends, width)]
        shapes += [(segments, ends, states), (segments, columns, columns)]
    return shapes


def march_arrays(
    address: Int[Array | np.ndarray, ""], lanes: Lanes, hidden: int, mode: Mode, wanted: Wanted = "jacobian"
) -> Marched:
    """[`march_lanes`][] outside JAX programs, on numpy arrays, without compilation for their shapes."""
    from hdjax.engine.handler import called

    results = [np.empty(shape) for shape in result_shapes(lanes, hidden, mode, wanted)]
    called(int(address), [np.ascontiguousarray(a) for a in _operands(address, lanes, wanted)], results)
    return Marched(*results)


_ALONE = ContextVar("_ALONE", default=False)


@contextlib.contextmanager
def one_thread() -> Iterator[None]:
    """Context in which marches use the calling thread only, for work that is already parallel."""
    token = _ALONE.set(True)
    try:
        yield
    finally:
        _ALONE.reset(token)


def threads() -> int:
    """Number of threads of a march: the available processors, or one within [`one_thread`][]."""
    return 1 if _ALONE.get() else _processors()


@functools.cache
def _processors() -> int:
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
