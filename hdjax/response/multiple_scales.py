"""Multiple scales: the transient off resonance, and steady primary, super-harmonic and sub-harmonic resonances.

`x'' + mu x' + omega_0^2 (x + alpha x^3) = A cos(omega t)`, with mu, alpha and the detuning small of order epsilon, and
at the primary resonance A too. First order errs by O(epsilon) of the response, second order by O(epsilon^2).

References:
    Nayfeh & Mook, Nonlinear Oscillations, 1979, section 4.1, with twice their damping coefficient as mu.
    Seed document, whose printed equations are at the end of this file.
"""

import abc
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool, Float, Int

from hdjax.drive import Drive, ReducedDrive
from hdjax.fourier import FourierSeries, fourier_series
from hdjax.parameters import as_scalar
from hdjax.response.modulation import AdditiveModulation, Branches, Curve, Modulation, SubharmonicModulation
from hdjax.where import where

SAMPLES = 32  # of a period: the terms kept reach harmonic 15, and none of them folds onto those that are used.
NEWTON_STEPS = 8


def backbone_slope(drive: Drive | ReducedDrive) -> Array:
    """`3/8 omega_0 alpha`, the frequency shift per squared amplitude of a free vibration [1/(s rad^2)]."""
    return 0.375 * drive.omega_0 * drive.alpha


class CurvePoints(eqx.Module):
    """Points of a frequency response curve; zeros where a point is absent.

    Attributes:
        amplitude: of the resonant harmonic [rad].
        sigma: detuning of the resonance [rad/s].
        omega: frequency of the forcing [rad/s].
        exists: whether the point is there.
    """

    amplitude: Float[Array, "*points"]
    sigma: Float[Array, "*points"]
    omega: Float[Array, "*points"]
    exists: Bool[Array, "*points"]


class Limits(eqx.Module):
    """An interval of the forcing in which something exists; zeros where there is none.

    Attributes:
        A: lower and upper amplitude of the forcing [rad/s^2].
        C: the same as amplitude of the forced response [rad].
        exists: whether there is such an interval.
    """

    A: Float[Array, "2"]
    C: Float[Array, "2"]
    exists: Bool[Array, ""]


class SteadyStates(eqx.Module):
    """The steady states at one frequency, with all harmonics that the order of the expansion holds.

    Attributes:
        branches: amplitude, phase, existence and stability of the resonant harmonic.
        harmonics: the series of each branch, as coordinates of one series [rad].
    """

    branches: Branches
    harmonics: FourierSeries

    def series(self, branch: int | Int[Array, ""]) -> FourierSeries:
        """x(t) on a branch (0 lower, 1 middle, 2 upper) [rad]; the forced response alone where it is absent."""
        h = self.harmonics
        return FourierSeries(h.omega, h.mean[branch], h.cosine[branch], h.sine[branch])


class Resonance(eqx.Module):
    """A resonance at `response omega = forcing (omega_0 + ...)`, response and forcing being small integers.

    The response has the fundamental `omega/forcing`; its multiple `response` is near omega_0, its multiple `forcing`
    is the forcing's own frequency. `sigma = response omega - forcing omega_0`. The amplitude of the forced response
    enters the frequency response at the centre of the resonance, where sigma is 0; in x(t) it is that at omega.

    Attributes:
        drive: gives mu, omega_0 and alpha.
        A: amplitude of the forcing `A cos(omega t)` as an acceleration [rad/s^2].
    """

    drive: eqx.AbstractVar[Drive | ReducedDrive]
    A: eqx.AbstractVar[Array]
    response: eqx.AbstractClassVar[int]
    forcing: eqx.AbstractClassVar[int]

    @property
    @abc.abstractmethod
    def modulation(self) -> Modulation:
        """The slow equation of the resonant harmonic."""

    def sigma(self, omega: ArrayLike) -> Array:
        """Detuning [rad/s]."""
        return self.response * jnp.asarray(omega, dtype=float) - self.forcing * self.drive.omega_0

    def omega(self, sigma: ArrayLike) -> Array:
        """Frequency of the forcing at a detuning [rad/s]."""
        return (jnp.asarray(sigma, dtype=float) + self.forcing * self.drive.omega_0) / self.response

    def forced(self, omega: ArrayLike) -> Array:
        """C of the forced response `C cos(omega t)` beside the resonant harmonic [rad]; 0 where they are one."""
        if self.response == self.forcing:
            return jnp.zeros_like(self.A)
        return self.A / (self.drive.omega_0**2 - jnp.asarray(omega, dtype=float) ** 2)

    @property
    def C(self) -> Array:
        """Amplitude of the forced response at the centre of the resonance [rad]."""
        return self.forced(self.omega(0.0))

    def branches(self, omega: ArrayLike) -> Branches:
        """All steady states at the forcing's frequency, to first order."""
        return self.modulation.branches(self.sigma(omega) / self.forcing)

    def _points(self, curve: Curve) -> CurvePoints:
        a, s, exists = curve
        sigma = self.forcing * s
        return CurvePoints(a, sigma, where(exists, self.omega(sigma), 0.0), exists)

    def detuning(self, a: ArrayLike) -> CurvePoints:
        """Where the response has the amplitude `a` [rad]: left and right of the backbone."""
        return self._points(self.modulation.detuning(jnp.asarray(a, dtype=float)))

    def backbone(self, a: ArrayLike) -> Array:
        """Detuning sigma about which the curve runs at the amplitude `a` [rad/s]."""
        return self.forcing * self.modulation.backbone(jnp.asarray(a, dtype=float))

    def peak(self) -> CurvePoints:
        """The largest amplitude over all frequencies: absent without damping, and at the sub-harmonic resonance."""
        return self._points(self.modulation.peak())

    def folds(self) -> CurvePoints:
        """The two points, lower amplitude first, where the curve turns back and the response jumps.

        The sub-harmonic resonance has one. Absent where the curve does not turn back, and without damping.
        """
        return self._points(self.modulation.folds())


