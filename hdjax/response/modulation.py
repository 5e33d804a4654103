"""The slow amplitude and phase of a resonant mode: steady branches, their stability, peak and folds.

Every resonance of the cubic oscillator reduces, at first order of multiple scales, to one complex equation for the
resonant part `a cos(w_r t + psi)` of the response, with `z = a exp(i psi)`, the detuning `s = w_r - omega_0` and
`^` for the conjugate:

    z' = -(mu/2 + i (s - kappa - q |z|^2)) z + i e        additive: primary, super-harmonic, combinations
    z' = -(mu/2 + i (s - kappa - q |z|^2)) z + i e z^^2   sub-harmonic of order 1/3

With `v = q a^2`, the shift of the mode's frequency by its own amplitude, steady states obey
`(mu/2)^2 + (s - kappa - v)^2 = gain(a)^2`, where `gain` is `|e|/a` or `|e| a`. In `v` the polynomials stay monic, so
`alpha -> 0` and `mu -> 0` are no special cases.

References:
    Nayfeh & Mook, Nonlinear Oscillations, 1979, sections 4.1.1 to 4.1.4, with twice their damping coefficient as mu.
"""

import abc
from collections.abc import Callable
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

Curve = tuple[Float[Array, "*points"], Float[Array, "*points"], Bool[Array, "*points"]]


class Branches(eqx.Module):
    """Steady states at one frequency in the slots lower, middle, upper; a branch keeps its slot up to its fold.

    Attributes:
        amplitude: a of `a cos(w_r t + phase)` [rad]; 0 where the branch is absent.
        phase: see `amplitude` [rad]; 0 where the branch is absent.
        exists: whether the branch is there.
        stable: whether it is there and small deviations from it decay.
    """

    amplitude: Float[Array, "3"]
    phase: Float[Array, "3"]
    exists: Bool[Array, "3"]
    stable: Bool[Array, "3"]


class Modulation(eqx.Module):
    """The slow equation of a resonant mode; see the module for its terms.

    Attributes:
        mu: damping of the dynamic error [1/s].
        q: shift of the mode's frequency per squared amplitude, `3/8 omega_0 alpha` [1/(s rad^2)].
        kappa: shift of the mode's frequency by the forced response [1/s].
        e: excitation of the mode [rad/s], or [1/(s rad)] where it multiplies the squared amplitude.
    """

    mu: eqx.AbstractVar[Float[Array, ""]]
    q: eqx.AbstractVar[Float[Array, ""]]
    kappa: eqx.AbstractVar[Float[Array, ""]]
    e: eqx.AbstractVar[Float[Array, ""]]
    power: eqx.AbstractClassVar[int]

    @abc.abstractmethod
    def feed(self, z: Float[Array, "2"]) -> Float[Array, "2"]:
        """Excitation of the mode, as real and imaginary part [rad/s]."""

    @abc.abstractmethod
    def gain(self, a: Array) -> Array:
        """Magnitude of the excitation over the amplitude [1/s]."""

    @abc.abstractmethod
    def states(self, s: Array) -> tuple[Float[Array, "3"], Float[Array, "3"], Bool[Array, "3"]]:
        """Frequency shift v [1/s], amplitude [rad] and existence of each branch at the detuning `s` [rad/s]."""

    @abc.abstractmethod
    def peak(self) -> Curve:
        """Largest amplitude [rad], its detuning s [rad/s], and whether there is one."""

    @abc.abstractmethod
    def folds(self) -> Curve:
        """Amplitudes [rad] where the curve turns back (jumps), the detunings s [rad/s], and which exist."""

    def rate(self, z: Float[Array, "2"], s: Array) -> Float[Array, "2"]:
        """Slow rate of change of the real and imaginary part of z [rad/s]."""
        x, y = z
        w = s - self.kappa - self.q * (x * x + y * y)
        return self.feed(z) + jnp.stack([w * y, -w * x]) - 0.5 * self.mu * z

    @eqx.filter_jit
    def branches(self, s: Array) -> Branches:
        """All steady states at the detuning `s` [rad/s]."""
        v, amplitude, exists = self.states(s)
        amplitude = jnp.where(exists, amplitude, 0.0)
        lag = jnp.arctan2(s - self.kappa - v, 0.5 * self.mu)
        # Three sub-harmonics a period of the forcing apart share a branch: this is one of them.
        phase = (jnp.where(self.e < 0, -0.5 * jnp.pi, 0.5 * jnp.pi) - lag) / (1 + self.power)
        phase = jnp.where(amplitude > 0, phase, 0.0)
        z = jnp.stack([amplitude * jnp.cos(phase), amplitude * jnp.sin(phase)], axis=-1)
        slopes = jax.vmap(jax.jacfwd(self.rate), in_axes=(0, None))(z, s)
        trace = slopes[:, 0, 0] + slopes[:, 1, 1]
        determinant = slopes[:, 0, 0] * slopes[:, 1, 1] - slopes[:, 0, 1] * slopes[:, 1, 0]
        return Branches(amplitude, phase, exists, exists & (trace < 0) & (determinant > 0))

    def backbone(self, a: Array) -> Array:
        """Detuning s of the free, undamped mode at the amplitude `a`, about which the curve runs [rad/s]."""
        return self.kappa + self.q * a * a

    def detuning(self, a: Array) -> Curve:
        """The curve at the amplitude `a` [rad]: both sides of the backbone, left (lower s) first."""
        room = self.gain(a) ** 2 - (0.5 * self.mu) ** 2
        exists = jnp.stack([room >= 0, room >= 0])
        half_width = jnp.sqrt(jnp.where(room > 0, room, 0.0))
        s = self.backbone(a) + jnp.stack([-half_width, half_width])
        return jnp.where(exists, a, 0.0), jnp.where(exists, s, 0.0), exists


