"""Inspection of logs: time column, joint, findings, excitation and what a fit could identify."""

import json
import tomllib
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import matplotlib
import mutations
import numpy as np
import polars as pl
import pytest
from joint_logs import SHAPES
from simulated_joint import Motion, simulated

import fitting
from fitting import DataError, InputError
from fitting.inspection.columns import read_columns
from fitting.inspection.hypotheses import OTHERS, hypotheses
from fitting.inspection.inspection import inspect_tables
from fitting.inspection.time_column import sampling_findings

matplotlib.use("Agg")


@pytest.fixture(scope="module")
def motion() -> Motion:
    return simulated(count=3000)


@pytest.fixture(scope="module")
def drive_log(motion: Motion) -> dict[str, np.ndarray]:
    return SHAPES["own names"].columns(motion)


@pytest.mark.parametrize(
    ("name", "factor", "start", "unit"),
    [
        ("t", 1.0, 0.0, "s"),
        ("t", 1e3, 0.0, "ms"),
        ("clock", 1e6, 0.0, "us"),
        ("stamp", 1e9, 1.6e18, "ns"),
        ("stamp", 1.0, 1.6e9, "s"),
        ("time_us", 1e6, 0.0, "us"),
        ("Time [ms]", 1e3, 0.0, "ms"),
        # The 15th of January 2024, as counted by Windows, .NET, spreadsheets and MATLAB's datenum.
        ("time", 1e7, 1.33498e17, "100 ns"),
        ("Ticks", 1e7, 6.38409e17, "100 ns"),
        ("Time", 1 / 86400, 45306.25, "d"),
        ("stamp", 1 / 86400, 739266.25, "d"),
    ],
)
def test_time_column_and_its_unit_are_detected(
    name: str, factor: float, start: float, unit: str, drive_log: dict[str, np.ndarray]
):
    columns = {name: start + factor * drive_log["time"]} | {k: v for k, v in drive_log.items() if k != "time"}
    found = fitting.inspect(columns).inspection
    assert (found.time.column, found.time.unit) == (name.partition(" [")[0], unit)
    # A double holds 6e17 to 13 us.
    assert found.rates[0] == pytest.approx(1000.0, rel=2e-3)


def test_counter_and_whole_seconds_are_not_chosen_as_time_column(drive_log: dict[str, np.ndarray]):
    count = len(drive_log["time"])
    columns = {"seq": np.arange(count), "secs": np.floor(drive_log["time"]), "stamp": drive_log["time"]}
    found = fitting.inspect(columns | {k: v for k, v in drive_log.items() if k != "time"}).inspection
    assert found.time.column == "stamp"


@pytest.mark.parametrize("counter", [{}, {"sample": 1}, {"cycle count": 4}, {"Unnamed: 0": 1}])
def test_log_without_a_time_column_asks_for_the_sample_rate(counter: dict[str, int], drive_log: dict[str, np.ndarray]):
    # The numbers of rows or cycles tell no rate.
    columns = {name: step * np.arange(len(drive_log["time"])) for name, step in counter.items()}
    found = fitting.inspect(columns | {k: v for k, v in drive_log.items() if k != "time"})
    assert found.inspection.time.column is None
    assert "[signals] sample_rate" in found.unknown
    assert set(found.inspection.joint.signals) == {"motor_angle", "load_angle", "motor_torque"}


@pytest.mark.parametrize("torque", [0.0, 1.0])
def test_log_at_rest_is_told(torque: float, drive_log: dict[str, np.ndarray]):
    still = {k: v if k == "time" else 0.0 * v + torque for k, v in drive_log.items()}
    found = fitting.inspect(still)
    assert {f.where for f in found.findings[0] if f.what == "it is constant"} == set(drive_log) - {"time"}


def test_log_without_an_angle_tells_no_coherence(drive_log: dict[str, np.ndarray]):
    assert "None" not in fitting.inspect({k: drive_log[k] for k in ("time", "motor_torque")}).summary()


