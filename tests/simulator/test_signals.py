"""Inter-sample behaviour of sampled signals, and delays of them."""

import inspect

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicSpline

from hdjax import HOLDS, PiecewisePolynomial, sampled

STEP = 1e-3
ROWS = 40
CUBIC_HOLDS = tuple(h for h in HOLDS if h != "band-limited")

seeds = st.integers(min_value=0, max_value=2**32 - 1)
delays = st.floats(min_value=0.0, max_value=5.0)  # in sample intervals
jitters = st.floats(min_value=0.0, max_value=0.15)  # of each stamp; neighbours then differ by up to 30 %


@jax.jit
def evaluate(signal: PiecewisePolynomial, times: jax.Array) -> jax.Array:
    return jax.vmap(signal)(times)


@jax.jit
def delay(signal: PiecewisePolynomial, by: jax.Array) -> PiecewisePolynomial:
    return signal.delayed(by)


@jax.jit
def slope(signal: PiecewisePolynomial, times: jax.Array) -> jax.Array:
    return jax.vmap(jax.grad(lambda t: signal(t)))(times)


def record(seed: int, jitter: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and samples of a rough signal of order one, starting at a time that is not zero."""
    rng = np.random.default_rng(seed)
    time = 0.5 + STEP * (np.arange(ROWS) + jitter * rng.uniform(-1, 1, ROWS))
    return time, rng.normal(size=ROWS)


def between(time: np.ndarray, fraction: float) -> np.ndarray:
    return time[:-1] + fraction * np.diff(time)


def at(signal: PiecewisePolynomial, times: np.ndarray) -> np.ndarray:
    return np.asarray(evaluate(signal, jnp.asarray(times)))


@pytest.mark.parametrize("hold", HOLDS)
@settings(max_examples=20)
@given(seed=seeds, jitter=jitters)
def test_hold_reproduces_the_samples(hold, seed, jitter):
    time, values = record(seed, jitter)
    np.testing.assert_allclose(at(sampled(time, values, hold=hold), time), values, atol=1e-12)


@pytest.mark.parametrize("hold", ("linear", "cubic", "band-limited"))
@settings(max_examples=20)
@given(seed=seeds, jitter=jitters)
def test_smooth_hold_is_continuous(hold, seed, jitter):
    """From the left, too; at twice the largest slope of such samples, a picosecond makes 1e-8."""
    time, values = record(seed, jitter)
    signal = sampled(time, values, hold=hold)
    np.testing.assert_allclose(at(signal, time[1:] - 1e-12), values[1:], atol=1e-8)


@pytest.mark.parametrize("hold", ("cubic", "band-limited"))
@settings(max_examples=10)
@given(seed=seeds, jitter=jitters)
def test_smooth_hold_has_a_continuous_slope(hold, seed, jitter):
    """In units of samples, where curvatures are of order ten: 1e-9 of an interval makes 1e-8."""
    time, values = record(seed, jitter)
    signal = sampled(time, values, hold=hold)
    left, right = (STEP * np.asarray(slope(signal, jnp.asarray(time[1:-1] + s * 1e-12))) for s in (-1, 1))
    np.testing.assert_allclose(left, right, atol=1e-6)


@settings(max_examples=20)
@given(seed=seeds, jitter=jitters, fraction=st.floats(min_value=0.0, max_value=0.99))
def test_zero_order_hold_is_constant_and_linear_hold_interpolates(seed, jitter, fraction):
    time, values = record(seed, jitter)
    when = between(time, fraction)
    np.testing.assert_array_equal(at(sampled(time, values, hold="zero-order"), when), values[:-1])
    # Stamps near 0.5 s are known to 1e-16 s, slopes are up to 1e4: rounding reaches 1e-12.
    np.testing.assert_allclose(
        at(sampled(time, values, hold="linear"), when), np.interp(when, time, values), atol=1e-11
    )


@settings(max_examples=20)
@given(seed=seeds, jitter=jitters, fraction=st.floats(min_value=0.0, max_value=1.0))
def test_cubic_hold_agrees_with_scipys_cubic_spline(seed, jitter, fraction):
    time, values = record(seed, jitter)
    when = between(time, fraction)
    expected = CubicSpline(time, values)(when)
    np.testing.assert_allclose(at(sampled(time, values, hold="cubic"), when), expected, atol=1e-11)


@pytest.mark.parametrize("hold", HOLDS)
def test_last_sample_is_held_beyond_the_record(hold):
    time, values = record(3)
    beyond = time[-1] + STEP * np.array([0.3, 0.9, 20.0])
    np.testing.assert_allclose(at(sampled(time, values, hold=hold), beyond), values[-1], atol=1e-12)


@settings(max_examples=15)
@given(seed=seeds, share=st.floats(min_value=0.05, max_value=0.7))
def test_band_limited_hold_interpolates_a_multisine(seed, share):
    """Up to 0.7 of the Nyquist frequency, 60 samples away from the ends.

    A quintic through exact values, slopes and curvatures errs by up to w^6 / (6! 4^3) of a line's amplitude, with w
    the phase from sample to sample: 2.5e-3 at 0.7 of Nyquist. The windowed filters add 1e-4 of slope and curvature.
    """
    rng = np.random.default_rng(seed)
    rows = 400
    time = 0.5 + STEP * np.arange(rows)
    omegas = np.pi / STEP * share * rng.uniform(0.05, 1.0, 5)
    phases = rng.uniform(0, 2 * np.pi, 5)

    def multisine(t):
        return np.sqrt(2 / 5) * np.sum(np.cos(omegas[:, None] * t + phases[:, None]), axis=0)

    signal = sampled(time, multisine(time), hold="band-limited")
    bound = np.sqrt(2 / 5) * np.sum((omegas * STEP) ** 6 / 46080 + 1e-4 * omegas * STEP)
    for fraction in (0.25, 0.5, 0.8):
        when = between(time, fraction)[60:-60]
        np.testing.assert_allclose(at(signal, when), multisine(when), atol=bound)


def test_band_limited_hold_is_more_accurate_than_others_at_high_frequency():
    time = STEP * np.arange(400)
    omega = 0.6 * np.pi / STEP
    when = between(time, 0.5)[60:-60]
    errors = {h: np.abs(at(sampled(time, np.cos(omega * time), hold=h), when) - np.cos(omega * when)) for h in HOLDS}
    assert errors["band-limited"].max() < 0.1 * errors["cubic"].max()
    assert errors["cubic"].max() < errors["linear"].max() < errors["zero-order"].max()


@pytest.mark.parametrize("hold", HOLDS)
@pytest.mark.parametrize("rows", (3, 30, 200))
def test_hold_of_a_constant_is_constant(hold, rows):
    """Short records, too. 1e-10: the band-limited filters sum to zero to rounding, times 1/STEP scales cancel."""
    time = STEP * np.arange(rows)
    signal = sampled(time, np.full(rows, 3.25), hold=hold)
    np.testing.assert_allclose(at(signal, between(time, 0.37)), 3.25, atol=1e-10)


@pytest.mark.parametrize("hold", ("linear", "cubic", "band-limited"))
def test_hold_of_a_ramp_is_a_ramp(hold):
    """The band-limited slope of a line carries the window's error at zero frequency, 2e-4."""
    time = STEP * np.arange(200)
    when = between(time, 0.37)
    found = at(sampled(time, time / STEP, hold=hold), when)
    np.testing.assert_allclose(found, when / STEP, atol=1e-4 if hold == "band-limited" else 1e-10)


@pytest.mark.parametrize("hold", HOLDS)
@settings(max_examples=10)
@given(seed=seeds, gain=st.floats(-3, 3), offset=st.floats(-3, 3))
def test_affine_applies_gain_and_offset(hold, seed, gain, offset):
    time, values = record(seed)
    signal = sampled(time, values, hold=hold)
    when = between(time, 0.6)
    changed = signal.affine(jnp.asarray(gain), jnp.asarray(offset))
    np.testing.assert_allclose(at(changed, when), gain * at(signal, when) + offset, atol=1e-12)


@pytest.mark.parametrize("hold", HOLDS)
def test_hold_bridges_a_gap_without_overshoot(hold):
    time, values = record(5)
    time = np.concatenate([time[:20], time[20:] + 6.3 * STEP])
    when = np.linspace(time[19], time[20], 50)[:-1]
    assert np.abs(at(sampled(time, values, hold=hold), when)).max() < 4 * np.abs(values).max()


def test_unknown_hold_is_refused():
    """Without the test suite's type checker, which refuses it earlier."""
    time, values = record(0)
    with pytest.raises(ValueError, match="`hold` must be one of .* but is 'sinc'"):
        inspect.unwrap(sampled)(time, values, hold="sinc")


# -- delay --


# Exact for a quintic times a cubic on a piece without breaks.
NODES, WEIGHTS = np.polynomial.legendre.leggauss(6)


def moments(signal, knots: np.ndarray, shift: float, breaks: np.ndarray) -> np.ndarray:
    """Moments up to the third of `signal(t - shift)` over every interval, about its begin, in units of its width."""
    found = np.zeros((knots.size - 1, 4))
    for k, (begin, end) in enumerate(zip(knots[:-1], knots[1:], strict=True)):
        inside = breaks[(breaks > begin + 1e-15) & (breaks < end - 1e-15)]
        edges = np.concatenate([[begin], inside, [end]])
        for a, b in zip(edges[:-1], edges[1:], strict=True):
            t = 0.5 * (a + b) + 0.5 * (b - a) * NODES
            fraction = (t - begin) / (end - begin)
            value = np.array([signal(when - shift) for when in t])
            found[k] += 0.5 * (b - a) / (end - begin) * (WEIGHTS * value) @ fraction[:, None] ** np.arange(4)
    return found


def numpy_signal(signal: PiecewisePolynomial):
    """The same piecewise polynomial by an independent implementation."""
    knots, coefficients = np.asarray(signal.knots), np.asarray(signal.coefficients)

    def value(t):
        k = int(np.clip(np.searchsorted(knots, t, side="right") - 1, 0, len(coefficients) - 1))
        return np.polynomial.polynomial.polyval(t - knots[k], coefficients[k])

    return value


@pytest.mark.parametrize("hold", HOLDS)
@settings(max_examples=5)
@example(seed=1, jitter=0.15, intervals=0.93)  # intervals that lie on three pieces
@given(seed=seeds, jitter=jitters, intervals=delays)
def test_delay_keeps_the_moments_of_every_interval(hold, seed, jitter, intervals):
    time, values = record(seed, jitter)
    signal = sampled(time, values, hold=hold)
    knots, by = np.asarray(signal.knots), intervals * STEP
    late = delay(signal, jnp.asarray(by))
    original = moments(numpy_signal(signal), knots, by, knots + by)
    found = moments(numpy_signal(late), knots, 0.0, knots)
    # Stamps near 0.5 s are known to 1e-16 s = 1e-13 intervals, where jumps are of order one.
    np.testing.assert_allclose(found, original, atol=1e-10)


@pytest.mark.parametrize("hold", CUBIC_HOLDS)
@settings(max_examples=10)
@given(seed=seeds, jitter=jitters)
def test_zero_delay_does_not_change_the_signal(hold, seed, jitter):
    time, values = record(seed, jitter)
    signal = sampled(time, values, hold=hold)
    when = between(time, 0.3)
    np.testing.assert_allclose(at(delay(signal, jnp.asarray(0.0)), when), at(signal, when), atol=1e-11)


@pytest.mark.parametrize("hold", CUBIC_HOLDS)
@settings(max_examples=10)
@given(seed=seeds, samples=st.integers(1, 7))
def test_delay_by_whole_samples_is_a_shift(hold, seed, samples):
    time, values = record(seed)
    signal = sampled(time, values, hold=hold)
    late = delay(signal, jnp.asarray(samples * STEP))
    for fraction in (0.2, 0.9):
        when = between(time, fraction)
        np.testing.assert_allclose(at(late, when)[samples:], at(signal, when)[:-samples], atol=1e-10)


def test_delayed_signal_begins_with_the_first_sample():
    time, values = record(2)
    late = delay(sampled(time, values, hold="zero-order"), jnp.asarray(3.4 * STEP))
    np.testing.assert_allclose(at(late, between(time, 0.5)[:3]), values[0], atol=1e-12)


@pytest.mark.parametrize("time", ([0.0], [0.0, 2.0, 1.0], [0.0, 1.0, 1.0], [0.0, np.nan, 1.0]))
def test_stamps_that_do_not_rise_are_refused(time):
    with pytest.raises(ValueError, match="`time` must rise"):
        sampled(np.array(time), np.ones(len(time)), hold="linear")


@jax.jit
def delay_slope(signal: PiecewisePolynomial, by: jax.Array) -> jax.Array:
    return jax.jvp(lambda d: signal.delayed(d).coefficients, (by,), (jnp.ones_like(by),))[1]


@pytest.mark.parametrize("hold", HOLDS)
@pytest.mark.parametrize("intervals", (0.05, 0.6, 2.31))
def test_derivative_by_the_delay_agrees_with_differences(hold, intervals):
    time, values = record(11, 0.1)
    signal = sampled(time, values, hold=hold)
    by, h = intervals * STEP, 1e-5 * STEP
    late, later = (np.asarray(delay(signal, jnp.asarray(by + s * h)).coefficients) for s in (-1, 1))
    differences = (later - late) / (2 * h)
    found = np.asarray(delay_slope(signal, jnp.asarray(by)))
    # Coefficient j counts in STEP^-j. Differences err by (1e-5)^2 times third derivatives of up to 1e6, and by
    # rounding, 1e-12 / 1e-5.
    powers = STEP ** np.arange(found.shape[1]) * STEP
    np.testing.assert_allclose(found * powers, differences * powers, rtol=1e-6, atol=2e-4)
    assert np.abs(found * powers).max() > 0.1


@pytest.mark.parametrize("hold", HOLDS)
@pytest.mark.parametrize("jitter", (0.0, 0.1))
@pytest.mark.parametrize(
    ("change", "intervals"), (("delayed", 0.6), ("delayed", -2.31), ("lagged", 1.7), ("lagged", 0.05))
)
def test_numpy_and_jax_change_a_signal_alike(hold, jitter, change, intervals):
    """Also by complex steps, as the fit differentiates where nothing is traced."""
    signal = sampled(*record(5, jitter), hold=hold)
    by, tiny = intervals * STEP, 1e-30
    one = jax.jvp(lambda d: getattr(signal, change)(d).coefficients, (jnp.asarray(by),), (jnp.asarray(1.0),))
    other = getattr(jax.tree.map(np.asarray, signal), change)(by + 1j * tiny).coefficients
    # Coefficient j counts in STEP^-j.
    powers = STEP ** np.arange(other.shape[1])
    np.testing.assert_allclose(other.real * powers, np.asarray(one[0]) * powers, atol=1e-9)
    np.testing.assert_allclose(other.imag / tiny * powers * STEP, np.asarray(one[1]) * powers * STEP, atol=1e-8)


@pytest.mark.parametrize("hold", ("linear", "cubic", "band-limited"))
def test_signal_without_its_lag_lags_to_the_signal(hold):
    signal, by = sampled(*record(6), hold=hold), jnp.asarray(0.7 * STEP)
    again = signal.unlagged(by).lagged(by)
    when = between(record(6)[0], 0.5)[10:]
    np.testing.assert_allclose(at(again, when), at(signal, when), atol=1e-6)