class AdditiveModulation(Modulation):
    """A mode with constant excitation: primary, super-harmonic and combination resonances."""

    mu: Float[Array, ""]
    q: Float[Array, ""]
    kappa: Float[Array, ""]
    e: Float[Array, ""]
    power: ClassVar[int] = 0

    def feed(self, z: Float[Array, "2"]) -> Float[Array, "2"]:
        return jnp.stack([jnp.zeros_like(self.e), self.e])

    def gain(self, a: Array) -> Array:
        return jnp.where(a > 0, jnp.abs(self.e) / jnp.where(a > 0, a, 1.0), 0.0)

    def states(self, s: Array) -> tuple[Float[Array, "3"], Float[Array, "3"], Bool[Array, "3"]]:
        d, m, g = s - self.kappa, 0.5 * self.mu, self.q * self.e**2

        def equation(v: Array) -> Array:
            return ((d - v) ** 2 + m * m) * v - g

        # v = 2 d / 3 + t leaves a cubic in t without a square.
        t, exists = real_roots(m * m - d * d / 3, d * (2 / 27 * d * d + 2 / 3 * m * m) - g)
        v = with_derivative(equation, 2 / 3 * d + t)
        v, exists = (jnp.where(self.q < 0, r, r[::-1]) for r in (v, exists))
        size = m * m + (d - v) ** 2
        return v, jnp.abs(self.e) / jnp.sqrt(jnp.where(size > 0, size, 1.0)), exists & (size > 0)

    def peak(self) -> Curve:
        exists = self.mu > 0
        a = jnp.where(exists, jnp.abs(self.e) / jnp.where(exists, 0.5 * self.mu, 1.0), 0.0)
        return a, jnp.where(exists, self.backbone(a), 0.0), exists

    @eqx.filter_jit
    def folds(self) -> Curve:
        # On the curve, ds/da = 0 is u^3 (1 - u) = k for u = (a / peak)^2. It has two roots, about u = 3/4, for
        # k < 27/256. Newton runs on the logarithm, concave, from points outside both roots.
        a, _, damped = self.peak()
        m, v = 0.5 * self.mu, self.q * a * a
        bent = damped & (4 * v**2 * 27 > 256 * m * m)
        k = jnp.where(bent, m * m / jnp.where(bent, 4 * v**2, 1.0), 0.1)

        def equation(u: Array) -> Array:
            return 3 * jnp.log(u) + jnp.log1p(-u) - jnp.log(k)

        def step(_: Array, u: Array) -> Array:
            return u - equation(u) / (3 / u - 1 / (1 - u))

        start = jax.lax.stop_gradient(jnp.stack([jnp.cbrt(k), 1 - k]))
        # Where the two roots are about to merge, each step only halves the distance.
        u = with_derivative(equation, jax.lax.fori_loop(0, 40, lambda i, u: jax.lax.stop_gradient(step(i, u)), start))
        s = self.kappa + v * u + jnp.sign(v) * m * jnp.sqrt(1 / u - 1)
        exists = jnp.stack([bent, bent])
        return jnp.where(exists, a * jnp.sqrt(u), 0.0), jnp.where(exists, s, 0.0), exists


