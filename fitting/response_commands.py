"""The commands that need no log: `hdjax amplitudes | seed-tables | speeds`."""

import json
import math
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from cyclopts import Parameter
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table

from fitting.errors import DataError, InputError
from fitting.files import write_whole
from fitting.model_file import read_model
from hdjax import PRESETS, Drive, ReducedDrive, TwoInertiaModel
from hdjax.parameters import as_scalar

_RPM = 30.0 / math.pi


def amplitudes(
    *,
    preset: str = "HDC-40-050",
    model: Path | None = None,
    stiffness: Annotated[float | None, Parameter(name="--K")] = None,
    cubic: Annotated[float | None, Parameter(name="--alpha")] = None,
    damping: Annotated[float | None, Parameter(name="--B_sp")] = None,
    motor_torque: float = 10.0,
    load_torque: float = 0.0,
    omega: Annotated[list[float] | None, Parameter(consume_multiple=True)] = None,
    out: Path | None = None,
) -> None:
    """Check the analytic amplitudes of the dynamic error against harmonic balance and time integration.

    Parameters
    ----------
    preset
        Name of a drive with published parameters.
    model
        model.json of a report, in place of a preset; its effects are left aside, as the expansions know none.
    stiffness
        Torsional stiffness [N m/rad] in place of the drive's own.
    cubic
        Cubic stiffness coefficient [rad^-2] in place of the drive's own.
    damping
        Mesh damping [N m s/rad] in place of the drive's own.
    motor_torque
        Amplitude of the harmonic motor torque [N m] (or of a reduced drive's forcing).
    load_torque
        Amplitude of a load torque at the same frequency, in phase [N m].
    omega
        Forcing frequencies [rad/s]; two off resonance and the centres of the three resonances where not given.
    out
        Folder for amplitudes.json, frequency_response.png and error_map.png; none where not given.
    """
    from hdjax.response.amplitudes import AmplitudeCheck, check_amplitudes

    drive = _drive(preset, model, {"K": stiffness, "alpha": cubic, "B_sp": damping})
    if isinstance(drive, Drive):
        A = float(drive.error_forcing(as_scalar(motor_torque), as_scalar(load_torque)))
    else:
        A = float(drive.gain) * motor_torque
    if not (math.isfinite(A) and A != 0.0):
        raise InputError("--motor-torque and --load-torque must not cancel to zero")
    if not float(drive.mu) > 0.0:
        raise InputError("the drive has no damping, and so no steady response; give --B_sp")
    omega_0 = float(drive.omega_0)
    frequencies = [0.6 * omega_0, 1.7 * omega_0, omega_0 / 3, omega_0, 3 * omega_0] if omega is None else omega
    for w in frequencies:
        if not (math.isfinite(w) and w > 0.0):
            raise InputError(f"--omega must be positive, but is {w}")
    checks: list[AmplitudeCheck] = [check_amplitudes(drive, A, w) for w in frequencies]
    _show_checks(drive, A, checks)
    if out is not None:
        document = {
            "schema": "hdjax-amplitudes/1",
            "drive": {n: float(getattr(drive, n)) for n in ("mu", "omega_0", "alpha")},
            "A": A,
            "checks": [{"omega": c.omega, "kind": c.kind, "motions": [_row(r) for r in c.rows]} for c in checks],
        }
        files: dict[Path, str | bytes] = {out / "amplitudes.json": json.dumps(document, indent=1) + "\n"}
        files |= {out / name: _png(figure) for name, figure in _amplitude_pictures(drive, A).items()}
        write_whole(files)
        print(f"Files: {', '.join(str(f) for f in files)}")


def seed_tables() -> None:
    """Recompute the seed document's Tables 1 to 4 and its figure beside what is printed, cell by cell."""
    from hdjax.response.seed_fit import best_fit_of_table_2
    from hdjax.response.seed_tables import as_text
    from hdjax.response.seed_tables import seed_tables as computed

    print(as_text(computed(), best_fit_of_table_2()))


