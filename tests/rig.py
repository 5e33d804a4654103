"""An independent simulated test rig: the equations of motion in plain Python, with the classical Runge-Kutta method.

It uses no equations of hdjax, so that an error there is detected. The torque is held between samples.
"""

import functools
import math
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from fitting.estimation.experiment import Experiment, experiment_from_log
from fitting.logs.log import Log
from hdjax import Drive, ReducedDrive, ReducedModel, TwoInertiaModel

N, J_M, J_L = 50.0, 5.26e-4, 5.0e-2
K, ALPHA, B_SP = 7160.0, 2e4, 0.3
STEP = 5e-4
MU, OMEGA_0, GAIN = 3.0, 90.0, 20.0
REDUCED_ALPHA = 0.5
REDUCED_STEP = 4e-3
MOTOR_NOISE, LOAD_NOISE = 1e-5, 1e-6


def rk4(rates: Callable, state: Sequence[float], inputs: np.ndarray, step: float, substeps: int) -> np.ndarray:
    """States at the samples; `rates(state, input)` with the input held over each sample interval."""
    march = _step_of(len(state))
    h = step / substeps
    y = tuple(float(v) for v in state)
    kept = np.empty((len(inputs), len(y)))
    for i, u in enumerate(inputs.tolist()):
        kept[i] = y
        for _ in range(substeps):
            y = march(rates, y, u, h)
    return kept


@functools.cache
def _step_of(size: int) -> Callable:
    """One step for states of this size, written out: loops over the states would take as long as the rates."""

    def states(term: str) -> str:
        return "(" + "".join(term.format(i=i) + ", " for i in range(size)) + ")"

    source = f"""
def march(rates, y, u, h):
    half, sixth = 0.5 * h, h / 6
    {states("y{i}")} = y
    {states("p{i}")} = rates(y, u)
    {states("q{i}")} = rates({states("y{i} + half * p{i}")}, u)
    {states("r{i}")} = rates({states("y{i} + half * q{i}")}, u)
    {states("s{i}")} = rates({states("y{i} + h * r{i}")}, u)
    return {states("y{i} + sixth * (p{i} + 2 * q{i} + 2 * r{i} + s{i})")}
"""
    made: dict[str, Callable] = {}
    exec(source, made)
    return made["march"]


def multisine(count: int, step: float, *, rms: float, low: float, high: float, seed: int = 0) -> np.ndarray:
    """Random-phase multisine between two frequencies [Hz], periodic over the record."""
    random = np.random.default_rng(seed)
    lines = np.fft.rfftfreq(count, step)
    spectrum = np.exp(2j * np.pi * random.uniform(size=lines.size)) * ((lines >= low) & (lines <= high))
    signal = np.fft.irfft(spectrum, count)
    return rms * signal / np.std(signal)


def drive_torque(count: int, *, rms: float = 0.3, seed: int = 0) -> np.ndarray:
    """Motor torque [N m]: a slow sine and a multisine across the resonance."""
    slow = 0.15 * np.sin(4 * np.pi * np.arange(count) / count)
    return multisine(count, STEP, rms=rms, low=2.0, high=110.0, seed=seed) + slow


def drive_motion(
    torque: np.ndarray,
    *,
    stiffness: float = K,
    alpha: float = ALPHA,
    damping: float = B_SP,
    state: Sequence[float] = (0.0, 0.0, 0.0, 0.0),
    mesh_friction: tuple[float, float] = (0.0, 1.0),
    motor_friction: tuple[float, float] = (0.0, 1.0),
    torque_bias: float = 0.0,
    kinematic: tuple[float, float] = (0.0, 0.0),
    gravity: float = 0.0,
    tether: float = 0.0,
    gap: float = 0.0,
    step: float = STEP,
    substeps: int = 6,
) -> np.ndarray:
    """States (theta_m, theta_l, omega_m, omega_l) of two inertias on the mesh, DESIGN 2.4.

    Args:
        torque: logged motor torque [N m].
        stiffness: K.
        alpha: cubic coefficient.
        damping: B_sp.
        state: at the first sample.
        mesh_friction: torque [N m] and the twist rate over which its sign changes [rad/s].
        motor_friction: likewise on the motor.
        torque_bias: acting torque less the logged torque [N m].
        kinematic: cosine and sine part of a second-order kinematic error [rad].
        gravity: m g r of the load [N m].
        tether: stiffness of a spring from the load to the ground [N m/rad].
        gap: half-width of the dead zone in the mesh [rad].
        step: sampling interval [s].
        substeps: Runge-Kutta steps in each.
    """
    (T_mesh, v_0), (T_motor, w_0), (a, b) = mesh_friction, motor_friction, kinematic
    wavy = any(kinematic)

    def rates(y, T):
        # Most logs have one effect at most: those that are absent are not computed.
        theta_m, theta_l, omega_m, omega_l = y
        x, slope = theta_m / N - theta_l, 0.0
        if wavy:
            c, s = math.cos(2 * theta_m), math.sin(2 * theta_m)
            x, slope = x + a * c + b * s, 2 * (b * c - a * s)
        v = omega_m * (1 / N + slope) - omega_l
        spring = x - min(max(x, -gap), gap) if gap else x
        rubbing = T_mesh * math.tanh(v / v_0) if T_mesh else 0.0
        tau = stiffness * (spring + alpha * spring**3) + damping * v + rubbing
        friction = T_motor * math.tanh(omega_m / w_0) if T_motor else 0.0
        on_motor = T + torque_bias - friction - (1 / N + slope) * tau
        weight = gravity * math.sin(theta_l) if gravity else 0.0
        return omega_m, omega_l, on_motor / J_M, (tau - weight - tether * theta_l) / J_L

    return rk4(rates, state, torque, step, substeps)


