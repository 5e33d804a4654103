"""Progress lines on standard error where it is no terminal."""

import sys
import threading
import time
from functools import partial
from pathlib import Path

import pytest

from fitting.commands import run_fit, spinner
from fitting.commands.minutes import line_a_minute
from fitting.commands.spinner import counting, spinning

INTERVAL = 0.02  # s


class ClosedPipe:
    """A stream whose reader has closed the pipe."""

    def __init__(self):
        self.tried = 0

    def write(self, text: str) -> int:
        self.tried += 1
        raise BrokenPipeError

    def flush(self) -> None: ...


def last_line(capsys: pytest.CaptureFixture[str]) -> str:
    """The next progress line; fails if none is written within a second, fifty times the interval."""
    until = time.monotonic() + 50 * INTERVAL
    while time.monotonic() < until:
        if told := capsys.readouterr().err:
            return told.splitlines()[-1]
        time.sleep(INTERVAL / 4)
    raise AssertionError("no line came")


def test_stage_is_reported_each_interval_until_its_end(capsys: pytest.CaptureFixture[str]):
    with line_a_minute("starting", interval=INTERVAL) as say:
        assert last_line(capsys) == "hdjax: 0:00:00 starting"
        assert last_line(capsys) == "hdjax: 0:00:00 starting"
        say("fitting the base model")
        assert last_line(capsys).endswith((" starting", " fitting the base model"))
        assert last_line(capsys) == "hdjax: 0:00:00 fitting the base model"
    capsys.readouterr()
    time.sleep(5 * INTERVAL)
    assert capsys.readouterr().err == ""


def test_short_work_reports_nothing_and_leaves_no_thread(capsys: pytest.CaptureFixture[str]):
    threads = threading.active_count()
    with pytest.raises(ValueError, match="work"), line_a_minute("starting") as say:
        say("fitting the base model")
        raise ValueError("work")
    assert threading.active_count() == threads
    assert capsys.readouterr() == ("", "")


def test_closed_pipe_does_not_end_the_work(monkeypatch: pytest.MonkeyPatch):
    stream = ClosedPipe()
    monkeypatch.setattr(sys, "stderr", stream)
    with line_a_minute("starting", interval=INTERVAL):
        time.sleep(5 * INTERVAL)
    assert stream.tried == 1


@pytest.fixture
def short_interval(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shorten the interval between progress lines from a minute to 20 ms."""
    monkeypatch.setattr(spinner, "line_a_minute", partial(line_a_minute, interval=INTERVAL))


@pytest.mark.usefixtures("short_interval")
def test_counted_progress_is_reported(capsys: pytest.CaptureFixture[str]):
    with counting("logs", first="choosing the route") as progress:
        assert last_line(capsys).endswith(" choosing the route")
        progress(3, 20)
        last_line(capsys)
        assert last_line(capsys).endswith(" 3 of 20 logs")


@pytest.mark.usefixtures("short_interval")
def test_terminal_shows_only_the_spinner(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]):
    monkeypatch.setattr(sys.stderr, "isatty", lambda: True)
    monkeypatch.setenv("TERM", "xterm")
    with spinning() as say:
        say("fitting the base model")
        time.sleep(3 * INTERVAL)
    assert "hdjax: " not in capsys.readouterr().err


@pytest.mark.usefixtures("short_interval")
def test_progress_of_the_loop_is_reported_on_a_pipe(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
):
    lines: list[str] = []

    class Found:
        def save(self, out: Path) -> Path:
            return out

        def summary(self) -> str:
            return "found"

    def close_loop(data, *, search, progress):
        progress("looking through the catalogue")
        lines.extend(last_line(capsys) for _ in range(2))
        return Found()

    monkeypatch.setattr(run_fit, "load", lambda logs, drive, test=(): None)
    monkeypatch.setattr(run_fit, "close_loop", close_loop)
    run_fit.close_loop_on_logs([tmp_path / "log.csv"], tmp_path / "drive.toml", tmp_path)
    assert lines[-1].endswith(" looking through the catalogue")
    assert "found" in capsys.readouterr().out
