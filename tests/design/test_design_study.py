"""Search and confirmation on studies whose optimum is known in closed form."""

import dataclasses
from typing import ClassVar

import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array
from scipy.stats import norm

from hdjax import TwoInertiaModel, hdc_40_050
from hdjax.design import Case, Draws, Limit, Measure, Outcome, Study, Term, Variable, confirm, optimise
from hdjax.design.closed_measures import MotorSpeed, MotorTorque, StaticTwist
from hdjax.design.confirm import gradient_error
from hdjax.design.lockstep import in_lockstep
from hdjax.design.robustness import exact_worst_share, worst_share
from hdjax.design.study import appraise

CASE = Case(TwoInertiaModel(dataclasses.replace(hdc_40_050(), alpha=0.0)))
ACCELERATION, TORQUE = 30.0, 4.0
J_M, J_L = 5.26e-4, 5e-2
RATIO = Variable("N", 20.0, 200.0, "log")
BEST = np.sqrt((J_L * ACCELERATION + TORQUE) / (J_M * ACCELERATION))


class StiffnessFunction(Measure):
    """A function of K alone with a kink, an interval without values, no value at all or a wrong slope."""

    name: ClassVar[str] = "named"
    unit: ClassVar[str] = "1"
    says: ClassVar[str] = "a test's own"
    kind: str

    def __call__(self, case: Case) -> Array:
        K = case.drive.K / 7000.0
        if self.kind == "kink":
            return jnp.abs(K - 1.1)
        if self.kind == "hole":
            return jnp.where(K < 0.9, jnp.nan, (K - 1.1) ** 2)
        if self.kind == "nowhere":
            return jnp.nan * K
        # The value follows K, but its gradient is zero.
        return jnp.round(K * 1e6) / 1e6


def torque_study(*limits: Limit, draws: Draws | None = None, criterion="expected", low: float = 5.0) -> Study:
    return Study(
        CASE,
        (Variable("N", low, 200.0, "log"),),
        (Term("torque", MotorTorque(ACCELERATION, TORQUE)),),
        limits,
        draws,
        criterion,
    )


def test_optimal_ratio_matches_the_inertias():
    study = torque_study()
    found = optimise(study, 3)
    assert [end.outcome for end in found.ends] == [Outcome.optimum] * 3
    # A minimum of a function known to 1e-16 is known to 1e-8, and the search stops at 1e-10 of the objective.
    assert found.best.values["N"] == pytest.approx(BEST, rel=1e-4)
    exact = 2.0 * np.sqrt(J_M * ACCELERATION * (J_L * ACCELERATION + TORQUE))
    assert found.best.objective == pytest.approx(exact, rel=1e-9)
    assert found.best.at_bound == {} and found.best.multipliers == {}
    proof = confirm(study, found.best, width=0.3, points=11)
    assert proof.confirmed() and proof.shape == (11,)
    assert proof.gradient_error < 1e-7


def test_active_upper_limit_has_the_closed_form_multiplier():
    """`N omega <= 0.3` at omega = 0.02 holds the ratio at 15: `-d torque/d limit = -torque'(15)/omega`."""
    study = torque_study(Limit("speed", MotorSpeed(0.02), 0.3))
    best = optimise(study, 3).best
    assert best.values["N"] == pytest.approx(15.0, rel=1e-6) and BEST > 15.0
    price = -(J_M * ACCELERATION - (J_L * ACCELERATION + TORQUE) / 15.0**2) / 0.02
    assert best.multipliers == {"speed": pytest.approx(price, rel=1e-4)}
    assert confirm(study, best).confirmed()


def test_active_lower_limit_has_the_closed_form_multiplier():
    study = torque_study(Limit("speed", MotorSpeed(0.02), 2.0, least=True))
    best = optimise(study, 2).best
    assert best.values["N"] == pytest.approx(100.0, rel=1e-6)
    assert best.multipliers["speed"] == pytest.approx(
        (J_M * ACCELERATION - (J_L * ACCELERATION + TORQUE) / 100.0**2) / 0.02, rel=1e-4
    )


