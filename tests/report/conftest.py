"""A loop and a fit of one log, shared by the tests of reports."""

from pathlib import Path

import pytest
from report_cases import HOLD, HOSTILE, T_C, write_page

import rig
from fitting.estimation.experiment import Experiment
from fitting.fit_drive import fit_only
from fitting.loop import close_loop
from fitting.outcome import FitOnly, Loop
from fitting.search_options import SearchOptions
from hdjax import Hold
from hdjax.effects.actuation import TorqueBias
from hdjax.effects.friction import MotorFriction


@pytest.fixture(scope="session")
def loop() -> Loop:
    """The loop closed on one log of a drive with motor friction, with two forms to choose from."""
    known, test = rig.drive_parts(2400, 600, motor_friction=(T_C, 0.05), name=HOSTILE)
    data: dict[Hold, tuple[Experiment, ...]] = {HOLD: (known,)}
    start = rig.drive_model(K=1e4, alpha=0.0, B_sp=0.0)
    forms = (MotorFriction, TorqueBias)
    return close_loop(start, data, test={HOLD: (test,)}, hold=HOLD, catalogue=forms, search=SearchOptions(1))


@pytest.fixture(scope="session")
def fitted() -> FitOnly:
    """A fit of the same log, whose name contains markup."""
    known, test = rig.drive_parts(2400, 600, motor_friction=(T_C, 0.05), name=HOSTILE)
    return fit_only(rig.drive_model(K=1e4, alpha=0.0, B_sp=0.0), {HOLD: (known,)}, test={HOLD: (test,)}, hold=HOLD)


@pytest.fixture
def page(loop: Loop, tmp_path: Path) -> str:
    return write_page(tmp_path, loop)
