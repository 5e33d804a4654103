"""What a command left behind, as one record: decision, names, figures, words, keys and files."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import polars as pl

from characterisation.figures import flattened, keys, numbers

Record = dict[str, Any]

_HASH = re.compile(r"[0-9a-f]{12,}")
_MOST_LETTERS = 20_000
# What is read may be of another version than what this was written for.
_UNREADABLE = (ValueError, KeyError, TypeError, AttributeError, OSError, pl.exceptions.PolarsError)


def read_results(folder: Path, *, stdout: str, printed: bool, measured: Path | None, ratio: float) -> Record:
    """Read what a command wrote and printed.

    Args:
        folder: that it wrote to.
        stdout: what it printed.
        printed: whether numbers in it count.
        measured: a log with both angles, with which `prediction.csv` is compared; none where None.
        ratio: of that log.
    """
    record: Record = {"decision": None, "names": {}, "figures": {}, "words": {}, "schema": [], "files": []}
    for path in _files(folder):
        name = _HASH.sub("#", str(path.relative_to(folder)))
        if name not in record["files"]:
            record["files"].append(name)
        try:
            _add_file(record, name, path)
        except _UNREADABLE as error:
            record["words"][f"{name}:unread"] = f"{type(error).__name__}: {error}"
    if measured is not None and (folder / "prediction.csv").exists():
        _add_error(record, folder / "prediction.csv", measured, ratio)
    if printed:
        _add_printed(record, stdout)
    record["schema"] = sorted(set(record["schema"]))
    return record | {"stdout": stdout[:_MOST_LETTERS]}


def _add_file(record: Record, name: str, path: Path) -> None:
    if path.suffix == ".json" and "#" not in name:
        _add_document(record, name, json.loads(path.read_text(encoding="utf-8")))
    elif path.suffix == ".csv":
        _add_table(record, name, pl.read_csv(path, infer_schema_length=None))
    elif path.suffix == ".parquet":
        _add_table(record, name, pl.read_parquet(path))
    elif path.suffix == ".jsonl":
        _add_draws(record, [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()])


def _files(folder: Path) -> Iterator[Path]:
    """Files in the order of their paths; a store of arrays counts as one."""
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        if path.is_dir() and not (path / "zarr.json").exists():
            yield from _files(path)
        else:
            yield path


def _add_document(record: Record, name: str, content: Any) -> None:
    # A model's numbers stand in the report with their standard errors, and predictions are made of them.
    stored = isinstance(content, dict) and "torque_hold" in content
    figures, words = flattened({"hold": content["torque_hold"], "kind": content["kind"]} if stored else content)
    record["figures"] |= {f"{name}:{path}": figure for path, figure in figures.items()}
    record["words"] |= {f"{name}:{path}": word for path, word in words.items()}
    record["schema"] += [f"{name}:{key}" for key in keys(content)]
    if isinstance(content, dict) and "decision" in content:
        record["decision"] = content["decision"]
        record["names"] |= _names(content)


def _names(report: dict[str, Any]) -> dict[str, list[str]]:
    """Effects and alternatives in their order."""

    def labels(entries: Any) -> list[str]:
        return [f"{e.get('family')}/{e.get('name')}" if isinstance(e, dict) else str(e) for e in entries or []]

    found = {f"{at}.effects": labels((report.get(at) or {}).get("effects")) for at in ("before", "after")}
    ties = [e for e in report.get("alternatives") or [] if isinstance(e, dict) and e.get("separable") is False]
    found |= {"ties": labels(ties), "dropped": labels(report.get("dropped"))}
    return found | {"steps": [str(step.get("added")) for step in report.get("steps") or []]}


def _add_table(record: Record, name: str, table: pl.DataFrame) -> None:
    """Columns and rows, and of each column of numbers its mean, rms and last value; a fleet's table row by row."""
    record["schema"] += [f"{name}:{column}" for column in table.columns]
    if {"log", "state"} <= set(table.columns):
        record["names"]["states"] = [f"{row['log']} {row['state']}" for row in table.iter_rows(named=True)]
        for row in table.iter_rows(named=True):
            told = {key: value for key, value in row.items() if key not in ("log", "drive", "message")}
            _add_flat(record, f"{name}:{row['log']}", _with_estimates(told))
        return
    record["figures"][f"{name}:rows"] = {"value": table.height}
    for column in table.columns:
        if table[column].dtype.is_numeric() and table.height:
            values = table[column].to_numpy().astype(float)
            told = {"mean": values.mean(), "rms": np.sqrt(np.mean(values**2)), "last": values[-1]}
            _add_flat(record, f"{name}:{column}", {key: float(value) for key, value in told.items()})


def _with_estimates(row: dict[str, Any]) -> dict[str, Any]:
    """A fleet's row with each value and its standard error in one."""
    found = dict(row)
    for key in row:
        if f"{key}_std" in row:
            found[key] = {
                "value": row[key],
                "std": found.pop(f"{key}_std"),
                "ci95": [found.pop(f"{key}_low", None), found.pop(f"{key}_high", None)],
                "identifiable": found.pop(f"{key}_identifiable", None),
            }
    return found


def _add_flat(record: Record, path: str, content: Any) -> None:
    figures, words = flattened(content, path)
    record["figures"] |= figures
    record["words"] |= words


def _add_draws(record: Record, draws: list[dict[str, Any]]) -> None:
    """What `benchmarks/convergence.py` writes: a verdict for each draw, and the parameters that were fitted."""
    verdicts = [f"{d['draw']['index']} {d['verdict']}" for d in draws]
    record["names"]["verdicts"] = verdicts
    told = ("excess", "horizon", "substeps", "converged", "steps", "left_out", "parameters")
    for one in draws:
        _add_flat(record, f"draw {one['draw']['index']}", {key: one[key] for key in told if key in one})
    record["schema"] += [f"draws.jsonl:{key}" for key in set().union(*map(keys, draws))]


def _add_error(record: Record, prediction: Path, measured: Path, ratio: float) -> None:
    log, predicted = pl.read_csv(measured, infer_schema_length=None), pl.read_csv(prediction)
    twist = (log["motor_angle"] / ratio - log["load_angle"]).to_numpy()
    error = twist[: predicted.height] - predicted["dynamic_error"].to_numpy()
    record["figures"]["prediction.csv:rms error"] = {"value": float(np.sqrt(np.mean(error**2)))}


def options_of(help_text: str) -> list[str]:
    """Verbs and options that a help page lists."""
    options = set(re.findall(r"(?<!\w)--[A-Za-z][\w-]*", help_text))
    return sorted(options | set(re.findall(r"^│ ([a-z][\w-]+)\s", help_text, flags=re.MULTILINE)))


def _add_printed(record: Record, stdout: str) -> None:
    try:
        _add_document(record, "stdout", json.loads(stdout))
    except ValueError:
        found, text = numbers(stdout)
        record["figures"] |= {f"stdout:{place}": figure for place, figure in found.items()}
        record["words"]["stdout"] = _HASH.sub("#", text)