class PrimaryResonance(Resonance):
    """`omega = omega_0 + sigma`: `x = a cos(omega t + psi)`.

    `(mu^2/4 + (sigma - 3/8 omega_0 alpha a^2)^2) a^2 = A^2/(4 omega_0^2)` (Nayfeh & Mook section 4.1.1). The largest
    amplitude is `A/(mu omega_0)`.
    """

    drive: Drive | ReducedDrive
    A: Array = eqx.field(converter=as_scalar)
    response: ClassVar[int] = 1
    forcing: ClassVar[int] = 1

    @property
    def modulation(self) -> Modulation:
        q = backbone_slope(self.drive)
        return AdditiveModulation(self.drive.mu, q, jnp.zeros_like(q), -0.5 * self.A / self.drive.omega_0)


class SuperharmonicResonance(Resonance):
    """`3 omega = omega_0 + sigma`: `x = a cos(3 omega t + psi) + C cos(omega t)`.

    `(mu^2/4 + (sigma - 3/4 omega_0 alpha C^2 - 3/8 omega_0 alpha a^2)^2) a^2 = (omega_0 alpha C^3/8)^2` with
    `C = A/(omega_0^2 - omega^2)` (Nayfeh & Mook section 4.1.3).
    """

    drive: Drive | ReducedDrive
    A: Array = eqx.field(converter=as_scalar)
    response: ClassVar[int] = 3
    forcing: ClassVar[int] = 1

    @property
    def modulation(self) -> Modulation:
        q, C = backbone_slope(self.drive), self.C
        return AdditiveModulation(self.drive.mu, q, 2 * q * C**2, q * C**3 / 3)


class SubharmonicResonance(Resonance):
    """`omega = 3 omega_0 + sigma`: `x = a cos(omega t/3 + psi) + C cos(omega t)`, or a = 0.

    `(9/4 mu^2 + (sigma - 9/4 omega_0 alpha C^2 - 9/8 omega_0 alpha a^2)^2) a^2 = (9/8 omega_0 alpha C a^2)^2` with
    `C = A/(omega_0^2 - omega^2)` (Nayfeh & Mook section 4.1.4).
    """

    drive: Drive | ReducedDrive
    A: Array = eqx.field(converter=as_scalar)
    response: ClassVar[int] = 1
    forcing: ClassVar[int] = 3

    @property
    def modulation(self) -> Modulation:
        q, C = backbone_slope(self.drive), self.C
        return SubharmonicModulation(self.drive.mu, q, 2 * q * C**2, q * C)

    def existence(self, omega: ArrayLike) -> Limits:
        """Amplitudes of the forcing between which the sub-harmonic exists at a frequency.

        There are such where `sigma^2 >= 63/4 mu^2` and sigma has the sign of alpha. The fold is the limit of the
        frequency at a given amplitude: the sub-harmonic exists beyond it, at lower frequencies where alpha < 0.

        References:
            Nayfeh & Mook, section 4.1.4.
        """
        q, s, m = backbone_slope(self.drive), self.sigma(omega) / self.forcing, 0.5 * self.drive.mu
        exists = (q * s > 0) & (s * s >= 7 * m * m)
        # q C^2 between the roots of 7/4 E^2 - s E + m^2.
        width = jnp.sqrt(where(exists, s * s - 7 * m * m, 0.0))
        square = 2 / 7 * (jnp.abs(s) + jnp.stack([-width, width])) / where(exists, jnp.abs(q), 1.0)
        C = where(exists, jnp.sqrt(where(square > 0, square, 1.0)), 0.0)
        C = where(square > 0, C, 0.0)
        return Limits(C * 8 * self.drive.omega_0**2, C, exists)


