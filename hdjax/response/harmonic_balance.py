"""Harmonic balance: the steady motion under periodic forcing as the root of an algebraic system.

Alternating frequency-time (Cameron and Griffin 1989): the motion is a Fourier series, forces are evaluated at samples
of one period and projected back. With more than four samples per harmonic this is exact for the cubic.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float

from hdjax.dynamics import Model, TwoInertiaModel
from hdjax.effects import ActuatorEffect
from hdjax.effects.kinematic import KinematicHarmonic
from hdjax.fourier import FourierSeries
from hdjax.parameters import as_scalar

DEFAULT_HARMONICS = 9
_TOLERANCE = 1e-12
_SOLVED = 1e-9
_START_SCALES = (1.0, 0.5, 0.25, 0.1, 0.03, 0.0)


class SteadyState(eqx.Module):
    """A periodic motion found by harmonic balance.

    Attributes:
        motion: the coordinates as one series: the dynamic error x, and for two inertias theta_l beside it [rad].
        mean_torque: of the motor, to hold its mean speed [N m]; zero for a reduced drive.
        defect: truncation error: residual of the equations above the highest harmonic, relative to the forces.
        converged: whether the algebraic system was solved. Where not, the motion is zero.
    """

    motion: FourierSeries
    mean_torque: Float[Array, ""]
    defect: Float[Array, ""]
    converged: Bool[Array, ""]

    @property
    def x(self) -> FourierSeries:
        """The dynamic error: `B_k` and `psi_k` are its `amplitudes` and `phases`."""
        m = self.motion
        return FourierSeries(m.omega, m.mean[..., 0], m.cosine[..., 0, :], m.sine[..., 0, :])

    @property
    def swing(self) -> Float[Array, "*rows"]:
        """Largest distance of the dynamic error from its mean [rad]."""
        x = self.x
        return FourierSeries(x.omega, jnp.zeros_like(x.mean), x.cosine, x.sine).largest()


class BalancedMotion(eqx.Module):
    """The algebraic system of harmonic balance for one model and forcing: `residual(unknowns, omega) = 0`.

    The unknowns are Fourier coefficients in units of `length`, each coordinate's as (mean, cosines, sines). For two
    inertias the coordinates are x and theta_l; the rigid rotation leaves the mean of theta_l free, so that it is zero
    and replaced by the mean motor torque (in units of `length * K / N`) that keeps the mean speed.

    Attributes:
        model: the equations.
        forcing: motor torque or forcing at multiples of the forcing frequency; its own omega is not used.
        load_torque: likewise on the load.
        length: scale of the motion [rad].
        harmonics: highest multiple of the fundamental kept.
        samples: points of one period at which forces are evaluated.
        subharmonic: the fundamental is the forcing frequency over this.
        rotating: the motor turns at the forcing frequency, so that angle-dependent effects see `theta_m = omega t`.
    """

    model: Model
    forcing: FourierSeries
    load_torque: FourierSeries
    length: Float[Array, ""]
    harmonics: int = eqx.field(static=True)
    samples: int = eqx.field(static=True)
    subharmonic: int = eqx.field(static=True)
    rotating: bool = eqx.field(static=True)

    @property
    def coordinates(self) -> int:
        """1 for a reduced drive, 2 for two inertias."""
        return 2 if isinstance(self.model, TwoInertiaModel) else 1

    @property
    def _ratio(self) -> Array:
        return self.model.drive.N if isinstance(self.model, TwoInertiaModel) else jnp.ones(())

    def with_parameter(self, path: str, value: Array) -> "BalancedMotion":
        """The system with another value at a parameter's dotted path, or with `amplitude` times the forcing."""
        if path == "amplitude":
            scaled = jax.tree.map(lambda c: c * value, (self.forcing, self.load_torque))
            return eqx.tree_at(lambda s: (s.forcing, s.load_torque), self, scaled)
        return eqx.tree_at(lambda s: s.model, self, self.model.replace({path: value}))

    def residual(self, unknowns: Float[Array, " unknowns"], omega: Array) -> Float[Array, " unknowns"]:
        """Residual of the equations of motion, by harmonic, in units of `length * omega_0^2`."""
        return self._left_over(unknowns, omega)[..., : 2 * self.harmonics + 1].reshape(-1)

    def defect(self, unknowns: Float[Array, " unknowns"], omega: Array) -> Float[Array, ""]:
        """Size of the harmonics above the highest kept, relative to the restoring force of the motion."""
        above = self._left_over(unknowns, omega)[..., 2 * self.harmonics + 1 :]
        return jnp.linalg.norm(above) / (jnp.linalg.norm(unknowns) + 1e-300)

    def _left_over(self, unknowns: Array, omega: Array) -> Float[Array, "coordinates projections"]:
        basis, slope, projection, orders = waves(self.harmonics, self.samples)
        fundamental = omega / self.subharmonic
        coefficients, mean_torque = self._coefficients(unknowns)
        position, velocity = coefficients @ basis, fundamental * (coefficients @ slope)
        acceleration = self._accelerations(position, velocity, omega, mean_torque)
        inertial = jnp.zeros((self.coordinates, projection.shape[1]))
        inertial = inertial.at[:, : orders.size].set(-((orders[None] * fundamental) ** 2) * coefficients)
        return (inertial - acceleration @ projection) / (self.length * self.model.drive.omega_0**2)

    def _coefficients(self, unknowns: Array) -> tuple[Array, Array]:
        """Fourier coefficients of the coordinates by row, and the mean motor torque."""
        coefficients = self.length * unknowns.reshape(self.coordinates, -1)
        if self.coordinates == 1:
            return coefficients, jnp.zeros(())
        mean_torque = coefficients[1, 0] * self.model.drive.stiffness / self._ratio
        return coefficients.at[1, 0].set(0.0), mean_torque

    def _accelerations(self, position: Array, velocity: Array, omega: Array, mean_torque: Array) -> Array:
        """Each coordinate's acceleration at the samples, from the model's own rates."""
        angles = jnp.arange(float(self.samples)) * (2 * np.pi / self.samples)
        # In time units in which the forcing's frequency is one.
        torque, load_torque = (
            FourierSeries(1.0, s.mean, s.cosine, s.sine)(self.subharmonic * angles)
            for s in (self.forcing, self.load_torque)
        )
        N = self._ratio
        if self.coordinates == 2:
            torque = torque - self.forcing.mean + mean_torque

        def acceleration(q: Array, q_rate: Array, angle: Array, torque: Array, load_torque: Array) -> Array:
            rates = self.model.rates(self._state(q, q_rate, angle, omega), torque, load_torque)
            return rates[1:] if self.coordinates == 1 else jnp.stack([rates[2] / N - rates[3], rates[3]])

        return jax.vmap(acceleration, in_axes=(1, 1, 0, 0, 0), out_axes=1)(
            position, velocity, angles, torque, load_torque
        )

    def _state(self, q: Array, q_rate: Array, angle: Array, omega: Array) -> Array:
        """The model's state at coordinates, their rates and the phase of the fundamental."""
        if self.coordinates == 1:
            return jnp.concatenate([q, q_rate])
        N = self._ratio
        turned, speed = (self.subharmonic * angle, omega) if self.rotating else (0.0, 0.0)
        return jnp.stack(
            [N * (q[0] + q[1]) + turned, q[1] + turned / N, N * (q_rate[0] + q_rate[1]) + speed, q_rate[1] + speed / N]
        )

    def jacobian(
        self, unknowns: Float[Array, " unknowns"], omega: Array, phase: Array
    ) -> Float[Array, "states states"]:
        """Derivative of the state's rates by the state, at a phase [rad] of the motion's fundamental."""
        coefficients, _ = self._coefficients(unknowns)
        angles = phase * jnp.arange(1.0, self.harmonics + 1.0)
        fundamental, H = omega / self.subharmonic, self.harmonics
        cosine, sine = coefficients[:, 1 : H + 1], coefficients[:, H + 1 :]
        q = coefficients[:, 0] + cosine @ jnp.cos(angles) + sine @ jnp.sin(angles)
        orders = fundamental * jnp.arange(1.0, H + 1.0)
        q_rate = sine @ (orders * jnp.cos(angles)) - cosine @ (orders * jnp.sin(angles))
        nothing = jnp.zeros(())
        return jax.jacfwd(self.model.rates)(self._state(q, q_rate, phase, omega), nothing, nothing)

    def linear(self, omega: Array) -> Float[Array, " unknowns"]:
        """The unknowns after one Newton step from no motion: the linearised drive's response."""
        zero = jnp.zeros(self.coordinates * (2 * self.harmonics + 1))
        jacobian = jax.jacfwd(self.residual)(zero, omega)
        return jnp.linalg.solve(jacobian, -self.residual(zero, omega))

    def steady_state(self, unknowns: Float[Array, " unknowns"], omega: Array, converged: Array) -> SteadyState:
        """The motion of the unknowns."""
        coefficients, mean_torque = self._coefficients(unknowns)
        H = self.harmonics
        motion = FourierSeries(
            omega / self.subharmonic, coefficients[:, 0], coefficients[:, 1 : H + 1], coefficients[:, H + 1 :]
        )
        return SteadyState(motion, mean_torque, self.defect(unknowns, omega), converged)

    def unknowns(self, motion: FourierSeries) -> Float[Array, " unknowns"]:
        """The unknowns of a given dynamic error (of a reduced drive)."""
        if self.coordinates != 1:
            raise ValueError("`motion` can be given for a ReducedModel only")
        series = motion.padded(self.harmonics)
        return jnp.concatenate([series.mean[None], series.cosine, series.sine]) / self.length


