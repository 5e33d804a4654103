"""Missing values of a log's signals: valid rows, and interpolation in the others."""

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from fitting.errors import DataError, InputError
from fitting.logs.drive_file import DriveFile
from fitting.logs.findings import Finding
from fitting.logs.gaps import SHORTEST, pieces
from fitting.logs.log_kind import OPTIONAL_SIGNALS
from fitting.logs.time_stamps import TimeBase

_FEWEST_INPUTS = 50


def trusted_rows(
    path: Path,
    drive_file: DriveFile,
    signals: dict[str, np.ndarray],
    outputs: Sequence[str],
    outputs_until: int | None,
    asked: int | None,
    *,
    own_clocks: bool,
) -> tuple[np.ndarray, tuple[Finding, ...]]:
    """Rows in which all outputs are known; the others are filled, so that no NaN remains.

    Args:
        path: The log, for messages.
        drive_file: Names the columns, for messages.
        signals: By name; unknown outputs are filled.
        outputs: Their names.
        outputs_until: Rows in which the outputs are known, or None for all.
        asked: Required samples of each output there, or None for all.
        own_clocks: Whether rows are the union of all channels' stamps, so that each channel has missing rows.
    """
    count = len(signals[outputs[0]])
    trusted, findings = np.ones(count, dtype=bool), []
    rows = np.arange(count)
    until = count if outputs_until is None else min(outputs_until, count)
    needed = min(SHORTEST, ((count if asked is None else min(asked, count)) + 1) // 2)
    for name in outputs:
        known = np.isfinite(signals[name])
        if known.sum() < needed:
            raise InputError(
                f"{path}: {_column(drive_file, name)} is a number in {known.sum()} rows only, where {needed} are "
                "needed; name the right column or mend the log"
            )
        blank = np.flatnonzero(~known[:until])
        if len(blank):
            seen = "was not sampled" if own_clocks else "is blank or not finite"
            what = f"{name} {seen} in {len(blank)} rows ({100 * len(blank) / until:.3g} %)"
            where = f"{drive_file.column_of(name).column}, first in row {blank[0] + 1}"
            findings.append(
                Finding("note" if own_clocks else "warning", what, where, "they have weight zero in the fit")
            )
        signals[name] = signals[name] if known.all() else np.interp(rows, rows[known], signals[name][known])
        trusted &= known
    if trusted.sum() < needed:
        raise DataError(f"{path}: only {trusted.sum()} rows hold all of {', '.join(outputs)}; a fit needs {SHORTEST}")
    return trusted, tuple(findings)


def input_rows(
    path: Path,
    drive_file: DriveFile,
    base: TimeBase,
    signals: Mapping[str, np.ndarray],
    name: str,
    outputs_until: int | None,
) -> tuple[np.ndarray, tuple[tuple[int, int], ...], tuple[Finding, ...]]:
    """Rows in which the input is known, pieces in which it is known or can be bridged, and findings."""
    known = np.isfinite(signals[name])
    if known.sum() < _FEWEST_INPUTS:
        raise InputError(
            f"{path}: {_column(drive_file, name)} is a number in {known.sum()} rows only; name the right column"
        )
    whole = outputs_until is not None
    if name == "joint_torque":
        # A quasi-static log needs no torque between its samples.
        return known, ((0, len(known)),), ()
    spans, gaps = pieces(base.time, signals[name], known, base.restarts, name, whole=whole)
    # A sample or two at the ends may be held.
    lacks = len(spans) != 1 or spans[0][0] > 2 or spans[0][1] < len(known) - 2
    if not spans or (whole and lacks):
        seen = gaps[0].what if gaps else f"{name} is unknown at its ends"
        wanted = "a prediction needs it throughout" if whole else f"no stretch of {SHORTEST} rows is left"
        raise DataError(f"{path}: {seen}, so that {name} is not known there and {wanted}; record the log without gaps")
    return known, spans, gaps


def interpolated(
    path: Path, drive_file: DriveFile, time: np.ndarray, signals: dict[str, np.ndarray]
) -> tuple[Finding, ...]:
    """Fill missing values of the inputs; the fit uses the main one only where it was sampled.

    An optional input without numbers is left out, unless the drive file names it.
    """
    findings = []
    for name in ("motor_torque", "forcing", "joint_torque", *OPTIONAL_SIGNALS):
        if name not in signals:
            continue
        known = np.isfinite(signals[name])
        if known.sum() < 2 and name in OPTIONAL_SIGNALS and name not in drive_file.columns:
            del signals[name]
            findings.append(Finding("note", f"{name} holds no numbers", name, "it was left out"))
            continue
        if known.sum() < 2:
            raise InputError(
                f"{path}: {_column(drive_file, name)} holds no numbers; name the right column or leave it out"
            )
        if not known.all() and name in OPTIONAL_SIGNALS:
            what = f"{name} is blank in {(~known).sum()} rows ({100 * np.mean(~known):.3g} %)"
            findings.append(Finding("note", what, name, "it was interpolated between the rows that have it"))
        if not known.all():
            signals[name] = np.interp(time, time[known], signals[name][known])
    return tuple(findings)


def _column(drive_file: DriveFile, signal: str) -> str:
    return f"the column '{drive_file.column_of(signal).column}' ({signal})"
