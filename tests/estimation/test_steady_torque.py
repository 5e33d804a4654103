"""A steady load with a free value in each segment: a hidden state that acts as a constant torque."""

import diffrax as dfx
import jax.numpy as jnp
import numpy as np

import rig
from fitting.estimation.steady_torque import SteadyLoad
from hdjax import sampled
from hdjax.effects.load import ConstantLoad
from hdjax.simulate import march


def test_steady_load_acts_as_its_state_times_its_reach():
    torque = sampled(rig.STEP * np.arange(200), rig.drive_torque(200), hold="zero-order")

    def motion(effect, *own):
        model = rig.drive_model().with_effects(effect)
        start = jnp.concatenate([jnp.zeros(4), jnp.asarray(own)])
        return march(model, torque, None, start, solver=dfx.Tsit5(), substeps=2)[0]

    loaded, constant = motion(SteadyLoad(reach=8.0), 0.25), motion(ConstantLoad(constant=2.0))
    np.testing.assert_allclose(loaded[:, :4], constant, rtol=1e-12, atol=1e-15)
    np.testing.assert_array_equal(loaded[:, 4], 0.25)
