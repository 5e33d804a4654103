"""Screening reports nothing on noise alone, and ranks a missing effect first."""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import kstest

import rig
from fitting.attribution.screening import Screen, screen
from fitting.estimation.estimate import Fit, Start, Strategy, fit, half_log_determinant
from fitting.estimation.experiment import split
from fitting.estimation.free_parameters import FreeParameters, base_paths, fitted_paths
from fitting.estimation.problem import Segmentation
from fitting.estimation.projection import solved, without_undetermined
from fitting.estimation.residual import Blocks
from fitting.estimation.whole_log_fit import follows
from fitting.first_order.surrogates import DRAWS, PARTNERS, Surrogates, chance_of_gain
from hdjax import Model
from hdjax.effects import CATALOGUE, Effect
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.backlash import Backlash
from hdjax.effects.damping import QuadraticDamping
from hdjax.effects.friction import CoulombFriction, MotorFriction
from hdjax.effects.kinematic import KinematicError
from hdjax.effects.stiffness import QuadraticStiffness

COUNT, HORIZON, NOISE = 1200, 128, 1e-3
# Forms that compile quickly; slow tests screen all forms.
SOME_FORMS = (CoulombFriction, TorqueBias, QuadraticStiffness, QuadraticDamping, Backlash)


def fits(seed: int = 0, model=None, **physics) -> tuple[Fit, Fit]:
    """Fit the base model to the training part, and with its parameters held to the rest."""
    experiment = rig.reduced_experiment(COUNT, noise=NOISE, seed=seed, **physics)
    training, held_out = split([experiment])
    segmentation = Segmentation(HORIZON, halo=4, substeps=2, count=8)
    found = fit(model or rig.reduced_model(), training, base_paths(rig.reduced_model()), segmentation)
    unseen = fit(
        found.model,
        held_out,
        base_paths(found.model),
        segmentation,
        start=Start(found.covariance),
        strategy=Strategy(hold_parameters=True),
    )
    return found, unseen


@pytest.fixture(scope="module")
def screen_with_bias() -> Screen:
    return screen(*fits(bias=0.3), catalogue=SOME_FORMS)


@pytest.fixture(scope="module")
def screen_with_friction() -> Screen:
    return screen(*fits(friction=(10.0, 0.27)), catalogue=SOME_FORMS)


def test_no_gain_is_significant_where_the_null_distribution_is_unknown():
    assert Screen((), np.full(4, -np.inf)).p_value(1.0) == 1.0
    assert Screen((), np.array([-np.inf, 0.5, 2.0])).p_value(1.0) == 0.5


@pytest.mark.parametrize(
    "catalogue", [SOME_FORMS, pytest.param(CATALOGUE, marks=pytest.mark.slow)], ids=["some", "all"]
)
def test_p_values_are_not_small_on_noise_alone(catalogue: tuple[type[Effect], ...]):
    p_values = []
    for seed in range(6):
        found = screen(*fits(seed), seed=seed, catalogue=catalogue)
        p_values.append(found.p_value(found.leads[0].gain))
    # p-values are uniform and at least 1/1001: the smallest of six is below 0.01 in 6 % of such sets.
    assert min(p_values) >= 0.01, p_values
    assert max(p_values) > 0.3, p_values


def test_torque_bias_is_ranked_first_with_its_true_strength(screen_with_bias: Screen):
    lead = screen_with_bias.leads[0]
    assert isinstance(lead.effect, TorqueBias)
    # A bias acts linearly, except for the hardening spring.
    assert float(lead.effect.bias) == pytest.approx(0.3, rel=0.05)


def test_torque_bias_has_the_smallest_possible_p_value(screen_with_bias: Screen):
    assert screen_with_bias.p_value(screen_with_bias.leads[0].gain) == 1 / (DRAWS * PARTNERS + 1)


def test_friction_is_ranked_first_and_corrects_the_damping(screen_with_friction: Screen):
    lead = screen_with_friction.leads[0]
    assert isinstance(lead.effect, CoulombFriction)
    assert screen_with_friction.p_value(lead.gain) == 1 / (DRAWS * PARTNERS + 1)
    # The proposal's sharpness is near the truth, and friction changes the motion by a percent or so.
    assert float(lead.effect.T_c) == pytest.approx(10.0, rel=0.15)
    # The base fit explains friction by damping, so that the estimated damping decreases.
    assert lead.drive_changes["mu"] < 0


