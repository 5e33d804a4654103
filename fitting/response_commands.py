"""The commands that need no log: `hdjax amplitudes | seed-tables | speeds`."""

import dataclasses
import json
import math
import os
from collections.abc import Collection
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any

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
from hdjax.effects import Effect
from hdjax.parameters import as_scalar

_RPM = 30.0 / math.pi
_BEYOND = 10.0  # times the natural frequency: the last resonance, a sub-harmonic, is at three times it


@Parameter(name="*")
@dataclasses.dataclass(frozen=True)
class DriveOptions:
    """Which drive a command works on.

    Attributes:
        preset: Name of a drive with published parameters.
        model: model.json of a report, in place of a preset. Of its effects only `speeds` uses one, the kinematic error.
        K: Torsional stiffness [N m/rad] in place of the drive's own.
        alpha: Cubic stiffness coefficient [rad^-2] in place of the drive's own.
        B_sp: Mesh damping [N m s/rad] in place of the drive's own.
    """

    preset: str = "HDC-40-050"
    model: Path | None = None
    K: Annotated[float | None, Parameter(name="--K")] = None
    alpha: Annotated[float | None, Parameter(name="--alpha")] = None
    B_sp: Annotated[float | None, Parameter(name="--B_sp")] = None

    def read(self) -> tuple[Drive | ReducedDrive, tuple[Effect, ...]]:
        """The drive, and the effects of its model."""
        if self.preset not in PRESETS:
            raise InputError(f"--preset must be one of {', '.join(PRESETS)}, but is {self.preset}")
        stored = None if self.model is None else read_model(self.model).model
        drive, effects = (PRESETS[self.preset](), ()) if stored is None else (stored.drive, stored.effects)
        for name in ("K", "alpha", "B_sp"):
            value = getattr(self, name)
            if value is None:
                continue
            if not hasattr(drive, name):
                raise InputError(f"{self.model}: a reduced model has no {name}; leave --{name} out")
            require_number(f"--{name}", value, positive=name != "alpha")
            drive = dataclasses.replace(drive, **{name: value})
        if not float(drive.mu) > 0.0:
            raise InputError("the drive has no damping, and so no steady response; give --B_sp or another --model")
        return drive, effects


def require_number(name: str, value: float, *, positive: bool = True) -> None:
    """Refuse what is no number, or not above zero.

    Raises:
        InputError: that names the option.
    """
    if not math.isfinite(value) or (positive and value <= 0.0):
        raise InputError(f"{name} must be a {'positive ' if positive else ''}number, but is {value:g}")


def require_folder(path: Path | None) -> None:
    """Refuse a folder that can't be written to, before minutes of work are done for it. Nothing is made.

    Raises:
        InputError: where it, or the place in which it would be made, is no folder or is not open for writing.
    """
    if path is None:
        return
    place = next(p for p in (path, *path.absolute().parents) if p.exists())
    if not place.is_dir():
        raise InputError(f"--out must be a folder, but {place} is a file")
    if not os.access(place, os.W_OK | os.X_OK):
        raise InputError(f"--out must be open for writing, but {place} is not; give another folder")


def amplitudes(
    *,
    drive: DriveOptions = DriveOptions(),
    motor_torque: float = 10.0,
    load_torque: float = 0.0,
    omega: Annotated[list[float] | None, Parameter(consume_multiple=True, negative="")] = None,
    out: Path | None = None,
) -> None:
    """Check the analytic amplitudes of the dynamic error against harmonic balance and time integration.

    Takes a minute or two, most of it compilation.

    Parameters
    ----------
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

    require_folder(out)
    require_number("--motor-torque", motor_torque, positive=False)
    require_number("--load-torque", load_torque, positive=False)
    if omega is not None and not omega:
        raise InputError("--omega must be followed by frequencies, but none is given")
    for w in omega or ():
        require_number("--omega", w)
    made, _ = drive.read()
    if isinstance(made, Drive):
        A = float(made.error_forcing(as_scalar(motor_torque), as_scalar(load_torque)))
    else:
        A = float(made.gain) * motor_torque
    if A == 0.0:
        raise InputError("--motor-torque and --load-torque must not cancel to zero")
    omega_0 = float(made.omega_0)
    frequencies = omega or [0.6 * omega_0, 1.7 * omega_0, omega_0 / 3, omega_0, 3 * omega_0]
    checks: list[AmplitudeCheck] = [check_amplitudes(made, A, w) for w in frequencies]
    files: dict[Path, str | bytes] = {}
    if out is not None:
        document = {
            "schema": "hdjax-amplitudes/1",
            "drive": {n: float(getattr(made, n)) for n in ("mu", "omega_0", "alpha")},
            "A": A,
            "checks": [{"omega": c.omega, "kind": c.kind, "motions": [_row(r) for r in c.rows]} for c in checks],
        }
        files[out / "amplitudes.json"] = json.dumps(document, indent=1, allow_nan=False) + "\n"
        files |= {out / name: _png(figure) for name, figure in _amplitude_pictures(made, A).items()}
        write_whole(files)
    _show_checks(made, A, checks)
    _show_files(files)


def seed_tables() -> None:
    """Recompute the seed document's Tables 1 to 4 and its figure beside what is printed, cell by cell."""
    from hdjax.response.seed_fit import best_fit_of_table_2
    from hdjax.response.seed_tables import as_text
    from hdjax.response.seed_tables import seed_tables as computed

    print(as_text(computed(), best_fit_of_table_2()))