@jax.jit
def first_order(resonance: Resonance, omega: ArrayLike) -> SteadyStates:
    """All steady states at the forcing's frequency [rad/s], right to O(epsilon)."""
    branches = resonance.branches(omega)
    c, s = branches.amplitude * jnp.cos(branches.phase), -branches.amplitude * jnp.sin(branches.phase)
    series = jax.vmap(lambda c, s: _leading_series(resonance, omega, c, s))(c, s)
    return SteadyStates(branches, FourierSeries(series.omega[0], series.mean, series.cosine, series.sine))


@jax.jit
def second_order(resonance: Resonance, omega: ArrayLike) -> SteadyStates:
    """All steady states at the forcing's frequency [rad/s], right to O(epsilon^2).

    The harmonics off resonance follow once from the leading response x_0, as x_1; the resonant one solves its own
    harmonic balance of the force of `x_0 + x_1`, kept to `x_0^3 + 3 x_0^2 x_1`. Newton steps start at the first-order
    states, whose stability the branches keep. A branch whose steps do not converge, or lead nearer to another
    first-order state (both happen next to a fold), is absent.
    """
    drive, branches = resonance.drive, resonance.branches(omega)
    start = jnp.stack([branches.amplitude * jnp.cos(branches.phase), -branches.amplitude * jnp.sin(branches.phase)], 1)
    push = jnp.zeros(2).at[0].set(resonance.A if resonance.response == resonance.forcing else 0.0)
    r = resonance.response - 1

    def expand(z: Float[Array, "2"]) -> tuple[Float[Array, "2"], FourierSeries]:
        """Residual of the resonant harmonic's balance [rad/s^2], and the response."""
        x_0 = _leading_series(resonance, omega, z[0], z[1])
        H = x_0.harmonics
        times = 2 * jnp.pi / SAMPLES / x_0.omega * jnp.arange(1.0 * SAMPLES)
        x, v = (jax.vmap(series)(times) for series in (x_0, x_0.derivative()))
        cubic = drive.omega_0**2 * drive.alpha
        off = jnp.arange(H) != r
        free = drive.omega_0**2 - (x_0.omega * jnp.arange(1.0, H + 1.0)) ** 2
        load = fourier_series(x_0.omega, drive.mu * v + cubic * x**3, H)
        response = [-where(off, c / where(off, free, 1.0), 0.0) for c in (load.cosine, load.sine)]
        x_1 = FourierSeries(x_0.omega, jnp.zeros_like(x_0.mean), *response)
        load = fourier_series(x_0.omega, drive.mu * v + cubic * (x**3 + 3 * x**2 * jax.vmap(x_1)(times)), H)
        left = free[r] * z + jnp.stack([load.cosine[r], load.sine[r]]) - push
        return left, FourierSeries(x_0.omega, x_0.mean, x_0.cosine + x_1.cosine, x_0.sine + x_1.sine)

    def newton(z: Float[Array, "2"]) -> Float[Array, "2"]:
        left, tangent = jax.linearize(lambda z: expand(z)[0], z)
        return _solve_two(jax.vmap(tangent, out_axes=1)(jnp.eye(2)), left)

    def refine(z: Float[Array, "2"]) -> tuple[Float[Array, "2"], Float[Array, "2"], FourierSeries]:
        def body(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
            z, _last = carry
            change = newton(z)
            return z - change, change

        z, change = jax.lax.fori_loop(0, NEWTON_STEPS, body, (z, z))
        return z, change, expand(z)[1]

    z, change, series = jax.vmap(refine)(start)
    size = jnp.sum(z * z, axis=-1)
    # A last step below the square root of the precision: the next would be below rounding.
    converged = jnp.sum(change**2, axis=-1) <= jnp.finfo(z.dtype).eps * (size + resonance.C**2)
    distances = jnp.sum((z[:, None] - start[None]) ** 2, axis=-1)
    nearest = jnp.argmin(where(branches.exists[None], distances, jnp.inf), axis=1)
    exists = branches.exists & converged & (nearest == jnp.arange(3))
    there = exists & (branches.amplitude > 0)
    z = where(there[:, None], z, jnp.array([1.0, 0.0]))
    amplitude = where(there, jnp.hypot(z[:, 0], z[:, 1]), 0.0)
    phase = where(there, jnp.arctan2(-z[:, 1], z[:, 0]), 0.0)
    plain = first_order(resonance, omega).harmonics
    cosine, sine = (
        where(exists[:, None], refined, leading)
        for refined, leading in ((series.cosine, plain.cosine), (series.sine, plain.sine))
    )
    refined_branches = Branches(amplitude, phase, exists, exists & branches.stable)
    return SteadyStates(refined_branches, FourierSeries(plain.omega, plain.mean, cosine, sine))


def _leading_series(resonance: Resonance, omega: ArrayLike, cosine: Array, sine: Array) -> FourierSeries:
    """The response of order epsilon^0, from the two coefficients of its resonant harmonic [rad]."""
    omega = jnp.asarray(omega, dtype=float)
    zeros = jnp.zeros(3 * max(resonance.response, resonance.forcing))
    forced = zeros.at[resonance.forcing - 1].set(resonance.forced(omega))
    r = resonance.response - 1
    return FourierSeries(
        omega / resonance.forcing, jnp.zeros_like(cosine), forced.at[r].set(cosine), zeros.at[r].set(sine)
    )


def _solve_two(J: Float[Array, "2 2"], b: Float[Array, "2"]) -> Float[Array, "2"]:
    """`J^-1 b`, or b where J is singular."""
    determinant = J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]
    solved = jnp.stack([J[1, 1] * b[0] - J[0, 1] * b[1], J[0, 0] * b[1] - J[1, 0] * b[0]])
    return where(determinant == 0, b, solved / where(determinant == 0, 1.0, determinant))