def test_each_applicable_form_is_screened_once_in_order_of_gain(screen_with_bias: Screen):
    names = [lead.effect.name for lead in screen_with_bias.leads]
    assert sorted(names) == sorted(f.name for f in SOME_FORMS)
    gains = [lead.gain for lead in screen_with_bias.leads]
    assert gains == sorted(gains, reverse=True)
    assert screen_with_bias.null_gains.shape == (DRAWS * PARTNERS,)
    assert np.isfinite(screen_with_bias.null_gains).all()
    assert set(screen_with_bias.leads[0].drive_changes) == set(base_paths(rig.reduced_model()))


def test_estimates_of_positive_strengths_are_not_negative(screen_with_bias: Screen, screen_with_friction: Screen):
    for lead in (*screen_with_bias.leads, *screen_with_friction.leads):
        if isinstance(lead.effect, CoulombFriction):
            assert float(lead.effect.T_c) >= 0.0
        if isinstance(lead.effect, Backlash):
            assert float(lead.effect.b) >= 0.0


class _Overflowing(QuadraticStiffness):
    """An effect with so large a response that its inner products overflow."""

    name = "overflowing"

    def torque(self, motion, drive, state):
        return 1e200 * self.k2 * jnp.square(motion.x)


def test_form_whose_inner_products_overflow_is_left_out():
    found = screen(*fits(bias=0.3), catalogue=(_Overflowing, TorqueBias))
    assert [lead.effect.name for lead in found.leads] == ["torque_bias"]


def test_motor_forms_are_not_screened_on_a_reduced_log():
    found = screen(*fits(), catalogue=(MotorFriction, *SOME_FORMS))
    assert len(found.leads) == len(SOME_FORMS)


def test_seed_changes_only_the_surrogates():
    pair = fits(bias=0.3)
    first, again, other = (screen(*pair, catalogue=SOME_FORMS, seed=s) for s in (0, 0, 7))
    np.testing.assert_array_equal(first.null_gains, again.null_gains)
    assert np.any(first.null_gains != other.null_gains)
    assert first.leads[0].gain == pytest.approx(other.leads[0].gain, rel=1e-12)


@pytest.mark.parametrize("shorter", [0, 1])
def test_scores_of_surrogates_are_inner_products_with_them(shorter: int):
    drawn = Surrogates.of(fits()[0], 0)
    # Even and odd lengths; one sample beyond the length repeats the first.
    used = slice(drawn.turns.shape[1] - shorter)
    lines = {"turns": drawn.turns[:, used], "spectrum": drawn.spectrum[:, used]}
    drawn = dataclasses.replace(drawn, length=drawn.length - shorter, **lines)
    columns = np.random.default_rng(1).normal(size=(*drawn.counts.shape, 1, 3))
    series = np.fft.irfft(drawn.spectrum * drawn.turns, n=drawn.length)
    repeated = series[:, np.arange(drawn.counts.sum()) % drawn.length]
    np.testing.assert_allclose(drawn.against(columns), (repeated @ columns[drawn.counts][:, 0]).T, rtol=0, atol=1e-10)


def test_surrogates_exclude_spectral_lines_of_the_residual():
    """A line is not coloured noise; surrogates with the line would have too large gains."""
    fitted, _ = fits()
    noise = np.random.default_rng(3).normal(size=np.asarray(fitted.error).shape)
    time = np.arange(noise[..., 0].size).reshape(noise.shape[:2])
    line = 3.0 * np.sin(0.3 * time)[..., None]
    white = eqx.tree_at(lambda f: f.problem.whitening, fitted, jnp.eye(1))
    kept = np.asarray(fitted.problem.segments.weight) > 0
    each_sample = np.eye(noise.size).reshape(*noise.shape, -1)
    drawn = {}
    for name, error in (("noise", noise), ("both", noise + line)):
        given = eqx.tree_at(lambda f: f.error, white, jnp.asarray(error))
        series = Surrogates.of(given, 0).against(each_sample)[kept.ravel()]
        drawn[name] = float(np.std(series))
    assert drawn["noise"] == pytest.approx(1.0, abs=0.03)
    # The skirts of the line remain; with the whole line it would be 2.3.
    assert drawn["both"] == pytest.approx(1.0, abs=0.15)


