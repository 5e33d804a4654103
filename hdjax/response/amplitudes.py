"""The check of the analytic amplitudes: multiple scales against harmonic balance against time integration."""

import dataclasses
from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, ArrayLike, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.fourier import FourierSeries
from hdjax.parameters import as_scalar
from hdjax.response.continuation import Branch
from hdjax.response.cubic_motion import ForcedCubic, balanced, closed
from hdjax.response.marching import transient_and_steps
from hdjax.response.multiple_scales import (
    PrimaryResonance,
    Resonance,
    SteadyStates,
    SubharmonicResonance,
    SuperharmonicResonance,
    first_order,
    second_order,
)
from hdjax.response.nearest_motion import Oscillators, balanced_waves, largest, largest_of
from hdjax.response.poincare import PoincareSection, period_of, poincare_section
from hdjax.where import where

Kind = Literal["off-resonance", "primary", "super-harmonic", "sub-harmonic"]
KINDS: dict[Kind, Callable[[Drive | ReducedDrive, ArrayLike], Resonance]] = {
    "primary": PrimaryResonance,
    "super-harmonic": SuperharmonicResonance,
    "sub-harmonic": SubharmonicResonance,
}
GOOD = (0.01, 0.05, 0.10)
"""Relative errors that separate the verdicts."""

_NEAR = 0.3
_AGREEMENT = 1e-6
_HARMONICS = 15
_SLOTS = ("lower", "middle", "upper")


@dataclasses.dataclass(frozen=True)
class AmplitudeRow:
    """One steady motion, by four routes; amplitudes are the largest |x| over a period [rad].

    Attributes:
        branch: which of the coexisting motions; for the sub-harmonic resonance the lower is the motion without it.
        stable: whether its Floquet multipliers lie inside the unit circle.
        first_order: multiple scales, first order.
        second_order: multiple scales, second order; None where it has no such motion.
        balance: harmonic balance; None where it has no such motion.
        time: time integration over one period from a closed orbit (shooting); None where there is none.
    """

    branch: str
    stable: bool
    first_order: float
    second_order: float | None
    balance: float | None
    time: float | None

    @property
    def error(self) -> float | None:
        """Relative error of first-order multiple scales."""
        return _relative(self.first_order, self.time)

    @property
    def second_order_error(self) -> float | None:
        """Relative error of second-order multiple scales."""
        return _relative(self.second_order, self.time)

    @property
    def agreement(self) -> float | None:
        """Relative difference of harmonic balance and time integration."""
        return _relative(self.balance, self.time)

    @property
    def verdict(self) -> str:
        """Verdict on the analytic amplitude."""
        if self.error is None or self.agreement is None:
            return "fails: no motion near it"
        if self.agreement > _AGREEMENT:
            return "undecided: the two numerical routes differ"
        for level in GOOD:
            if self.error <= level:
                return f"holds to {level:.0%}"
        return f"fails by {self.error:.0%}"


def _relative(value: float | None, truth: float | None) -> float | None:
    return None if value is None or truth is None or truth == 0.0 else abs(value / truth - 1.0)


@dataclasses.dataclass(frozen=True)
class AmplitudeCheck:
    """All steady motions at one forcing frequency, analytic against numeric.

    Attributes:
        omega: forcing frequency [rad/s].
        A: forcing amplitude [rad/s^2].
        kind: which expansion applies.
        rows: the motions.
    """

    omega: float
    A: float
    kind: Kind
    rows: tuple[AmplitudeRow, ...]


def resonance_kind(omega_0: float, omega: float) -> Kind:
    """Which expansion applies: a resonance within 30 % of its centre, else off resonance."""
    if abs(omega / omega_0 - 1.0) <= _NEAR:
        return "primary"
    if abs(3.0 * omega / omega_0 - 1.0) <= _NEAR:
        return "super-harmonic"
    if abs(omega / (3.0 * omega_0) - 1.0) <= _NEAR:
        return "sub-harmonic"
    return "off-resonance"


