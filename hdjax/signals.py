"""Inter-sample behaviour of sampled signals: one polynomial per interval for every hold."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, Literal, get_args

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Inexact, Int

DEGREE = 5
"""Degree of the polynomial of an interval; 5 matches value, slope and curvature at both ends."""

Hold = Literal["zero-order", "linear", "cubic", "band-limited"]
"""Inter-sample behaviour of a sampled input: constant, straight, a cubic spline, or a windowed sinc."""
HOLDS: tuple[Hold, ...] = get_args(Hold)
"""All of them."""


_Number = Array | np.ndarray | float | complex


class PiecewisePolynomial(eqx.Module):
    """A signal that is a polynomial in `t - knots[k]` on each interval `knots[k] <= t < knots[k + 1]`.

    Several signals, along first axes, are changed together by numpy, with real or complex numbers.

    Attributes:
        knots: interval ends [s], rising.
        coefficients: `coefficients[k, j]` multiplies `(t - knots[k])**j`.
    """

    knots: Float[Array | np.ndarray, "*batch knots"]
    coefficients: Inexact[Array | np.ndarray, "*batch intervals powers"]

    def __call__(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """The signal's value at time `t` [s]; the end polynomials continue beyond the ends."""
        return self._on(jnp.searchsorted(self.knots, t, side="right"), t)

    def before(self, t: Float[Array, ""]) -> Float[Array, ""]:
        """The limit of the signal's value from times before `t` [s]; at the first knot, from after it."""
        return self._on(jnp.searchsorted(self.knots, t, side="left"), t)

    def _on(self, following: Int[Array, ""], t: Float[Array, ""]) -> Float[Array, ""]:
        """The value at a time by the polynomial that ends at this knot."""
        k = jnp.clip(following - 1, 0, self.coefficients.shape[0] - 1)
        return polynomial(self.coefficients[k], t - self.knots[k])

    def affine(self, gain: _Number, offset: _Number) -> "PiecewisePolynomial":
        """The signal `gain * self + offset`."""
        first = np.eye(1, self.coefficients.shape[-1])
        return PiecewisePolynomial(self.knots, gain * self.coefficients + offset * first)

    def delayed(self, delay: _Number) -> "PiecewisePolynomial":
        """The signal `self(t - delay)` on the same knots.

        A jump that the delay moves inside an interval can't be represented by one polynomial. Each interval gets the
        quintic with the same moments up to the fifth (the L2 projection). So a smooth system receives the same impulse,
        and the result is differentiable by the delay.

        Args:
            delay: of the signal [s].
        """
        library = _library_of(self.knots, delay)
        start: Any = self.knots[..., :-1] - delay
        width = library.diff(self.knots)
        last = self.coefficients.shape[-2] - 1
        search = functools.partial(library.searchsorted, side="right")
        before = library.vectorize(search, signature="(m),(n)->(n)")(self.knots, start.real)
        source = library.clip(before - 1, 0, last)

        parts, begin = [], library.zeros_like(width)
        for j in range(_PIECES):
            piece = library.minimum(source + j, last)
            following = library.take_along_axis(self.knots, piece + 1, axis=-1)
            end = library.clip(following - start, begin, width) if j < _PIECES - 1 else width
            coefficients = library.take_along_axis(self.coefficients, piece[..., None], axis=-2)
            shift = start - library.take_along_axis(self.knots, piece, axis=-1)
            parts.append((coefficients, shift, begin, end))
            begin = end
        project = _projected if library is jnp else _projected_alike
        return PiecewisePolynomial(self.knots, project(parts, width))

    def lagged(self, lag: _Number) -> "PiecewisePolynomial":
        """The signal y of `lag y' + y = self`, in steady state at the first knot, on the same knots.

        On each interval y is a polynomial and a decaying exponential; the latter is replaced by the quintic with the
        same moments, see [`delayed`][].

        Args:
            lag: time constant [s], above zero.
        """
        library = _library_of(self.knots, lag)
        width = library.diff(self.knots)
        # The polynomial part: self - lag self' + lag^2 self'' - ...
        part = derivative = self.coefficients
        for _ in range(DEGREE):
            derivative = -lag * _rate(derivative)
            part = part + derivative
        first, end = part[..., 0], polynomial(part, width)
        # The exponential part at the start of each interval.
        away = _summed(library.exp(-width / lag)[..., :-1], end[..., :-1] - first[..., 1:])
        away = library.concatenate([library.zeros_like(first[..., :1]), away], axis=-1)
        # Equidistant stamps share one row of moments.
        one = width[(slice(1),) * width.ndim]
        shared = library is np and bool(np.all(np.abs(width - one) <= _ALIKE * one))
        legendre = away[..., None] * _decay_moments((one if shared else width) / lag) * library.asarray(_NORMS)[None, :]
        return PiecewisePolynomial(self.knots, part + _powers(legendre, width))

    def unlagged(self, lag: _Number) -> "PiecewisePolynomial":
        """The signal `self + lag self'`, which [`lagged`][] would turn into this one; a jump adds no impulse.

        Args:
            lag: time constant [s].
        """
        return PiecewisePolynomial(self.knots, self.coefficients + lag * _rate(self.coefficients))


