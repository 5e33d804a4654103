"""Random expressions translated to machine code, with their derivatives, against numpy and JAX."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from machine_function import MachineFunction

# Functions that stay bounded when nested; the last entry is zero at a corner.
_ONE: dict[str, tuple[Callable, Callable | None]] = {
    "neg": (lambda n, a: -a, None),
    "abs": (lambda n, a: n.abs(a), lambda a: a),
    "sign": (lambda n, a: n.sign(a), lambda a: a),
    "tanh": (lambda n, a: n.tanh(a), None),
    "sin": (lambda n, a: n.sin(a), None),
    "cos": (lambda n, a: n.cos(a), None),
    "asinh": (lambda n, a: n.arcsinh(a), None),
    "atan": (lambda n, a: n.arctan(a), None),
    "bell": (lambda n, a: n.exp(-a * a), None),
    "expm1": (lambda n, a: n.expm1(-n.abs(a)), lambda a: a),
    "log": (lambda n, a: n.log(1.5 + a * a), None),
    "log1p": (lambda n, a: n.log1p(a * a), None),
    "sqrt": (lambda n, a: n.sqrt(0.5 + a * a), None),
    "cube": (lambda n, a: n.tanh(a) ** 3, None),
    "round": (lambda n, a: n.round(a), lambda a: a - np.floor(a) - 0.5),
    "floor": (lambda n, a: n.floor(a), lambda a: a - np.round(a)),
    "clip": (lambda n, a: n.clip(a, -0.7, 0.8), lambda a: (a + 0.7) * (a - 0.8)),
}
_TWO: dict[str, tuple[Callable, Callable | None]] = {
    "add": (lambda n, a, b: a + b, None),
    "sub": (lambda n, a, b: a - b, None),
    "mul": (lambda n, a, b: a * b, None),
    "div": (lambda n, a, b: a / (1.0 + b * b), None),
    "max": (lambda n, a, b: n.maximum(a, b), lambda a, b: a - b),
    "min": (lambda n, a, b: n.minimum(a, b), lambda a, b: a - b),
    "where": (lambda n, a, b: n.where(a < b, a * a, n.sin(b)), lambda a, b: a - b),
    "both": (lambda n, a, b: n.where((a > 0.1) & ~(b > 0.2), a, b), lambda a, b: (a - 0.1) * (b - 0.2)),
    "atan2": (lambda n, a, b: n.arctan2(a, 1.0 + b * b), None),
    "pow": (lambda n, a, b: (1.0 + a * a) ** n.tanh(b), None),
}

expressions = st.recursive(
    st.sampled_from(["x", "y", "z"]) | st.sampled_from([0.0, 1.0, -1.0, 2.0, 0.3, -1.7]),
    lambda inner: (
        st.tuples(st.sampled_from(sorted(_ONE)), inner) | st.tuples(st.sampled_from(sorted(_TWO)), inner, inner)
    ),
    max_leaves=12,
)


def evaluate(expression, library, values, corners: list | None = None):
    """The expression by numpy or JAX; `corners` collects the distance of each value from the next corner."""
    if isinstance(expression, str):
        return values[expression]
    if isinstance(expression, float):
        return library.full_like(values["x"], expression)
    name, *inner = expression
    arguments = [evaluate(i, library, values, corners) for i in inner]
    rule, corner = (_ONE if len(inner) == 1 else _TWO)[name]
    if corners is not None:
        corners.extend(np.abs(a) for a in arguments)
        corners += [] if corner is None else [(corner(*arguments),)]
    return rule(library, *arguments)


@settings(max_examples=50)
@given(expressions, st.integers(0, 2**32 - 1))
def test_random_expression_agrees_with_jax(expression, seed: int):
    points = dict(zip("xyz", np.random.default_rng(seed).normal(scale=1.5, size=(3, 16)), strict=True))
    noted: list = []
    wanted = evaluate(expression, np, points, noted)
    size = np.maximum(1.0, np.max([np.ones(16), *(a for a in noted if not isinstance(a, tuple))], axis=0))
    assume(size.max() < 1e3)
    # Points that rounding may move across a corner are left out.
    sharp = [np.abs(a[0]) > 1e-9 for a in noted if isinstance(a, tuple)]
    clear = np.all([np.ones(16, dtype=bool), *sharp], axis=0)
    assume(clear.any())

    def function(x, y, z):
        return evaluate(expression, jnp, {"x": x, "y": y, "z": z})

    made = MachineFunction(function, 3)
    rows = made(*points.values())
    numbers = [jnp.asarray(p) for p in points.values()]
    value, slopes = jax.vmap(function)(*numbers), jax.vmap(jax.jacfwd(function, (0, 1, 2)))(*numbers)
    steep = np.maximum(size, np.max(np.abs(slopes), axis=0))
    for found in (rows, made.by_numpy(*points.values())):
        assert np.max((np.abs(found[0] - wanted) / size)[clear]) < 1e-12
        assert np.max((np.abs(found[0] - np.asarray(value)) / size)[clear]) < 1e-12
        # Slopes of nested functions lose a digit for each large factor.
        assert np.max((np.abs(found[1:] - np.asarray(slopes)) / steep**2)[:, clear]) < 1e-12