def drive_log(
    motion: np.ndarray, torque: np.ndarray, *, noise: float = 1.0, seed: int = 0, step: float = STEP, name: str = "log"
) -> Log:
    """The rig's log of a motion; `noise` multiplies the encoders' nominal noise."""
    random = np.random.default_rng(1000 + seed)
    count = torque.size
    motor = motion[:, 0] + noise * MOTOR_NOISE * random.normal(size=count)
    load = motion[:, 1] + noise * LOAD_NOISE * random.normal(size=count)
    return log_of_angles(motor, load, torque, ratio=N, step=step, name=name)


def log_of_angles(
    motor: np.ndarray, load: np.ndarray, torque: np.ndarray, *, ratio: float, step: float, name: str
) -> Log:
    """A drive log of encoder readings."""
    return Log(
        name=name,
        path=Path(f"{name}.csv"),
        kind="drive",
        time=np.arange(torque.size) * step,
        motor_angle=motor,
        load_angle=load,
        motor_torque=torque,
        load_torque=None,
        temperature=None,
        dynamic_error=motor / ratio - load,
        forcing=None,
        units={"dynamic_error": "rad"},
    )


def drive_experiment(
    count: int, *, noise: float = 1.0, seed: int = 0, rms: float = 0.3, name: str = "log", **physics
) -> Experiment:
    """The rig's experiment; `physics` goes to [`drive_motion`][]."""
    (experiment,) = drive_parts(count, noise=noise, seed=seed, rms=rms, name=name, **physics)
    return experiment


def drive_parts(
    *counts: int, noise: float = 1.0, seed: int = 0, rms: float = 0.3, name: str = "log", **physics
) -> tuple[Experiment, ...]:
    """Consecutive parts of the rig's experiment with the given numbers of samples."""
    torque = drive_torque(sum(counts), rms=rms, seed=seed)
    log = drive_log(drive_motion(torque, **physics), torque, noise=noise, seed=seed, name=name)
    ends = np.cumsum(counts)
    parts = (log.rows(end - count, end) for end, count in zip(ends, counts, strict=True))
    return tuple(experiment_from_log(part, hold="zero-order", N=N) for part in parts)


def drive_model(*, K: float = K, alpha: float = ALPHA, B_sp: float = B_SP) -> TwoInertiaModel:
    """hdjax' model of the rig."""
    return TwoInertiaModel(Drive(N=N, J_m=J_M, J_l=J_L, K=K, alpha=alpha, B_sp=B_sp))


def reduced_forcing(count: int, *, rms: float = 10.0, seed: int = 0) -> np.ndarray:
    """Multisine forcing across the reduced oscillator's resonance."""
    return multisine(count, REDUCED_STEP, rms=rms, low=0.3, high=30.0, seed=seed)


def reduced_motion(
    forcing: np.ndarray,
    *,
    mu: float = MU,
    omega_0: float = OMEGA_0,
    alpha: float = REDUCED_ALPHA,
    gain: float = GAIN,
    state: Sequence[float] = (0.0, 0.0),
    bias: float = 0.0,
    friction: tuple[float, float] = (0.0, 1.0),
    quadratic: float = 0.0,
    step: float = REDUCED_STEP,
    substeps: int = 10,
) -> np.ndarray:
    """States (x, v) of `x'' + mu x' + omega_0^2 (x + q x^2 + alpha x^3) + T tanh(v/v_0) = gain (u + bias)`."""
    T_c, v_0 = friction

    def rates(y, u):
        x, v = y
        spring = x + quadratic * x**2 + alpha * x**3
        friction = T_c * math.tanh(v / v_0) if T_c else 0.0
        return v, gain * (u + bias) - mu * v - omega_0**2 * spring - friction

    return rk4(rates, state, forcing, step, substeps)


def reduced_log(
    x: np.ndarray, forcing: np.ndarray, *, noise: float = 0.0, seed: int = 0, step: float = REDUCED_STEP
) -> Log:
    """A log of the dynamic error alone; `noise` is its rms."""
    random = np.random.default_rng(2000 + seed)
    return Log(
        name="reduced",
        path=Path("reduced.csv"),
        kind="reduced",
        time=np.arange(forcing.size) * step,
        motor_angle=None,
        load_angle=None,
        motor_torque=None,
        load_torque=None,
        temperature=None,
        dynamic_error=x + noise * random.normal(size=forcing.size),
        forcing=forcing,
        units={"dynamic_error": "V", "forcing": "V"},
    )


def reduced_experiment(
    count: int, *, noise: float = 0.0, seed: int = 0, rms: float = 10.0, step: float = REDUCED_STEP, **physics
) -> Experiment:
    """An experiment of the dynamic error alone; `physics` goes to [`reduced_motion`][]."""
    forcing = reduced_forcing(count, rms=rms, seed=seed)
    motion = reduced_motion(forcing, step=step, **physics)
    log = reduced_log(motion[:, 0], forcing, noise=noise, seed=seed, step=step)
    return experiment_from_log(log, hold="zero-order")


def reduced_model(
    *, mu: float = MU, omega_0: float = OMEGA_0, alpha: float = REDUCED_ALPHA, gain: float = GAIN
) -> ReducedModel:
    """hdjax' model of the reduced oscillator."""
    return ReducedModel(ReducedDrive(mu=mu, omega_0=omega_0, alpha=alpha, gain=gain))
