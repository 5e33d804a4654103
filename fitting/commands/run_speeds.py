"""Implementation of `hdjax speeds`."""

import json
import math
from collections.abc import Sequence
from pathlib import Path

import jax.numpy as jnp
import numpy as np

from fitting.commands.chosen_drive import read_drive
from fitting.commands.options import DriveOptions
from fitting.commands.pictures import png, show_files
from fitting.commands.spinner import spinning
from fitting.errors import DataError, InputError
from fitting.files import write_whole
from hdjax import Drive, TwoInertiaModel
from hdjax.effects.kinematic import KinematicError
from hdjax.response.coexisting import from_both_ends
from hdjax.response.critical_speeds import SpeedBand, can_persist, critical_speeds, speeds_to_avoid
from hdjax.response.plots import speed_plot

_RPM = 30.0 / math.pi
_BEYOND = 10.0  # times the natural frequency: the last resonance, a sub-harmonic, is at three times it


def show_speeds(
    drive: DriveOptions,
    kinematic_error: float,
    slowest: float,
    fastest: float,
    limit: float | None,
    out: Path | None,
) -> None:
    """Find the motor speeds to avoid, write them, and print them.

    Args:
        drive: its options.
        kinematic_error: amplitude [rad] where the model has none.
        slowest: motor speed [rpm].
        fastest: motor speed [rpm].
        limit: amplitude of the dynamic error [rad], or None.
        out: folder, or None.

    Raises:
        InputError: bad drive, or speeds beyond all resonances.
        DataError: the response can't be computed by continuation.
    """
    made, effects = read_drive(drive)
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
    with spinning("following the response over the speed"):
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
        document = {"schema": "hdjax-speeds/1", "limit": limit, "avoid": _rows(bands), "two_motions_rpm": both}
        figure = speed_plot(*branches, bands=bands, limit=limit)
        files = {
            out / "speeds.json": json.dumps(document, indent=1, allow_nan=False) + "\n",
            out / "speeds.png": png(figure),
        }
        write_whole(files)
    print(f"Natural frequency {float(made.omega_0) / (2 * math.pi):.4g} Hz; kinematic error {size:.3g} rad.")
    for c in critical_speeds(made, orders):
        if slowest <= c.speed * _RPM <= fastest:
            print(f"  {c.speed * _RPM:8.1f} rpm  {c.kind} resonance of {_cycles(c.order)}")
    print(f"Speeds to avoid (amplitude of the dynamic error above {limit:.3g} rad):" if bands else "No speed to avoid.")
    for b in bands:
        print(
            f"  {b.start * _RPM:.1f} to {b.end * _RPM:.1f} rpm, up to {b.amplitude:.3g} rad at "
            f"{b.speed_at_peak * _RPM:.1f} rpm, mostly {_cycles(b.order)}"
        )
    if both is not None:
        print(
            f"From {both[0]:.1f} to {both[1]:.1f} rpm two motions exist; which one occurs depends on the initial state."
        )
    show_files(files)


def _rows(bands: Sequence[SpeedBand]) -> list[dict[str, float]]:
    """The bands as JSON content."""
    return [
        {
            "start_rpm": b.start * _RPM,
            "end_rpm": b.end * _RPM,
            "peak_rpm": b.speed_at_peak * _RPM,
            "swing": b.amplitude,
            "order": b.order,
        }
        for b in bands
    ]


def _cycles(order: int) -> str:
    return f"{order} cycle{'' if order == 1 else 's'} per revolution"
