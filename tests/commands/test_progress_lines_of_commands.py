"""Commands without a fit say in a pipe what they do, too."""

import time
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest

from fitting.commands import run_inspect, run_predict, spinner
from fitting.commands.minutes import line_a_minute


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """A minute takes an instant."""
    monkeypatch.setattr(spinner, "line_a_minute", partial(line_a_minute, interval=0.01))


def slow(result: SimpleNamespace):
    """A function that takes ten such minutes."""

    def work(*arguments: object, **options: object) -> SimpleNamespace:
        time.sleep(0.1)
        return result

    return work


def test_an_inspection_in_a_pipe_is_told(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(run_inspect, "_tables", lambda logs: [])
    monkeypatch.setattr(run_inspect, "alike", lambda tables: [()])
    monkeypatch.setattr(run_inspect, "inspected", slow(SimpleNamespace(summary=lambda: "what was found")))
    run_inspect.show_logs([], None)
    told = capsys.readouterr()
    assert told.out == "what was found\n" and "hdjax: 0:00:00 inspecting the logs\n" in told.err


def test_a_prediction_in_a_pipe_is_told(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    monkeypatch.setattr(run_predict, "load", lambda log, drive, outputs_until: None)
    monkeypatch.setattr(run_predict, "predict", slow(SimpleNamespace(save=lambda out: out, findings=())))
    run_predict.write_prediction(tmp_path, tmp_path, tmp_path, tmp_path / "out.csv")
    told = capsys.readouterr()
    assert told.out.startswith("Prediction: ") and "hdjax: 0:00:00 simulating\n" in told.err