def test_active_bound_is_reported_with_its_multiplier():
    best = optimise(torque_study(low=60.0), 3).best
    assert best.outcome is Outcome.optimum
    assert best.at_bound == {"N": "low"} and best.values["N"] == pytest.approx(60.0)
    slope = J_M * ACCELERATION - (J_L * ACCELERATION + TORQUE) / 60.0**2
    assert best.bound_multipliers["N"] == pytest.approx(slope, rel=1e-4)


def test_infeasible_study_is_reported_with_the_excess():
    found = optimise(torque_study(Limit("speed", MotorSpeed(0.02), 0.08)), 3)
    assert {end.outcome for end in found.ends} == {Outcome.infeasible}
    assert not found.best.feasible and found.best.excess["speed"] == pytest.approx(0.25, rel=1e-3)
    proof = confirm(torque_study(Limit("speed", MotorSpeed(0.02), 0.08)), found.best)
    assert proof.best == {} and not proof.feasible.any()


def stiffness_study(kind: str) -> Study:
    return Study(CASE, (Variable("K", 5000.0, 9000.0),), (Term("it", StiffnessFunction(kind)),))


def test_search_at_a_kink_is_reported_as_stalled():
    best = optimise(stiffness_study("kink"), 2).best
    assert best.values["K"] == pytest.approx(7700.0, rel=1e-4)
    assert best.outcome is Outcome.stalled


def test_start_without_a_value_is_reported_as_lost_and_others_converge():
    found = optimise(stiffness_study("hole"), np.array([[0.1], [0.6], [0.95]]))
    assert [end.outcome for end in found.ends] == [Outcome.lost, Outcome.optimum, Outcome.optimum]
    assert found.best.values["K"] == pytest.approx(7700.0, rel=1e-4)
    assert found.ends[0].objective == np.inf and np.isfinite(found.ends[0].shares).all()
    with pytest.raises(ValueError, match="at no start"):
        optimise(stiffness_study("nowhere"), 2)


def test_confirmation_detects_a_wrong_gradient_and_a_better_neighbour():
    assert gradient_error(stiffness_study("deaf"), np.array([0.4])) > 0.5
    study = torque_study()
    best = optimise(study, 1).best
    off = dataclasses.replace(
        best, shares=best.shares + 0.05, objective=float(appraise(study, best.shares[None] + 0.05).rows[0, 0])
    )
    assert not confirm(study, off).confirmed()


# -- uncertain parameters --


def test_worst_share_of_a_normal_distribution_agrees_with_the_closed_form():
    """`sigma phi(z)/share` at the quantile z of the share."""
    values = norm.ppf((np.arange(4000) + 0.5) / 4000)
    exact = norm.pdf(norm.ppf(0.95)) / 0.05
    assert exact_worst_share(values, 0.05) == pytest.approx(exact, rel=2e-3)
    assert float(worst_share(jnp.asarray(3.0 + 2.0 * values), 0.05)) == pytest.approx(3.0 + 2.0 * exact, rel=2e-3)
    assert exact_worst_share(np.array([1.0, 2.0, 4.0, 8.0]), 0.375) == pytest.approx((8.0 + 0.5 * 4.0) / 1.5)
    assert float(worst_share(jnp.full(8, 7.0), 0.05)) == pytest.approx(7.0)


def inertia_draws(count: int = 64) -> Draws:
    quantiles = norm.ppf((np.arange(count) + 0.5) / count)
    return Draws(("J_l",), jnp.asarray(J_L * (1.0 + 0.2 * quantiles))[:, None])


def test_expected_criterion_of_a_linear_measure_gives_the_optimum_of_the_mean():
    best = optimise(torque_study(draws=inertia_draws()), 2).best
    assert best.values["N"] == pytest.approx(BEST, rel=1e-4)
    assert best.draws["torque"].shape == (64,)


def test_worst_criterion_gives_the_ratio_of_the_worst_inertia():
    """The torque rises with the load's inertia, so that its worst share is the torque at the inertia's worst share."""
    study = torque_study(draws=inertia_draws(), criterion="worst")
    best = optimise(study, 2).best
    worst = exact_worst_share(np.asarray(study.draws.values[:, 0]), 0.05)
    assert best.values["N"] == pytest.approx(np.sqrt((worst * ACCELERATION + TORQUE) / (J_M * ACCELERATION)), rel=1e-3)
    assert best.objective == pytest.approx(exact_worst_share(best.draws["torque"], 0.05), rel=1e-3)
    proof = confirm(study, best)
    assert proof.confirmed() and proof.gradient_error < 1e-5


