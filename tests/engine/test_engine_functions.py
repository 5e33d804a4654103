"""Functions that the engine translates to machine code, with their derivatives, against JAX."""

import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from machine_function import LANES, MachineFunction

from hdjax.elementary import cosine_and_sine, exponential, power
from hdjax.engine.array_rules import UntranslatableError
from hdjax.engine.graph import PARAMETER

# -- points ------------------------------------------------------------------------------------------------------------

_SIZES = np.array([1e-300, 1e-30, 1e-12, 1e-5, 3e-3, 0.1, 0.3, 0.49999999999999994, 0.9, 1.3, 2.5, 7.7, 31.0, 1e3, 1e6])
_DENSE = np.linspace(-6.0, 6.0, 149)  # no corner on it but zero
REALS = np.concatenate([-_SIZES[::-1], _SIZES, _DENSE])
WIDE = np.concatenate([REALS, [-1e150, -1e20, 1e20, 1e150]])
POSITIVE = np.concatenate([_SIZES, [1e-150, 1e20, 1e150, 1e300], np.linspace(0.05, 9.0, 97)])
MODERATE = REALS[np.abs(REALS) < 600.0]
ANGLES = np.concatenate([REALS, np.linspace(-1e6, 1e6, 501), np.pi / 2 * np.arange(-9, 10)])
UNIT = np.concatenate([np.linspace(-0.999, 0.999, 101), [-1e-9, 1e-9, 1e-300]])
PAIRS = tuple(a.ravel() for a in np.meshgrid(*[np.array([-1e6, -31.0, -0.9, -1e-5, 1e-12, 0.3, 2.5, 7.7, 1e3])] * 2))
_APART = PAIRS[0] != PAIRS[1]
PAIRS_APART = PAIRS[0][_APART], PAIRS[1][_APART]
TABLE = np.linspace(-2.0, 2.0, 9)
HEIGHTS = np.sin(3.0 * TABLE) + TABLE**2
BETWEEN_KNOTS = np.linspace(-3.0, 3.0, 101)[1::2] + 0.011


def _halves(x):
    return jnp.asarray([0.5, -1.5])[jnp.where(x > 0.2, 1, 0)] * x


def _scanned(x):
    return jax.lax.scan(lambda total, a: (total * x + a, total), jnp.zeros_like(x), jnp.asarray([0.3, -1.0, 2.0, 0.7]))


def _counted(x):
    return jax.lax.fori_loop(0, 5, lambda k, a: a + jnp.sin(a) / (1.0 + k), x)


@jax.custom_jvp
def _with_own_slope(x):
    return x * x


@_with_own_slope.defjvp
def _with_own_slope_jvp(primals, tangents):
    # A slope other than the function's own shows which of the two was used.
    return _with_own_slope(*primals), 7.0 * primals[0] * tangents[0]


