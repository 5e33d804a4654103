"""Tables of the source document recomputed, the verdicts on their values, and fits of amplitudes."""

import jax
import numpy as np
import pytest
from orbits import duffing_rates, duffing_slope, multipliers, period_error

from hdjax import hdc_40_050
from hdjax.response.seed_data import TABLE_2
from hdjax.response.seed_fit import best_fit_of_table_2, fit_amplitudes
from hdjax.response.seed_tables import Cell, as_text, seed_tables


@pytest.fixture(scope="module")
def tables():
    return {table.title.split(":")[0]: table.cells for table in seed_tables()}


def cells(tables, title: str, column: str) -> list[Cell]:
    return [c for c in tables[title] if c.column == column]


@pytest.mark.parametrize(
    ("printed", "recomputed", "verdict"),
    [
        (1.0, 1.004, "agrees"),
        (1.0, 1.2, "differs by 17%"),
        (3.0, 1.0, "differs by a factor 3"),
        (1.0, 4.0, "differs by a factor 4"),
        (1.0, None, "does not follow from the stated model"),
        (0.0, 0.0, "agrees"),
    ],
)
def test_cell_reports_its_verdict(printed, recomputed, verdict):
    assert Cell("row", "column", printed, recomputed, "rad").verdict == verdict


def test_printed_natural_frequency_differs_from_the_recomputed_one(tables):
    (cell,) = cells(tables, "Table 1", "omega_0")
    assert cell.recomputed == pytest.approx(385.545, abs=1e-3)
    assert cell.verdict.startswith("differs by a factor")


def test_recomputed_table_2_agrees_with_the_linear_closed_form(tables):
    """With alpha = 0.1 the nonlinearity is negligible, so that the linear closed form holds."""
    drive = hdc_40_050()
    A = 10.0 / (50 * 5.26e-4)
    rows = cells(tables, "Table 2", "analytical amplitude")[::2]
    for cell, omega in zip(rows, (100.0, 300.0, 122.5, 40.83, 367.5), strict=True):
        linear = A / abs(complex(float(drive.omega_0) ** 2 - omega**2, float(drive.mu) * omega))
        assert cell.recomputed == pytest.approx(linear, rel=1e-3)
        assert cell.verdict != "agrees"
    implied = [float(c.note.split("A = ")[1].split()[0]) for c in rows]
    assert (min(implied), max(implied)) == pytest.approx((116.0, 2005.0), rel=0.01)
    assert all(c.verdict == "agrees" for c in cells(tables, "Table 2", "relative error"))


def test_table_3_is_inconsistent_with_the_stated_model(tables):
    assert [c.recomputed for c in cells(tables, "Table 3", "first peak over this")] == pytest.approx([5.0, 10.0])
    for cell in cells(tables, "Table 3", "half-power bandwidth"):
        assert cell.printed / cell.recomputed == pytest.approx(1.5, rel=2e-3)
    assert cells(tables, "Table 3", "nonlinear shift")[0].printed == pytest.approx(
        60 * cells(tables, "Table 3", "nonlinear shift")[0].recomputed, rel=0.05
    )


def test_table_4_has_one_effect_of_the_stated_model(tables):
    verdicts = {c.row: c.verdict for c in tables["Table 4"]}
    stated = verdicts.pop("flexspline deformation")
    assert stated.startswith("differs by a factor")
    assert set(verdicts.values()) == {"does not follow from the stated model"}


def test_figure_1_agrees_with_the_parameters_beside_it_only(tables):
    assert [c.verdict for c in tables["Figure 1"][:3]] == ["agrees"] * 3
    assert all(c.verdict.startswith("differs by a factor") for c in tables["Figure 1"][3:])


@pytest.mark.slow
def test_no_parameters_fit_table_2():
    """Not even with little damping and the nearest stable motion at each frequency, which scipy confirms."""
    fit = best_fit_of_table_2()
    assert fit.worst > 1.3 and fit.rms > 0.15
    for i, omega in enumerate(fit.omega):
        x = jax.tree.map(lambda leaf, i=i: leaf[i], fit.motions)
        equation = duffing_rates(fit.mu, fit.alpha, fit.A, omega, fit.omega_0)
        assert period_error(equation, x) < 1e-3
        moduli = np.abs(multipliers(equation, duffing_slope(fit.mu, fit.alpha, fit.omega_0), x))
        # With so little damping, multipliers deviate from one by less than the motion's error.
        assert moduli.max() < 1.0 + 1e-4
    text = as_text((), fit)
    assert "no parameters of the stated model" in text and "a sub-harmonic motion" in text


@pytest.mark.slow
def test_consistent_table_is_fitted():
    """Amplitudes of a linear response, far from its resonance: the same search finds parameters that give them."""
    omega = tuple(case.omega for case in TABLE_2)
    amplitude = tuple(500.0 / abs(complex(200.0**2 - w**2, 5.0 * w)) for w in omega)
    fit = fit_amplitudes(omega, amplitude, bands=1, generations=30)
    assert fit.worst < 1.02
    assert fit.omega_0 == pytest.approx(200.0, rel=0.02)
    assert np.isfinite(fit.rms) and not any(fit.subharmonic)
    assert "the table is consistent" in as_text((), fit)


def test_table_without_amplitudes_is_refused():
    with pytest.raises(ValueError, match="`omega` and `amplitude` must be of one length"):
        fit_amplitudes((100.0,), (0.0,))
