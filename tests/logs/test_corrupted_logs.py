"""Corrupted logs give a result or one sentence: no traceback, no endless run, no NaN."""

import json
import time
from pathlib import Path

import mutations
import numpy as np
import pytest
from invocation import run

import rig
from fitting.drive_data import ready_log
from fitting.errors import DataError, InputError
from fitting.logs.checks import examine, refuse_unfit
from fitting.logs.drive_file import read_drive_file
from fitting.logs.log import Log

# A log of 600 rows takes milliseconds; a loaded machine may take a hundred times as long.
LONGEST = 20.0


def read_or_refusal(log_path: Path, drive_path: Path) -> Log | ValueError:
    """The log, ready to be fitted, or the error by which it is refused."""
    try:
        drive = read_drive_file(drive_path)
        log = ready_log(log_path, drive)
        findings = examine(log, drive)
        for finding in findings:
            assert "\n" not in str(finding)
            assert not {"nan", "inf"} & set(finding.what.replace(",", " ").split()), str(finding)
        refuse_unfit(findings, log)
    except (InputError, DataError) as error:
        return error
    return log


def assert_valid(found: Log | ValueError, log_path: Path, drive_path: Path) -> None:
    """Assert that a log is finite and ordered in time, or that an error is one sentence that names the file."""
    if isinstance(found, ValueError):
        message = str(found)
        assert len(message.splitlines()) == 1 and message.isprintable(), message
        assert str(log_path) in message or str(drive_path) in message, message
        assert 30 < len(message) < 1200, message
        return
    columns = [value for key, value in vars(found).items() if isinstance(value, np.ndarray) and "velocity" not in key]
    assert all(np.isfinite(column).all() for column in columns if column.dtype == float)
    assert {column.shape for column in columns} == {(len(found),)}
    assert (np.diff(found.time) > 0).all()
    for start, stop in found.pieces or ():
        assert 0 <= start < stop <= len(found)


def fit(log_path: Path, drive_path: Path, out: Path) -> int:
    """The exit code of a fit on the command line."""
    return run("fit", log_path, "--drive", drive_path, "--out", out)


def is_readable(seed: int, folder: Path) -> bool:
    """Whether a corrupted log passes the checks."""
    log_path, drive_path = mutations.spoilt_case(seed, folder / str(seed))
    begin = time.monotonic()
    found = read_or_refusal(log_path, drive_path)
    assert time.monotonic() - begin < LONGEST
    assert_valid(found, log_path, drive_path)
    return isinstance(found, Log)


@pytest.mark.parametrize("block", range(6))
def test_corrupted_logs_are_read_or_refused_in_one_sentence(block: int, tmp_path: Path):
    fitted = [is_readable(seed, tmp_path) for seed in range(20 * block, 20 * block + 20)]
    # Some logs are refused and some pass, so that both outcomes are tested.
    assert 0 < sum(fitted) < len(fitted)


@pytest.mark.slow
@pytest.mark.parametrize("block", range(10))
def test_a_thousand_corrupted_logs_are_read_or_refused(block: int, tmp_path: Path):
    for seed in range(1000 + 100 * block, 1100 + 100 * block):
        is_readable(seed, tmp_path)


@pytest.mark.slow
@pytest.mark.usefixtures("own_cache")
def test_corrupted_logs_that_pass_the_checks_are_fitted_or_refused(tmp_path: Path, capfd: pytest.CaptureFixture[str]):
    """A fit of corrupted logs that pass the checks gives a report without NaN, or one sentence."""
    fitted = 0
    for seed in range(200, 300):
        log_path, drive_path = mutations.spoilt_case(seed, tmp_path / str(seed))
        if isinstance(read_or_refusal(log_path, drive_path), ValueError):
            continue
        out = tmp_path / str(seed) / "out"
        capfd.readouterr()
        code = fit(log_path, drive_path, out)
        told = capfd.readouterr()
        if code == 0:
            text = (out / "report.json").read_text(encoding="utf-8")
            # Python would read and write NaN and Infinity as if they were JSON.
            json.loads(text, parse_constant=lambda name: pytest.fail(f"{name} in report.json"))
            assert "nan" not in told.out.lower().split(), told.out
        else:
            assert code in (1, 2) and told.err.startswith("hdjax: ") and told.err.count("\n") == 1, (seed, told.err)
            assert not out.exists()
        fitted += 1
        if fitted == 12:
            return


@pytest.mark.slow
@pytest.mark.usefixtures("own_cache")
def test_parameters_are_recovered_from_a_log_with_many_defects(tmp_path: Path):
    """Latin-1, decimal commas, degrees, a gap, a dropped sample, blanks, spikes, encoders without a common zero."""
    count, random = 6000, np.random.default_rng(0)
    torque = rig.drive_torque(count)
    log = rig.drive_log(rig.drive_motion(torque), torque)
    assert log.motor_angle is not None and log.load_angle is not None
    motor, load = np.rad2deg(log.motor_angle), np.rad2deg(log.load_angle - 0.7)
    load[random.integers(100, count - 100, 12)] += 0.2 * random.normal(size=12)
    motor[random.integers(0, count, 20)] = np.nan
    kept = np.delete(np.arange(count), [*range(2000, 2300), 4000])
    rows = [";".join("" if np.isnan(c[i]) else f"{c[i]:.12g}" for c in (log.time, motor, load, torque)) for i in kept]
    text = "Prüfstand 3\ntime;motor_angle;load_angle;motor_torque\ns;°;°;Nm\n" + "\n".join(rows).replace(".", ",")
    path, drive, out = tmp_path / "log.csv", tmp_path / "drive.toml", tmp_path / "out"
    path.write_text(text, encoding="latin-1")
    drive.write_bytes(mutations.drive_text(np.random.default_rng(0), spoilt=False))
    assert fit(path, drive, out) == 0
    report = json.loads((out / "report.json").read_text(encoding="utf-8"))
    found = report["before"]["parameters"]
    for name, truth in {"K": rig.K, "alpha": rig.ALPHA, "B_sp": rig.B_SP}.items():
        # Four standard errors, and one for the interpolated sample.
        assert abs(found[name]["value"] - truth) < 5 * found[name]["std"], name
    noise = np.hypot(rig.MOTOR_NOISE / rig.N, rig.LOAD_NOISE)
    assert report["before"]["rmse"]["test"] < 1.1 * noise
    assert [log["name"] for log in report["logs"]] == ["log, part 1", "log, part 2"]
    told = " ".join(finding["what"] for finding in report["health"])
    for words in ("20 rows", "1 gaps", "1 samples of motor_torque", "12 samples differ", "off zero"):
        assert words in told
