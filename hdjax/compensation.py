"""Feedforward compensation of a periodic dynamic error: torque and motor angle.

The equations are inverted along one motor revolution: the desired motion is prescribed, the other coordinate follows
from the load's equation by harmonic balance, and the motor's equation gives the torque.
"""

from typing import Any, ClassVar, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jaxtyping import Array, ArrayLike, Bool, Float

from hdjax.drive import Drive
from hdjax.dynamics import TwoInertiaModel
from hdjax.effects import ActuatorEffect, Effect, Motion, MotorSideEffect, Scales
from hdjax.effects.kinematic import KinematicHarmonic
from hdjax.fourier import FourierSeries, fourier_series, harmonic_series
from hdjax.parameters import Scalar, as_scalar, parameter
from hdjax.simulate import Trajectory, simulate

Target = Literal["dynamic_error", "output"]
_TOLERANCE = 1e-12
_SOLVED = 1e-9


class Feedforward(eqx.Module):
    """Motor angle and torque for which an error vanishes at constant speed.

    Attributes:
        speed: mean motor rate [rad/s].
        correction: of the motor angle, around `speed * t` [rad, motor side].
        torque: motor torque along that motion [N m].
        dynamic_error: remaining x = theta_m/N - theta_l [rad].
        output_error: remaining deviation of the load from its mean rotation [rad].
        converged: whether the equations were solved.
    """

    speed: Float[Array, ""]
    correction: FourierSeries
    torque: FourierSeries
    dynamic_error: FourierSeries
    output_error: FourierSeries
    converged: Bool[Array, ""]

    def motor_angle(self, t: Array) -> Array:
        """The motor angle to command at time t [rad]."""
        return self.speed * t + self.correction(t)


def feedforward(
    model: TwoInertiaModel,
    speed: ArrayLike,
    *,
    target: Target = "dynamic_error",
    load_torque: ArrayLike = 0.0,
    harmonics: int = 12,
    samples: int = 64,
) -> Feedforward:
    """The motor torque and angle under which an error vanishes at a constant mean speed.

    Args:
        model: the drive with its kinematic error and other effects without memory.
        speed: mean motor rate [rad/s].
        target: `"dynamic_error"`: x is constant, motor and load oscillate together. `"output"`: the load turns
            uniformly, and the motor moves against the kinematic error.
        load_torque: constant torque on the load along +theta_l [N m].
        harmonics: of the motor revolution to keep.
        samples: of a revolution at which forces are evaluated; above twice the harmonics.

    Raises:
        ValueError: an effect has memory, acts on a logged torque, does not repeat with the motor's revolution, or is a
            function of the motor torque.
    """
    for effect in model.effects:
        if effect.states or isinstance(effect, ActuatorEffect):
            raise ValueError(f"`{effect.name}` has memory or acts on a logged torque: no feedforward can carry it")
        if "theta_l" in effect.angles:
            raise ValueError(f"`{effect.name}` turns with the output: its period is not the motor's revolution")
        if isinstance(effect, KinematicHarmonic) and not effect.repeats():
            raise ValueError(f"`{effect.name}` has order {float(effect.n):g}: it does not repeat every revolution")
        if effect.follows_torque:
            raise ValueError(f"`{effect.name}` is a function of the motor torque, which is to be found")
    if samples <= 2 * harmonics:
        raise ValueError(f"`samples` must be above {2 * harmonics}, but is {samples}")
    return _feedforward(model, as_scalar(speed), as_scalar(load_torque), target, harmonics, samples)


@eqx.filter_jit
def _feedforward(
    model: TwoInertiaModel, speed: Array, load_torque: Array, target: Target, harmonics: int, samples: int
) -> Feedforward:
    drive = model.drive

    def motion(unknowns: Array, speed: Array) -> tuple[FourierSeries, FourierSeries]:
        """x and the load's oscillation: the mean of x, then the cosines and sines of the free coordinate."""
        free = FourierSeries(speed, jnp.zeros(()), unknowns[1 : harmonics + 1], unknowns[harmonics + 1 :])
        held = FourierSeries(speed, jnp.zeros(()), jnp.zeros(harmonics), jnp.zeros(harmonics))
        x, swing = (held, free) if target == "dynamic_error" else (free, held)
        return FourierSeries(speed, unknowns[0], x.cosine, x.sine), swing

    def torques(model: TwoInertiaModel, x: FourierSeries, swing: FourierSeries, load_torque: Array) -> Array:
        """By sample: residual torque on the load, and motor torque [N m]."""
        drive = model.drive
        t = jnp.arange(float(samples)) * (2 * np.pi / samples) / x.omega
        rates = [(s, s.derivative(), s.derivative().derivative()) for s in (x, swing)]
        (x_0, x_1, x_2), (y_0, y_1, y_2) = ([s(t) for s in series] for series in rates)
        states = jnp.stack(
            [
                drive.N * (x_0 + y_0) + x.omega * t,
                y_0 + x.omega * t / drive.N,
                drive.N * (x_1 + y_1) + x.omega,
                y_1 + x.omega / drive.N,
            ],
            axis=1,
        )
        no_torque, loads = jnp.zeros_like(t), jnp.full(samples, 1.0) * load_torque
        # The motor's acceleration is linear in the torque.
        free, pushed = (jax.vmap(model.rates)(states, no_torque + unit, loads) for unit in (0.0, 1.0))
        lacking = (drive.N * (x_2 + y_2) - free[:, 2]) / (pushed - free)[:, 2]
        return jnp.stack([drive.J_l * (y_2 - free[:, 3]), lacking])

    length = jnp.maximum(jnp.max(jnp.abs(_geometry(model))), jnp.abs(load_torque) / drive.K)
    length = jnp.where(length > 0.0, length, 1.0)

    def residual(unknowns: Array, given: Any) -> Array:
        model, speed, load_torque, length = given
        lacking = torques(model, *motion(length * unknowns, speed), load_torque)[0]
        series = fourier_series(speed, lacking / (model.drive.K * length), harmonics)
        return jnp.concatenate([series.mean[None], series.cosine, series.sine])

    given = (model, speed, load_torque, length)
    start = jnp.zeros(2 * harmonics + 1)
    solver = optx.Newton(_TOLERANCE, _TOLERANCE)
    unknowns = optx.root_find(residual, solver, start, given, max_steps=50, throw=False).value
    left = jnp.max(jnp.abs(residual(unknowns, given)))
    converged = jnp.isfinite(left) & (left < _SOLVED)
    x, swing = motion(jnp.where(converged, length * unknowns, 0.0), speed)
    torque = fourier_series(speed, torques(model, x, swing, load_torque)[1], harmonics)
    correction = FourierSeries(
        speed, drive.N * x.mean, drive.N * (x.cosine + swing.cosine), drive.N * (x.sine + swing.sine)
    )
    return Feedforward(speed, correction, torque, x, swing, converged)