def test_repeated_time_column_is_the_clock_of_the_next_column(motion: Motion):
    late = motion.time + 3e-4
    columns = {
        "Time": motion.time,
        "Motor angle": motion.motor_angle,
        "Torque": motion.motor_torque,
        "Time (2)": late,
        "Load angle": np.interp(late, motion.time, motion.load_angle),
    }
    found = fitting.inspect(columns).inspection
    assert found.time.column == "Time" and found.time.clocks == {"Load angle": "Time (2)"}
    assert found.joint.ratio is not None and found.joint.ratio.value == 100
    np.testing.assert_array_equal(found.samples("load_angle")[0], late)


def test_gaps_and_blank_samples_are_reported(drive_log: dict[str, np.ndarray]):
    kept = np.delete(np.arange(3000), np.arange(1000, 1200))
    columns = {name: values[kept].copy() for name, values in drive_log.items()}
    columns["motor_angle"][5] = np.nan
    found = fitting.inspect(columns)
    text = found.summary()
    assert "1 gaps, the longest 0.201 s" in text
    assert any("blank" in finding.what for finding in found.findings[0])
    assert any("gaps" in finding.what for finding in found.findings[0])


def test_excitation_and_identifiable_parameters_are_reported_for_each_kind(motion: Motion):
    told = {name: fitting.inspect(SHAPES[name].columns(motion)) for name in SHAPES if SHAPES[name].joint is None}
    drive = told["own names"].excitations[0]
    assert drive.band is not None and 0 < drive.band[0] < drive.band[1] < 60
    assert drive.coherent is not None and drive.twist == pytest.approx(
        np.ptp(motion.motor_angle / 100 - motion.load_angle), rel=0.05
    )
    kinds = {"own names": "drive", "motor side alone": "motor side", "twist and joint torque": "quasi-static"}
    kinds |= {"input and output": "reduced", "nothing that is a drive": None}
    for name, kind in kinds.items():
        assert told[name].inspection.joint.kind == kind
    words = {"own names": "inertias", "motor side alone": "One side alone", "twist and joint torque": "hysteresis"}
    words |= {"input and output": "omega_0", "nothing that is a drive": "not sufficient for a fit"}
    for name, word in words.items():
        assert word in " ".join(told[name].told)


def test_drift_of_the_motor_angle_does_not_mask_its_response(motion: Motion):
    """A motor that turns freely drifts, which does not mask its response to the torque."""
    columns = {"time": motion.time, "motor_torque": motion.motor_torque}
    columns["motor_angle"] = motion.motor_angle + 300.0 * motion.time**2
    found = fitting.inspect(columns)
    (moved,) = found.excitations
    assert moved.coherent is not None and moved.coherent[0] < 3.0
    assert f"inside the band of the torque ({moved.band[0]:.3g} to" in " ".join(found.told)


def test_second_log_of_equal_excitation_does_not_change_the_signals(motion: Motion):
    columns = SHAPES["symbols of papers"].columns(motion)
    once, twice = (fitting.inspect(logs).inspection.joint for logs in (columns, [columns, columns]))
    assert {s: g.column for s, g in once.signals.items()} == {s: g.column for s, g in twice.signals.items()}
    # The name of the torque does not state its side.
    columns["tau"] = columns.pop("T_m")
    assert "motor_torque" in fitting.inspect([columns, columns]).inspection.joint.signals


def test_several_logs_are_inspected_together(drive_log: dict[str, np.ndarray], motion: Motion):
    # At rest in one log, the drive moves in the other.
    still = drive_log | {name: np.zeros(3000) for name in ("motor_angle", "load_angle", "motor_torque")}
    found = fitting.inspect([still, drive_log])
    assert found.inspection.joint.kind == "drive" and len(found.findings) == len(found.excitations) == 2
    # What a fit can determine is that of the log that moves.
    assert found.told == fitting.inspect([drive_log, still]).told == fitting.inspect(drive_log).told
    with pytest.raises(InputError, match="log 2: its columns are not those of log 1"):
        fitting.inspect([drive_log, SHAPES["German PLC"].columns(motion)])