Case = tuple[Callable[..., Any], tuple[np.ndarray, ...]]
FUNCTIONS: dict[str, Case] = {
    # Of one number.
    "neg": (lambda x: -x, (WIDE,)),
    "abs": (jnp.abs, (WIDE,)),
    "sign": (jnp.sign, (WIDE,)),
    "sqrt": (jnp.sqrt, (POSITIVE,)),
    "rsqrt": (jax.lax.rsqrt, (POSITIVE[(POSITIVE > 1e-99) & (POSITIVE < 1e99)],)),
    "cbrt": (jnp.cbrt, (WIDE[np.abs(WIDE) > 1e-99],)),
    "floor": (jnp.floor, (WIDE,)),
    "ceil": (jnp.ceil, (WIDE,)),
    "round to even": (jnp.round, (np.append(WIDE, [0.5, 1.5, 2.5, -0.5, -3.5]),)),
    "round away": (jax.lax.round, (np.append(WIDE, [0.5, 1.5, 2.5, -0.5, -3.5]),)),
    "square": (jnp.square, (WIDE,)),
    "integer_pow 3": (lambda x: x**3, (REALS,)),
    "integer_pow 7": (lambda x: x**7, (REALS,)),
    "integer_pow -2": (lambda x: x**-2, (REALS[np.abs(REALS) > 1e-99],)),
    "exp": (jnp.exp, (MODERATE,)),
    "exp2": (jnp.exp2, (MODERATE[np.abs(MODERATE) < 300],)),
    "expm1": (jnp.expm1, (MODERATE,)),
    "log": (jnp.log, (POSITIVE,)),
    "log1p": (jnp.log1p, (np.concatenate([POSITIVE, UNIT]),)),
    "tanh": (jnp.tanh, (WIDE,)),
    "logistic": (jax.nn.sigmoid, (np.append(WIDE, 0.0),)),
    "softplus": (jax.nn.softplus, (MODERATE,)),
    "sinh": (jnp.sinh, (MODERATE,)),
    "cosh": (jnp.cosh, (MODERATE,)),
    "asinh": (jnp.arcsinh, (np.append(WIDE, 0.0),)),
    "acosh": (jnp.arccosh, (1.0 + POSITIVE[POSITIVE > 1e-6],)),
    "atanh": (jnp.arctanh, (UNIT,)),
    "sin": (jnp.sin, (ANGLES,)),
    "cos": (jnp.cos, (ANGLES,)),
    "tan": (jnp.tan, (REALS,)),
    "asin": (jnp.arcsin, (UNIT,)),
    "acos": (jnp.arccos, (UNIT,)),
    "atan": (jnp.arctan, (np.append(WIDE, 0.0),)),
    "is_finite": (lambda x: jnp.where(jnp.isfinite(1.0 / x), x, 2.0), (np.append(REALS, 0.0),)),
    "stop_gradient": (lambda x: x * jax.lax.stop_gradient(x), (REALS,)),
    "custom_jvp": (lambda x: jnp.sin(_with_own_slope(x)), (_DENSE,)),
    "jit": (lambda x: jax.jit(lambda y: jnp.sin(y) * y)(x), (REALS,)),
    "checkpoint": (lambda x: jax.checkpoint(lambda y: jnp.sin(y) * y)(x), (REALS,)),
    "to integer": (lambda x: x * x.astype(int).astype(float), (REALS,)),
    "to truth": (lambda x: x * x.astype(bool).astype(float), (np.append(REALS, 0.0),)),
    "integers": (lambda x: x * ((jnp.floor(x).astype(int) * 3 - 7) // 4 % 5).astype(float), (_DENSE,)),
    "elementary cosine": (lambda x: cosine_and_sine(x)[0], (ANGLES,)),
    "elementary exponential": (exponential, (MODERATE,)),
    # Of two.
    "add": (lambda x, y: x + y, PAIRS),
    "sub": (lambda x, y: x - y, PAIRS),
    "mul": (lambda x, y: x * y, PAIRS),
    "div": (lambda x, y: x / y, PAIRS),
    "max": (jnp.maximum, PAIRS_APART),
    "min": (jnp.minimum, PAIRS_APART),
    "pow": (
        lambda x, y: jnp.power(jnp.abs(x), 0.01 * y),
        (PAIRS[0][np.abs(PAIRS[1]) < 99], PAIRS[1][np.abs(PAIRS[1]) < 99]),
    ),
    "pow from zero": (jnp.power, (np.array([0.0, 0.0, 0.0, 1.0, 2.0]), np.array([1.5, 2.0, 7.1, 0.0, 0.0]))),
    "pow of a negative number": (
        lambda x, y: jnp.power(x, jnp.rint(y)),
        (np.array([-2.0, -2.0, -3.0, -1.5, -0.5]), np.array([3.0, 2.0, -1.0, 0.0, 5.0])),
    ),
    "elementary power": (lambda x, y: power(1.0 + x * x, 1e-3 * y), PAIRS),
    "atan2": (jnp.arctan2, PAIRS),
    "hypot": (jnp.hypot, PAIRS_APART),
    "rem": (jax.lax.rem, (np.array([7.3, -7.3, 7.3, -0.2, 1e5]), np.array([2.0, 2.0, -2.0, 3.0, 0.3]))),
    "mod": (jnp.mod, (np.array([7.3, -7.3, 7.3, -0.2, 1e5]), np.array([2.0, 2.0, -2.0, 3.0, 0.3]))),
    "eq": (lambda x, y: jnp.where(x == y, x * y, x + y), PAIRS),
    "ne": (lambda x, y: jnp.where(x != y, x * y, x + y), PAIRS),
    "lt": (lambda x, y: jnp.where(x < y, x * y, x + y), PAIRS),
    "le": (lambda x, y: jnp.where(x <= y, x * y, x + y), PAIRS),
    "gt": (lambda x, y: jnp.where(x > y, x * y, x + y), PAIRS),
    "ge": (lambda x, y: jnp.where(x >= y, x * y, x + y), PAIRS),
    "and": (lambda x, y: jnp.where((x > 0) & (y > 0), x * y, x + y), PAIRS),
    "or": (lambda x, y: jnp.where((x > 0) | (y > 0), x * y, x + y), PAIRS),
    "xor": (lambda x, y: jnp.where((x > 0) ^ (y > 0), x * y, x + y), PAIRS),
    "not": (lambda x, y: jnp.where(~(x > y), x * y, x + y), PAIRS),
    "truths compared": (lambda x, y: jnp.where((x > 0) == (y > 0), x * y, x + y), PAIRS),
    "truth selected": (lambda x, y: jnp.where(jnp.where(x > y, x > 0, y > 0), x * y, x + y), PAIRS),
    "clip": (lambda x, y: jnp.clip(x, -2.0, 2.0) * y, PAIRS),
    "select_n of three": (
        lambda x, y: jax.lax.select_n(jnp.clip(jnp.floor(x), 0, 2).astype(jnp.int32), x * y, x + y, x - y),
        PAIRS,
    ),
    # With short vectors.
    "interp": (lambda x: jnp.interp(x, jnp.asarray(TABLE), jnp.asarray(HEIGHTS)), (BETWEEN_KNOTS,)),
    "gather": (_halves, (REALS,)),
    "polyval": (lambda x: jnp.polyval(jnp.asarray([2.0, -1.0, 0.5, 3.0]), x), (_DENSE,)),
    "scan": (lambda x: _scanned(x)[0] + jnp.sum(_scanned(x)[1]), (_DENSE,)),
    "scan backwards": (
        lambda x: jax.lax.scan(lambda a, b: (a * x + b, a), x, jnp.arange(4.0), reverse=True)[1][0],
        (_DENSE,),
    ),
    "fori_loop": (_counted, (_DENSE,)),
    "dot": (lambda x, y: jnp.stack([x, y, x * y]) @ jnp.asarray([[1.0, 2.0], [0.5, -1.0], [3.0, 0.1]])[:, 1], PAIRS),
    "matrices": (
        lambda x, y: jnp.trace(jnp.stack([x, y, 2 * x, -y]).reshape(2, 2) @ jnp.stack([y, x, x, x]).reshape(2, 2).T),
        PAIRS,
    ),
    "einsum": (lambda x, y: jnp.einsum("i,ij,j->", jnp.stack([x, y]), jnp.ones((2, 2)), jnp.stack([y, x])), PAIRS),
    "reductions": (
        lambda x: jnp.max(x * TABLE[:3]) + jnp.min(x - TABLE[:3]) + jnp.prod(x + TABLE[:2]) + jnp.sum(x * TABLE),
        (_DENSE[_DENSE != 0],),
    ),
    "any and all": (
        lambda x: jnp.where(jnp.any(x > TABLE), x, 1.0) + jnp.where(jnp.all(x > TABLE), x * x, 1.0),
        (_DENSE + 0.001,),
    ),
    "cumsum": (lambda x: jnp.sum(jnp.cumsum(x ** jnp.arange(1.0, 4.0)) * jnp.asarray([1.0, -2.0, 0.5])), (_DENSE,)),
    "norm": (lambda x, y: jnp.linalg.norm(jnp.stack([x, y])), PAIRS),
    "pad and flip": (lambda x, y: jnp.pad(jnp.stack([x, y]), (1, 2))[::-1] @ jnp.arange(5.0), PAIRS),
    "roll": (lambda x, y: jnp.roll(jnp.stack([x, y, x * y]), 1) @ jnp.asarray([1.0, 2.0, 4.0]), PAIRS),
    "dynamic_slice": (
        lambda x: jax.lax.dynamic_slice(jnp.asarray(HEIGHTS) * x, (jnp.floor(jnp.abs(x)).astype(int),), (1,))[0],
        (_DENSE,),
    ),
    "piecewise": (lambda x: jnp.select([x < -1.0, x < 1.3], [x * x, jnp.sin(x)], jnp.log(jnp.abs(x) + 1.0)), (_DENSE,)),
}

# Derivatives of these are one minus a number close to one, in JAX as here: accurate to the last digit of one.
NEAR_ONE = {"tanh": 4.0, "expm1": 1.0, "elementary exponential": 2.0, "logistic": 1.0, "softplus": 1.0}
# Remainders err by the rounding of the quotient.
LEFT_OVER = {"rem": 2e-11, "mod": 2e-11}


@pytest.fixture(scope="module")
def by_jax() -> dict[str, np.ndarray]:
    """Value and derivatives of each function by one program of JAX."""

    def all_of_them(points):
        def one(function, own):
            numbers = tuple(range(len(own)))
            value = jax.vmap(function)(*own)
            slopes = jax.vmap(jax.jacfwd(function, argnums=numbers))(*own)
            return [value, *slopes]

        return {name: one(FUNCTIONS[name][0], own) for name, own in points.items()}

    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        found = jax.jit(all_of_them)({name: tuple(map(jnp.asarray, own)) for name, (_, own) in FUNCTIONS.items()})
    return {name: np.stack([np.asarray(f, dtype=float) for f in rows]) for name, rows in found.items()}


def assert_same(name: str, found: np.ndarray, wanted: np.ndarray):
    # Values that underflow are compared with the smallest numbers that are kept.
    np.testing.assert_allclose(found[0], wanted[0], rtol=1e-13, atol=LEFT_OVER.get(name, 1e-300), err_msg=name)
    atol = 2.3e-16 * NEAR_ONE.get(name, 0.0)
    for i in range(1, len(found)):
        np.testing.assert_allclose(found[i], wanted[i], rtol=1e-13, atol=max(atol, 1e-300), err_msg=f"{name}, slope")


def machine_function(name: str, **how) -> MachineFunction:
    function, points = FUNCTIONS[name]
    with jax.numpy_rank_promotion("allow"), jax.numpy_dtype_promotion("standard"):
        return MachineFunction(function, len(points), **how)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_machine_function_agrees_with_jax(name: str, by_jax):
    made = machine_function(name)
    points = FUNCTIONS[name][1]
    assert_same(name, made(*points), by_jax[name])
    assert_same(name, made.by_numpy(*points), by_jax[name])


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=() if i % 4 == 0 else pytest.mark.slow) for i, n in enumerate(FUNCTIONS)]
)
def test_machine_function_of_one_lane_agrees_with_jax(name: str, by_jax):
    """Parameters are plain numbers, in one lane."""
    assert_same(name, machine_function(name, lanes=1)(*FUNCTIONS[name][1]), by_jax[name])


