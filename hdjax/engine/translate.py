"""From JAX's intermediate language to a graph of scalars: arrays are small, and each entry is a node of its own."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from hdjax.elementary import cosine_and_sine
from hdjax.engine.derivatives import Tangent, derivatives
from hdjax.engine.graph import Graph, Node
from hdjax.where import where

Nodes = np.ndarray[Any, np.dtype[np.object_]]
"""Nodes in the shape of an array."""

# A product of matrices with so many multiplications is no longer written out one by one.
_LARGE = 64
_LONGEST_LOOP = 64


class UntranslatableError(Exception):
    """A function that the graph has no words for."""


def traced(function: Callable[..., Any], *examples: Any) -> ClosedJaxpr:
    """The function in JAX's language, at arguments like the examples."""
    return jax.make_jaxpr(function)(*examples)


def translated(
    graph: Graph, program: ClosedJaxpr, arguments: Sequence[Nodes], *, values_only: bool = False
) -> list[Nodes]:
    """Add a program to a graph.

    Args:
        graph: takes up its nodes.
        program: in JAX's language.
        arguments: nodes for each of its inputs.
        values_only: leave out the derivatives that functions in it bring along.

    Returns:
        Nodes of each of its outputs.

    Raises:
        UntranslatableError: for a primitive that is not known here, by its name.
    """
    constants = [_constants(graph, c) for c in program.consts]
    return _run(graph, program.jaxpr, constants, arguments, values_only)


def _run(
    graph: Graph, jaxpr: Jaxpr, constants: Sequence[Nodes], arguments: Sequence[Nodes], values_only: bool
) -> list[Nodes]:
    value: dict[Any, Nodes] = dict(zip(jaxpr.constvars, constants, strict=True))
    value |= dict(zip(jaxpr.invars, arguments, strict=True))

    def read(variable: Any) -> Nodes:
        return _constants(graph, variable.val) if isinstance(variable, Literal) else value[variable]

    for equation in jaxpr.eqns:
        found = _translate(graph, equation, [read(v) for v in equation.invars], values_only)
        value |= dict(zip(equation.outvars, found, strict=True))
    return [read(v) for v in jaxpr.outvars]


def _constants(graph: Graph, array: Any) -> Nodes:
    array = np.asarray(array)
    if array.dtype != bool and not np.issubdtype(array.dtype, np.number):
        raise UntranslatableError(f"a constant of type {array.dtype}")
    found = np.empty(array.shape, dtype=object)
    for index in np.ndindex(array.shape):
        value = array[index].item()
        found[index] = graph.constant(value if isinstance(value, bool) else float(value))
    return found


def _translate(graph: Graph, equation: Any, arguments: list[Nodes], values_only: bool) -> list[Nodes]:
    name, parameters = equation.primitive.name, equation.params
    inner = parameters.get("jaxpr") or parameters.get("call_jaxpr")
    if name in ("pjit", "jit", "closed_call", "remat2", "checkpoint", "custom_vjp_call"):
        closed = inner if isinstance(inner, ClosedJaxpr) else ClosedJaxpr(inner, ())
        return translated(graph, closed, arguments, values_only=values_only)
    if name == "custom_jvp_call":
        return _with_own_derivative(graph, parameters, arguments, values_only)
    if name == "scan":
        return _unrolled(graph, parameters, arguments, values_only)
    if name in _ELEMENTWISE:
        return [_each(functools.partial(_ELEMENTWISE[name], graph, equation), *arguments)]
    if name in _STRUCTURAL:
        return [np.asarray(_STRUCTURAL[name](graph, equation, *arguments), dtype=object)]
    raise UntranslatableError(f"the primitive `{name}`")


def _each(rule: Callable[..., Node], *arguments: Nodes) -> Nodes:
    """Apply a rule entry by entry."""
    arrays = np.broadcast_arrays(*arguments) if len(arguments) > 1 else list(arguments)
    found = np.empty(arrays[0].shape, dtype=object)
    for index in np.ndindex(found.shape):
        found[index] = rule(*(a[index] for a in arrays))
    return found