def test_limit_under_the_worst_criterion_holds_for_most_draws():
    draws = Draws(("K",), jnp.asarray(7160.0 * (1.0 + 0.1 * norm.ppf((np.arange(64) + 0.5) / 64)))[:, None])
    study = Study(
        CASE,
        (Variable("N", 20.0, 200.0, "log"), Variable("J_l", 0.01, 0.1)),
        (Term("torque", MotorTorque(ACCELERATION, TORQUE)), Term("inertia", Inertia(), -100.0)),
        (Limit("twist", TwistOfLoad(), 3e-4),),
        draws,
        "worst",
    )
    best = optimise(study, 3).best
    assert best.outcome is Outcome.optimum
    assert np.mean(best.draws["twist"] <= 3e-4) >= 0.95
    # It holds without a margin: the worst twist is J_l a over the mean of the softest twentieth.
    softest = exact_worst_share(1.0 / np.asarray(draws.values[:, 0]), 0.05)
    assert best.values["J_l"] == pytest.approx(3e-4 / (ACCELERATION * softest), rel=2e-3)


class Inertia(Measure):
    name: ClassVar[str] = "inertia"
    unit: ClassVar[str] = "kg m^2"
    says: ClassVar[str] = "a test's own"

    def __call__(self, case: Case) -> Array:
        return case.drive.J_l


class TwistOfLoad(Measure):
    name: ClassVar[str] = "twist_of_load"
    unit: ClassVar[str] = "rad"
    says: ClassVar[str] = "a test's own"

    def __call__(self, case: Case) -> Array:
        return StaticTwist(1.0)(case) * case.drive.J_l * ACCELERATION


def test_design_variable_has_its_chosen_value_in_every_draw():
    draws = Draws(("N", "J_l"), jnp.array([[40.0, J_L], [60.0, J_L]]))
    best = optimise(torque_study(draws=draws), 2).best
    assert np.ptp(best.draws["torque"]) == pytest.approx(0.0, abs=1e-12)


# -- refusals --


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda: Variable("K", 2.0, 1.0), "range that rises"),
        (lambda: Variable("K", 0.0, 1.0, "log"), "above zero"),
        (lambda: Study(CASE, (), (Term("t", MotorTorque(1.0)),)), "a variable and a term"),
        (lambda: Study(CASE, (RATIO, RATIO), (Term("t", MotorTorque(1.0)),)), "named twice"),
        (lambda: Study(CASE, (RATIO,), (Term("t", MotorTorque(1.0)),), share=0.0), "share"),
        (lambda: optimise(Study(CASE, (Variable("Q", 1.0, 2.0),), (Term("t", MotorTorque(1.0)),))), "`Q` is no"),
    ],
)
def test_invalid_study_is_refused(build, message: str):
    with pytest.raises(ValueError, match=message):
        build()


# -- lockstep --


def test_lockstep_evaluates_all_searches_in_one_batch():
    asked: list[int] = []

    def answers(points: np.ndarray) -> list[float]:
        asked.append(len(points))
        return [float(p[0]) ** 2 for p in points]

    def search(number, ask) -> float:
        return sum(ask(np.array([number + k])) for k in range(number + 1))

    assert in_lockstep(3, search, answers) == [0.0, 1.0 + 4.0, 4.0 + 9.0 + 16.0]
    assert asked == [3, 2, 1]


def test_lockstep_error_ends_all_searches():
    def search(number, ask) -> float:
        ask(np.zeros(1))
        if number == 1:
            raise RuntimeError("second")
        return ask(np.zeros(1))

    with pytest.raises(RuntimeError, match="second"):
        in_lockstep(3, search, lambda points: [0.0] * len(points))
    with pytest.raises(ZeroDivisionError):
        in_lockstep(2, lambda number, ask: ask(np.zeros(1)), lambda points: [1 / 0])
