"""Nonlinear regression problems with certified answers (NIST StRD), as input of the least-squares solver.

All problems are padded to one shape and share one compiled program, which selects the model by its number.
"""

import tomllib
from collections.abc import Callable
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from fitting.estimation.arrow_system import normal_equations
from fitting.estimation.levenberg_marquardt import ArrowLevenbergMarquardt
from fitting.estimation.residual import Blocks, LinearisedResidual, Products, Unknowns

SAMPLES, PARAMETERS = 250, 9
# Residual of a model that is not finite, as in `fitting.estimation.residual`: the step is rejected.
LOST = 1e8


def _saturation(b: Array, x: Array, _: Array) -> Array:
    return b[0] * (1 - jnp.exp(-b[1] * x))


def _chwirut(b: Array, x: Array, _: Array) -> Array:
    return jnp.exp(-b[0] * x) / (b[1] + b[2] * x)


def _lanczos(b: Array, x: Array, _: Array) -> Array:
    return b[0] * jnp.exp(-b[1] * x) + b[2] * jnp.exp(-b[3] * x) + b[4] * jnp.exp(-b[5] * x)


def _gauss(b: Array, x: Array, _: Array) -> Array:
    peaks = b[2] * jnp.exp(-(((x - b[3]) / b[4]) ** 2)) + b[5] * jnp.exp(-(((x - b[6]) / b[7]) ** 2))
    return b[0] * jnp.exp(-b[1] * x) + peaks


def _cubic_over_cubic(b: Array, x: Array, _: Array) -> Array:
    return (b[0] + x * (b[1] + x * (b[2] + x * b[3]))) / (1 + x * (b[4] + x * (b[5] + x * b[6])))


def _enso(b: Array, x: Array, _: Array) -> Array:
    def wave(cosine: Array, sine: Array, period: float | Array) -> Array:
        return cosine * jnp.cos(2 * jnp.pi * x / period) + sine * jnp.sin(2 * jnp.pi * x / period)

    return b[0] + wave(b[1], b[2], 12.0) + wave(b[4], b[5], b[3]) + wave(b[7], b[8], b[6])


def _power(base: Array, exponent: Array) -> Array:
    """base^exponent; NaN, with its derivatives, where the base is negative."""
    return jnp.exp(exponent * jnp.log(base))


MODELS: dict[str, Callable[[Array, Array, Array], Array]] = {
    "Misra1a": _saturation,
    "Chwirut2": _chwirut,
    "Chwirut1": _chwirut,
    "Lanczos3": _lanczos,
    "Gauss1": _gauss,
    "Gauss2": _gauss,
    "DanWood": lambda b, x, _: b[0] * _power(x, b[1]),
    "Misra1b": lambda b, x, _: b[0] * (1 - 1 / (1 + b[1] * x / 2) ** 2),
    "Kirby2": lambda b, x, _: (b[0] + x * (b[1] + x * b[2])) / (1 + x * (b[3] + x * b[4])),
    "Hahn1": _cubic_over_cubic,
    # The response is log y.
    "Nelson": lambda b, x_1, x_2: b[0] - b[1] * x_1 * jnp.exp(-b[2] * x_2),
    "MGH17": lambda b, x, _: b[0] + b[1] * jnp.exp(-x * b[3]) + b[2] * jnp.exp(-x * b[4]),
    "Lanczos1": _lanczos,
    "Lanczos2": _lanczos,
    "Gauss3": _gauss,
    "Misra1c": lambda b, x, _: b[0] * (1 - 1 / jnp.sqrt(1 + 2 * b[1] * x)),
    "Misra1d": lambda b, x, _: b[0] * b[1] * x / (1 + b[1] * x),
    "Roszman1": lambda b, x, _: b[0] - b[1] * x - jnp.arctan(b[2] / (x - b[3])) / jnp.pi,
    "ENSO": _enso,
    "MGH09": lambda b, x, _: b[0] * (x**2 + x * b[1]) / (x**2 + x * b[2] + b[3]),
    "Thurber": _cubic_over_cubic,
    "BoxBOD": _saturation,
    "Rat42": lambda b, x, _: b[0] / (1 + jnp.exp(b[1] - b[2] * x)),
    "MGH10": lambda b, x, _: b[0] * jnp.exp(b[1] / (x + b[2])),
    "Eckerle4": lambda b, x, _: b[0] / b[1] * jnp.exp(-0.5 * ((x - b[2]) / b[1]) ** 2),
    "Rat43": lambda b, x, _: b[0] / _power(1 + jnp.exp(b[1] - b[2] * x), 1 / b[3]),
    "Bennett5": lambda b, x, _: b[0] * _power(b[1] + x, -1 / b[2]),
}

