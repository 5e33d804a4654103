"""One program of a fixed size for motions of all lengths: the pieces must not show."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.instants import INSTANTS, at_instants, through_instants

SHAPES = [(5,), (3, 7), (INSTANTS,), (2, INSTANTS // 2 + 1), (3, INSTANTS, 1)]


def looked_at(shape: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    draw = np.random.default_rng(0)
    return draw.normal(size=shape), draw.normal(size=(*shape, 2))


@pytest.mark.parametrize("shape", SHAPES)
def test_each_instant_by_itself(shape: tuple[int, ...]):
    angle, pair = looked_at(shape)
    sizes = []

    def program(angle, pair):
        sizes.append(angle.shape)
        return {"sine": jnp.sin(angle), "both": jnp.stack([pair[:, 0], pair[:, 1], angle], axis=-1)}

    found = at_instants(program, shape, angle, pair)
    assert set(sizes) == {(INSTANTS,)}
    np.testing.assert_array_equal(found["sine"], jnp.sin(angle))
    np.testing.assert_array_equal(found["both"], np.concatenate([pair, angle[..., None]], axis=-1))


@pytest.mark.parametrize("shape", SHAPES)
def test_what_one_instant_leaves_the_next_one_takes(shape: tuple[int, ...]):
    angle, _ = looked_at(shape)

    @jax.jit
    def program(before, angle):
        total = before + jnp.cumsum(angle)
        return total[-1], total

    found = through_instants(program, jnp.ones(()), shape, angle)
    np.testing.assert_allclose(found, 1.0 + np.cumsum(angle).reshape(shape), rtol=1e-9, atol=1e-9)


def test_nothing_is_made_of_what_has_no_columns():
    """An effect without own states has an empty axis for them."""
    found = at_instants(lambda states: jnp.sum(states, axis=1), (4, 3), np.zeros((4, 3, 0, 2)))
    assert found.shape == (4, 3, 2)