class SubharmonicModulation(Modulation):
    """A mode with excitation by the square of its amplitude: the sub-harmonic of order 1/3, and the state without
    it."""

    mu: Float[Array, ""]
    q: Float[Array, ""]
    kappa: Float[Array, ""]
    e: Float[Array, ""]
    power: ClassVar[int] = 2

    def feed(self, z: Float[Array, "2"]) -> Float[Array, "2"]:
        x, y = z
        return self.e * jnp.stack([2 * x * y, x * x - y * y])

    def gain(self, a: Array) -> Array:
        return jnp.abs(self.e) * a

    @property
    def fed(self) -> Bool[Array, ""]:
        """Whether the mode is excited."""
        return self.e * self.q != 0

    @property
    def E(self) -> Float[Array, ""]:
        """`e^2/q`, the squared gain over v [1/s]."""
        return jnp.where(self.fed, self.e**2 / jnp.where(self.fed, self.q, 1.0), 0.0)

    def amplitude(self, v: Array) -> Array:
        """`sqrt(v/q)`; 0 where there is none [rad]."""
        square = jnp.where(self.fed, v / jnp.where(self.fed, self.q, 1.0), 0.0)
        return jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1.0)), 0.0)

    def states(self, s: Array) -> tuple[Float[Array, "3"], Float[Array, "3"], Bool[Array, "3"]]:
        d, m = s - self.kappa, 0.5 * self.mu
        room = d * self.E + 0.25 * self.E**2 - m * m
        exists = self.fed & (room >= 0)
        distance = jnp.sign(self.q) * jnp.sqrt(jnp.where(room > 0, room, 0.0))
        v = d + 0.5 * self.E + jnp.stack([-distance, distance])
        a = self.amplitude(v)
        trivial = jnp.zeros(1, v.dtype)
        there = jnp.concatenate([jnp.ones(1, bool), exists[None] & (a > 0)])
        return jnp.concatenate([trivial, v]), jnp.concatenate([trivial, a]), there

    def peak(self) -> Curve:
        """None: both branches grow without end along the backbone."""
        return jnp.zeros_like(self.e), jnp.zeros_like(self.e), jnp.zeros_like(self.e, dtype=bool)

    def folds(self) -> Curve:
        """The one fold, where the two branches begin, and an absent second."""
        E = jnp.where(self.fed, self.E, 1.0)
        d = (0.25 * self.mu**2 - 0.25 * E**2) / E
        exists = jnp.stack([self.fed, jnp.zeros_like(self.fed)])
        a, s = self.amplitude(d + 0.5 * E), self.kappa + d
        return jnp.where(exists, a, 0.0), jnp.where(exists, s, 0.0), exists


def real_roots(p: Array, r: Array) -> tuple[Float[Array, "3"], Bool[Array, "3"]]:
    """Real roots of `t^3 + p t + r`, highest first, and which exist; a single one stands first if above 0, else last.

    The roots carry no derivative.
    """
    p, r = jax.lax.stop_gradient((p, r))
    discriminant = 0.25 * r * r + p**3 / 27
    three = discriminant < 0
    radius = 2 * jnp.sqrt(jnp.where(three, -p / 3, 1.0))
    cosine = jnp.clip(3 * r / jnp.where(three, p * radius, 1.0), -1.0, 1.0)
    all_three = radius * jnp.cos((jnp.arccos(cosine) - 2 * jnp.pi * jnp.arange(3.0)) / 3)
    w = jnp.cbrt(0.5 * jnp.abs(r) + jnp.sqrt(jnp.where(three, 0.0, discriminant)))
    single = -jnp.sign(r) * (w - p / jnp.where(w > 0, 3 * w, 1.0))
    slots = jnp.stack([single >= 0, jnp.zeros_like(three), single < 0])
    return jnp.where(three, all_three, single), slots | three


def with_derivative(equation: Callable[[Array], Array], roots: Float[Array, " n"]) -> Float[Array, " n"]:
    """Polish roots of `equation`, elementwise, by Newton steps that carry the derivatives of first and second order."""
    roots = jax.lax.stop_gradient(roots)
    for _ in range(2):
        value, slope = jax.jvp(equation, (roots,), (jnp.ones_like(roots),))
        roots = roots - value / jnp.where(slope == 0, 1.0, slope)
    return roots