def _rate(coefficients: Any) -> Any:
    """Coefficients of the derivative of polynomials."""
    library = _library_of(coefficients)
    risen = coefficients[..., 1:] * np.arange(1.0, coefficients.shape[-1])[None, :]
    return library.concatenate([risen, library.zeros_like(coefficients[..., :1])], axis=-1)


def _library_of(*arrays: Any) -> Any:
    """The array library: numpy where none of the arrays is one of JAX."""
    return jnp if any(isinstance(array, Array) for array in arrays) else np


def _summed(factor: Any, push: Any) -> Any:
    """The sequence `next = factor * now + push` that starts from zero, without the zero. Each pass doubles the number
    of terms."""
    library, step = _library_of(push), 1

    def earlier(terms: Any) -> Any:
        return library.concatenate([library.zeros_like(terms[..., :step]), terms[..., :-step]], axis=-1)

    while step < push.shape[-1]:
        push, factor, step = push + factor * earlier(push), factor * earlier(factor), 2 * step
    return push


def _projected(parts: Sequence[tuple[Any, ...]], width: Any) -> Any:
    """Coefficients of the quintics over intervals that have the moments of several pieces together.

    Args:
        parts: of each piece the coefficients; the time into it at which the interval begins; where in the interval it
            begins and ends.
        width: of the intervals.
    """
    library = _library_of(width)
    moments = sum(_moments(part, width) for part in parts)
    return _powers(moments @ library.asarray(_POWERS_TO_LEGENDRE) / width[..., None], width)


def _moments(part: tuple[Any, ...], width: Any) -> Any:
    """Integrals of one piece over its part of the intervals, times powers of `z`, which rises from -1 to 1 over an
    interval."""
    coefficients, shift, begin, end = part
    half = 0.5 * (end - begin)
    at = [begin + half * (node + 1.0) for node in _NODES]
    weighted = [w * half * polynomial(coefficients, t + shift) for w, t in zip(_WEIGHTS, at, strict=True)]
    z = [2.0 * t / width - 1.0 for t in at]
    found = [sum(weighted)]
    for _ in range(DEGREE):
        weighted = [value * x for value, x in zip(weighted, z, strict=True)]
        found.append(sum(weighted))
    return _library_of(*found).stack(found, axis=-1)


