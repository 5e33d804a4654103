"""The core of the fit reaches the certified values and standard errors of NIST's nonlinear regression problems."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from nist_strd import MODELS, TABLE, Regression, padded, physical, regression, residual, solve

from fitting.estimation.residual import Unknowns
from hdjax.compilation import jit_small

DIGITS = 1e-6
# Lanczos1 is noiseless but for the 14th digit: evaluated in double precision, its residual of 1e-13 keeps three digits,
# and so do the standard errors, which are in proportion to it.
ROUNDING = {"Lanczos1": 1e-2}


def sum_of_squares(parameters, data: Regression) -> float:
    """Sum of squared residuals at physical parameters."""
    return float(_sum_of_squares(parameters, data))


@jit_small
def _sum_of_squares(parameters, data: Regression):
    plain = eqx.tree_at(lambda d: d.logarithmic, data, jnp.zeros_like(data.logarithmic))
    return jnp.sum(residual(Unknowns(parameters, jnp.zeros((1, 1))), plain)[0].rows ** 2)


def test_table_holds_all_27_problems():
    assert len(TABLE) == 27
    assert set(TABLE) == set(MODELS)
    assert {
        level: sum(e["difficulty"] == level for e in TABLE.values()) for level in ("lower", "average", "higher")
    } == {
        "lower": 8,
        "average": 11,
        "higher": 8,
    }


@pytest.mark.parametrize("name", TABLE)
def test_certified_parameters_give_the_certified_sum_of_squares(name: str):
    """Detect an error in a table or a model, independently of the fit."""
    entry = TABLE[name]
    found = sum_of_squares(padded(entry["certified"]), regression(name))
    # Certified to eleven digits; rounding of the residual leaves two or three of Lanczos1's.
    assert found == pytest.approx(entry["sum_of_squares"], rel=ROUNDING.get(name, 1e-7))


@pytest.mark.parametrize("start", [1, 2])
@pytest.mark.parametrize("name", TABLE)
def test_solver_reaches_certified_values_and_standard_errors(name: str, start: int):
    entry = TABLE[name]
    certified, errors = np.asarray(entry["certified"]), np.asarray(entry["standard_errors"])
    count = certified.size
    begin = np.asarray(entry["starts"][start - 1])
    assert np.max(np.abs(begin / certified - 1)) > 1e-2, "the start is the answer"
    found = solve(regression(name), padded(entry["starts"][start - 1]))
    assert found.converged
    np.testing.assert_allclose(found.parameters[:count], certified, rtol=DIGITS)
    assert float(found.sum_of_squares) == pytest.approx(entry["sum_of_squares"], rel=ROUNDING.get(name, DIGITS))
    information = np.asarray(found.information)[:count, :count]
    scale = 1.0 / np.sqrt(np.diag(information))
    inverse = np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale)
    variance = float(found.sum_of_squares) / (len(entry["y"]) - count)
    np.testing.assert_allclose(np.sqrt(variance * np.diag(inverse)), errors, rtol=ROUNDING.get(name, DIGITS))


def test_padded_parameters_do_not_move():
    found = solve(regression("Misra1a"), padded(TABLE["Misra1a"]["starts"][1]))
    np.testing.assert_array_equal(found.parameters[2:], 1.0)


def test_sum_of_squares_detects_wrong_parameters():
    data, entry = regression("Misra1a"), TABLE["Misra1a"]
    vector = padded(entry["certified"]) * (1 + 1e-4)
    assert sum_of_squares(vector, data) > (1 + 10 * DIGITS) * entry["sum_of_squares"]
    np.testing.assert_array_equal(physical(vector, data), vector)
