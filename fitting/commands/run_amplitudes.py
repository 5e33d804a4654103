"""Implementation of `hdjax amplitudes`."""

import json
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from fitting.commands.chosen_drive import read_drive
from fitting.commands.options import DriveOptions
from fitting.commands.pictures import png, show_files
from fitting.commands.spinner import spinning
from fitting.errors import DataError, InputError
from fitting.files import write_whole
from hdjax import Drive, ReducedDrive
from hdjax.parameters import as_scalar
from hdjax.response.amplitudes import AmplitudeCheck, check_amplitudes


def show_amplitudes(
    drive: DriveOptions, motor_torque: float, load_torque: float, omega: list[float] | None, out: Path | None
) -> None:
    """Check the analytic amplitudes, write them, and show them.

    Args:
        drive: its options.
        motor_torque: amplitude [N m].
        load_torque: amplitude [N m].
        omega: frequencies [rad/s]; five default ones where None.
        out: folder, or None.

    Raises:
        InputError: bad drive, or torques that cancel.
        DataError: there is nothing to plot.
    """
    made, _ = read_drive(drive)
    if isinstance(made, Drive):
        A = float(made.error_forcing(as_scalar(motor_torque), as_scalar(load_torque)))
    else:
        A = float(made.gain) * motor_torque
    if A == 0.0:
        raise InputError("--motor-torque and --load-torque must not cancel to zero")
    omega_0 = float(made.omega_0)
    frequencies = omega or [0.6 * omega_0, 1.7 * omega_0, omega_0 / 3, omega_0, 3 * omega_0]
    files: dict[Path, str | bytes] = {}
    with spinning("checking amplitudes") as say:
        checks: list[AmplitudeCheck] = [check_amplitudes(made, A, w) for w in frequencies]
        if out is not None:
            say("computing the plots")
            files |= {out / name: png(figure) for name, figure in _amplitude_pictures(made, A).items()}
    if out is not None:
        document = {
            "schema": "hdjax-amplitudes/1",
            "drive": {n: float(getattr(made, n)) for n in ("mu", "omega_0", "alpha")},
            "A": A,
            "checks": [{"omega": c.omega, "kind": c.kind, "motions": [_row(r) for r in c.rows]} for c in checks],
        }
        files[out / "amplitudes.json"] = json.dumps(document, indent=1, allow_nan=False) + "\n"
        write_whole(files)
    _show_checks(made, A, checks)
    show_files(files)


def _show_checks(drive: Drive | ReducedDrive, A: float, checks: list) -> None:
    table = Table(box=SIMPLE)
    for name in ("omega [rad/s]", "expansion", "motion", "", "first order", "second order"):
        table.add_column(name)
    for name in ("harmonic balance", "time integration", "error", "verdict"):
        table.add_column(name)
    for check in checks:
        for row in check.rows:
            table.add_row(
                f"{check.omega:.6g}",
                check.kind,
                row.branch,
                "stable" if row.stable else "unstable",
                *(_number(v) for v in (row.first_order, row.second_order, row.balance, row.time)),
                "-" if row.error is None else f"{row.error:.2%}",
                row.verdict,
            )
    print(
        f"omega_0 = {float(drive.omega_0):.6g} rad/s, mu = {float(drive.mu):.4g} 1/s, "
        f"alpha = {float(drive.alpha):.4g}, A = {A:.6g} [x]/s^2; amplitudes are the largest |x|."
    )
    Console(width=max(150, Console().width), highlight=False).print(table)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.6g}"


def _row(row: Any) -> dict[str, Any]:
    names = ("branch", "stable", "first_order", "second_order", "balance", "time", "error", "agreement", "verdict")
    return {n: getattr(row, n) for n in names}


def _amplitude_pictures(drive: Drive | ReducedDrive, A: float) -> dict[str, Any]:
    import jax

    from hdjax import ReducedModel
    from hdjax.fourier import harmonic_series
    from hdjax.response.amplitudes import error_map, settled
    from hdjax.response.coexisting import from_both_ends
    from hdjax.response.fold import folds
    from hdjax.response.multiple_scales import PrimaryResonance
    from hdjax.response.plots import error_map_plot, frequency_response_plot
    from hdjax.response.resonance import backbone, peak

    model = ReducedModel(ReducedDrive(mu=drive.mu, omega_0=drive.omega_0, alpha=drive.alpha))
    omega_0 = float(drive.omega_0)
    branches = from_both_ends(model, harmonic_series(1.0, A), 0.2 * omega_0, 2.5 * omega_0)
    steady = [b for b in branches if bool(jnp.any(b.valid & b.stable))]
    if not steady:
        raise DataError("no steady motion was found to plot; give a smaller --motor-torque, or omit --out")
    largest = max(float(jnp.max(b.amplitude, where=b.valid, initial=0.0)) for b in branches)
    peaks = [p for p in map(peak, branches) if bool(p.converged) and 0.2 < float(p.value) / omega_0 < 2.5]
    omegas = np.linspace(0.6, 2.5, 600) * omega_0
    figure = frequency_response_plot(
        *branches,
        folds=[folds(b) for b in branches],
        peak=max(peaks, key=lambda p: float(p.amplitude), default=None),
        backbone=backbone(model, jnp.linspace(0.01, 1.0, 100) * largest),
        settled=[settled(b) for b in steady],
        analytic=(omegas, jax.vmap(PrimaryResonance(drive, A).branches)(jnp.asarray(omegas))),
        unit="rad" if isinstance(drive, Drive) else "unit of the log",
    )
    sign = -1.0 if float(drive.alpha) < 0.0 else 1.0
    sigma, strength = np.linspace(-0.3, 0.3, 61), np.geomspace(1e-4, 1.0, 41)
    errors = error_map("primary", sigma, sign * strength, float(drive.mu) / omega_0)
    title = "Primary resonance: error of multiple scales in the largest |x|"
    return {
        "frequency_response.png": figure,
        "error_map.png": error_map_plot(errors, title=title, strength=f"${'-' if sign < 0.0 else ''}\\alpha a^2$"),
    }