def balance(
    model: Model,
    forcing: FourierSeries | None = None,
    *,
    load_torque: FourierSeries | None = None,
    harmonics: int = DEFAULT_HARMONICS,
    samples: int | None = None,
    subharmonic: int = 1,
    rotating: bool = False,
) -> BalancedMotion:
    """Set up harmonic balance for a model and a periodic forcing.

    Args:
        model: the equations; effects must have no hidden states and must not act on a logged torque.
        forcing: motor torque [N m] or a reduced drive's forcing; none where not given. For two inertias its mean is
            not used: the mean torque is what keeps the mean speed.
        load_torque: torque on the load along +theta_l [N m], with the same fundamental.
        harmonics: highest multiple of the fundamental to keep.
        samples: points of one period; the next power of two above four per harmonic where not given.
        subharmonic: look for motions of this many forcing periods.
        rotating: the motor turns at the forcing frequency (two inertias only).

    Raises:
        ValueError: the model has effects that harmonic balance does not support.
    """
    for effect in model.effects:
        if effect.states or isinstance(effect, ActuatorEffect):
            raise ValueError(
                f"`{effect.name}` has memory or acts on a logged torque: use the time domain (`shoot`, `swept_sine`)"
            )
        if rotating and "theta_l" in effect.angles:
            raise ValueError(f"`{effect.name}` turns with the output: its period is not the motor's revolution")
        if rotating and isinstance(effect, KinematicHarmonic) and not effect.repeats():
            raise ValueError(f"`{effect.name}` has order {float(effect.n):g}: it does not repeat every revolution")
    if rotating and not isinstance(model, TwoInertiaModel):
        raise ValueError("`rotating` needs a TwoInertiaModel: a reduced drive has no motor angle")
    nothing = FourierSeries(1.0, jnp.zeros(()), jnp.zeros(1), jnp.zeros(1))
    system = BalancedMotion(
        model,
        nothing if forcing is None else forcing,
        nothing if load_torque is None else load_torque,
        jnp.ones(()),
        harmonics,
        2 ** int(np.ceil(np.log2(4 * harmonics + 1))) if samples is None else samples,
        subharmonic,
        rotating,
    )
    if system.samples <= 2 * harmonics:
        raise ValueError(f"`samples` must be above {2 * harmonics}, but is {system.samples}")
    return eqx.tree_at(lambda s: s.length, system, _resonance_length(system))


