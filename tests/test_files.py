"""Files are written completely or not at all."""

import os
import stat
from pathlib import Path

import pytest

from fitting import files
from fitting.files import write_whole


def contents(folder: Path) -> dict[str, str]:
    return {p.name: p.read_text(encoding="utf-8") for p in folder.iterdir()}


def test_several_files_are_written_into_new_folders(tmp_path: Path):
    first, second = tmp_path / "a" / "b" / "one.txt", tmp_path / "c" / "two.txt"
    write_whole({first: "eins\n", second: "zwölf"})
    assert contents(first.parent) == {"one.txt": "eins\n"}
    assert contents(second.parent) == {"two.txt": "zwölf"}
    assert stat.S_IMODE(first.stat().st_mode) == 0o644


def test_existing_file_is_replaced(tmp_path: Path):
    path = tmp_path / "report.json"
    path.write_text("old and longer", encoding="utf-8")
    write_whole({path: "new"})
    assert contents(tmp_path) == {"report.json": "new"}


def test_files_of_an_earlier_run_are_removed(tmp_path: Path):
    for name in ("report.json", "plot.png", "notes.txt"):
        (tmp_path / name).write_text("old", encoding="utf-8")
    older = [tmp_path / name for name in ("report.json", "plot.png", "absent.csv")]
    write_whole({tmp_path / "report.json": "new"}, older=older)
    assert contents(tmp_path) == {"report.json": "new", "notes.txt": "old"}


@pytest.mark.parametrize("failing", [1, 2])
def test_failed_write_changes_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failing: int):
    (tmp_path / "one.txt").write_text("old", encoding="utf-8")
    opened = []
    fdopen = os.fdopen

    class FullDisk:
        """A file on a disk that is full after two characters."""

        def __init__(self, file):
            self.file = file

        def __enter__(self):
            return self

        def __exit__(self, *details):
            self.file.close()

        def write(self, text: str):
            self.file.write(text[:2])
            raise OSError(28, "No space left on device")

    def open_or_fail(*arguments, **options):
        opened.append(fdopen(*arguments, **options))
        return FullDisk(opened[-1]) if len(opened) == failing else opened[-1]

    monkeypatch.setattr(files.os, "fdopen", open_or_fail)
    with pytest.raises(OSError, match="No space left"):
        write_whole({tmp_path / "one.txt": "new text", tmp_path / "two.txt": "more text"})
    assert len(opened) == failing
    assert contents(tmp_path) == {"one.txt": "old"}


def test_failed_first_renaming_changes_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "one.txt").write_text("old", encoding="utf-8")

    def refuse(source, destination):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(files.os, "replace", refuse)
    with pytest.raises(PermissionError):
        write_whole({tmp_path / "one.txt": "new", tmp_path / "two.txt": "more"})
    assert contents(tmp_path) == {"one.txt": "old"}


def test_failed_later_renaming_leaves_only_whole_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    (tmp_path / "two.txt").write_text("old", encoding="utf-8")
    replace = os.replace

    def refuse_two(source, destination):
        if Path(destination).name == "two.txt":
            raise PermissionError(13, "Permission denied")
        replace(source, destination)

    monkeypatch.setattr(files.os, "replace", refuse_two)
    with pytest.raises(PermissionError):
        write_whole({tmp_path / "one.txt": "new", tmp_path / "two.txt": "more"})
    # Complete files only, with the old or the new text, and no temporary ones.
    assert contents(tmp_path) in ({"one.txt": "new", "two.txt": "old"}, {"two.txt": "old"})


def test_errors_name_the_destination(tmp_path: Path):
    (tmp_path / "two.txt").mkdir()
    with pytest.raises(IsADirectoryError) as refusal:
        write_whole({tmp_path / "one.txt": "new", tmp_path / "two.txt": "more"})
    assert refusal.value.filename == str(tmp_path / "two.txt")
    assert [p.name for p in tmp_path.iterdir()] == ["two.txt"]


def test_folder_that_is_a_file_is_refused(tmp_path: Path):
    (tmp_path / "taken").write_text("", encoding="utf-8")
    with pytest.raises(OSError):
        write_whole({tmp_path / "taken" / "one.txt": "new"})
    assert contents(tmp_path) == {"taken": ""}