def test_joint_is_selected_by_motion_or_by_label(motion: Motion):
    columns = SHAPES["counts on both sides"].columns(motion)
    assert fitting.inspect(columns).inspection.joint.label == "2"
    other = fitting.inspect(columns, joint=1)
    assert other.inspection.joint.label == "1"
    # The counts of a revolution follow from the joint that moves.
    units = {s: g.unit for s, g in other.inspection.joint.signals.items()}
    assert units["motor_angle"] == units["load_angle"] == "rev / 16777216"
    with pytest.raises(InputError, match="there is no joint '9'; the log has 1, 2, 3"):
        fitting.inspect(columns, joint=9)


def test_numbered_encoders_of_one_drive_are_not_detected_as_joints(motion: Motion):
    columns = {
        "t": motion.time,
        "encoder1": motion.motor_angle,
        "encoder2": motion.load_angle,
        "speed1": motion.motor_velocity,
        "speed2": motion.load_velocity,
        "torque": motion.motor_torque,
    }
    found = fitting.inspect(columns).inspection
    assert found.joint.label is None
    assert {g.column: s for s, g in found.joint.signals.items()}["encoder1"] == "motor_angle"


def test_short_columns_are_reported_with_their_rows(drive_log: dict[str, np.ndarray]):
    found = fitting.inspect(drive_log | {"gain": np.ones(1), "limits": np.arange(5.0)})
    assert found.inspection.tables[0].left_out == {"gain": "a single number", "limits": "only 5 rows"}


class CountedEvidence:
    """Evidence of columns that nothing tells apart; it counts the assignments of angles that are weighed."""

    def __init__(self, count: int):
        self.columns, self.weighed = range(count), 0
        self.names = {signal: [SimpleNamespace(odds=-10.0)] * count for signal in OTHERS}

    def candidates(self, signal: str) -> list[int]:
        return [*self.columns]

    def geometry(self, motor: int | None, load: int | None, twist: int | None) -> float:
        self.weighed += 1
        return -1.0 if motor is None else 0.0


def test_twists_of_many_columns_are_sought_beside_likely_angles_alone():
    evidence: Any = CountedEvidence(100)
    hypotheses(evidence)
    assert evidence.weighed < 300_000


def test_text_and_blank_columns_are_reported_as_left_out(tmp_path: Path, drive_log: dict[str, np.ndarray]):
    frame = pl.DataFrame(drive_log).with_columns(note=pl.lit("ok"), spare=pl.lit(None, dtype=pl.Float64))
    frame.write_csv(tmp_path / "log.csv")
    found = fitting.inspect(tmp_path / "log.csv")
    assert set(found.inspection.tables[0].left_out) == {"note", "spare"}
    assert "No channels: note (text such as 'ok'), spare (blank)" in found.summary()
    frame.select("note").write_csv(tmp_path / "text.csv")
    with pytest.raises(InputError):
        fitting.inspect(tmp_path / "text.csv")
    with pytest.raises(InputError, match="there is no log"):
        fitting.inspect([])


@pytest.mark.parametrize("kind", ["batched", "jumping back", "constant"])
def test_own_clocks_of_channels_are_mended_or_refused(kind: str, drive_log: dict[str, np.ndarray]):
    time = drive_log["time"]
    stamps = {
        "batched": np.repeat(time[9::10], 10)[: len(time)],
        "jumping back": time - 0.3 * time[-1] * (time > 0.5 * time[-1]),
        "constant": np.zeros_like(time),
    }[kind]
    table = read_columns(Path("recording"), {name: c for name, c in drive_log.items() if name != "time"})
    own = tuple(replace(c, values=c.values[: len(stamps)], time=stamps) for c in table.columns)
    found = inspect_tables([replace(table, columns=own)])
    told = sampling_findings(found.tables[0], found.time, found.clocks[0])
    if kind == "batched":
        assert found.rates[0] == pytest.approx(1.0 / np.diff(time).mean(), rel=1e-2)
        assert not told
    elif kind == "constant":
        assert found.rates == (None,)
        assert [finding.severity for finding in told] == ["refusal"] * len(own)
    else:
        assert all(np.all(np.diff(clock.base.time) > 0) for clock in found.clocks)


