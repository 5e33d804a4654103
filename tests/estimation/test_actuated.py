"""The torque after actuator effects, and its derivatives, outside JAX programs."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from fitting.estimation.free_parameters import strength_paths
from fitting.estimation.machine_code import actuated
from hdjax import PiecewisePolynomial, sampled
from hdjax.effects import CATALOGUE, ActuatorEffect, Scales
from hdjax.effects.actuation import TorqueGain
from hdjax.parameters import Scalar, parameter

STEP, SAMPLES = 1e-3, 12
FORMS = [form for form in CATALOGUE if issubclass(form, ActuatorEffect)]


class Saturation(ActuatorEffect):
    """An actuator effect that a user wrote, for JAX alone."""

    name: ClassVar[str] = "saturation"
    family: ClassVar[str] = "unknown"

    limit: Scalar = parameter(1.0, unit="N m", doc="largest torque", role="strength")

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[ActuatorEffect, ...]:
        return (cls(),)

    def actuate(self, logged: PiecewisePolynomial) -> PiecewisePolynomial:
        held = logged.coefficients.at[:, 0].min(self.limit)
        return PiecewisePolynomial(logged.knots, held)


def test_an_actuator_effect_for_jax_alone_is_applied_outside_jax_programs():
    random = np.random.default_rng(0)
    torque = PiecewisePolynomial(np.arange(6.0)[None], random.normal(size=(1, 5, 6)))
    found, (slope,) = actuated((Saturation(),), ("saturation.limit",), np.array([0.2]), torque)
    np.testing.assert_allclose(found[..., 0], np.minimum(torque.coefficients[..., 0], 0.2))
    np.testing.assert_allclose(slope[..., 0], torque.coefficients[..., 0] > 0.2)


@pytest.mark.parametrize("form", FORMS)
def test_torque_and_its_derivatives_by_numpy_equal_those_by_jax(form: type[ActuatorEffect]):
    """Delays are near zero as in screening, within a sample interval, and over several. A gain comes first."""
    random = np.random.default_rng(0)
    times = np.cumsum(STEP * random.uniform(0.8, 1.2, (3, SAMPLES)), axis=1)
    signals = [sampled(t, random.normal(size=SAMPLES), hold="cubic") for t in times]
    torque = jax.tree.map(lambda *each: np.stack(each), *signals)
    effects = (TorqueGain(), form()) if form is not TorqueGain else (form(),)
    paths = tuple(path for effect in effects for path in strength_paths(effect))
    program = jax.jit(lambda values: actuated(effects, paths, values, torque))
    for strength in (1e-9, 0.3, 2.6):
        values = np.array([0.1] * (len(paths) - 1) + [strength * (1.0 if form.family == "torque_sensor" else STEP)])
        found, expected = actuated(effects, paths, values, torque), program(jnp.asarray(values))
        for own, other in zip((found[0], *found[1]), (expected[0], *expected[1]), strict=True):
            at_the_end = np.asarray(other) * STEP ** np.arange(6.0)
            np.testing.assert_allclose(own * STEP ** np.arange(6.0), at_the_end, atol=1e-10 * np.abs(at_the_end).max())
