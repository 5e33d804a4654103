"""The law that the data require is the true one, also where the fitted law is wrong."""

import numpy as np
import pytest

import rig
from fitting.attribution.effect_evidence import Evidence, evidence
from fitting.estimation.estimate import Fit, Strategy, fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.problem import Segmentation
from hdjax.effects import Effect
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.friction import CoulombFriction

T_C, V_0 = 150.0, 1.0


def fitted(effect: Effect, *, hold_parameters: bool = False) -> Fit:
    experiment = rig.reduced_experiment(1600, noise=1e-3, rms=40.0, friction=(T_C, V_0))
    paths = ("mu", "omega_0", f"{effect.name}.{'T_c' if isinstance(effect, CoulombFriction) else 'bias'}")
    return fit(
        rig.reduced_model().with_effects(effect),
        [Stretch(experiment, 0, 1600)],
        paths,
        Segmentation(128, substeps=4),
        strategy=Strategy(hold_parameters=hold_parameters),
    )


def law(found: Evidence) -> np.ndarray:
    return T_C * np.tanh(found.places / V_0)


def test_evidence_agrees_with_the_true_law():
    (found,) = evidence(fitted(CoulombFriction(T_c=100.0, v_0=V_0)))
    assert found.variable == "v"
    assert np.all(np.diff(found.places) > 0)
    np.testing.assert_allclose(found.does, T_C * np.tanh(found.at / V_0), atol=0.02 * T_C)
    assert np.all(found.std < 0.1 * T_C)
    np.testing.assert_array_less(np.abs(found.told - law(found)), 4.5 * found.std)


def test_evidence_contradicts_a_law_of_the_wrong_size():
    (found,) = evidence(fitted(CoulombFriction(T_c=0.8 * T_C, v_0=V_0), hold_parameters=True))
    far = np.abs(found.places) > 3 * V_0
    wrong = 0.8 * T_C * np.tanh(found.places / V_0)
    # An error of a fifth is large for a first-order estimate, which is still much closer to the true law.
    assert np.all(np.abs(found.told - law(found))[far] < 0.3 * np.abs(wrong - law(found))[far])


def test_effect_without_a_variable_has_no_evidence():
    assert evidence(fitted(TorqueBias(bias=0.1))) == ()


@pytest.mark.parametrize("direction", [-1.0, 1.0])
def test_hat_functions_reproduce_constants_and_straight_lines(direction: float):
    from fitting.attribution.effect_evidence import _hats

    nodes = np.array([-1.0, -0.2, 0.5, 2.0, np.nan])
    value = direction * np.linspace(-0.9, 0.9, 7)[None]
    hats = _hats(value, nodes)
    np.testing.assert_allclose(hats.sum(axis=-1), 1.0)
    np.testing.assert_allclose(hats[..., :4] @ nodes[:4], value, atol=1e-12)
    assert not np.any(hats[..., 4])