def check_amplitudes(
    drive: Drive | ReducedDrive, A: float, omega: float, *, harmonics: int = _HARMONICS
) -> AmplitudeCheck:
    """Compare the analytic amplitudes with two independent numerical routes at one frequency.

    Args:
        drive: gives mu, omega_0 and alpha.
        A: amplitude of the forcing `A cos(omega t)` as an acceleration [rad/s^2], see [`hdjax.Drive.error_forcing`][].
        omega: forcing frequency [rad/s].
        harmonics: of the forcing frequency in harmonic balance.

    Raises:
        ValueError: the frequency is not above zero.
    """
    if not omega > 0.0:
        raise ValueError(f"`omega` must be above zero, but is {omega} rad/s")
    mu, omega_0, alpha = (float(v) for v in (drive.mu, drive.omega_0, drive.alpha))
    kind = resonance_kind(omega_0, omega)
    # Off resonance the super-harmonic's expansion is valid as well, with a third harmonic that is not resonant.
    resonance = KINDS.get(kind, SuperharmonicResonance)
    at = resonance(drive, A)
    first, second = _expansions(at, as_scalar(omega))
    given = ForcedCubic(mu, omega_0, alpha, A, omega, at.forcing)
    existing = np.flatnonzero(np.asarray(first.branches.exists)).tolist()
    sizes = largest(first.harmonics), largest(second.harmonics)
    rows = []
    for slot in existing:
        refined = bool(second.branches.exists[slot])
        guess = (second if refined else first).series(slot)
        leading = abs(A / (omega_0**2 - omega**2)) if kind == "off-resonance" else float(sizes[0][slot])
        x, solved = balanced(given, guess, harmonics * at.forcing)
        orbit = closed(given, x, harmonics * at.forcing) if solved else None
        rows.append(
            AmplitudeRow(
                branch=_SLOTS[slot] if len(existing) > 1 else "only",
                stable=orbit is not None and orbit.stable,
                first_order=leading,
                second_order=float(sizes[1][slot]) if refined else None,
                balance=float(largest(x)) if solved else None,
                time=float(largest(orbit.motion)) if orbit is not None and orbit.converged else None,
            )
        )
    return AmplitudeCheck(float(omega), float(A), kind, tuple(rows))


@eqx.filter_jit
def _expansions(resonance: Resonance, omega: Array) -> tuple[SteadyStates, SteadyStates]:
    """First and second order."""
    return first_order(resonance, omega), second_order(resonance, omega)


def settled(branch: Branch, *, motions: int = 24, off: float = 0.01, transient_periods: int = 1000) -> PoincareSection:
    """Time integration from near stable motions of a branch, which return to it if the branch is right.

    A motion that has not settled after the transient is omitted.

    Args:
        branch: a frequency response of a reduced drive, for which it computes the stability.
        motions: number to integrate, evenly along its stable part.
        off: initial deviation, relative to the motion.
        transient_periods: forcing periods before the motion is measured.
    """
    stable = np.flatnonzero(np.asarray(branch.valid & branch.stable))
    if not stable.size:
        raise ValueError("`branch` must have stable motions")
    rows = stable[np.linspace(0.0, stable.size - 1.0, motions).round().astype(int)]
    x = jax.tree.map(lambda leaf: leaf[rows], branch.steady_states.x)
    zero = jnp.zeros(())
    starts = (1.0 + off) * jax.vmap(lambda x: jnp.stack([x(zero), x.derivative()(zero)]))(x)
    given = branch.system.forcing
    model, omegas = branch.system.model, branch.omega[rows]
    _, steps = transient_and_steps(model, omegas, given.harmonics, transient_periods, None)

    def one(omega: Array, start: Array) -> PoincareSection:
        forcing = FourierSeries(omega, given.mean, given.cosine, given.sine)
        section = poincare_section(
            model, forcing, start[None], transient_periods=transient_periods, steps_per_period=steps
        )
        return jax.tree.map(lambda leaf: leaf[0], section)

    found = eqx.filter_vmap(one)(omegas, starts)
    at_rest = np.flatnonzero(np.asarray(period_of(found)))
    return jax.tree.map(lambda leaf: leaf[at_rest], found)


