"""The response off resonance to any sum of harmonics, and the resonances at which they combine.

`x'' + mu x' + omega_0^2 (x + alpha x^3) = sum_i A_i cos(w_i t + phi_i)`, to first order of multiple scales. The forcing
is a [`MultiHarmonic`][] of accelerations: harmonics of the motor, a load torque at its own frequency, and a constant
load as a term of frequency 0. Its frequencies are distinct.
"""

import dataclasses
import itertools
import math
from collections.abc import Sequence
from typing import Literal

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike

from hdjax.drive import Drive, ReducedDrive
from hdjax.forcing import MultiHarmonic
from hdjax.parameters import as_scalar
from hdjax.response.modulation import AdditiveModulation, Branches
from hdjax.response.multiple_scales import backbone_slope
from hdjax.where import where

Kind = Literal["primary", "additive", "parametric", "sub-harmonic"]


def harmonics_and_load(
    omega: ArrayLike,
    A: ArrayLike | Sequence[float],
    phi: ArrayLike | Sequence[float],
    omega_l: ArrayLike,
    A_l: ArrayLike,
    phi_l: ArrayLike = 0.0,
) -> MultiHarmonic:
    """`sum_n A_n cos(n omega t + phi_n) + A_l cos(omega_l t + phi_l)` (seed document, multiple harmonics).

    Args:
        omega: fundamental frequency [rad/s].
        A: amplitudes of the harmonics n = 1, 2, ... as accelerations [rad/s^2].
        phi: their phases [rad].
        omega_l: frequency of the load torque [rad/s]; 0 for a constant load.
        A_l: amplitude of the load's acceleration [rad/s^2].
        phi_l: its phase [rad].
    """
    A, phi = (jnp.atleast_1d(jnp.asarray(v, dtype=float)) for v in (A, phi))
    own = jnp.asarray(omega, dtype=float) * jnp.arange(1.0, A.shape[0] + 1.0)
    ends = (jnp.atleast_1d(as_scalar(v)) for v in (A_l, omega_l, phi_l))
    return MultiHarmonic(*(jnp.concatenate([v, end]) for v, end in zip((A, own, phi), ends, strict=True)))


def forced_response(drive: Drive | ReducedDrive, forcing: MultiHarmonic) -> MultiHarmonic:
    """`sum_i C_i cos(w_i t + phi_i)`, `C_i = A_i / (omega_0^2 - w_i^2)`, the steady response off resonance [rad]."""
    C = forcing.amplitudes / (drive.omega_0**2 - forcing.omegas**2)
    return MultiHarmonic(C, forcing.omegas, forcing.phases)


def forced_shift(drive: Drive | ReducedDrive, forcing: MultiHarmonic) -> Array:
    """Shift of the mode's frequency by all forced responses, `3/4 omega_0 alpha sum_i C_i^2` [rad/s].

    A term of frequency 0 counts twice: its mean square is that of a constant.
    """
    x = forced_response(drive, forcing)
    mean_square = where(x.omegas == 0, (x.amplitudes * jnp.cos(x.phases)) ** 2, 0.5 * x.amplitudes**2)
    return 4 * backbone_slope(drive) * jnp.sum(mean_square)