def test_first_order_gain_with_two_outputs_equals_that_of_a_refit():
    """p-values compare first-order gains with gains of refits."""
    parts = split([rig.drive_experiment(COUNT)])
    segmentation = Segmentation(HORIZON, halo=4, substeps=1, count=10)

    def fitted(model: Model) -> tuple[Fit, Fit]:
        patient = Strategy(40)
        found = fit(model, parts[0], fitted_paths(model), segmentation, strategy=patient)
        held = dataclasses.replace(patient, hold_parameters=True)
        start = Start(found.covariance)
        return found, fit(found.model, parts[1], fitted_paths(model), segmentation, start=start, strategy=held)

    before = fitted(rig.drive_model())
    after = fitted(before[0].model.with_effects(TorqueBias(bias=jnp.asarray(1e-6))))
    (lead,) = screen(*before, catalogue=(TorqueBias,)).leads
    # Outputs are weighted again by their residual, which changes little.
    assert lead.gain == pytest.approx(before[1].objective - after[1].objective, rel=0.1)


def test_p_value_of_a_term_learned_on_other_data_is_uniform():
    _, unseen = fits()
    random = np.random.default_rng(0)
    weight = np.asarray(unseen.problem.segments.weight)[..., None]
    chances = []
    for seed in range(80):
        noise, changed = (weight * random.normal(size=unseen.error.shape) for _ in range(2))

        def leaving(error: np.ndarray) -> Fit:
            squares = np.array([[np.sum(error**2) / weight.sum()]])
            held = eqx.tree_at(lambda f: (f.error, f.problem.whitening), unseen, (jnp.asarray(error), jnp.eye(1)))
            return dataclasses.replace(held, objective=half_log_determinant(squares))

        learned = 10.0 ** random.uniform(-1.5, -0.5) * changed
        chances.append(chance_of_gain(leaving(noise), leaving(noise - learned), seed))
    # The probability of a smaller p-value of the Kolmogorov-Smirnov test is 2e-3.
    assert kstest(chances, "uniform").pvalue > 2e-3


def test_p_value_is_the_share_of_null_draws_with_a_larger_gain():
    found = Screen((), np.array([0.1, 0.2, 0.3]))
    assert [found.p_value(g) for g in (0.0, 0.1, 0.25, 0.4)] == [1.0, 1.0, 0.5, 0.25]


def test_parameter_with_a_negligible_column_gets_a_zero_step():
    """Its column is negligible beside the others, and would differ on other data."""
    columns = np.random.default_rng(0).normal(size=(50, 3)) * [1.0, 1e-125, 3.0]
    residual = np.random.default_rng(1).normal(size=50)
    with np.errstate(under="ignore"):
        step = solved(columns.T @ columns, columns.T @ residual[:, None])[:, 0]
    assert step[1] == 0.0
    kept = np.linalg.lstsq(columns[:, [0, 2]], residual, rcond=None)[0]
    np.testing.assert_allclose(step[[0, 2]], kept)


def test_only_undetermined_positive_parameters_lose_their_columns():
    """Two positive parameters and one signed one, of which the last two have information below one.

    Information of one means a positive parameter known to a factor of e.
    """
    size = np.array([30.0, 0.5, 0.5])
    by_parameter = jnp.asarray(np.ones((2, 8, 3)) * size / 4.0)
    before = jnp.ones((2, 4, 3))
    other = jnp.zeros((2, 8)), by_parameter, jnp.zeros((2, 8, 4)), jnp.zeros((2, 4)), before, jnp.zeros((2, 4, 4))
    free = FreeParameters(("K", "B_sp", "alpha"), (True, True, False), jnp.ones(3), jnp.zeros(3), jnp.zeros(3))
    found = without_undetermined(Blocks(*other), free)
    np.testing.assert_array_equal(np.linalg.norm(found.by_parameter, axis=(0, 1)), [30.0, 0.0, 0.5])
    np.testing.assert_array_equal(found.before_by_parameter[..., 1], 0.0)
    np.testing.assert_array_equal(found.before_by_parameter[..., [0, 2]], 1.0)


def test_kinematic_error_is_ranked_first_when_the_motion_strays():
    physics = {"rms": 0.05, "kinematic": (1e-4, 2e-4), "state": (0.0, 0.0, 15.0, 0.3)}
    training, held_out = split([rig.drive_experiment(2400, **physics)])
    segmentation = Segmentation(HORIZON, halo=4, substeps=2)
    found = fit(rig.drive_model(), training, base_paths(rig.drive_model()), segmentation)
    again = Strategy(hold_parameters=True)
    unseen = fit(
        found.model, held_out, base_paths(found.model), segmentation, start=Start(found.covariance), strategy=again
    )
    assert not follows(found, share=0.1)
    lead = screen(found, unseen, catalogue=(KinematicError, MotorFriction)).leads[0]
    assert isinstance(lead.effect, KinematicError)
    assert float(lead.effect.sin_2) == pytest.approx(2e-4, rel=0.1)
