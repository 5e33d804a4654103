"""Translation of JAX's intermediate language to a graph of scalars; each entry of the (small) arrays is a separate
node."""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend.core import ClosedJaxpr, Jaxpr, Literal

from hdjax.elementary import cosine_and_sine
from hdjax.engine.array_rules import ARRAYS, Nodes, UntranslatableError, constants, each
from hdjax.engine.derivatives import Tangent, derivatives
from hdjax.engine.formulas import acosh, arctangent, arctangent2, asinh, cosh, log1p, power, sinh, with_slope
from hdjax.engine.graph import Graph, Node

_LONGEST_LOOP = 64


def traced(function: Callable[..., Any], *examples: Any) -> ClosedJaxpr:
    """The function in JAX's intermediate language, for arguments like the examples."""
    return jax.make_jaxpr(function)(*examples)


def translated(
    graph: Graph, program: ClosedJaxpr, arguments: Sequence[Nodes], *, values_only: bool = False
) -> list[Nodes]:
    """Add a program to a graph.

    Args:
        graph: receives its nodes.
        program: in JAX's intermediate language.
        arguments: nodes for each of its inputs.
        values_only: omit custom derivatives of functions.

    Returns:
        Nodes of each of its outputs.

    Raises:
        UntranslatableError: names an unsupported primitive.
    """
    own = [constants(graph, c) for c in program.consts]
    return _run(graph, program.jaxpr, own, arguments, values_only)


def _run(
    graph: Graph, jaxpr: Jaxpr, own: Sequence[Nodes], arguments: Sequence[Nodes], values_only: bool
) -> list[Nodes]:
    value: dict[Any, Nodes] = dict(zip(jaxpr.constvars, own, strict=True))
    value |= dict(zip(jaxpr.invars, arguments, strict=True))

    def read(variable: Any) -> Nodes:
        return constants(graph, variable.val) if isinstance(variable, Literal) else value[variable]

    for equation in jaxpr.eqns:
        found = _translate(graph, equation, [read(v) for v in equation.invars], values_only)
        value |= dict(zip(equation.outvars, found, strict=True))
    return [read(v) for v in jaxpr.outvars]


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
        return [each(functools.partial(_ELEMENTWISE[name], graph, equation), *arguments)]
    if name in ARRAYS:
        return [np.asarray(ARRAYS[name](graph, equation, *arguments), dtype=object)]
    raise UntranslatableError(f"the primitive `{name}`")


def _with_own_derivative(
    graph: Graph, parameters: dict[str, Any], arguments: list[Nodes], values_only: bool
) -> list[Nodes]:
    """A function with a custom rule of differentiation."""
    # Inner rules would not be used: this one has all derivatives.
    values = translated(graph, parameters["call_jaxpr"], arguments, values_only=True)
    if values_only:
        return values
    entries = [(k, index) for k, a in enumerate(arguments) for index in np.ndindex(a.shape)]
    moving = [e for e in entries if graph.known(arguments[e[0]].item(*e[1])) is None]
    if not moving:
        return values
    if parameters.get("num_consts", 0):
        raise UntranslatableError("a function with its own derivative that captures arrays")
    rule, constants, zeros = parameters["jvp_jaxpr_fun"].call_wrapped(*(False for _ in arguments))
    # The rule is linear in the tangents: its derivatives by them are the partial derivatives.
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
            result[place] = graph.apply("given", value.item(*place), *given)
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
    """A function of scalars composed of supported ones."""

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


def _pow(graph: Graph, equation: Any, base: Node, exponent: Node) -> Node:
    known = graph.known(exponent)
    if known is not None and float(known).is_integer() and abs(known) <= 16:
        return graph.power(base, int(known))
    if known == 0.5:
        return graph.apply("sqrt", base)
    return _any_power(graph, equation, base, exponent)


_any_power = _by_jax(power)


_ELEMENTWISE: dict[str, Callable[..., Node]] = {
    **{name: _operation(name) for name in ("add", "sub", "mul", "neg", "max", "min", "abs", "sign", "sqrt")},
    **{name: _operation(name) for name in ("floor", "ceil", "exp", "expm1", "log", "tanh", "is_finite")},
    **{name: _operation(name) for name in ("eq", "ne", "lt", "le", "gt", "ge", "and", "or", "not", "xor")},
    # Total orders: callers have removed NaN.
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
    "log1p": _by_jax(with_slope(log1p, lambda x, y: 1.0 / (1.0 + x))),
    "logistic": _by_jax(with_slope(lambda x: 1.0 / (1.0 + jnp.exp(-x)), lambda x, y: y * (1.0 - y))),
    "sinh": _by_jax(with_slope(sinh, lambda x, y: cosh(x))),
    "cosh": _by_jax(with_slope(cosh, lambda x, y: sinh(x))),
    "asinh": _by_jax(with_slope(asinh, lambda x, y: 1.0 / jnp.sqrt(1.0 + x * x))),
    "acosh": _by_jax(with_slope(acosh, lambda x, y: 1.0 / jnp.sqrt((x - 1.0) * (x + 1.0)))),
    "atanh": _by_jax(with_slope(lambda x: 0.5 * (log1p(x) - log1p(-x)), lambda x, y: 1.0 / ((1.0 - x) * (1.0 + x)))),
    "atan": _by_jax(with_slope(arctangent, lambda x, y: 1.0 / (1.0 + x * x))),
    "atan2": _by_jax(arctangent2),
    "asin": _by_jax(lambda x: arctangent2(x, jnp.sqrt((1.0 - x) * (1.0 + x)))),
    "acos": _by_jax(lambda x: arctangent2(jnp.sqrt((1.0 - x) * (1.0 + x)), x)),
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
    # Halves are rounded away from zero. (A half plus the number just below it gives one.)
    size = graph.apply("abs", a)
    down = graph.apply("floor", size)
    far = graph.apply("ge", graph.apply("sub", size, down), graph.constant(0.5))
    up = graph.apply("add", down, graph.apply("select", far, graph.constant(1.0), graph.constant(0.0)))
    return graph.apply("mul", graph.apply("sign", a), up)
