"""Functions evaluated at many instants without compilation, against JAX; and those that JAX has to evaluate."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hdjax.effects import Motion
from hdjax.effects.creep import Creep
from hdjax.engine import pointwise
from hdjax.engine.driven import own_states_along
from hdjax.engine.pointwise import at_instants, slopes_at_instants

SHAPES = [(5,), (3, 7), (2, 9000), (3, 5000, 1)]


def function_of_a_point(strengths, effect, point):
    size, name = effect
    assert name == "some"
    return {
        "sine": strengths[0] * jnp.sin(size * point["angle"]) + strengths[1] ** 2,
        "both": jnp.stack([point["pair"][0] * strengths[1], point["pair"][1], size]),
    }


def sorted_pair(strengths, point):
    """A function with a primitive that can't be translated."""
    return strengths * jnp.sort(point["pair"])


def points(shape: tuple[int, ...]) -> dict[str, np.ndarray]:
    draw = np.random.default_rng(0)
    return {"angle": draw.normal(size=shape), "pair": draw.normal(size=(*shape, 2))}


def mapped_over(function, shape: tuple[int, ...]):
    """The function mapped by JAX over the axes of the instants."""
    for _ in shape:
        function = jax.vmap(function)
    return function


@pytest.mark.parametrize("shape", SHAPES)
def test_values_and_slopes_at_instants_agree_with_jax(shape: tuple[int, ...]):
    looked_at, strengths, effect = points(shape), np.array([0.7, -1.3]), (np.array(1.1), "some")
    found = at_instants(function_of_a_point, (strengths, 0), (effect, 0), (looked_at, len(shape)))
    slopes = slopes_at_instants(function_of_a_point, (strengths, 0), (effect, 0), (looked_at, len(shape)))
    wanted = mapped_over(lambda point: function_of_a_point(strengths, effect, point), shape)(looked_at)
    linear = mapped_over(lambda point: jax.jacfwd(function_of_a_point)(strengths, effect, point), shape)(looked_at)
    for name in wanted:
        np.testing.assert_allclose(found[name], wanted[name], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(slopes[name], linear[name], rtol=1e-12, atol=1e-12)


def test_arguments_broadcast_over_instants():
    """Each of two effects at each of four points."""
    sizes, looked_at = np.array([[0.5], [2.0]]), points((4,))
    strengths = np.array([[[1.0, 2.0]], [[3.0, 4.0]]])
    found = at_instants(function_of_a_point, (strengths, 2), ((sizes, "some"), 2), (looked_at, 1))
    assert found["sine"].shape == (2, 4) and found["both"].shape == (2, 4, 3)
    expected = strengths[..., 0] * np.sin(sizes * looked_at["angle"]) + strengths[..., 1] ** 2
    np.testing.assert_allclose(found["sine"], expected, rtol=1e-12)


def test_untranslatable_function_is_evaluated_by_jax():
    looked_at, strengths = points((3, 4)), np.array([2.0, 3.0])
    found = at_instants(sorted_pair, (strengths, 0), (looked_at, 2))
    slopes = slopes_at_instants(sorted_pair, (strengths, 0), (looked_at, 2))
    ordered = np.sort(looked_at["pair"], axis=-1)
    np.testing.assert_allclose(found, strengths * ordered)
    np.testing.assert_allclose(slopes, ordered[..., None] * np.eye(2))


def test_single_instant_is_evaluated_by_jax():
    looked_at = {"pair": np.array([2.0, 1.0])}
    found = at_instants(sorted_pair, (np.array([1.0, 3.0]), 0), (looked_at, 0))
    np.testing.assert_array_equal(found, [1.0, 6.0])


def test_function_is_translated_once_for_all_values(monkeypatch: pytest.MonkeyPatch):
    looked_at, strengths = points((6,)), np.array([0.7, -1.3])
    at_instants(function_of_a_point, (strengths, 0), ((np.array(1.1), "some"), 0), (looked_at, 1))

    def refused(*_):
        raise AssertionError("translated again")

    monkeypatch.setattr(pointwise, "translated", refused)
    at_instants(function_of_a_point, (2.0 * strengths, 0), ((np.array(0.1), "some"), 0), (points((8,)), 1))


@pytest.mark.parametrize("by_machine_code", [True, False])
def test_hidden_states_along_a_ramp_agree_with_the_closed_form(by_machine_code: bool):
    """Creep's state follows a ramp of the twist with a lag, in closed form."""
    width, speed, taus = np.full((2, 40), 2e-3), np.array([0.3, -0.2]), np.array([0.01, 0.05])
    time = np.pad(np.cumsum(width, axis=1), ((0, 0), (1, 0)))
    twist = speed[:, None] * time
    before, after = (Motion(x=jnp.asarray(x), v=jnp.zeros_like(x)) for x in (twist[:, :-1], twist[:, 1:]))
    creep = Creep(tau=0.01, span=1e-3)
    effect = jax.tree.map(lambda a: np.broadcast_to(np.asarray(a), 2), creep)
    effect = jax.tree.map(lambda a, b: np.where(b == 0.01, taus, a), effect, creep)
    start = np.full((2, 2, 1), 1e-3)
    found = own_states_along(effect, before, after, width, start, by_machine_code=by_machine_code)
    t, tau = time[:, :, None], taus[None, None]
    decay, ramp = np.exp(-t / tau), speed[:, None, None] * t
    expected = ramp - speed[:, None, None] * tau * (1.0 - decay) + 1e-3 * decay
    np.testing.assert_allclose(found[..., 0], expected, rtol=1e-6, atol=1e-9)


@jax.custom_jvp
def still(x):
    """A function whose own rule says that it does not change."""
    return x**2


@still.defjvp
def _(points, tangents):
    return still(*points), jnp.zeros_like(tangents[0])


WEIGHTS = jnp.arange(3.0)


@jax.custom_jvp
def weighted(x):
    """A function that captures an array."""
    return x * jnp.sum(WEIGHTS)


@weighted.defjvp
def _(points, tangents):
    return weighted(*points), 2.0 * tangents[0] * jnp.sum(WEIGHTS)


@pytest.mark.parametrize(("function", "slope"), [(still, 0.0), (weighted, 6.0)])
def test_rule_of_a_function_decides_its_slope(function, slope: float):
    """Also where it captures arrays, so that it can't be translated."""

    def scaled(strengths, x):
        return function(strengths[0] * x)

    x = np.array([1.0, -3.0])
    found = slopes_at_instants(scaled, (np.array([2.0]), 0), (x, 1))
    np.testing.assert_allclose(found[:, 0], slope * x)