def test_matrix_columns_of_a_mat_file_are_inspected(tmp_path: Path, motion: Motion):
    scipy_io = pytest.importorskip("scipy.io")
    data = np.stack([motion.time, motion.motor_angle, motion.load_angle, motion.motor_torque], axis=1)
    scipy_io.savemat(tmp_path / "log.mat", {"data": data, "Ts": 1e-3, "title": "run 1"})
    found = fitting.inspect(tmp_path / "log.mat").inspection
    assert found.time.column == "data(:,1)"
    told = {g.column: s for s, g in found.joint.signals.items()}
    assert (told["data(:,2)"], told["data(:,3)"]) == ("motor_angle", "load_angle")


def test_inspection_result_is_printed_plotted_and_saved(drive_log: dict[str, np.ndarray], tmp_path: Path):
    found = fitting.inspect(drive_log)
    assert found.columns["signal"].to_list() == ["time", "motor_angle", "load_angle", "motor_torque"]
    assert "motor_angle" in found._repr_html_() and str(found) == found.summary()
    told = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert told["kind"] == "drive" and told["signals"]["load_angle"]["unit"] == "rad"
    assert len(found.plot()) == 3
    path = found.save(tmp_path / "drive.toml")
    with pytest.raises(InputError, match="the file exists already"):
        found.save(path)
    assert found.save(path, force=True) == path
    with pytest.raises(ValueError, match="nothing to plot"):
        fitting.inspect({"t": np.arange(500) / 100, "a": np.random.default_rng(0).normal(size=500)}).plot()


def test_signals_of_measured_logs_are_detected(shared: Path):
    logs = {
        "data/silverbox/silverbox_estimation.mat": ("reduced", {"V1": "forcing", "V2": "dynamic_error"}, None),
        "data/bouc_wen/estimation.h5": ("reduced", {"multisine/u": "forcing", "multisine/y": "dynamic_error"}, None),
        "data/lara8/ML1_validate.csv": (
            "quasi-static",
            {"encoder_motorinc_3": "motor_angle", "encoder_loadinc_3": "load_angle"},
            101,
        ),
        "data/lara8/ML2_jogging_joint_mass.csv": (
            "quasi-static",
            {"encoder_motorinc_2": "motor_angle", "joint_torque_current_2": "joint_torque"},
            121,
        ),
    }
    for path, (kind, signals, ratio) in logs.items():
        joint = fitting.inspect(shared / path).inspection.joint
        assert joint.kind == kind, path
        assert {g.column: s for s, g in joint.signals.items()}.items() >= signals.items()
        assert ratio is None or (joint.ratio is not None and joint.ratio.sure and joint.ratio.value == ratio)
        if "encoder" in str(signals):
            assert joint.signals["motor_angle"].unit == joint.signals["load_angle"].unit == "rev / 16777216"


@pytest.mark.parametrize("block", range(2))
def test_corrupted_logs_are_inspected_or_refused_in_one_sentence(block: int, tmp_path: Path):
    read = 0
    for seed in range(30 * block, 30 * block + 30):
        path, _ = mutations.spoilt_case(seed, tmp_path / str(seed))
        try:
            found = fitting.inspect(path)
        except (InputError, DataError) as error:
            assert str(path) in str(error) and len(str(error).splitlines()) == 1
            continue
        read += 1
        tomllib.loads(found.drive_file())
        json.dumps(found.to_dict(), allow_nan=False)
        assert not {"nan", "inf"} & set(found.summary().replace(",", " ").split())
    # Most corrupted logs can be inspected, though few can be fitted.
    assert read > 15


@pytest.mark.parametrize("sign", [1, -1])
def test_sign_of_a_joint_torque_beside_a_twist_gives_a_complete_drive_file(sign: int, tmp_path: Path):
    """The twist is nearly proportional to the torque, without inertia or resonance."""
    time = np.arange(2000) * 0.01
    twist = 0.04 * np.sin(0.7 * time) + 0.01 * np.sin(2.0 * time)
    noise = 0.02 * np.random.default_rng(0).normal(size=time.size)
    columns = {"t": time, "deflection": twist, "effort": sign * (120.0 * twist + 500.0 * twist**3) + noise}
    found = fitting.inspect(columns)
    assert found.inspection.joint.signals["joint_torque"].sign == sign
    assert fitting.load(columns, tomllib.loads(found.drive_file())).kind == "quasi-static"
