"""Outputs of a simulated drive with effects, and their derivatives by an effect's parameters."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from fitting.estimation.engines import linearise, with_engine
from fitting.estimation.experiment import Experiment, Stretch
from fitting.estimation.free_parameters import FreeParameters
from fitting.estimation.problem import stable_substeps
from fitting.estimation.residual import Problem, Unknowns
from fitting.estimation.segments import cut
from hdjax import Drive, TwoInertiaModel, sampled
from hdjax.parameters import own_parameters

# A drive like the preset with a cubic term of one per cent; its initial transient decays within the record.
DRIVE = Drive(N=50.0, J_m=5.26e-4, J_l=5.0e-2, K=7160.0, alpha=2e4, B_sp=2.0)
STEP = 1e-3
TIME = STEP * np.arange(200)
# The slow part turns the motor by half a revolution and back; the fast ones shake the mesh near omega_0 = 386 rad/s.
TORQUE = sampled(
    TIME,
    1.5 * np.cos(50 * TIME) + 0.8 * np.sin(330 * TIME) + 0.5 * np.sin(410 * TIME + 1.0),
    hold="linear",
)
# It rises by ten kelvin over the record; the base drive does not depend on it.
TEMPERATURE = sampled(TIME, 300.0 + 50.0 * TIME, hold="linear")
START = jnp.asarray([0.3, 0.007, 5.0, 0.2])


def outputs_and_slopes(model, torque, start, substeps=None, settled=None):
    """Outputs of a simulation and their derivatives by each parameter of the last effect, by dotted path.

    The drive's states start at `start`. States of effects start where those of the model `settled` are, by default of
    the model itself. It runs by machine code, which agrees with XLA for every form (`test_engine_march.py`) and
    compiles sooner. It takes one step in an interval where `substeps` is not given, or as many as bristles need.
    """
    count = torque.knots.size - 1
    warmth = eqx.tree_at(lambda s: s.coefficients, torque, jnp.zeros((count, 1)) + 300.0)
    if torque.knots.size == TEMPERATURE.knots.size:
        warmth = TEMPERATURE
    knots = np.asarray(torque.knots)
    log = Experiment("rig", knots[:-1], torque, None, np.zeros((count, 2)), None, temperature=warmth)
    paths = tuple(f"{e.name}.{name}" for e in model.effects[-1:] for name, _ in own_parameters(e))
    nothing = jnp.zeros(len(paths))
    free = FreeParameters(paths, (False,) * len(paths), jnp.ones(len(paths)), nothing, nothing)
    states = (model if settled is None else settled).settled(start)[None]
    weights = jnp.eye(2), jnp.ones(len(paths)), jnp.ones(states.shape[1])
    steps = substeps or stable_substeps(model, log.time_step)
    problem = Problem(model, free, cut([Stretch(log, 0, count)], count), *weights, substeps=steps)
    found = linearise(with_engine(problem), Unknowns(free.pack(model), states))
    rows = slice(2 * count)
    slopes = -np.asarray(found.by_parameter)[0, rows].reshape(count, 2, len(paths))
    return -np.asarray(found.residual)[0, rows].reshape(count, 2), dict(
        zip(paths, np.moveaxis(slopes, 2, 0), strict=True)
    )


def outputs(model, torque, start, substeps=None, settled=None):
    """Outputs of a simulation, as in [`outputs_and_slopes`][]."""
    return outputs_and_slopes(model, torque, start, substeps, settled)[0]


def slopes(model, torque, start):
    """Derivative of the outputs with respect to each parameter of the last effect, by dotted path."""
    return outputs_and_slopes(model, torque, start)[1]


BASE = TwoInertiaModel(DRIVE)


def rms(x) -> float:
    return float(np.sqrt(np.mean(np.square(x))))