def _with_own_derivative(
    graph: Graph, parameters: dict[str, Any], arguments: list[Nodes], values_only: bool
) -> list[Nodes]:
    """A function that brings its own rule of differentiation."""
    values = translated(graph, parameters["call_jaxpr"], arguments, values_only=values_only)
    if values_only:
        return values
    entries = [(k, index) for k, a in enumerate(arguments) for index in np.ndindex(a.shape)]
    moving = [e for e in entries if graph.known(arguments[e[0]].item(*e[1])) is None]
    if not moving:
        return values
    rule, constants, zeros = parameters["jvp_jaxpr_fun"].call_wrapped(*(False for _ in arguments))
    # The rule is linear in the tangents: of what it makes of them the derivatives by each are the partial ones.
    tangents = [np.full(a.shape, graph.constant(0.0), dtype=object) for a in arguments]
    seeds: dict[Node, Tangent] = {}
    for k, index in moving:
        tangents[k][index] = leaf = graph.leaf(("tangent", k, index))
        seeds[leaf] = {(k, index): graph.constant(1.0)}
    # The rule may call the function itself.
    found = translated(graph, ClosedJaxpr(rule, constants), [*arguments, *tangents], values_only=True)[len(values) :]
    along = iter(found)
    moved = [None if zero else next(along) for zero in zeros]
    wanted: list[Node] = [m.item(*i) for m in moved if m is not None for i in np.ndindex(m.shape)]
    partials = derivatives(graph, wanted, seeds)
    results = []
    for value, change in zip(values, moved, strict=True):
        result = np.empty(value.shape, dtype=object)
        for place in np.ndindex(value.shape):
            own = {} if change is None else partials[change.item(*place)]
            given = [n for (k, index), slope in own.items() for n in (arguments[k].item(*index), slope)]
            result[place] = graph.apply("given", value.item(*place), *given) if given else value[place]
        results.append(result)
    return results


def _unrolled(graph: Graph, parameters: dict[str, Any], arguments: list[Nodes], values_only: bool) -> list[Nodes]:
    """A short loop, written out."""
    length, body = parameters["length"], parameters["jaxpr"]
    if length > _LONGEST_LOOP:
        raise UntranslatableError(f"a loop of {length} rounds")
    fixed, carried = parameters["num_consts"], parameters["num_carry"]
    constants, carry, rows = arguments[:fixed], arguments[fixed : fixed + carried], arguments[fixed + carried :]
    stacked: list[list[Nodes]] = []
    rounds = range(length)
    for i in reversed(rounds) if parameters["reverse"] else rounds:
        inputs = [*constants, *carry, *(np.asarray(r[i], dtype=object) for r in rows)]
        found = translated(graph, body, inputs, values_only=values_only)
        carry = found[:carried]
        stacked.append(found[carried:])
    if parameters["reverse"]:
        stacked.reverse()
    return [*carry, *(np.stack(column) for column in zip(*stacked, strict=True))]


def _operation(name: str) -> Callable[..., Node]:
    return lambda graph, equation, *nodes: graph.apply(name, *nodes)


def _by_jax(function: Callable[..., Any]) -> Callable[..., Node]:
    """A function of scalars made of such as are known here."""

    @functools.cache
    def program(count: int) -> ClosedJaxpr:
        with jax.enable_x64(True):
            return traced(function, *(np.float64(0.5) for _ in range(count)))

    def rule(graph: Graph, equation: Any, *nodes: Node) -> Node:
        (found,) = translated(graph, program(len(nodes)), [np.array(n, dtype=object) for n in nodes])
        return found.item()

    return rule


def _towards_zero(graph: Graph, a: Node) -> Node:
    positive = graph.apply("ge", a, graph.constant(0.0))
    return graph.apply("select", positive, graph.apply("floor", a), graph.apply("ceil", a))


def _divide(graph: Graph, equation: Any, a: Node, b: Node) -> Node:
    quotient = graph.apply("div", a, b)
    return _towards_zero(graph, quotient) if np.issubdtype(equation.outvars[0].aval.dtype, np.integer) else quotient


def _remainder(graph: Graph, equation: Any, a: Node, b: Node) -> Node:
    whole = _towards_zero(graph, graph.apply("div", a, b))
    return graph.apply("sub", a, graph.apply("mul", whole, b))