def _geometry(model: TwoInertiaModel) -> Array:
    """The mesh's kinematic error over a motor revolution [rad]."""
    angles = jnp.arange(64.0) * (2 * np.pi / 64)
    at = jax.vmap(lambda a: model.motion(jnp.zeros(4).at[0].set(a)).x - a / model.drive.N)
    return at(angles)


class MotorServo(MotorSideEffect):
    """A position servo on the motor: torque `stiffness (theta_command - theta_m) + damping (its rate)`.

    The command is a function of time and enters with the motor torque, see [`ServoTorque`][].
    """

    family: ClassVar[str] = "servo"
    name: ClassVar[str] = "motor_servo"

    stiffness: Scalar = parameter(unit="N m/rad", doc="position gain, motor side", bounds=(0.0, 1e9))
    damping: Scalar = parameter(unit="N m s/rad", doc="rate gain, motor side", bounds=(0.0, 1e9))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        """None: a servo is not a candidate effect."""
        return ()

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return -self.stiffness * motion.theta_m - self.damping * motion.omega_m


class ServoTorque(eqx.Module):
    """The part of a servo's motor torque that is a function of time: command and feedforward.

    Attributes:
        servo: its gains.
        k_T: ratio of the acting to the commanded torque.
        speed: commanded mean motor rate [rad/s].
        correction: of the commanded motor angle, around `speed * t` [rad].
        feedforward: torque added to the servo's [N m].
    """

    servo: MotorServo
    k_T: Array
    speed: Array = eqx.field(converter=as_scalar)
    correction: FourierSeries
    feedforward: FourierSeries

    def __call__(self, t: Array) -> Array:
        angle = self.speed * t + self.correction(t)
        rate = self.speed + self.correction.derivative()(t)
        # The servo's reaction acts as it is.
        return (self.servo.stiffness * angle + self.servo.damping * rate) / self.k_T + self.feedforward(t)


def run_at_speed(
    plant: TwoInertiaModel,
    speed: ArrayLike,
    times: Float[Array | np.ndarray, " n"],
    servo: MotorServo,
    *,
    correction: Feedforward | None = None,
    use: tuple[Literal["torque", "motor_angle"], ...] = ("torque", "motor_angle"),
    load_torque: ArrayLike = 0.0,
) -> Trajectory:
    """Simulate a drive with a servo at constant speed, with or without feedforward.

    The drive starts in rigid rotation; discard the transient before comparing.

    Args:
        plant: the true drive.
        speed: commanded motor rate [rad/s].
        times: of the saved states [s].
        servo: the motor's position servo.
        correction: from [`feedforward`][], of a model that may differ from the plant; none where not given.
        use: whether to use the corrected motor angle, the torque, or both. The torque alone suits a soft servo (which
            opposes the desired motion), the angle alone a stiff one.
        load_torque: constant torque on the load along +theta_l [N m].
    """
    speed = as_scalar(speed)
    nothing = harmonic_series(speed, jnp.zeros(1 if correction is None else correction.torque.harmonics))
    angle = torque = nothing
    if correction is not None:
        angle = correction.correction if "motor_angle" in use else nothing
        torque = correction.torque if "torque" in use else nothing
    driven = plant.with_effects(servo)
    return simulate(
        driven,
        ServoTorque(servo, plant.drive.k_T, speed, angle, torque),
        times,
        driven.settled(jnp.stack([jnp.zeros(()), jnp.zeros(()), speed, speed / plant.drive.N])),
        load_torque=harmonic_series(speed, 0.0, mean=load_torque),
        rtol=1e-9,
        atol=1e-12,
    )
