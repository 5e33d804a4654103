"""The linear response along a motion, compared with differences of independent simulations."""

from dataclasses import replace

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import rig
from fitting.estimation.estimate import Fit, fit
from fitting.estimation.experiment import split
from fitting.estimation.free_parameters import base_paths, strength_paths
from fitting.estimation.linear_response import Followed, follow, respond
from fitting.estimation.problem import Segmentation
from fitting.estimation.residual import simulate_segments
from fitting.first_order.motion import along
from fitting.first_order.regressors import regressors
from hdjax import PiecewisePolynomial
from hdjax.effects import Effect
from hdjax.effects.actuation import InputDelay, TorqueBias
from hdjax.effects.creep import Creep
from hdjax.effects.damping import DisplacementDamping, QuadraticDamping
from hdjax.effects.effect import Scales
from hdjax.effects.kinematic import KinematicError
from hdjax.effects.load import GravityLoad, LoadDisturbance
from hdjax.effects.stiffness import QuadraticStiffness
from hdjax.effects.thermal import ThermalStiffness

COUNT = 256
SCALES = Scales(x=1e-3, x_max=3e-3, v=0.2, omega_m=5.0, omega_l=0.1, time_step=rig.STEP)


@pytest.fixture(scope="module")
def found() -> Fit:
    """A fit that starts at the true model, over segments of 64 samples."""
    training, _ = split([rig.drive_experiment(COUNT)], held_out=0.02)
    model = rig.drive_model()
    return fit(model, training, base_paths(model), Segmentation(64, halo=4, substeps=3))


@pytest.fixture(scope="module")
def followed(found: Fit) -> Followed:
    return follow(replace(found.problem, model=found.model), found.unknowns)


def simulated(found: Fit, effect: Effect) -> np.ndarray:
    """Outputs of the simulation with the effect; its hidden states start at rest."""
    model = found.model.with_effects(effect)
    rest = jnp.broadcast_to(model.rest()[4:], (found.unknowns.states.shape[0], len(effect.states)))
    unknowns = replace(found.unknowns, states=jnp.concatenate([found.unknowns.states, rest], axis=1))
    outputs, _ = simulate_segments(replace(found.problem, model=model, substeps=12), unknowns)
    return np.asarray(outputs)


CASES = {
    "bias": (TorqueBias(), {"bias": 1e-3}, 1e-3),
    "quadratic stiffness": (QuadraticStiffness(), {"k2": 1e-3}, 2e-3),
    "quadratic damping": (QuadraticDamping(), {"c2": 1e-4}, 5e-3),
    "displacement damping": (DisplacementDamping(), {"c_x": 1.0}, 5e-3),
    "kinematic error": (KinematicError(), {"cos_2": 1e-8}, 2e-3),
    "gravity": (GravityLoad(), {"sine": 1e-3}, 1e-3),
    # A delayed torque jumps inside the interval; a straight line keeps only its impulse and first moment.
    "delay": (InputDelay.proposals(SCALES)[0], {"delay": 1e-7}, 2e-2),
}


@pytest.mark.parametrize("case", CASES)
def test_regressor_equals_the_derivative_of_the_simulation(found: Fit, followed: Followed, case: str):
    effect, strength, tolerance = CASES[case]
    (name, size), *_ = strength.items()
    start = float(getattr(effect, name))
    both = [eqx.tree_at(lambda e: getattr(e, name), effect, jnp.asarray(start + sign * size)) for sign in (0.0, 1.0)]
    slope = (simulated(found, both[1]) - simulated(found, both[0])) / size
    seen = along(found.model, followed, found.problem.segments, found.stretches)
    forces, _ = regressors(seen, [effect])
    column = [p.split(".")[1] for p in strength_paths(effect)].index(name)
    assert forces.forces is not None
    outputs, _ = respond(followed, forces.forces)
    answer = np.asarray(outputs if forces.reading is None else outputs + forces.reading)[..., column]
    real = np.asarray(found.problem.segments.weight)[:, :, None] > 0
    off = np.where(real, answer - slope, 0.0)
    assert np.abs(off).max() < tolerance * np.abs(np.where(real, slope, 0.0)).max()


def test_responses_along_a_motion_allow_for_temperature(found: Fit, followed: Followed):
    """The response to a unit of torque is the same at any time and temperature.

    An error of the mesh acts through the stiffness, which is larger by 1e-3 of itself for each of 6.85 K.
    """
    model = found.model.with_effects(LoadDisturbance(omega=30.0, cosine=1e-3), ThermalStiffness(k_T=1e-3))
    segments = found.problem.segments
    knots = segments.torque.knots[:, segments.halo :]
    warm = PiecewisePolynomial(
        knots, jnp.stack([jnp.full_like(knots[:, 1:], 300.0), jnp.zeros_like(knots[:, 1:])], axis=-1)
    )
    segments = replace(segments, temperature=warm)
    plain = along(found.model, followed, found.problem.segments, found.stretches)
    seen = along(model, followed, segments, found.stretches)
    assert len(plain.carried) == 6
    for name, change in plain.carried.items():
        if name != "slope":
            factor = 1.00685 if name == "error" else 1.0
            np.testing.assert_allclose(seen.carried[name], factor * change, rtol=1e-9, atol=0.0)


def test_hidden_states_follow_the_motion_and_continue_into_the_next_stretch():
    """The state of creep is the lagged twist; the next stretch starts from its last value."""
    tau = 0.03
    creep = Creep(tau=tau, span=1e-3)
    model = rig.drive_model()
    parts = split([rig.drive_experiment(COUNT)], held_out=0.3)
    fits = [fit(model, part, base_paths(model), Segmentation(64, halo=4, substeps=3, count=3)) for part in parts]
    first, second = (
        along(f.model, follow(replace(f.problem, model=f.model), f.unknowns), f.problem.segments, f.stretches)
        for f in fits
    )
    _, memory = regressors(first, [creep, creep])
    _, later = regressors(second, [creep, creep], memory)
    _, afresh = regressors(second, [creep, creep])
    assert memory is not None and later is not None and afresh is not None
    assert memory.at_starts.shape == (3, 1, 2) and memory.at_ends.shape == (1, 1, 2)
    # A straight line through each interval of the twist as it was measured, in closed form.
    twist = np.asarray(parts[0][0].experiment.measured)[:, 1]
    z, decay = [twist[0]], np.exp(-rig.STEP / tau)
    for x, rise in zip(twist, np.diff(twist), strict=False):
        z.append(x + (z[-1] - x) * decay + rise - rise * tau / rig.STEP * (1.0 - decay))
    border = parts[0][0].stop
    expected = np.array([z[0], z[64], z[128]])
    size = np.abs(z).max()
    np.testing.assert_allclose(memory.at_starts[:, 0, 0], expected, atol=0.02 * size)
    np.testing.assert_allclose(memory.at_ends[0, 0], z[border], atol=0.02 * size)
    np.testing.assert_array_equal(later.at_starts[0], memory.at_ends[0])
    np.testing.assert_allclose(later.at_starts[1, 0], z[border + 64], atol=0.02 * size)
    assert abs(afresh.at_starts[0, 0, 0] - z[border]) > 0.1 * size


def test_xla_linearisation_equals_that_of_machine_code(found: Fit, followed: Followed):
    again = follow(replace(found.problem, model=found.model, kernel=None), found.unknowns)
    for name, values in vars(followed).items():
        size = np.maximum(np.abs(values).max(axis=(0, 1)), 1e-12)
        np.testing.assert_allclose(getattr(again, name) / size, values / size, atol=1e-9, err_msg=name)