def _convert(graph: Graph, equation: Any, a: Node) -> Node:
    kind, came = equation.params["new_dtype"], equation.invars[0].aval.dtype
    to_truth, from_truth = np.issubdtype(kind, np.bool_), np.issubdtype(came, np.bool_)
    if to_truth and not from_truth:
        return graph.apply("ne", a, graph.constant(0.0))
    if from_truth and not to_truth:
        return graph.apply("select", a, graph.constant(1.0), graph.constant(0.0))
    if np.issubdtype(kind, np.integer) and np.issubdtype(came, np.floating):
        return _towards_zero(graph, a)
    return a


def _choose(graph: Graph, equation: Any, which: Node, *cases: Node) -> Node:
    if len(cases) == 1:
        return cases[0]
    if equation.invars[0].aval.dtype == bool:
        return graph.apply("select", which, cases[1], cases[0])
    found = cases[-1]
    for i in range(len(cases) - 2, -1, -1):
        found = graph.apply("select", graph.apply("le", which, graph.constant(float(i))), cases[i], found)
    return found


def _sum(graph: Graph, nodes: Sequence[Node], operation: str = "add", start: float | bool = 0.0) -> Node:
    return functools.reduce(lambda a, b: graph.apply(operation, a, b), nodes) if len(nodes) else graph.constant(start)


def _pow(graph: Graph, equation: Any, base: Node, exponent: Node) -> Node:
    known = graph.known(exponent)
    if known is not None and float(known).is_integer() and abs(known) <= 16:
        return graph.power(base, int(known))
    if known == 0.5:
        return graph.apply("sqrt", base)
    return _any_power(graph, equation, base, exponent)


@jax.custom_jvp
def _power(base, exponent):
    """No number of a negative base, whatever the exponent."""
    positive = base > 0.0
    at_zero = where(exponent > 0.0, 0.0, where(exponent == 0.0, 1.0, math.inf))
    beside = where(base == 0.0, at_zero, math.nan)
    return where(positive, jnp.exp(exponent * jnp.log(where(positive, base, 1.0))), beside)


@_power.defjvp
def _power_jvp(primals, tangents):
    (base, exponent), (moved, bent) = primals, tangents
    value = _power(base, exponent)
    # One power less than none is none, and a zero stays one whatever its exponent.
    by_base = where(exponent == 0.0, 0.0, exponent * _power(base, exponent - 1.0))
    by_exponent = jnp.log(where(base == 0.0, 1.0, base)) * value
    return value, by_base * moved + by_exponent * bent


_any_power = _by_jax(_power)


def _with_slope(function: Callable[[Any], Any], slope: Callable[[Any, Any], Any]) -> Callable[[Any], Any]:
    """A function whose derivative is a formula of its argument and value: what its parts give would be less exact."""
    found = jax.custom_jvp(function)

    def rule(primals, tangents):
        value = found(*primals)
        return value, slope(primals[0], value) * tangents[0]

    found.defjvp(rule)
    return found


# Beyond it the square of a number, or one beside it, is nothing worth having.
_HUGE = 1e100


def _log1p(x):
    # Kahan: the rounding of 1 + x is taken back.
    u = 1.0 + x
    huge = u > _HUGE
    small = where((u == 1.0) | huge, 1.0, u - 1.0)
    return where(u == 1.0, x, jnp.log(u) * where(huge, 1.0, where(u == 1.0, 1.0, x) / small))


def _asinh(x):
    size = jnp.abs(x)
    huge = size > _HUGE
    a = where(huge, 1.0, size)
    near = _log1p(a + a * a / (1.0 + jnp.sqrt(1.0 + a * a)))
    return jnp.sign(x) * where(huge, jnp.log(where(huge, size, 1.0)) + math.log(2.0), near)


def _acosh(x):
    huge = x > _HUGE
    a = where(huge, 2.0, x) - 1.0
    near = _log1p(a + jnp.sqrt(a * (a + 2.0)))
    return where(huge, jnp.log(where(huge, x, 1.0)) + math.log(2.0), near)


def _sinh(x):
    return 0.5 * (jnp.expm1(x) - jnp.expm1(-x))


def _cosh(x):
    return 0.5 * (jnp.exp(x) + jnp.exp(-x))