@eqx.filter_jit
def _resonance_length(system: BalancedMotion) -> Array:
    """The resonance's amplitude as the scale of the motion: A/(mu omega), where hardening raises omega."""
    drive = system.model.drive
    still = jnp.zeros(system.coordinates * (2 * system.harmonics + 1))
    push = jnp.max(jnp.abs(system.residual(still, drive.omega_0)))
    length: Array = push * drive.omega_0 / jnp.maximum(drive.mu, 1e-6 * drive.omega_0)
    length = length / (1.0 + 0.75 * jnp.maximum(drive.alpha, 0.0) * length**2) ** 0.25
    return jnp.where(length > 0, length, 1.0)


def solve(
    system: BalancedMotion, omega: ArrayLike, guess: FourierSeries | None = None, *, max_steps: int = 64
) -> SteadyState:
    """The steady motion at one forcing frequency; differentiable through the implicit function theorem.

    Where several motions exist, this is one of them; [`hdjax.response.frequency_response`][] finds a whole branch.

    Args:
        system: from [`balance`][].
        omega: forcing frequency [rad/s].
        guess: a dynamic error to start from (reduced drives); the linearised response where not given.
        max_steps: largest number of steps.
    """
    return _solve(system, as_scalar(omega), guess, max_steps)


@eqx.filter_jit
def _solve(system, omega, guess, max_steps) -> SteadyState:
    unknowns, solved = find_root(system, omega, guess, max_steps)
    return system.steady_state(unknowns, omega, solved)


