"""How far is a simulation of few steps off, where dry friction stops, holds and turns a drive? See README.md beside
this file.

The truth is this script's own Runge-Kutta, of the friction's law as stated and with steps that resolve its corner. It
shares no code with the simulation.
"""

import diffrax as dfx
import jax
import jax.numpy as jnp
import numba
import numpy as np

from hdjax import Drive, TwoInertiaModel, sampled
from hdjax.effects.friction import CoulombFriction, LoadFriction, MotorFriction
from hdjax.effects.position import PositionDependentMotorFriction
from hdjax.simulate import march

DRIVE = Drive(N=100.0, J_m=1e-4, J_l=1.0, K=2e4, B_sp=5.0)
DT, COUNT = 1e-3, 2000
# Steps a sample of the truth, and of what is compared with it.
FINE = 2048
STEPS = (1, 2, 4)
# Width of the corner, in motor rate [rad/s]: resolved by no step, by some, by all.
CORNERS = (1e-3, 0.1, 0.3, 1.0)
# Dry friction of the motor (and its ripple over a revolution), in the mesh and of the load [N m].
FRICTIONS = {
    "motor": (0.12, 0.0, 0.0, 0.0),
    "mesh": (0.0, 0.0, 2.0, 0.0),
    "load": (0.0, 0.0, 0.0, 5.0),
    "motor, rippling": (0.12, 0.04, 0.0, 0.0),
    "motor and mesh": (0.12, 0.0, 2.0, 0.0),
}


def torques() -> np.ndarray:
    """Motor torque of each sample: two slow sinusoids and a drift, under which the drive sticks a part of the time."""
    t = DT * np.arange(COUNT)
    drift = np.cumsum(np.random.default_rng(0).normal(size=COUNT)) / np.sqrt(COUNT)
    return 0.25 * np.sin(2 * np.pi * 1.5 * t) + 0.1 * np.sin(2 * np.pi * 4.0 * t) + 0.05 * drift


def model_of(friction: tuple[float, float, float, float], corner: float) -> TwoInertiaModel:
    """The drive with that friction, in hdjax."""
    motor, ripple, mesh, load = friction
    effects = []
    if ripple > 0:
        effects.append(PositionDependentMotorFriction(T_c=motor, cosine=ripple, n=1.0, transition=corner))
    elif motor > 0:
        effects.append(MotorFriction(T_c=motor, transition=corner))
    if mesh > 0:
        effects.append(CoulombFriction(T_c=mesh, v_0=corner / DRIVE.N))
    if load > 0:
        effects.append(LoadFriction(T_c=load, transition=corner / DRIVE.N))
    return TwoInertiaModel(DRIVE).with_effects(*effects)


@numba.njit
def _slope(y, torque, drive, friction, corner):
    N, J_m, J_l, K, B_sp = drive
    motor, ripple, mesh, load = friction
    x, v = y[0] / N - y[1], y[2] / N - y[3]
    tau = K * x + B_sp * v + mesh * np.tanh(v * N / corner)
    on_motor = (motor + ripple * np.cos(y[0])) * np.tanh(y[2] / corner)
    on_load = load * np.tanh(y[3] * N / corner)
    return np.array([y[2], y[3], (torque - on_motor - tau / N) / J_m, (tau - on_load) / J_l])


@numba.njit
def _twist(torque, steps, drive, friction, corner):
    """The law as stated, by RK4."""
    h = DT / steps
    y = np.zeros(4)
    out = np.empty(torque.size)
    for k in range(torque.size):
        out[k] = y[0] / drive[0] - y[1]
        for _ in range(steps):
            a = _slope(y, torque[k], drive, friction, corner)
            b = _slope(y + 0.5 * h * a, torque[k], drive, friction, corner)
            c = _slope(y + 0.5 * h * b, torque[k], drive, friction, corner)
            d = _slope(y + h * c, torque[k], drive, friction, corner)
            y = y + h / 6 * (a + 2 * (b + c) + d)
    return out


def main() -> None:
    """Print the table."""
    jax.config.update("jax_enable_x64", True)
    torque = torques()
    drive = tuple(float(v) for v in (DRIVE.N, DRIVE.J_m, DRIVE.J_l, DRIVE.K, DRIVE.B_sp))
    signal = sampled(DT * np.arange(COUNT), torque, hold="zero-order")

    @jax.jit
    def twist(model, steps):
        states, _ = march(model, signal, None, jnp.zeros(4), solver=dfx.Tsit5(), substeps=steps)
        return states[:, 0] / DRIVE.N - states[:, 1]

    print(f"{float(DRIVE.omega_0) * DT:.2f} rad of the drive's oscillation a sample; rms errors of the twist [urad]")
    ours, stated = (f"{name}, {' / '.join(map(str, STEPS))} steps" for name in ("hdjax", "law as stated"))
    print(f"{'friction':<17}{'corner [rad/s]':>15}{'rms twist':>11}{ours:>30}{stated:>36}")
    for corner in CORNERS:
        for name, friction in FRICTIONS.items():
            truth = _twist(torque, FINE, drive, friction, corner)

            def error(other, truth=truth):
                rms = float(np.sqrt(np.mean((np.asarray(other) - truth) ** 2)))
                return f"{1e6 * rms:9.2f}" if np.isfinite(rms) else "    lost"

            model = model_of(friction, corner)
            found = "".join(error(twist(model, steps)) for steps in STEPS)
            plain = "".join(error(_twist(torque, steps, drive, friction, corner)) for steps in STEPS)
            print(f"{name:<17}{corner:15g}{1e6 * np.std(truth):11.0f}{found:>30}{plain:>36}", flush=True)


if __name__ == "__main__":
    main()
