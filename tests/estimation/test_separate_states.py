"""Initial states with fixed parameters: every segment is a least-squares problem of its own."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from fitting.estimation.residual import Products, Unknowns
from fitting.estimation.separate_states import Ended, solve_states

PARAMETERS = 2
STARTS = np.array([[-1.2, 1.0], [0.9, 0.9], [2.0, -3.0], [0.1, 0.1]])


def rosenbrock(x: np.ndarray) -> np.ndarray:
    return np.array([10.0 * (x[1] - x[0] ** 2), 1.0 - x[0], 0.1 * x[0] * x[1]])


def slope(x: np.ndarray) -> np.ndarray:
    return np.array([[-20.0 * x[0], 10.0], [-1.0, 0.0], [0.1 * x[1], 0.1 * x[0]]])


class Sight:
    """Rosenbrock's function in each segment; the last ones diverge where asked for."""

    def __init__(self, diverging: int = 0) -> None:
        self.seen: list[np.ndarray] = []
        self.diverging = diverging

    def __call__(self, unknowns: Unknowns) -> tuple[Products, np.ndarray]:
        states = np.asarray(unknowns.states)
        self.seen.append(states.copy())
        rows = np.array([rosenbrock(x) for x in states])
        rows[len(rows) - self.diverging :] = np.nan
        by_state = np.array([slope(x) for x in states])
        columns = np.concatenate([np.zeros((*rows.shape, PARAMETERS)), by_state, rows[:, :, None]], axis=2)
        nothing = np.zeros((len(rows), 2, PARAMETERS))
        products = np.swapaxes(columns, 1, 2) @ columns
        return Products(products, np.zeros((len(rows), 2)), nothing, np.zeros((len(rows), 2, 2))), rows


def solved(look: Sight) -> Ended:
    with np.errstate(all="ignore"):
        return solve_states(look, Unknowns(np.zeros(PARAMETERS), STARTS), 200, 1e-3, rtol=1e-10, least_progress=0.0)


def test_each_segment_reaches_its_own_minimum():
    found = solved(Sight())
    assert found.success
    for start, state, row in zip(STARTS, np.asarray(found.unknowns.states), found.rows, strict=True):
        np.testing.assert_allclose(state, least_squares(rosenbrock, start, xtol=1e-12).x, atol=1e-4)
        np.testing.assert_allclose(row, rosenbrock(state), atol=1e-12)


def test_segments_do_not_hold_each_other_up():
    together, alone = Sight(), Sight()
    solved(together)
    with np.errstate(all="ignore"):
        solve_states(alone, Unknowns(np.zeros(PARAMETERS), STARTS[1:2]), 200, 1e-3, rtol=1e-10, least_progress=0.0)
    # What is done depends on all segments' noise, so that only the path until then is the same.
    for both, one in zip(together.seen, alone.seen[:-1], strict=False):
        np.testing.assert_allclose(both[1], one[0], rtol=1e-9)


def test_diverging_segment_stays_and_the_others_converge():
    found, whole = solved(Sight(diverging=1)), solved(Sight())
    assert found.success and np.isfinite(found.rows[:-1]).all()
    np.testing.assert_array_equal(found.unknowns.states[-1], STARTS[-1])
    np.testing.assert_allclose(found.unknowns.states[:-1], whole.unknowns.states[:-1], atol=1e-6)


def test_another_pass_goes_on_with_the_damping_of_the_first():
    first = solved(Sight())
    look = Sight()
    with np.errstate(all="ignore"):
        again = solve_states(look, first.unknowns, 200, first.damping, rtol=1e-10, least_progress=0.0)
    assert again.success and again.steps <= 2
    assert first.damping.shape == (len(STARTS),) and np.all(first.damping < 1e-3)


@pytest.mark.parametrize("most", [1, 3])
def test_iteration_ends_at_the_latest_after_so_many_steps(most: int):
    look = Sight()
    found = solve_states(look, Unknowns(np.zeros(PARAMETERS), STARTS), most, 1e-3, rtol=1e-10, least_progress=0.0)
    assert not found.success and found.steps == most