class OffResonance(eqx.Module):
    """x(t) off resonance, a callable: a decaying free vibration on top of the forced response.

    `x = a_0 exp(-mu t/2) cos(omega_0 t + beta(t)) + sum_i C_i cos(w_i t + phi_i)` with
    `beta' = omega_0 alpha (3/8 a^2 + 3/4 sum_i C_i^2)` integrated exactly (seed document; Nayfeh & Mook section 4.1.2).
    The error is O(epsilon) up to times of order 1/epsilon. x(0) is met exactly and x'(0) to O(epsilon).

    Attributes:
        drive: gives mu, omega_0 and alpha.
        forcing: accelerations [rad/s^2].
        x_0: twist at t = 0 [rad].
        v_0: twist rate at t = 0 [rad/s].
    """

    drive: Drive | ReducedDrive
    forcing: MultiHarmonic
    x_0: Array = eqx.field(converter=as_scalar, default=0.0)
    v_0: Array = eqx.field(converter=as_scalar, default=0.0)

    @property
    def z_0(self) -> tuple[Array, Array]:
        """`a_0 cos(beta_0)` and `a_0 sin(beta_0)` [rad]."""
        x = forced_response(self.drive, self.forcing)
        rate = -jnp.sum(x.amplitudes * x.omegas * jnp.sin(x.phases))
        free = self.x_0 - x(as_scalar(0.0))
        return free, -(self.v_0 - rate + 0.5 * self.drive.mu * free) / self.drive.omega_0

    def __call__(self, t: Array) -> Array:
        """x at a time [s]."""
        mu, (c, s) = self.drive.mu, self.z_0
        damped = mu != 0
        # The integral of a^2 / a_0^2.
        elapsed = where(damped, -jnp.expm1(-mu * t) / where(damped, mu, 1.0), t)
        shift = forced_shift(self.drive, self.forcing) * t + backbone_slope(self.drive) * (c * c + s * s) * elapsed
        angle = self.drive.omega_0 * t + shift
        free = jnp.exp(-0.5 * mu * t) * (c * jnp.cos(angle) - s * jnp.sin(angle))
        return free + forced_response(self.drive, self.forcing)(t)


@dataclasses.dataclass(frozen=True)
class Combination:
    """A combination of the forcing's frequencies that excites the mode at first order of the cubic.

    Attributes:
        name: for instance `"2 w_1 + w_l"`, with all terms that share its frequency.
        kind: `"primary"` (w_i); `"additive"` (sums of three, super-harmonics among them), which force the mode;
            `"parametric"` (half a sum of two), which pump it; `"sub-harmonic"` (a third of one).
        omega: frequency of the response [rad/s].
        sigma: `omega - omega_0` [rad/s].
        multiples: of each term, how often each frequency counts.
    """

    name: str
    kind: Kind
    omega: float
    sigma: float
    multiples: tuple[tuple[int, ...], ...]


def combination_resonances(
    drive: Drive | ReducedDrive, forcing: MultiHarmonic, names: Sequence[str] | None = None
) -> list[Combination]:
    """All first-order resonances of the forcing's frequencies, the nearest to omega_0 first.

    Args:
        drive: gives omega_0.
        forcing: accelerations; its frequencies are concrete numbers.
        names: of the frequencies; `w_1`, `w_2`, ... where not given.
    """
    w, omega_0 = np.asarray(forcing.omegas, dtype=float), float(drive.omega_0)
    names = [f"w_{i + 1}" for i in range(w.size)] if names is None else list(names)
    if len(names) != w.size:
        raise ValueError(f"`names` must be {w.size}, one for each frequency, but are {len(names)}")
    sums: tuple[tuple[Kind, int, int], ...] = (
        ("primary", 1, 1),
        ("additive", 3, 1),
        ("parametric", 2, 2),
        ("sub-harmonic", 1, 3),
    )
    found = []
    for kind, order, divisor in sums:
        terms = [n for n in _signed_sums(w.size, order) if np.dot(n, w) > 0]
        if kind == "parametric":
            # Twice the same frequency pumps the mode where it forces it directly.
            terms = [n for n in terms if 2 not in n]
        terms = sorted(terms, key=lambda n: (_rounded(np.dot(n, w)), n))
        for _, same in itertools.groupby(terms, key=lambda n: _rounded(np.dot(n, w))):
            group = tuple(sorted(same, key=np.count_nonzero))
            omega = float(np.dot(group[0], w)) / divisor
            texts = [_sum_name(n, names) for n in group]
            if divisor > 1:
                texts = [f"({text}) / {divisor}" if " " in text else f"{text} / {divisor}" for text in texts]
            found.append(Combination(" = ".join(texts), kind, omega, omega - omega_0, group))
    return sorted(found, key=lambda c: abs(c.sigma))