def speeds(
    *,
    drive: DriveOptions = DriveOptions(),
    kinematic_error: float = 1.5e-4,
    slowest: float = 100.0,
    fastest: float = 3500.0,
    limit: float | None = None,
    out: Path | None = None,
) -> None:
    """Say which motor speeds to avoid: where the kinematic error's cycles meet the drive's natural frequency.

    Parameters
    ----------
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
    from hdjax.response.coexisting import from_both_ends
    from hdjax.response.critical_speeds import can_persist, critical_speeds, speeds_to_avoid
    from hdjax.response.plots import speed_plot

    require_folder(out)
    given = {"--kinematic-error": kinematic_error, "--slowest": slowest, "--fastest": fastest, "--limit": limit}
    for name, value in given.items():
        if value is not None:
            require_number(name, value)
    if not slowest < fastest:
        raise InputError(f"--slowest must be below --fastest, but they are {slowest:g} and {fastest:g} rpm")
    made, effects = drive.read()
    if not isinstance(made, Drive):
        raise InputError(
            f"{drive.model}: a reduced model has no motor speed; give a model of a drive with two inertias"
        )
    if fastest > _BEYOND * float(made.omega_0) * _RPM:
        raise InputError(
            f"--fastest must be below {_BEYOND * float(made.omega_0) * _RPM:.0f} rpm, where all resonances lie, "
            f"but is {fastest:g}"
        )
    own = [e for e in effects if isinstance(e, KinematicError)]
    error = own[0] if own else KinematicError(cos_2=kinematic_error)
    size = float(jnp.max(jnp.abs(error.error(jnp.linspace(0.0, 2 * jnp.pi, 256)))))
    limit = 3.0 * size if limit is None else limit
    if not limit > 0.0:
        raise InputError(f"{drive.model}: its kinematic error is zero; give a model with one, or none and a preset")
    orders = [n for n in KinematicError.orders if jnp.hypot(getattr(error, f"cos_{n}"), getattr(error, f"sin_{n}"))]

    model = TwoInertiaModel(made, (error,))
    branches = from_both_ends(model, None, slowest / _RPM, fastest / _RPM, rotating=True, harmonics=12)
    if not any(bool(b.complete) for b in branches):
        raise DataError(
            "the response could not be followed from --slowest to --fastest; narrow the range, or give more --B_sp"
        )
    bands = speeds_to_avoid(*branches, limit=limit)
    ranges = [np.asarray(b.omega)[np.asarray(can_persist(b))] * _RPM for b in branches]
    both = None if len(branches) == 1 else (float(ranges[1].min()), float(ranges[0].max()))
    files: dict[Path, str | bytes] = {}
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
        document = {"schema": "hdjax-speeds/1", "limit": limit, "avoid": rows, "two_motions_rpm": both}
        figure = speed_plot(*branches, bands=bands, limit=limit)
        files = {
            out / "speeds.json": json.dumps(document, indent=1, allow_nan=False) + "\n",
            out / "speeds.png": _png(figure),
        }
        write_whole(files)
    print(f"Natural frequency {float(made.omega_0) / (2 * math.pi):.4g} Hz; kinematic error {size:.3g} rad.")
    for c in critical_speeds(made, orders):
        if slowest <= c.speed * _RPM <= fastest:
            print(f"  {c.speed * _RPM:8.1f} rpm  {c.kind} resonance of {_cycles(c.order)}")
    print(f"Speeds to avoid (swing of the dynamic error above {limit:.3g} rad):" if bands else "No speed to avoid.")
    for b in bands:
        print(
            f"  {b.start * _RPM:.1f} to {b.end * _RPM:.1f} rpm, up to {b.amplitude:.3g} rad at "
            f"{b.speed_at_peak * _RPM:.1f} rpm, mostly {_cycles(b.order)}"
        )
    if both is not None:
        print(f"From {both[0]:.1f} to {both[1]:.1f} rpm two motions exist; a drive keeps the one that it comes with.")
    _show_files(files)


def _cycles(order: int) -> str:
    return f"{order} cycle{'' if order == 1 else 's'} per revolution"


def _show_files(files: Collection[Path]) -> None:
    if files:
        print(f"Files: {', '.join(str(f) for f in files)}")


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
    from hdjax.response.continuation import folds
    from hdjax.response.multiple_scales import PrimaryResonance
    from hdjax.response.plots import error_map_plot, frequency_response_plot
    from hdjax.response.resonance import backbone, peak

    model = ReducedModel(ReducedDrive(mu=drive.mu, omega_0=drive.omega_0, alpha=drive.alpha))
    omega_0 = float(drive.omega_0)
    branches = from_both_ends(model, harmonic_series(1.0, A), 0.2 * omega_0, 2.5 * omega_0)
    steady = [b for b in branches if bool(jnp.any(b.valid & b.stable))]
    if not steady:
        raise DataError("no steady motion was found to draw; give a smaller --motor-torque, or leave --out away")
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


def _png(figure: Any) -> bytes:
    buffer = BytesIO()
    figure.savefig(buffer, format="png", dpi=120)
    return buffer.getvalue()