def test_division_by_a_constant_uses_one_inverse(by_jax):
    made = machine_function("div", constant=(1,))
    inverse = made.graph.apply("div", made.graph.constant(1.0), made.graph.leaf(("x", 1)))
    assert made.graph.level[inverse] == PARAMETER
    assert made.graph.nodes[made.value][0] == "mul" and inverse in made.graph.nodes[made.value]
    assert_same("div", made(*PAIRS), by_jax["div"])


INF, NAN = math.inf, math.nan


@pytest.mark.parametrize("lanes", [1, LANES])
@pytest.mark.parametrize(
    "name, low, high",
    [("exp", -708.0, 709.0), ("expm1", -745.0, 709.0), ("log", 2.3e-308, 1.7e308), ("tanh", -1e308, 1e308)],
)
def test_elementary_functions_agree_with_the_c_library_over_their_range(name: str, low: float, high: float, lanes: int):
    """Against the C library, which errs by about a unit in the last place; and at zeros, infinities and NaN."""
    made = MachineFunction(getattr(jnp, name), 1, lanes)
    if name == "log":
        points = np.append(np.geomspace(low, high, 20_001), 1.0 + np.geomspace(1e-16, 0.5, 999))
    elif name == "tanh":
        sizes = np.geomspace(1e-300, high, 10_001)
        points = np.concatenate([sizes, -sizes, np.linspace(-25, 25, 10_001)])
    else:
        sizes = np.geomspace(1e-300, 1.0, 2_001)
        points = np.concatenate([np.linspace(low, high, 40_001), sizes, -sizes])
    found, wanted = made(points)[0], getattr(np, name)(points)
    assert np.max(np.abs(found - wanted) / np.maximum(np.abs(wanted), 2.3e-308)) < 1e-15
    special = {
        "exp": ([0.0, -0.0, -INF, -800.0, INF, 800.0, NAN], [1.0, 1.0, 0.0, 0.0, INF, INF, NAN]),
        "expm1": ([0.0, -INF, -800.0, INF, 800.0, NAN], [0.0, -1.0, -1.0, INF, INF, NAN]),
        "log": ([1.0, 0.0, -0.0, -1.0, -INF, INF, NAN], [0.0, -INF, -INF, NAN, NAN, INF, NAN]),
        "tanh": ([0.0, -0.0, -INF, INF, NAN], [0.0, -0.0, -1.0, 1.0, NAN]),
    }[name]
    np.testing.assert_array_equal(made(np.array(special[0]))[0], special[1])
    np.testing.assert_array_equal(np.signbit(made(np.array([-0.0]))[0]), name in ("tanh", "log"))