class CombinationResonance(eqx.Module):
    """The mode forced by an additive combination `n_1 w_1 + n_2 w_2 + ...`, the super-harmonic among them.

    As the super-harmonic, with `omega_0 alpha C^3/8` replaced by the sum over all terms of one frequency of
    `omega_0 alpha M/8 prod_i C_i^|n_i|`, where M is 1 for `3 w_i`, 3 for `2 w_i +- w_j`, 6 for three frequencies.
    The response is `a cos(omega t + psi)`, omega the combination's frequency, beside the forced response.

    Attributes:
        drive: gives mu, omega_0 and alpha.
        forcing: accelerations [rad/s^2]; none of its frequencies near omega_0.
        multiples: as [`Combination`][] gives them.
    """

    drive: Drive | ReducedDrive
    forcing: MultiHarmonic
    multiples: tuple[tuple[int, ...], ...] = eqx.field(static=True)

    @property
    def omega(self) -> Array:
        """Frequency of the resonant response [rad/s]."""
        return self.forcing.omegas @ jnp.asarray(self.multiples[0], dtype=float)

    @property
    def _feed(self) -> tuple[Array, Array]:
        """Cosine and negative sine coefficient of the mode's excitation [rad/s]."""
        x = forced_response(self.drive, self.forcing)
        n = jnp.asarray(self.multiples, dtype=float)
        M = jnp.asarray([6 / math.prod(math.factorial(abs(i)) for i in term) for term in self.multiples])
        size = backbone_slope(self.drive) / 3 * M * jnp.prod(x.amplitudes[None] ** jnp.abs(n), axis=1)
        angle = n @ x.phases
        return jnp.sum(size * jnp.cos(angle)), jnp.sum(size * jnp.sin(angle))

    @property
    def modulation(self) -> AdditiveModulation:
        """The slow equation of the response, its phase counted from that of the feed."""
        c, s = self._feed
        square = c * c + s * s
        e = where(square > 0, jnp.sqrt(where(square > 0, square, 1.0)), 0.0)
        return AdditiveModulation(self.drive.mu, backbone_slope(self.drive), forced_shift(self.drive, self.forcing), e)

    def branches(self) -> Branches:
        """All steady states of the resonant response, to first order."""
        c, s = self._feed
        angle = jnp.arctan2(s, where((c == 0) & (s == 0), 1.0, c))
        states = self.modulation.branches(self.omega - self.drive.omega_0)
        phase = where(states.amplitude > 0, states.phase + angle, 0.0)
        return eqx.tree_at(lambda b: b.phase, states, phase)


def _signed_sums(n: int, order: int) -> set[tuple[int, ...]]:
    """Integer vectors of length `n` whose absolute values add up to `order`."""
    vectors = set()
    for picked in itertools.combinations_with_replacement(range(n), order):
        for signs in itertools.product((1, -1), repeat=order):
            vector = [0] * n
            for i, sign in zip(picked, signs, strict=True):
                vector[i] += sign
            if sum(map(abs, vector)) == order:
                vectors.add(tuple(vector))
    return vectors


def _rounded(frequency: float) -> float:
    """The frequency without its last digits, so that equal sums compare equal, in float32 too."""
    return float(f"{frequency:.6g}")


def _sum_name(multiples: tuple[int, ...], names: Sequence[str]) -> str:
    """For instance `"2 w_1 - w_l"`, positive terms first."""
    terms = sorted(((n, name) for n, name in zip(multiples, names, strict=True) if n), key=lambda t: t[0] < 0)
    text = ""
    for n, name in terms:
        sign = (" + " if n > 0 else " - ") if text else ("" if n > 0 else "-")
        text += sign + (f"{abs(n)} {name}" if abs(n) > 1 else name)
    return text
