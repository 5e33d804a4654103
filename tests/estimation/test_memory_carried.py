"""Hidden states of slipping springs follow from the whole motion instead of a free start in each segment."""

import numpy as np
import pytest

import rig
from fitting.estimation.estimate import Strategy, fit
from fitting.estimation.experiment import Stretch, experiment_from_log
from fitting.estimation.problem import Segmentation
from fitting.estimation.whole_log_fit import with_memory_carried
from hdjax.effects.hysteresis import MaxwellSlip

COUNT, HORIZON, NOISE = 6000, 64, 1e-4
SPRINGS = ((900.0, 0.06), (1800.0, 0.025), (1800.0, 0.008))


def slipping(forcing: np.ndarray, *, substeps: int = 20) -> np.ndarray:
    """Dynamic error of `x'' = gain u - mu x' - omega_0^2 (x + alpha x^3) - sum k_i z_i`.

    Each z_i follows x and is cut at its limit after every step.
    """
    h = rig.REDUCED_STEP / substeps
    x = v = 0.0
    z = [0.0] * len(SPRINGS)
    kept = np.empty(forcing.size)

    def acceleration(x, v, moved, u):
        spring = rig.OMEGA_0**2 * (x + rig.REDUCED_ALPHA * x**3)
        slip = sum(k * min(max(old + moved, -d), d) for (k, d), old in zip(SPRINGS, z, strict=True))
        return rig.GAIN * u - rig.MU * v - spring - slip

    for i, u in enumerate(forcing.tolist()):
        kept[i] = x
        for _ in range(substeps):
            half = v + 0.5 * h * acceleration(x, v, 0.0, u)
            moved = h * half
            v = v + h * acceleration(x + 0.5 * moved, half, 0.5 * moved, u)
            z = [min(max(old + moved, -d), d) for (_, d), old in zip(SPRINGS, z, strict=True)]
            x += moved
    return kept


def test_carried_hidden_states_recover_the_springs_of_maxwell_slip():
    """On short segments, many initial states of the springs fit equally well and keep the fit from the truth.

    Over the whole log it comes near the truth. The rest is the error of sharp corners within half a sampling interval.
    """
    forcing = rig.reduced_forcing(COUNT)
    logged = experiment_from_log(rig.reduced_log(slipping(forcing), forcing, noise=NOISE), hold="zero-order")
    truth = {"k_1": 900.0, "k_2": 1800.0, "k_3": 1800.0, "yield_twist": 0.06, "share_2": 25 / 60, "share_3": 8 / 60}
    wrong = {name: 0.7 * value for name, value in truth.items() if name.startswith("k_")}
    guess = MaxwellSlip(**wrong, yield_twist=0.05, settling=0.5 * rig.REDUCED_STEP)
    paths = ("omega_0", "alpha", "mu", *(f"{guess.name}.{name}" for name in truth))
    model = rig.reduced_model().with_effects(guess)
    short = fit(
        model, [Stretch(logged, 0, COUNT)], paths, Segmentation(HORIZON, substeps=4), strategy=Strategy(max_steps=10)
    )
    carried = with_memory_carried(short)
    assert carried.horizon == HORIZON and carried.principal_std < 0.75 * short.principal_std
    assert carried.principal_std < 1.6 * NOISE
    found = {name: float(carried.model.get(f"{guess.name}.{name}")) for name in truth}
    assert found == pytest.approx(truth, rel=0.1)
    assert float(carried.model.get("omega_0")) == pytest.approx(rig.OMEGA_0, rel=2e-3)