class ErrorMap(eqx.Module):
    """Relative error of multiple scales in the largest |x|, against harmonic balance.

    Attributes:
        sigma: detuning over omega_0.
        strength: `alpha a^2` at the primary resonance (a: the analytic amplitude), `alpha C^2` at the others.
        mu: damping over omega_0.
        first_order: relative error of first order, infinite where there is no such motion.
        second_order: likewise of second order.
    """

    sigma: Float[Array, " sigmas"]
    strength: Float[Array, " strengths"]
    mu: Float[Array, " mus"]
    first_order: Float[Array, "mus strengths sigmas"]
    second_order: Float[Array, "mus strengths sigmas"]


def error_map(
    kind: Literal["primary", "super-harmonic"],
    sigma: ArrayLike,
    strength: ArrayLike,
    mu: ArrayLike,
    *,
    harmonics: int = _HARMONICS,
) -> ErrorMap:
    """The error of multiple scales over detuning, nonlinearity and damping, for any drive: all in units of omega_0.

    Args:
        kind: the resonance. At the primary one each point is the motion of the given amplitude at the given
            detuning (the forcing follows from them); at the super-harmonic the largest stable one.
        sigma: detunings over omega_0.
        strength: `alpha a^2` or `alpha C^2`; may be negative for a softening drive.
        mu: dampings over omega_0.
        harmonics: of the forcing frequency in harmonic balance.
    """
    sigma, strength, mu = (np.atleast_1d(np.asarray(v, dtype=float)) for v in (sigma, strength, mu))
    grid = np.meshgrid(mu, strength, sigma, indexing="ij")
    flat = [g.reshape(-1) for g in grid]
    omega, A, exists, *series = (np.asarray(a) for a in _expanded(KINDS[kind], *map(jnp.asarray, flat)))
    first, second = series[0] - 1j * series[1], series[2] - 1j * series[3]
    given = Oscillators(flat[0], np.ones(omega.size), flat[1], A, omega)
    guess = np.where(exists[:, None], second, first)[:, ::2]
    waves, solved = balanced_waves(given, guess, harmonics)
    truth, *sizes = (largest_of(z) for z in (waves, first[:, ::2], second[:, ::2]))
    errors = (
        np.where(there, np.abs(size / np.where(there, truth, 1.0) - 1.0), np.inf).reshape(grid[0].shape)
        for size, there in zip(sizes, (solved, solved & exists), strict=True)
    )
    return ErrorMap(*(jnp.asarray(a) for a in (sigma, strength, mu, *errors)))


@eqx.filter_jit
def _expanded(expansion: Callable[..., Resonance], mu: Array, strength: Array, sigma: Array) -> tuple[Array, ...]:
    """Frequency and amplitude of the forcing, whether second order has the motion, and both orders' waves of it."""

    def at(mu: Array, strength: Array, sigma: Array) -> tuple[Array, ...]:
        drive = ReducedDrive(mu=mu, omega_0=1.0, alpha=strength)
        if expansion is PrimaryResonance:
            # The amplitude is one: the frequency response gives the forcing that makes it so.
            A = 2.0 * jnp.hypot(0.5 * mu, sigma - 0.375 * strength)
        else:
            A = 1.0 - expansion(drive, 1.0).omega(0.0) ** 2
        resonance = expansion(drive, A)
        omega = resonance.omega(sigma)
        first, second = first_order(resonance, omega), second_order(resonance, omega)
        if expansion is PrimaryResonance:
            slot = jnp.argmin(where(first.branches.exists, jnp.abs(first.branches.amplitude - 1.0), jnp.inf))
        else:
            slot = jnp.argmax(where(first.branches.stable, first.branches.amplitude, -1.0))
        x, y = first.series(slot), second.series(slot)
        return omega, resonance.A, second.branches.exists[slot], x.cosine, x.sine, y.cosine, y.sine

    return jax.vmap(at)(mu, strength, sigma)