# As printed: the seed's equations, errors included, for comparison with the correct ones above. Each function gives the
# result of its equation.


def printed_error_forcing(drive: Drive, T_m: ArrayLike, T_l: ArrayLike) -> Array:
    """`F = (T_m J_l - T_l J_m)/(N J_m J_l)` [rad/s^2]: a factor N is missing on the load torque."""
    T_m, T_l = (jnp.asarray(T, dtype=float) for T in (T_m, T_l))
    return (T_m * drive.J_l - T_l * drive.J_m) / (drive.N * drive.J_m * drive.J_l)


def printed_primary(drive: Drive | ReducedDrive, A: ArrayLike, omega: ArrayLike) -> Array:
    """a [rad] of `(mu^2/4 + (sigma - 3/8 omega_0 alpha C^2)^2) a^2 = A^2/(4 omega_0^2)`, `sigma = omega - omega_0`.

    C stands where the amplitude itself should and is infinite at `omega = omega_0`: there, at the resonance, the
    equation gives a = 0. It never has more than one branch.
    """
    A, omega = (jnp.asarray(v, dtype=float) for v in (A, omega))
    q = backbone_slope(drive)
    gap = drive.omega_0**2 - omega**2
    shift = where(q == 0, 0.0, q * (A / gap) ** 2)
    return jnp.abs(A) / (2 * drive.omega_0 * jnp.hypot(0.5 * drive.mu, omega - drive.omega_0 - shift))


def printed_superharmonic(drive: Drive | ReducedDrive, A: ArrayLike, omega: ArrayLike) -> Branches:
    """The branches of the printed super-harmonic equation, `sigma = omega_0 - 3 omega` as printed.

    The equation holds for `3 omega = omega_0 + sigma`: taken as printed, the curve is mirrored about omega_0/3.
    """
    mirrored = SuperharmonicResonance(drive, A)
    return mirrored.modulation.branches(-mirrored.sigma(omega))


def printed_subharmonic(
    drive: Drive | ReducedDrive, A: ArrayLike, omega: ArrayLike
) -> tuple[Float[Array, "3"], Bool[Array, "3"]]:
    """Amplitudes [rad] (trivial, lower, upper) of the printed sub-harmonic equation, and which exist.

    `(9/4 mu^2 + (sigma - 9/8 omega_0 alpha C^2 - 9/4 omega_0^2 alpha a^2)^2) a^2 = (9/8 omega_0 alpha C a)^2` with
    `sigma = omega - 3 omega_0`. The coefficients of C^2 and a^2 are exchanged, one has omega_0 squared (which does not
    fit the units), and on the right a stands where a^2 should, so that C alone must overcome the damping.
    """
    resonance = SubharmonicResonance(drive, A)
    q, C = backbone_slope(drive), resonance.C
    room = (3 * q * C) ** 2 - 2.25 * drive.mu**2
    half_width = jnp.sqrt(where(room > 0, room, 0.0))
    numerator = resonance.sigma(omega) - 3 * q * C**2 + jnp.sign(q) * jnp.stack([-half_width, half_width])
    square = numerator / where(q == 0, 1.0, 6 * drive.omega_0 * q)
    exists = (q != 0) & (room >= 0) & (square > 0)
    a = where(exists, jnp.sqrt(where(exists, square, 1.0)), 0.0)
    return jnp.concatenate([jnp.zeros(1, a.dtype), a]), jnp.concatenate([jnp.ones(1, bool), exists])