# Some problems share a model, which the program contains once.
_FORMS = list(dict.fromkeys(MODELS.values()))
TABLE = tomllib.loads((Path(__file__).parent / "nist_strd.toml").read_text(encoding="utf-8"))


# Parameters fitted by their logarithm, as `fitting.estimation.free_parameters` does for positive ones.
POSITIVE = {"MGH10": (0, 1, 2)}


class Regression(eqx.Module):
    """Padded data of one problem: `weight` is zero in the padding."""

    number: Int[Array, ""]
    x_1: Float[Array, " samples"]
    x_2: Float[Array, " samples"]
    y: Float[Array, " samples"]
    weight: Float[Array, " samples"]
    logarithmic: Bool[Array, " parameters"]


class Answer(eqx.Module):
    """Result of a fit."""

    parameters: Float[Array, " parameters"]
    sum_of_squares: Array
    information: Float[Array, "parameters parameters"]
    converged: Array


def regression(name: str) -> Regression:
    """The data of a problem."""
    entry = TABLE[name]
    y = np.log(entry["y"]) if name == "Nelson" else np.asarray(entry["y"])
    x_1 = np.asarray(entry["x_1"] if name == "Nelson" else entry["x"])
    x_2 = np.asarray(entry["x_2"]) if name == "Nelson" else x_1
    rest = SAMPLES - y.size
    # Padding repeats the last sample, where the model is finite.
    x_1, x_2, y = (jnp.asarray(np.pad(a, (0, rest), mode="edge")) for a in (x_1, x_2, y))
    weight = jnp.asarray(np.pad(np.ones(SAMPLES - rest), (0, rest)))
    logarithmic = np.isin(np.arange(PARAMETERS), POSITIVE.get(name, ()))
    return Regression(jnp.asarray(_FORMS.index(MODELS[name])), x_1, x_2, y, weight, jnp.asarray(logarithmic))


def padded(values: list[float]) -> Float[Array, " parameters"]:
    """A problem's parameters, padded by ones."""
    return jnp.asarray(np.pad(np.asarray(values), (0, PARAMETERS - len(values)), constant_values=1.0))


def physical(vector: Array, data: Regression) -> Array:
    """The physical parameters of a fitted vector."""
    return jnp.where(data.logarithmic, jnp.exp(jnp.where(data.logarithmic, vector, 0.0)), vector)


def residual(unknowns: Unknowns, data: Regression) -> tuple[LinearisedResidual, Products]:
    """Residual and products of one segment, whose single state has no influence."""

    def error(parameters: Array) -> Array:
        values = jax.lax.switch(data.number, _FORMS, physical(parameters, data), data.x_1, data.x_2)
        found = (data.y - values) * data.weight
        return jnp.where(jnp.abs(found) < LOST, found, LOST)

    rows, slope = error(unknowns.parameters)[None, :], jax.jacfwd(error)(unknowns.parameters)[None]
    none = jnp.zeros((1, 1))
    blocks = Blocks(rows, slope, jnp.zeros((*rows.shape, 1)), none, jnp.zeros((1, 1, PARAMETERS)), none[None])
    return LinearisedResidual(rows, none), Products.of(blocks)


@eqx.filter_jit
def solve(data: Regression, start: Float[Array, " parameters"]) -> Answer:
    """Fit a problem by the least-squares solver of every fit; the information is J^T J of the physical parameters."""
    vector = jnp.where(data.logarithmic, jnp.log(jnp.where(data.logarithmic, start, 1.0)), start)
    state = jnp.zeros((1, 1))
    alone = jnp.zeros(1, dtype=bool)
    # Starting values are far from the solution, so that the first steps are short.
    rows = jnp.asarray(float(data.y.size))
    solver = ArrowLevenbergMarquardt(alone, jnp.ones(1), jnp.asarray(30.0), jnp.asarray(2000), rows, rtol=1e-14)
    start = Unknowns(vector, state)
    solution = optx.least_squares(residual, solver, start, args=data, has_aux=True, max_steps=None, throw=False)
    found = physical(solution.value.parameters, data)
    plain = eqx.tree_at(lambda d: d.logarithmic, data, jnp.zeros_like(data.logarithmic))
    _, products = residual(Unknowns(found, state), plain)
    information = normal_equations(products, alone).shared
    return Answer(found, products.square, information, solution.result == optx.RESULTS.successful)
