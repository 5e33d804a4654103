"""What no verb reaches: compensation, a swept sine and Floquet multipliers, through the Python interface.

It runs by `python -P probe.py NAME` and prints one JSON object.
"""

import json
import sys
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


def compensation() -> dict[str, Any]:
    """Feedforward of a kinematic error at one speed, and what it leaves of the error."""
    from hdjax import Drive
    from hdjax.compensation import MotorServo, feedforward, run_at_speed
    from hdjax.dynamics import TwoInertiaModel
    from hdjax.effects.kinematic import KinematicError

    drive = Drive(N=50.0, J_m=5.26e-4, J_l=5e-2, K=7160.0, alpha=1e5, B_sp=0.5)
    plant = TwoInertiaModel(drive, (KinematicError(cos_2=1.5e-4, sin_1=3e-5, cos_4=2e-5),))
    servo = MotorServo(stiffness=20.0, damping=0.2)
    times = np.linspace(0.0, 1.2, 1201)
    found: dict[str, Any] = {}
    for target in ("dynamic_error", "output"):
        correction = feedforward(plant, 60.0, target=target)
        run = run_at_speed(plant, 60.0, times, servo, correction=correction)
        found[target] = {
            "converged": bool(correction.converged),
            "torque": correction.torque.amplitudes.tolist()[:4],
            "angle": correction.correction.amplitudes.tolist()[:4],
            "left": float(np.log10(np.asarray(run.dynamic_error)[800:].std())),
        }
    plain = run_at_speed(plant, 60.0, times, servo)
    return found | {"without": float(np.asarray(plain.dynamic_error)[800:].std())}


def _duffing() -> Any:
    from hdjax import ReducedDrive, ReducedModel

    return ReducedModel(ReducedDrive(mu=0.1, omega_0=1.0, alpha=0.5))


def swept_sine() -> dict[str, Any]:
    """A sine swept up and down: amplitudes, jumps and the band of two motions."""
    from hdjax.response.swept_sine import hysteresis_band, swept_sine

    omegas = np.linspace(0.8, 2.0, 61)
    up, down = (swept_sine(_duffing(), 0.4, omegas, direction) for direction in ("up", "down"))
    band = hysteresis_band(up, down)
    found: dict[str, Any] = {"band": None if band is None else list(band)}
    for name, sweep in (("up", up), ("down", down)):
        found[name] = {
            "jumps": omegas[np.flatnonzero(np.asarray(sweep.jumps()))].tolist(),
            "amplitude": np.asarray(sweep.amplitude)[::20].tolist(),
            "escaped": int(jnp.sum(sweep.escaped)),
        }
    return found


def floquet() -> dict[str, Any]:
    """A frequency response through its folds: stability, multipliers, folds and peak."""
    from hdjax.fourier import harmonic_series
    from hdjax.response.continuation import frequency_response
    from hdjax.response.fold import folds
    from hdjax.response.resonance import peak

    branch = frequency_response(_duffing(), harmonic_series(1.0, 0.4), 0.1, 2.5, points=200)
    top = peak(branch)
    moduli = np.abs(np.asarray(branch.multipliers))
    return {
        "folds": np.sort(np.asarray(folds(branch).value)).tolist()[-4:],
        "peak": {"omega": float(top.value), "amplitude": float(top.amplitude)},
        "stable": int(jnp.sum(branch.stable)),
        "moduli": {"first": np.sort(moduli[0]).tolist(), "last": np.sort(moduli[-1]).tolist()},
        "largest_modulus": float(np.nanmax(moduli)),
    }


PROBES = {"compensation": compensation, "swept-sine": swept_sine, "floquet": floquet}

if __name__ == "__main__":
    jax.config.update("jax_enable_x64", True)
    print(json.dumps(PROBES[sys.argv[1]](), indent=1))