def _arctangent(x):
    """By two halvings of the angle, then a series on tangents below tan(pi / 16)."""
    a = jnp.abs(x)
    large = a > 1.0
    t = where(large, 1.0 / where(large, a, 1.0), a)
    for _ in range(2):
        t = t / (1.0 + jnp.sqrt(1.0 + t * t))
    total = jnp.zeros_like(t)
    for k in range(13, -1, -1):
        total = total * (t * t) + (-1.0) ** k / (2 * k + 1)
    angle = 4.0 * t * total
    return jnp.sign(x) * where(large, math.pi / 2 - angle, angle)


@jax.custom_jvp
def _arctangent2(y, x):
    swapped = jnp.abs(y) > jnp.abs(x)
    over, under = where(swapped, x, y), where(swapped, y, x)
    t = _arctangent(over / where(under == 0.0, 1.0, under))
    right = where(swapped, where(y >= 0.0, math.pi / 2, -math.pi / 2) - t, t)
    turned = where(y >= 0.0, math.pi, -math.pi)
    return where(swapped | (x >= 0.0), right, right + turned)


@_arctangent2.defjvp
def _arctangent2_jvp(primals, tangents):
    (y, x), (dy, dx) = primals, tangents
    square = x * x + y * y
    return _arctangent2(y, x), dy * (x / square) - dx * (y / square)


_ELEMENTWISE: dict[str, Callable[..., Node]] = {
    **{name: _operation(name) for name in ("add", "sub", "mul", "neg", "max", "min", "abs", "sign", "sqrt")},
    **{name: _operation(name) for name in ("floor", "ceil", "exp", "expm1", "log", "tanh", "is_finite")},
    **{name: _operation(name) for name in ("eq", "ne", "lt", "le", "gt", "ge", "and", "or", "not", "xor")},
    # Total orders: what asks for them has put away what is no number.
    "lt_to": _operation("lt"),
    "le_to": _operation("le"),
    "add_any": _operation("add"),
    "div": _divide,
    "round": lambda graph, e, a: _round(graph, e, a),
    "rem": _remainder,
    "pow": _pow,
    "integer_pow": lambda graph, e, a: graph.power(a, e.params["y"]),
    "square": lambda graph, e, a: graph.power(a, 2),
    "rsqrt": lambda graph, e, a: graph.apply("div", graph.constant(1.0), graph.apply("sqrt", a)),
    "convert_element_type": _convert,
    "select_n": _choose,
    "clamp": lambda graph, e, low, a, high: graph.apply("min", graph.apply("max", a, low), high),
    "sin": _by_jax(lambda x: cosine_and_sine(x)[1]),
    "cos": _by_jax(lambda x: cosine_and_sine(x)[0]),
    "tan": _by_jax(lambda x: cosine_and_sine(x)[1] / cosine_and_sine(x)[0]),
    "log1p": _by_jax(_with_slope(_log1p, lambda x, y: 1.0 / (1.0 + x))),
    "logistic": _by_jax(_with_slope(lambda x: 1.0 / (1.0 + jnp.exp(-x)), lambda x, y: y * (1.0 - y))),
    "sinh": _by_jax(_with_slope(_sinh, lambda x, y: _cosh(x))),
    "cosh": _by_jax(_with_slope(_cosh, lambda x, y: _sinh(x))),
    "asinh": _by_jax(_with_slope(_asinh, lambda x, y: 1.0 / jnp.sqrt(1.0 + x * x))),
    "acosh": _by_jax(_with_slope(_acosh, lambda x, y: 1.0 / jnp.sqrt((x - 1.0) * (x + 1.0)))),
    "atanh": _by_jax(_with_slope(lambda x: 0.5 * (_log1p(x) - _log1p(-x)), lambda x, y: 1.0 / ((1.0 - x) * (1.0 + x)))),
    "atan": _by_jax(_with_slope(_arctangent, lambda x, y: 1.0 / (1.0 + x * x))),
    "atan2": _by_jax(_arctangent2),
    "asin": _by_jax(lambda x: _arctangent2(x, jnp.sqrt((1.0 - x) * (1.0 + x)))),
    "acos": _by_jax(lambda x: _arctangent2(jnp.sqrt((1.0 - x) * (1.0 + x)), x)),
    "cbrt": _by_jax(lambda x: jnp.sign(x) * jnp.exp(jnp.log(jnp.abs(x)) / 3.0)),
    "exp2": _by_jax(lambda x: jnp.exp(x * math.log(2.0))),
    "stop_gradient": lambda graph, e, a: graph.apply("given", a),
    "copy": lambda graph, e, a: a,
    "copy_p": lambda graph, e, a: a,
    "optimization_barrier": lambda graph, e, a: a,
}