def _projected_alike(parts: Sequence[tuple[Any, ...]], width: np.ndarray) -> np.ndarray:
    """[`_projected`][] by numpy. The intervals that are cut like the middle one share one linear map: nearly all, where
    stamps are equidistant."""
    middle = tuple(n // 2 for n in width.shape)
    cuts = [width, *(cut.real for _, *own in parts for cut in own)]
    apart = np.any([np.abs(cut - cut[middle]) > _ALIKE * width[middle] for cut in cuts], axis=0)
    units = np.eye(DEGREE + 1)
    found: Any = 0.0
    for coefficients, *own in parts:
        unit = units, *(np.ravel(cut[middle]) for cut in own)
        found = found + coefficients @ _projected([unit], np.ravel(width[middle]))
    others = [tuple(each[apart] for each in part) for part in parts]
    found[apart] = _projected(others, width[apart])
    return found


def _powers(legendre: Any, width: Any) -> Any:
    """Coefficients in powers of the time into each interval, from those of Legendre polynomials over it."""
    powers = legendre @ _library_of(legendre).asarray(_LEGENDRE_TO_POWERS)
    return powers / width[..., None] ** np.arange(DEGREE + 1.0)[None, :]


def _decay_moments(rate: Inexact[Array | np.ndarray, "*batch n"]) -> Inexact[Array | np.ndarray, "*batch n d"]:
    """Integrals over u from 0 to 1 of exp(-rate u) times the Legendre polynomials there."""
    library = _library_of(rate)
    slow = library.where(rate < _FAST, rate, 1.0)
    u = library.asarray(0.5 * (_FINE_NODES + 1.0))
    weighted = library.asarray(0.5 * _FINE_WEIGHTS)[None, :] * library.exp(-slow[..., None] * u[None, :])
    by_quadrature = weighted @ library.asarray(np.polynomial.legendre.legvander(_FINE_NODES, DEGREE))
    # Modified spherical Bessel functions of half the rate, scaled; their recurrence is stable where it is large.
    half = 0.5 * library.where(rate < _FAST, _FAST, rate)
    tail = library.exp(-2.0 * half)
    found = [0.5 * (1.0 - tail) / half, 0.5 * ((1.0 + tail) / half - (1.0 - tail) / half**2)]
    for d in range(1, DEGREE):
        found.append(found[d - 1] - (2 * d + 1) / half * found[d])
    signs = (-1.0) ** np.arange(DEGREE + 1)
    by_recurrence = library.stack(found, axis=-1) * library.asarray(signs)[None, :]
    return library.where((rate < _FAST)[..., None], by_quadrature, by_recurrence)


def polynomial(coefficients: Inexact[Array | np.ndarray, "*a d"], s: Inexact[Array | np.ndarray, "*b"]) -> Any:
    """Value of `sum_j coefficients[..., j] s**j` by Horner's rule."""
    value = coefficients[..., -1]
    for j in range(coefficients.shape[-1] - 2, -1, -1):
        value = value * s + coefficients[..., j]
    return value


# Six Gauss-Legendre points integrate a quintic against a quintic exactly.
_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(6)
# Sixteen do so for an exponential that falls by this many e-folds in the interval.
_FINE_NODES, _FINE_WEIGHTS = np.polynomial.legendre.leggauss(16)
_FAST = 12.0
_NORMS = 2.0 * np.arange(DEGREE + 1) + 1.0
# Integrals times powers of z on [-1, 1], to coefficients of Legendre polynomials.
_POWERS_TO_LEGENDRE = (
    np.array(
        [np.pad(np.polynomial.legendre.leg2poly(row), (0, DEGREE - d)) for d, row in enumerate(np.eye(DEGREE + 1))]
    ).T
    * _NORMS
)
# Cuts that differ by this share of an interval are alike: the rounding of stamps.
_ALIKE = 1e-10
# A delayed interval may overlap two pieces, or three with jittering stamps (by up to a third).
_PIECES = 3
# Rows: Legendre polynomials on [0, 1] in powers of the fraction of the interval.
_LEGENDRE_TO_POWERS = np.array(
    [
        np.pad(
            np.polynomial.Legendre.basis(d, domain=[0, 1]).convert(kind=np.polynomial.Polynomial, domain=[-1, 1]).coef,
            (0, DEGREE - d),
        )
        for d in range(DEGREE + 1)
    ]
)


def sampled(time: Float[np.ndarray, " n"], values: Float[np.ndarray, " n"], *, hold: Hold) -> PiecewisePolynomial:
    """A signal through samples.

    Args:
        time: sample stamps [s], rising; two at least.
        values: the samples.
        hold: inter-sample behaviour. `"zero-order"`: keeps the sample until the next one (a digital drive's torque
            command); `"linear"`; `"cubic"`: a cubic spline; `"band-limited"`: the smooth signal without content above
            half the sampling rate (anti-aliased analogue measurements), from a windowed sinc.

    Returns:
        The signal on `n` intervals; the last one has the median width.

    Raises:
        ValueError: unknown hold, stamps that do not rise, or another number of samples.
    """
    if hold not in HOLDS:
        raise ValueError(f"`hold` must be one of {HOLDS}, but is {hold!r}")
    if np.shape(time) != np.shape(values) or np.ndim(time) != 1:
        raise ValueError(f"`values` must be as many as the stamps, {np.shape(time)}, but are {np.shape(values)}")
    if np.size(time) < 2 or not np.all(np.diff(time) > 0.0):
        raise ValueError("`time` must rise from each of two stamps or more to the next, but does not")
    width = np.diff(time)
    knots = np.append(time, time[-1] + np.median(width))
    build: dict[str, Callable[[np.ndarray, np.ndarray], np.ndarray]] = {
        "zero-order": _zero_order,
        "linear": _linear,
        "cubic": _cubic,
        "band-limited": _band_limited,
    }
    coefficients = build[hold](knots, np.asarray(values, dtype=float))
    return PiecewisePolynomial(jnp.asarray(knots), jnp.asarray(coefficients))


def _zero_order(knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    coefficients = np.zeros((values.size, DEGREE + 1))
    coefficients[:, 0] = values
    return coefficients


def _linear(knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    coefficients = _zero_order(knots, values)
    coefficients[:-1, 1] = np.diff(values) / np.diff(knots)[:-1]
    return coefficients


def _cubic(knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    # Imported here: most commands do not need it.
    from scipy.interpolate import CubicSpline

    coefficients = np.zeros((values.size, DEGREE + 1))
    coefficients[:-1, :4] = CubicSpline(knots[:-1], values).c[::-1].T
    coefficients[-1, 0] = values[-1]
    return coefficients


def _band_limited(knots: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Quintic Hermite pieces; slopes and curvatures at the samples come from a Kaiser-windowed sinc."""
    width = float(np.median(np.diff(knots)))
    reach = 48
    n = np.arange(-reach, reach + 1)
    window = np.kaiser(2 * reach + 1, 10.0)
    away = np.where(n == 0, 1, n)
    sign = np.where(n % 2 == 0, 1.0, -1.0)
    slope_filter = np.where(n == 0, 0.0, sign / away) * window
    curvature_filter = np.where(n == 0, -(np.pi**2) / 3, -2.0 * sign / away**2) * window
    # Corrects the window's truncation, so that a constant has no curvature.
    curvature_filter[reach] -= curvature_filter.sum()
    # Odd reflection keeps value and slope continuous where the record ends.
    extended = np.pad(values, reach, mode="reflect", reflect_type="odd")
    u0 = values
    d0 = np.convolve(extended, slope_filter, mode="valid")
    c0 = np.convolve(extended, curvature_filter, mode="valid")
    u1, d1, c1 = (np.append(a[1:], a[-1]) for a in (u0, d0, c0))
    # The filters count in median intervals, a piece in its own: with jittered stamps they differ.
    stretch = np.diff(knots) / width
    d0, d1, c0, c1 = d0 * stretch, d1 * stretch, c0 * stretch**2, c1 * stretch**2
    jump = u1 - u0
    coefficients = np.stack(
        [
            u0,
            d0,
            c0 / 2,
            10 * jump - 6 * d0 - 4 * d1 - 1.5 * c0 + 0.5 * c1,
            -15 * jump + 8 * d0 + 7 * d1 + 1.5 * c0 - c1,
            6 * jump - 3 * (d0 + d1) + 0.5 * (c1 - c0),
        ],
        axis=1,
    )
    coefficients[-1, 1:] = 0.0
    return coefficients / np.diff(knots)[:, None] ** np.arange(DEGREE + 1)