def test_comparisons_with_nan_are_false():
    points = np.array([1.0, NAN, INF]), np.array([NAN, NAN, NAN])
    for compare, always in ((jnp.less, False), (jnp.greater_equal, False), (jnp.equal, False), (jnp.not_equal, True)):
        made = MachineFunction(lambda x, y, compare=compare: jnp.where(compare(x, y), 1.0, 0.0), 2)
        np.testing.assert_array_equal(made(*points)[0], float(always))


def test_selection_ignores_value_and_slope_of_the_other_branch():
    """Even where they are infinite or NaN."""
    made = MachineFunction(lambda x: jnp.where(x > 0, jnp.sqrt(x), 0.0), 1)
    np.testing.assert_array_equal(made(np.array([-1.0, 0.0, 4.0])), [[0.0, 0.0, 2.0], [0.0, 0.0, 0.25]])


@pytest.mark.parametrize(
    "function, says",
    [
        (jax.scipy.special.i0, "`bessel_i0e`"),
        (lambda x: jax.lax.while_loop(lambda a: a < 3.0, lambda a: a + 1.0, x), "`while`"),
        (lambda x: jnp.sort(jnp.stack([x, -x]))[0], "`sort`"),
        (lambda x: jax.pure_callback(np.sin, jax.ShapeDtypeStruct((), float), x), "`pure_callback`"),
        (lambda x: jax.lax.fori_loop(0, 1000, lambda k, a: 0.5 * a, x), "a loop of 1000 rounds"),
        (lambda x: jnp.arange(1000.0)[jnp.floor(x).astype(int)], "a table of 1000 entries"),
        (lambda x: jnp.real(jnp.exp(jax.lax.complex(x, x))), "`complex`"),
    ],
)
def test_untranslatable_operation_is_named_in_the_error(function, says: str):
    with pytest.raises(UntranslatableError) as caught, jax.numpy_dtype_promotion("standard"):
        MachineFunction(function, 1)
    assert says in str(caught.value)