def _round(graph: Graph, equation: Any, a: Node) -> Node:
    if equation.params["rounding_method"] == jax.lax.RoundingMethod.TO_NEAREST_EVEN:
        return graph.apply("round", a)
    # Halves away from zero. (The sum of a half and the number just below it is one.)
    size = graph.apply("abs", a)
    down = graph.apply("floor", size)
    far = graph.apply("ge", graph.apply("sub", size, down), graph.constant(0.5))
    up = graph.apply("add", down, graph.apply("select", far, graph.constant(1.0), graph.constant(0.0)))
    return graph.apply("mul", graph.apply("sign", a), up)


def _broadcast(graph: Graph, equation: Any, a: Nodes, *_: Nodes) -> Nodes:
    shape, places = equation.params["shape"], equation.params["broadcast_dimensions"]
    spread = [1] * len(shape)
    for size, place in zip(a.shape, places, strict=True):
        spread[place] = size
    return np.broadcast_to(a.reshape(spread), shape)


def _slice(graph: Graph, equation: Any, a: Nodes) -> Nodes:
    p = equation.params
    strides = p["strides"] or (1,) * a.ndim
    return a[tuple(slice(*s) for s in zip(p["start_indices"], p["limit_indices"], strides, strict=True))]


def _pad(graph: Graph, equation: Any, a: Nodes, value: Nodes) -> Nodes:
    for axis, (low, high, inner) in enumerate(equation.params["padding_config"]):
        if low < 0 or high < 0 or inner:
            raise UntranslatableError("the primitive `pad` with holes or negative widths")
        shape = [*a.shape[:axis], -1, *a.shape[axis + 1 :]]
        before, after = (np.full([n if k < 0 else k for k in shape], value[()], dtype=object) for n in (low, high))
        a = np.concatenate([before, a, after], axis=axis)
    return a


def _dot(graph: Graph, equation: Any, a: Nodes, b: Nodes) -> Nodes:
    ((over_a, over_b), (batch_a, batch_b)) = equation.params["dimension_numbers"]
    if batch_a or batch_b:
        raise UntranslatableError("the primitive `dot_general` with batches")
    rest_a = [i for i in range(a.ndim) if i not in over_a]
    rest_b = [i for i in range(b.ndim) if i not in over_b]
    left = a.transpose(*rest_a, *over_a).reshape(math.prod(a.shape[i] for i in rest_a), -1)
    right = b.transpose(*over_b, *rest_b).reshape(-1, math.prod(b.shape[i] for i in rest_b))
    found = np.empty((left.shape[0], right.shape[1]), dtype=object)
    for i, j in np.ndindex(found.shape):
        row, column = list(left[i]), list(right[:, j])
        whole = None
        if left.size * right.shape[1] >= _LARGE:
            whole = graph.dot(row, column) or graph.dot(column, row)
        if whole is None:
            whole = _sum(graph, [graph.apply("mul", x, y) for x, y in zip(row, column, strict=True)])
        found[i, j] = whole
    return found.reshape([a.shape[i] for i in rest_a] + [b.shape[i] for i in rest_b])


def _reduced(operation: str, start: float | bool) -> Callable[..., Nodes]:
    def rule(graph: Graph, equation: Any, a: Nodes) -> Nodes:
        axes = equation.params["axes"]
        kept = [i for i in range(a.ndim) if i not in axes]
        rows = a.transpose(*kept, *axes).reshape(math.prod(a.shape[i] for i in kept), -1)
        found = np.empty(len(rows), dtype=object)
        for i, row in enumerate(rows):
            found[i] = _sum(graph, list(row), operation, start)
        return found.reshape([a.shape[i] for i in kept])

    return rule


def _cumulative(graph: Graph, equation: Any, a: Nodes) -> Nodes:
    axis, back = equation.params["axis"], equation.params["reverse"]
    rows = np.moveaxis(a, axis, 0)[:: -1 if back else 1]
    sums = [rows[:1]]
    for i in range(1, len(rows)):
        sums.append(_each(functools.partial(graph.apply, "add"), sums[-1], rows[i : i + 1]))
    return np.moveaxis(np.concatenate(sums)[:: -1 if back else 1], 0, axis)


