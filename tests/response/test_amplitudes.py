"""Analytic amplitudes against the numerical routes, the verdicts on them, and the plots."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hdjax import ReducedDrive
from hdjax.dynamics import ReducedModel
from hdjax.fourier import harmonic_series
from hdjax.response.amplitudes import (
    AmplitudeCheck,
    AmplitudeRow,
    ErrorMap,
    check_amplitudes,
    error_map,
    resonance_kind,
    settled,
)
from hdjax.response.attractors import Attractor, Basins
from hdjax.response.coexisting import from_both_ends
from hdjax.response.continuation import Branch, frequency_response
from hdjax.response.fold import folds
from hdjax.response.lyapunov import phase_portrait
from hdjax.response.multiple_scales import PrimaryResonance
from hdjax.response.plots import (
    basins_plot,
    error_map_plot,
    frequency_response_plot,
    phase_portrait_plot,
    poincare_plot,
)
from hdjax.response.poincare import PoincareSection
from hdjax.response.resonance import backbone, peak
from hdjax.response.swept_sine import SweptSine

MU, ALPHA = 0.02, 0.05
DRIVE = ReducedDrive(mu=MU, omega_0=1.0, alpha=ALPHA)


@pytest.mark.slow
def test_motion_far_below_resonance_is_stable_and_holds_to_one_percent():
    # A hundred natural oscillations within a period of the forcing.
    (row,) = check_amplitudes(DRIVE, 0.05, 0.01).rows
    assert row.stable
    assert row.verdict == "holds to 1%"


def test_amplitudes_without_a_frequency_are_refused():
    with pytest.raises(ValueError, match="`omega` must be above zero"):
        check_amplitudes(DRIVE, 0.05, 0.0)


@pytest.mark.parametrize(
    "omega", [pytest.param(0.34, marks=pytest.mark.slow), 0.5, 1.02, pytest.param(3.05, marks=pytest.mark.slow)]
)
def test_all_amplitude_routes_agree_on_a_linear_drive(omega):
    A = 0.05
    (row,) = check_amplitudes(ReducedDrive(mu=MU, omega_0=1.0), A, omega).rows
    truth = A / abs(1.0 - omega**2 + 1j * MU * omega)
    assert row.stable and row.branch == "only"
    assert (row.balance, row.time) == pytest.approx((truth, truth), rel=1e-8)
    # Near the resonance first order lacks terms of sigma; elsewhere it leaves out the damping.
    assert row.error < 0.015
    assert row.second_order_error is None or row.second_order_error < 1e-3
    assert row.verdict in ("holds to 1%", "holds to 5%")


def by_branch(check: AmplitudeCheck) -> dict[str, AmplitudeRow]:
    return {row.branch: row for row in check.rows}


def test_three_motions_coexist_near_the_primary_resonance():
    check = check_amplitudes(DRIVE, 0.05, 1.08)
    assert check.kind == "primary"
    rows = by_branch(check)
    assert list(rows) == ["lower", "middle", "upper"]
    assert [r.stable for r in rows.values()] == [True, False, True]
    for row in rows.values():
        assert row.agreement < 1e-6
        assert row.error < 0.05
        assert row.second_order_error < row.error
        assert row.verdict.startswith("holds to")
    assert rows["lower"].time < rows["middle"].time < rows["upper"].time


def test_both_numerical_routes_agree_near_the_sub_harmonic():
    check = check_amplitudes(DRIVE, 20.0, 3.2)
    assert check.kind == "sub-harmonic"
    assert check.rows
    for row in check.rows:
        assert row.agreement < 1e-6, check


def row(first: float, balance: float | None = 1.0, time: float | None = 1.0) -> AmplitudeRow:
    return AmplitudeRow("only", True, first, None, balance, time)


@pytest.mark.parametrize(
    ("made", "verdict"),
    (
        (row(1.0), "holds to 1%"),
        (row(1.03), "holds to 5%"),
        (row(0.93), "holds to 10%"),
        (row(1.25), "fails by 25%"),
        (row(1.0, balance=None), "fails: no motion near it"),
        (row(1.0, time=None), "fails: no motion near it"),
        (row(1.0, balance=1.001), "undecided: the two numerical routes differ"),
    ),
)
def test_amplitude_row_reports_its_verdict(made, verdict):
    assert made.verdict == verdict
    assert made.second_order_error is None


@pytest.mark.parametrize(
    ("omega", "kind"),
    (
        (2.0, "primary"),
        (2.5, "primary"),
        (2 / 3, "super-harmonic"),
        (0.8, "super-harmonic"),
        (6.0, "sub-harmonic"),
        (7.5, "sub-harmonic"),
        (0.1, "off-resonance"),
        (1.2, "off-resonance"),
        (3.5, "off-resonance"),
        (9.0, "off-resonance"),
    ),
)
def test_resonance_kind_follows_the_frequency_ratio(omega, kind):
    assert resonance_kind(2.0, omega) == kind


@cache
def errors() -> ErrorMap:
    return error_map("primary", np.asarray([-0.02, 0.0, 0.02]), np.asarray([1e-3, 1e-2, 1e-1, 0.5]), 0.02, harmonics=5)


def test_error_map_is_small_where_the_drive_is_nearly_linear():
    found = errors()
    first, second = np.asarray(found.first_order[0]), np.asarray(found.second_order[0])
    assert first.shape == (4, 3)
    assert first[0].max() < 0.02 and second[0].max() < 2e-3
    # At resonance the nonlinearity is the only source of error.
    assert (np.diff(first[:, 1]) > 0.0).all()
    assert (second[:3] < first[:3]).all()


# -- plots --


@cache
def branch() -> Branch:
    return frequency_response(ReducedModel(DRIVE), harmonic_series(1.0, 0.05), 0.8, 1.3, points=150, harmonics=5)


@pytest.mark.slow
def test_frequency_range_that_ends_between_folds_has_two_branches():
    def ends(fast: float) -> tuple[Branch, ...]:
        return from_both_ends(ReducedModel(DRIVE), harmonic_series(1.0, 0.05), 0.8, fast, points=150, harmonics=5)

    assert len(ends(1.3)) == 1
    low, high = (float(f) for f in np.sort(np.asarray(folds(branch()).value)[:2]))
    below, above = ends(0.5 * (low + high))
    for found in (below, above):
        omega = np.asarray(found.omega)[np.asarray(found.valid)]
        assert omega.max() == pytest.approx(0.5 * (low + high), rel=1e-6)
    assert float(below.amplitude[-1]) > 2.0 * float(above.amplitude[0])
    assert float(above.omega[above.valid].min()) == pytest.approx(low, rel=1e-3)


def test_time_integration_settles_onto_the_stable_branch():
    found = settled(branch(), motions=8)
    omega, size = np.asarray(found.omega), np.asarray(found.amplitude)
    assert size.size >= 6 and not np.asarray(found.escaped).any()
    rows = [
        int(np.argmin(np.hypot(branch().omega - w, branch().amplitude - a))) for w, a in zip(omega, size, strict=True)
    ]
    np.testing.assert_allclose(omega, np.asarray(branch().omega)[rows], rtol=1e-3)
    np.testing.assert_allclose(size, np.asarray(branch().amplitude)[rows], rtol=1e-3)
    assert np.asarray(branch().stable)[rows].all()


def saved(figure, path) -> int:
    figure.savefig(path)
    return path.stat().st_size


def test_frequency_response_plot_shows_the_unstable_part(tmp_path):
    omegas = jnp.linspace(0.9, 1.2, 31)
    analytic = jax.vmap(PrimaryResonance(DRIVE, 0.05).branches)(omegas)
    size = jnp.linspace(0.2, 0.4, 5)
    sweep = SweptSine(jnp.linspace(0.9, 1.0, 5), size, size, jnp.zeros((5, 2)), jnp.zeros(5, dtype=bool))
    figure = frequency_response_plot(
        branch(),
        folds=[folds(branch())],
        peak=peak(branch()),
        backbone=backbone(ReducedModel(DRIVE), jnp.linspace(0.1, 3.0, 10), harmonics=5),
        sweeps=(sweep, sweep),
        analytic=(np.asarray(omegas), analytic),
    )
    lines = {line.get_label(): line for line in figure.axes[0].get_lines()}
    unstable = np.asarray(lines["harmonic balance, unstable"].get_ydata())
    assert np.isfinite(unstable).sum() > 5 and np.isnan(unstable).any()
    x = np.asarray(lines["harmonic balance, unstable"].get_xdata())[np.isfinite(unstable)]
    crosses = np.asarray(lines["folds (jumps)"].get_xdata())
    assert crosses.size == 2
    assert (x.min(), x.max()) == pytest.approx((crosses.min(), crosses.max()), abs=0.02)
    assert {"harmonic balance, stable", "peak", "backbone", "time integration, sweep down"} <= set(lines)
    assert saved(figure, tmp_path / "response.png") > 1000


def test_phase_portrait_plot_is_drawn(tmp_path):
    starts = jnp.asarray([[0.3, 0.0], [0.0, 0.5], [1.5, 1.5]])
    softening = ReducedDrive(mu=0.3, omega_0=1.5, alpha=-1.0)
    for name, drive in (("softening", softening), ("hardening", ReducedDrive(mu=0.3, omega_0=1.5, alpha=1.0))):
        figure = phase_portrait_plot(phase_portrait(drive, starts, jnp.linspace(0.0, 10.0, 101)))
        assert len(figure.axes[0].get_lines()) == 7
        assert saved(figure, tmp_path / f"{name}.png") > 1000


def test_poincare_and_basin_plots_are_drawn(tmp_path):
    states = jnp.arange(24.0).reshape(2, 6, 2)
    section = PoincareSection(jnp.ones(2), states, jnp.ones(2), jnp.ones(2), jnp.asarray([False, True]))
    figure = poincare_plot(section)
    assert len(figure.axes[0].get_lines()) == 1  # the escaped motion is not drawn
    assert saved(figure, tmp_path / "section.png") > 1000
    grid = np.linspace(-1.0, 1.0, 3)
    found = (Attractor(1, np.asarray([[0.1, 0.2]]), 0.2, 0.5), Attractor(3, np.ones((3, 2)), 1.0, 0.3))
    figure = basins_plot(Basins(grid, grid, np.asarray([[0, 1, 0], [1, -1, 0], [-2, 0, 1]]), found))
    picture = np.asarray(figure.axes[0].get_images()[0].get_array())
    # x runs along the columns, v along the rows.
    np.testing.assert_array_equal(picture[0, 2], 0.25)
    np.testing.assert_array_equal(picture[1, 1], 0.25)
    assert (picture[2, 0] == picture[0, 0]).all() and (picture[1, 0] != picture[0, 0]).any()
    assert saved(figure, tmp_path / "basins.png") > 1000


def test_error_map_plot_is_drawn(tmp_path):
    figure = error_map_plot(errors(), title="primary resonance", strength="$\\alpha a^2$")
    assert len(figure.axes) == 2
    assert saved(figure, tmp_path / "errors.png") > 1000
