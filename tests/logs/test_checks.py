"""Checks of a log: each fault gives one finding, and a log without faults gives none."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from checked_logs import ROWS, STEP, angles, drive_file, drive_log, only_finding, reduced_log

import rig
from fitting.drive_data import ready_log
from fitting.errors import DataError
from fitting.logs.checks import examine, refuse_unfit
from fitting.logs.drive_file import DriveFile, read_drive_file
from fitting.logs.findings import Finding
from fitting.logs.log import Log


@pytest.mark.parametrize("log", [drive_log(), drive_log(3.0), reduced_log()])
def test_healthy_logs_have_no_findings(log: Log) -> None:
    findings = examine(log, drive_file())
    assert findings == ()
    refuse_unfit(findings, log)


def test_first_refusal_is_raised_and_notes_and_warnings_are_not() -> None:
    log = drive_log()
    note, warning = (Finding(s, "seen", "there", "so") for s in ("note", "warning"))
    refuse_unfit([note, warning], log)
    first, second = (Finding("refusal", what, "there", "so mend it") for what in ("one", "two"))
    with pytest.raises(DataError) as error:
        refuse_unfit([note, first, second], log)
    assert str(error.value) == "log.csv: there: one; so mend it"
    assert str(note) == "note: there: seen; so"


def test_findings_of_the_reader_precede_those_of_the_checks() -> None:
    seen = Finding("note", "seen", "there", "so")
    log = replace(drive_log(), findings=(seen,), motor_torque=np.zeros(ROWS))
    assert examine(log, drive_file())[0] == seen
    assert len(examine(log, drive_file())) == 2


@pytest.mark.parametrize("value", [0.0, 2.5])
def test_constant_torque_is_refused_unless_the_load_torque_varies(value: float) -> None:
    log = replace(drive_log(), motor_torque=np.full(ROWS, value))
    findings = examine(log, drive_file())
    only_finding(findings, "refusal", f"motor_torque is {value:g}", "does not excite")
    with pytest.raises(DataError, match="motor_torque"):
        refuse_unfit(findings, log)
    braked = replace(log, load_torque=np.random.default_rng(2).normal(size=ROWS))
    only_finding(examine(braked, drive_file()), "warning", "load torque")


def test_reduced_log_without_excitation_or_response_is_refused() -> None:
    log = replace(reduced_log(), forcing=np.zeros(ROWS))
    only_finding(examine(log, drive_file(None)), "refusal", "forcing is 0")
    log = replace(reduced_log(), dynamic_error=np.ones(ROWS))
    only_finding(examine(log, drive_file(None)), "refusal", "dynamic_error never changes")


def test_one_stuck_angle_is_warned_of_and_two_are_refused() -> None:
    still = np.full(ROWS, 0.7)
    log = replace(drive_log(), load_angle=still)
    only_finding(examine(log, drive_file()), "warning", "load_angle never changes")
    findings = examine(replace(log, motor_angle=still), drive_file())
    assert [finding.severity for finding in findings] == ["refusal", "refusal"]


def test_clipped_torque_is_reported() -> None:
    smooth = np.sin(60 * drive_log().time) + 0.01 * np.random.default_rng(0).normal(size=ROWS)
    log = replace(drive_log(), motor_torque=np.minimum(smooth, 0.8))
    only_finding(examine(log, drive_file()), "warning", "motor_torque", "at 0.8", "clipped")


@pytest.mark.parametrize("levels", [2, 3, 7])
def test_switched_torque_is_not_reported_as_clipped(levels: int) -> None:
    steps = np.random.default_rng(0).integers(levels, size=ROWS // 8).repeat(8) - 1.0
    log = replace(drive_log(), motor_torque=steps)
    assert not [f for f in examine(log, drive_file()) if f.severity != "note"]


def test_pulses_with_rests_at_zero_are_not_reported_as_clipped() -> None:
    pulses = np.maximum(np.sin(60 * drive_log().time), 0.0)
    assert examine(replace(drive_log(), motor_torque=pulses), drive_file()) == ()


@pytest.mark.parametrize(("name", "step"), [("load_angle", 1e-4), ("motor_angle", 5e-3)])
def test_coarse_quantisation_of_an_angle_is_noted(name: str, step: float) -> None:
    log = drive_log()
    values = np.rint(getattr(log, name) / step) * step
    finding = only_finding(examine(replace(log, **{name: values}), drive_file()), "note", name)
    assert f"{step:g} rad apart" in finding.what


def test_fine_quantisation_is_not_noted() -> None:
    log = drive_log()
    motor, load = angles(log)
    count = 2 * np.pi / 2**24
    log = replace(log, motor_angle=np.rint(motor / count) * count)
    log = replace(log, load_angle=np.rint(load / count) * count)
    assert examine(log, drive_file()) == ()


def test_sampling_jitter_is_noted() -> None:
    log = drive_log()
    jitter = 0.1 * STEP * np.random.default_rng(4).uniform(-1, 1, size=ROWS)
    only_finding(examine(replace(log, time=log.time + jitter), drive_file()), "note", "jitters by 8")
    slight = replace(log, time=log.time + 0.01 * jitter)
    assert examine(slight, drive_file()) == ()


@pytest.mark.parametrize("side", ["motor", "load"])
@pytest.mark.parametrize(
    ("factor", "severity", "word"),
    [
        (1.0, None, ""),
        (1.05, "warning", "time base"),
        (1e-3, "refusal", "time base"),
        (1e3, "refusal", "time base"),
        (0.02, "warning", '"50 rad/s"'),
        (50.0, "warning", '"rad/s / 50"'),
        (-1.0, "warning", "sign = -1"),
        (60 / (2 * np.pi), "warning", "rpm"),
        (180 / np.pi, "warning", "deg/s"),
    ],
)
def test_velocity_is_checked_against_the_derivative_of_its_angle(
    side: str, factor: float, severity: str | None, word: str
) -> None:
    log = drive_log()
    angle = getattr(log, f"{side}_angle")
    log = replace(log, **{f"{side}_velocity": factor * np.gradient(angle, log.time)})
    findings = examine(log, drive_file())
    if severity is None:
        assert findings == ()
    else:
        only_finding(findings, severity, f"{side}_velocity", word)


@pytest.mark.parametrize(("factor", "severity"), [(1.0, None), (0.02, "warning"), (1e-3, "refusal")])
def test_motor_velocity_is_checked_without_a_load_angle(factor: float, severity: str | None) -> None:
    log = drive_log()
    motor, _ = angles(log)
    alone = replace(log, load_angle=None, dynamic_error=None, motor_velocity=factor * np.gradient(motor, log.time))
    findings = examine(alone, drive_file())
    assert [finding.severity for finding in findings] == ([] if severity is None else [severity])


def test_velocity_with_missing_samples_and_a_gap_has_no_findings() -> None:
    log = drive_log()
    motor, _ = angles(log)
    velocity = np.gradient(motor, log.time)
    velocity[::9] = np.nan
    kept = np.delete(np.arange(ROWS), np.arange(1000, 2000))
    columns = {k: v[kept] for k, v in vars(log).items() if isinstance(v, np.ndarray)}
    assert examine(replace(log, **columns, motor_velocity=velocity[kept]), drive_file()) == ()


@pytest.fixture(scope="module")
def simulated_log() -> Log:
    """A simulated log, whose motion follows from its torque."""
    torque = rig.drive_torque(ROWS)
    return rig.drive_log(rig.drive_motion(torque), torque)


RIG = DriveFile(Path("drive.toml"), "rig", rig.N, rig.J_M, rig.J_L, "zero-order", None, {})


@pytest.mark.parametrize(
    ("changes", "severity", "words"),
    [
        ({}, None, []),
        ({"motor_torque": -1.0}, "refusal", ["against the motion", "sign = -1"]),
        ({"motor_torque": 1e3}, "refusal", ['"mN m"']),
        ({"motor_torque": 50.0}, "refusal", ["output side", '"N m / 50"']),
        ({"motor_torque": 0.02}, "refusal", ["too small by the ratio"]),
        ({"motor_angle": 180 / np.pi, "load_angle": 180 / np.pi}, "refusal", ["both angles look like degrees"]),
        ({"motor_angle": -1.0, "load_angle": -1.0}, "refusal", ["or both angles"]),
        ({"time": 1e3}, "refusal", ["milliseconds", '"ms"']),
        ({"motor_torque": 1 / 7.0}, "warning", ["6.99 times as much", "motor_inertia"]),
        ({"motor_torque": 1 / 300.0}, "refusal", ["times as much", "motor_inertia", "time"]),
        ({"time": 1 / 60.0}, "refusal", ["times as much", "angles and time"]),
        ({"motor_torque": 1.5}, None, []),
    ],
)
def test_torque_is_checked_against_the_motion(
    simulated_log: Log, changes: dict, severity: str | None, words: list[str]
):
    log = replace(simulated_log, **{name: factor * getattr(simulated_log, name) for name, factor in changes.items()})
    findings = examine(log, RIG)
    if severity is None:
        assert findings == ()
    else:
        only_finding(findings, severity, *words)


@pytest.mark.parametrize(
    ("factor", "words"), [(-1.0, "against the motion"), (1e3, '"mN m"'), (1 / 7.0, "times as much"), (1.0, "")]
)
def test_torque_of_a_log_with_gaps_is_checked(simulated_log: Log, factor: float, words: str):
    """The motion inside gaps is unknown: here angles change by any amount."""
    pieces = ((0, 1300), (1400, 2100), (2101, ROWS))
    steps = np.repeat([0.0, 3.0, 1.0], [1300, 801, ROWS - 2101])
    motor, load = angles(simulated_log)
    log = replace(
        simulated_log,
        motor_angle=motor + rig.N * steps,
        load_angle=load + steps,
        motor_torque=factor * simulated_log.motor_torque,
        pieces=pieces,
    )
    findings = [str(f) for f in examine(log, RIG) if f.where.startswith("motor_torque against")]
    assert len(findings) == bool(words) and all(words in f for f in findings)


@pytest.mark.parametrize(
    "physics", [{"motor_friction": (0.1, 0.5)}, {"gravity": 20.0}, {"torque_bias": 0.1}, {"mesh_friction": (2.0, 1e-3)}]
)
def test_missing_effects_are_not_reported_as_findings(physics: dict):
    torque = rig.drive_torque(ROWS)
    assert examine(rig.drive_log(rig.drive_motion(torque, **physics), torque), RIG) == ()


def test_spikes_of_the_torque_are_noted() -> None:
    smooth = np.sin(60 * drive_log().time)
    smooth[[700, 1200]] += 3.0
    only_finding(
        examine(replace(drive_log(), motor_torque=smooth), drive_file()), "note", "2 samples", "motor_torque", "row 701"
    )


SPOILERS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "nan": lambda values: np.full_like(values, np.nan),
    "zero": np.zeros_like,
    "swapped": lambda values: -3 * values,
}


@pytest.mark.parametrize("spoil", SPOILERS.values(), ids=SPOILERS)
@pytest.mark.parametrize("until", [1, 50, 1000])
def test_outputs_after_the_known_samples_do_not_change_the_findings(
    spoil: Callable[[np.ndarray], np.ndarray], until: int
) -> None:
    log = replace(drive_log(), outputs_until=until)
    spoilt = {}
    for name in ("motor_angle", "load_angle", "dynamic_error"):
        values = getattr(log, name).copy()
        values[until:] = spoil(values[until:])
        spoilt[name] = values
    assert examine(replace(log, **spoilt), drive_file()) == examine(log, drive_file())


def test_practice_logs_have_no_findings(shared: Path) -> None:
    cases = sorted((shared / "logs").glob("*/drive.toml"))
    assert cases
    for case in cases:
        drive = read_drive_file(case)
        for path in sorted(case.parent.glob("*.csv")):
            assert examine(ready_log(path, drive), drive) == (), path