def _place_of(better: str) -> Callable[..., Nodes]:
    """Where the first of the best entries along an axis stands."""

    def rule(graph: Graph, equation: Any, a: Nodes) -> Nodes:
        (axis,) = equation.params["axes"]
        rows = np.moveaxis(a, axis, -1)
        found = np.empty(rows.shape[:-1], dtype=object)
        for place in np.ndindex(found.shape):
            best, index = rows[place][0], graph.constant(0.0)
            for i, node in enumerate(rows[place][1:], 1):
                beats = graph.apply(better, node, best)
                best, index = (
                    graph.apply("select", beats, *pair) for pair in ((node, best), (graph.constant(float(i)), index))
                )
            found[place] = index
        return found

    return rule


def _gathered(graph: Graph, equation: Any, a: Nodes, index: Nodes) -> Nodes:
    """One entry, or one row along the first axis, of a table at an index that may depend on the motion."""
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    if index.size != 1 or tuple(numbers.start_index_map) != (0,) or sizes[0] != 1 or tuple(sizes[1:]) != a.shape[1:]:
        raise UntranslatableError("the primitive `gather` of several entries")
    return _picked(graph, a, index.reshape(-1)[0], keep=not numbers.collapsed_slice_dims)


def _dynamic_slice(graph: Graph, equation: Any, a: Nodes, *index: Nodes) -> Nodes:
    sizes = equation.params["slice_sizes"]
    starts = [graph.known(i.item()) for i in index]
    if None not in starts:
        whole = [int(s) for s in starts if s is not None]
        begins = [min(max(s, 0), n - k) for s, n, k in zip(whole, a.shape, sizes, strict=True)]
        return a[tuple(slice(s, s + k) for s, k in zip(begins, sizes, strict=True))]
    if sizes[0] != 1 or tuple(sizes[1:]) != a.shape[1:]:
        raise UntranslatableError("the primitive `dynamic_slice` of several rows")
    return _picked(graph, a, index[0].item(), keep=True)


def _picked(graph: Graph, a: Nodes, index: Node, *, keep: bool) -> Nodes:
    if len(a) > _LONGEST_LOOP:
        raise UntranslatableError(f"a table of {len(a)} entries")
    found = np.asarray(a[-1], dtype=object)
    for i in range(len(a) - 2, -1, -1):
        before = graph.apply("le", index, graph.constant(float(i)))
        found = _each(lambda x, y, before=before: graph.apply("select", before, x, y), np.asarray(a[i], object), found)
    return found[None] if keep else found


def _iota(graph: Graph, equation: Any) -> Nodes:
    shape, axis = equation.params["shape"], equation.params["dimension"]
    along = np.arange(shape[axis]).reshape([-1 if i == axis else 1 for i in range(len(shape))])
    return _constants(graph, np.broadcast_to(along, shape))


_STRUCTURAL: dict[str, Callable[..., Nodes]] = {
    "broadcast_in_dim": _broadcast,
    "reshape": lambda graph, e, a: a.reshape(e.params["new_sizes"]),
    "squeeze": lambda graph, e, a: a.squeeze(tuple(e.params["dimensions"])),
    "expand_dims": lambda graph, e, a: np.expand_dims(a, e.params["dimensions"]),
    "transpose": lambda graph, e, a: a.transpose(e.params["permutation"]),
    "rev": lambda graph, e, a: np.flip(a, e.params["dimensions"]),
    "concatenate": lambda graph, e, *parts: np.concatenate(parts, axis=e.params["dimension"]),
    "slice": _slice,
    "pad": _pad,
    "dynamic_slice": _dynamic_slice,
    "gather": _gathered,
    "dot_general": _dot,
    "reduce_sum": _reduced("add", 0.0),
    "reduce_max": _reduced("max", -math.inf),
    "reduce_min": _reduced("min", math.inf),
    "reduce_prod": _reduced("mul", 1.0),
    "reduce_and": _reduced("and", True),
    "reduce_or": _reduced("or", False),
    "argmax": _place_of("gt"),
    "argmin": _place_of("lt"),
    "cumsum": _cumulative,
    "iota": _iota,
}
