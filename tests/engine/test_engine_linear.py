"""A linear system in machine code against the same sums by numpy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hdjax.engine.linear import linear_response


@settings(deadline=None, max_examples=40)
@given(
    sizes=st.tuples(*(st.integers(1, most) for most in (3, 7, 6, 3, 5, 21))),
    seed=st.integers(0, 2**32 - 1),
)
def test_linear_response_agrees_with_the_recursion(sizes: tuple[int, int, int, int, int, int], seed: int):
    segments, samples, states, outputs, parts, columns = sizes
    random = np.random.default_rng(seed)
    transition = random.normal(size=(segments, samples, states, states))
    readout = random.normal(size=(segments, samples, outputs, states))
    lands = random.normal(size=(segments, samples, states, parts))
    forces = random.normal(size=(segments, samples, parts, columns))
    state = start = random.normal(size=(segments, states, columns))
    found, end = linear_response(transition, readout, lands, forces, start)
    for i in range(samples):
        wanted = readout[:, i] @ state
        np.testing.assert_allclose(found[:, i], wanted, rtol=0, atol=1e-13 * (10.0 + np.abs(state).max()) * states)
        state = transition[:, i] @ state + lands[:, i] @ forces[:, i]
    np.testing.assert_allclose(end, state, rtol=0, atol=1e-12 * (10.0 + np.abs(state).max()))


def test_linear_response_with_too_many_states_is_refused():
    many = 65
    with pytest.raises(ValueError, match="at most 64 states, but has 65"):
        linear_response(
            np.zeros((1, 1, many, many)),
            np.zeros((1, 1, 1, many)),
            np.zeros((1, 1, many, 1)),
            np.zeros((1, 1, 1, 8)),
            np.zeros((1, many, 8)),
        )
