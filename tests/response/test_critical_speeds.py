"""Speeds to avoid, against the closed form of a linear drive."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from hdjax import Drive
from hdjax.dynamics import TwoInertiaModel
from hdjax.effects.kinematic import KinematicError
from hdjax.response.coexisting import from_both_ends
from hdjax.response.continuation import Branch, frequency_response
from hdjax.response.critical_speeds import can_persist, critical_speeds, speeds_to_avoid
from hdjax.response.plots import speed_plot

DRIVE = Drive(N=50.0, J_m=5.26e-4, J_l=5e-2, K=7160.0, B_sp=2.0)
ERROR = 1.5e-4
OMEGA_0 = float(DRIVE.omega_0)


@cache
def branch(alpha: float = 0.0, B_sp: float = 2.0) -> Branch:
    drive = dataclasses.replace(DRIVE, alpha=alpha, B_sp=B_sp)
    model = TwoInertiaModel(drive, (KinematicError(cos_2=ERROR),))
    return frequency_response(model, None, 0.2 * OMEGA_0, 0.8 * OMEGA_0, rotating=True, harmonics=4, points=150)


def closed_form(speed: np.ndarray) -> np.ndarray:
    """Amplitude of `x'' + mu (x' + e') + omega_0^2 (x + e) = 0` with `e = ERROR cos(2 speed t)`."""
    w, mu = 2.0 * speed, float(DRIVE.mu)
    return ERROR * np.abs((OMEGA_0**2 + 1j * mu * w) / (OMEGA_0**2 - w**2 + 1j * mu * w))


def test_critical_speeds_are_the_natural_frequency_over_the_order():
    found = critical_speeds(DRIVE)
    speeds = [c.speed for c in found]
    assert speeds == sorted(speeds) and len(found) == 9
    primary = {c.order: c.speed for c in found if c.kind == "primary"}
    assert primary == pytest.approx({1: OMEGA_0, 2: OMEGA_0 / 2, 4: OMEGA_0 / 4})
    (two,) = (c for c in critical_speeds(DRIVE, (2,)) if c.kind == "super-harmonic")
    assert two.speed == pytest.approx(OMEGA_0 / 6)
    assert len(critical_speeds(DRIVE, (2,))) == 3


def test_swing_of_a_linear_drive_agrees_with_the_closed_form():
    found = branch()
    assert bool(found.complete)
    valid = np.asarray(found.valid)
    swing, omega = (np.asarray(a)[valid] for a in (found.steady_states.swing, found.omega))
    np.testing.assert_allclose(swing, closed_form(omega), rtol=0.02)


def test_speed_band_to_avoid_lies_around_half_the_natural_frequency():
    limit = 6e-4
    (band,) = speeds_to_avoid(branch(), limit=limit)
    assert band.order == 2
    assert band.start < OMEGA_0 / 2 < band.end
    assert band.start <= band.speed_at_peak <= band.end
    speeds = np.linspace(0.3, 0.8, 5001) * OMEGA_0
    size = closed_form(speeds)
    assert band.amplitude == pytest.approx(size.max(), rel=0.02)
    assert band.speed_at_peak == pytest.approx(speeds[size.argmax()], rel=0.01)
    assert band.start == pytest.approx(speeds[size > limit][0], rel=2e-3)


def test_speed_band_ends_where_the_closed_form_meets_the_limit():
    (band,) = speeds_to_avoid(branch(), limit=6e-4)
    speeds = np.linspace(0.3, 0.8, 5001) * OMEGA_0
    assert band.end == pytest.approx(speeds[closed_form(speeds) > 6e-4][-1], rel=2e-3)


def test_branch_with_folds_gives_one_speed_band():
    softening = branch(alpha=-1e5, B_sp=0.5)
    assert bool(softening.complete)
    speed, lasting = np.asarray(softening.omega), np.asarray(can_persist(softening))
    back = np.flatnonzero(~lasting & np.asarray(softening.valid))
    assert back.size > 10 and (np.diff(back) == 1).all()
    # Between the folds the speed falls along the branch.
    assert (np.diff(speed[back]) < 0.0).all()
    (band,) = speeds_to_avoid(softening, limit=3 * ERROR)
    assert band.start == pytest.approx(speed[back].min(), rel=0.01)
    assert band.end > speed[back].max()
    assert band.amplitude == pytest.approx(np.asarray(softening.steady_states.swing)[lasting].max())
    assert can_persist(branch()).all()


@pytest.mark.slow
def test_response_of_a_linear_drive_is_one_branch_from_both_ends():
    """The continuation stops within a tolerance of the range's end."""
    model = TwoInertiaModel(DRIVE, (KinematicError(cos_1=2e-5, cos_2=1e-4),))
    options = {"rotating": True, "harmonics": 6, "points": 300}
    assert len(from_both_ends(model, None, 0.03 * OMEGA_0, 0.95 * OMEGA_0, **options)) == 1


def test_limit_above_the_peak_gives_no_speed_band():
    assert speeds_to_avoid(branch(), limit=0.1) == []


def test_speed_plot_shows_bands_and_both_branches(tmp_path):
    figure = speed_plot(branch(), bands=speeds_to_avoid(branch(), limit=6e-4), limit=6e-4)
    labels = figure.axes[0].get_legend_handles_labels()[1]
    assert {"steady motion", "limit", "avoid"} <= set(labels)
    both = speed_plot(branch(), branch(alpha=-1e5, B_sp=0.5), bands=[], limit=6e-4)
    assert {"reached from below", "reached from above"} <= set(both.axes[0].get_legend_handles_labels()[1])
    figure.savefig(tmp_path / "speeds.png")
    assert (tmp_path / "speeds.png").stat().st_size > 1000