def find_root(
    system: BalancedMotion, omega: Array, guess: FourierSeries | None, max_steps: int = 64
) -> tuple[Float[Array, " unknowns"], Bool[Array, ""]]:
    """[`solve`][] in the system's own unknowns, and whether they solve it."""
    start = system.linear(omega) if guess is None else system.unknowns(guess)

    def residual(unknowns: Array, args: Any) -> Array:
        system, omega = args
        return system.residual(unknowns, omega)

    def root(start: Array) -> tuple[Array, Array]:
        solver = optx.Newton(_TOLERANCE, _TOLERANCE)
        unknowns = optx.root_find(residual, solver, start, (system, omega), max_steps=max_steps, throw=False).value
        left = jnp.max(jnp.abs(system.residual(unknowns, omega)))
        return unknowns, jnp.where(jnp.isfinite(left), left, jnp.inf)

    # Near a resonance the linearised motion is far too large: smaller starts are tried as well.
    scales = jnp.asarray(_START_SCALES if guess is None else [1.0])
    roots, left = jax.vmap(root)(scales[:, None] * start[None, :])
    solved = left < _SOLVED * (1.0 + jnp.max(jnp.abs(roots), axis=1))
    best = jax.lax.stop_gradient(jnp.where(jnp.any(solved), roots[jnp.argmax(solved)], jnp.zeros_like(start)))
    unknowns, _ = root(best)
    unknowns = jnp.where(jnp.any(solved), unknowns, best)
    return unknowns, jnp.any(solved)


def waves(harmonics: int, samples: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Basis functions at the samples, their slopes, the projection back onto them and above, and their orders."""
    angles = np.arange(samples) * (2 * np.pi / samples)
    k = np.arange(1, harmonics + 1)[:, None]
    cosine, sine = np.cos(k * angles), np.sin(k * angles)
    basis = np.concatenate([np.ones((1, samples)), cosine, sine])
    slope = np.concatenate([np.zeros((1, samples)), -k * sine, k * cosine])
    above = np.arange(harmonics + 1, (samples + 1) // 2)[:, None]
    weights = np.concatenate([np.full((1, samples), 0.5), cosine, sine, np.cos(above * angles), np.sin(above * angles)])
    orders = np.concatenate([[0.0], k[:, 0], k[:, 0]])
    return basis, slope, weights.T * (2.0 / samples), orders