def speeds(
    *,
    preset: str = "HDC-40-050",
    model: Path | None = None,
    stiffness: Annotated[float | None, Parameter(name="--K")] = None,
    cubic: Annotated[float | None, Parameter(name="--alpha")] = None,
    damping: Annotated[float | None, Parameter(name="--B_sp")] = None,
    kinematic_error: float = 1.5e-4,
    slowest: float = 100.0,
    fastest: float = 3500.0,
    limit: float | None = None,
    out: Path | None = None,
) -> None:
    """Say which motor speeds to avoid: where the kinematic error's cycles meet the drive's natural frequency.

    Parameters
    ----------
    preset
        Name of a drive with published parameters.
    model
        model.json of a report, in place of a preset; a kinematic error in it is used.
    stiffness
        Torsional stiffness [N m/rad] in place of the drive's own.
    cubic
        Cubic stiffness coefficient [rad^-2] in place of the drive's own.
    damping
        Mesh damping [N m s/rad] in place of the drive's own.
    kinematic_error
        Amplitude of two error cycles per motor revolution [rad], where the model has no kinematic error of its own.
    slowest
        Lowest motor speed [rpm].
    fastest
        Highest motor speed [rpm].
    limit
        Largest swing of the dynamic error that is allowed [rad]; three times the kinematic error where not given.
    out
        Folder for speeds.json and speeds.png; none where not given.
    """
    from hdjax.effects.kinematic import KinematicError
    from hdjax.response.continuation import frequency_response
    from hdjax.response.critical_speeds import critical_speeds, speeds_to_avoid
    from hdjax.response.plots import speed_plot

    drive = _drive(preset, model, {"K": stiffness, "alpha": cubic, "B_sp": damping})
    if not isinstance(drive, Drive):
        raise InputError(f"{model}: a reduced model has no motor speed; give a model of a drive with two inertias")
    if not 0.0 < slowest < fastest:
        raise InputError(f"--slowest must be positive and below --fastest, but they are {slowest} and {fastest} rpm")
    if not kinematic_error > 0.0:
        raise InputError(f"--kinematic-error must be positive, but is {kinematic_error}")
    own = [] if model is None else [e for e in read_model(model).model.effects if isinstance(e, KinematicError)]
    error = own[0] if own else KinematicError(cos_2=kinematic_error)
    angles = jnp.linspace(0.0, 2 * np.pi, 256)
    size = float(np.max(np.abs(np.asarray(error.error(angles)))))
    limit = 3.0 * size if limit is None else limit
    branch = frequency_response(
        TwoInertiaModel(drive, (error,)), None, slowest / _RPM, fastest / _RPM, rotating=True, harmonics=12
    )
    if not bool(branch.complete):
        raise DataError("the response could not be followed to --fastest; narrow the range of speeds")
    bands = speeds_to_avoid(branch, limit)
    print(f"Natural frequency {float(drive.omega_0) / (2 * np.pi):.4g} Hz; kinematic error {size:.3g} rad.")
    for c in critical_speeds(drive):
        if slowest <= c.speed * _RPM <= fastest:
            print(f"  {c.speed * _RPM:8.1f} rpm  {c.kind} resonance of {c.order} cycles per revolution")
    print(f"Speeds to avoid (swing of the dynamic error above {limit:.3g} rad):" if bands else "No speed to avoid.")
    for b in bands:
        print(
            f"  {b.start * _RPM:.1f} to {b.end * _RPM:.1f} rpm, up to {b.amplitude:.3g} rad at "
            f"{b.speed_at_peak * _RPM:.1f} rpm, {b.order} cycles per revolution lead"
        )
    if out is not None:
        rows = [
            {
                "start_rpm": b.start * _RPM,
                "end_rpm": b.end * _RPM,
                "peak_rpm": b.speed_at_peak * _RPM,
                "swing": b.amplitude,
                "order": b.order,
            }
            for b in bands
        ]
        document = {"schema": "hdjax-speeds/1", "limit": limit, "avoid": rows}
        files: dict[Path, str | bytes] = {
            out / "speeds.json": json.dumps(document, indent=1) + "\n",
            out / "speeds.png": _png(speed_plot(branch, bands, limit)),
        }
        write_whole(files)
        print(f"Files: {', '.join(str(f) for f in files)}")


def _drive(preset: str, model: Path | None, values: dict[str, float | None]) -> Drive | ReducedDrive:
    """The drive that the options describe."""
    if preset not in PRESETS:
        raise InputError(f"--preset must be one of {', '.join(PRESETS)}, but is {preset}")
    drive = PRESETS[preset]() if model is None else read_model(model).model.drive
    for name, value in values.items():
        if value is None:
            continue
        if not hasattr(drive, name):
            raise InputError(f"{model}: a reduced model has no {name}; leave --{name} out")
        if not math.isfinite(value) or (name != "alpha" and value <= 0.0):
            raise InputError(f"--{name} must be a {'' if name == 'alpha' else 'positive '}number, but is {value}")
        drive = eqx.tree_at(lambda d, n=name: getattr(d, n), drive, as_scalar(value))
    return drive


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
    from hdjax.response.amplitudes import error_map
    from hdjax.response.continuation import folds, frequency_response
    from hdjax.response.multiple_scales import PrimaryResonance
    from hdjax.response.plots import error_map_plot, frequency_response_plot
    from hdjax.response.resonance import backbone, peak

    model = ReducedModel(ReducedDrive(mu=drive.mu, omega_0=drive.omega_0, alpha=drive.alpha))
    omega_0 = float(drive.omega_0)
    branch = frequency_response(model, harmonic_series(1.0, A), 0.2 * omega_0, 2.5 * omega_0)
    omegas = np.linspace(0.6, 1.6, 400) * omega_0
    top = peak(branch)
    figure = frequency_response_plot(
        branch,
        folds=folds(branch),
        peak=top,
        backbone=backbone(model, jnp.linspace(0.01, 1.0, 100) * top.amplitude),
        analytic=(omegas, jax.vmap(PrimaryResonance(drive, A).branches)(jnp.asarray(omegas))),
    )
    zeta = float(drive.mu) / omega_0
    errors = error_map(
        "primary", np.linspace(-0.3, 0.3, 61), np.geomspace(1e-4, 1.0, 41) * (-1) ** (float(drive.alpha) < 0), zeta
    )
    title = "Primary resonance: error of multiple scales in the largest |x|"
    return {
        "frequency_response.png": figure,
        "error_map.png": error_map_plot(errors, title=title, strength="$\\alpha a^2$"),
    }


def _png(figure: Any) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()
