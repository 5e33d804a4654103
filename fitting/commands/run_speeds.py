"""Implementation of `hdjax speeds`."""

import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from fitting.commands.chosen_drive import read_drive
from fitting.commands.options import DriveOptions
from fitting.commands.pictures import png, show_files
from fitting.commands.spinner import spinning
from fitting.errors import DataError, InputError
from fitting.files import write_whole
from hdjax import Drive, TwoInertiaModel
from hdjax.effects import MeshGeometryEffect
from hdjax.effects.kinematic import KinematicError, KinematicHarmonic
from hdjax.response.coexisting import from_both_ends
from hdjax.response.continuation import Branch
from hdjax.response.critical_speeds import SpeedBand, can_persist, critical_speeds, speeds_to_avoid
from hdjax.response.plots import speed_plot

_RPM = 30.0 / math.pi
_SMALLEST_LINE = 0.01  # of the largest line of an error; smaller ones of a learned error are its noise (assumed)
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
    own = tuple(e for e in effects if isinstance(e, MeshGeometryEffect)) or (KinematicError(cos_2=kinematic_error),)
    over = [e.name for e in own if "theta_l" in e.angles or (isinstance(e, KinematicHarmonic) and not e.repeats())]
    if over:
        raise InputError(
            f"{drive.model}: {over[0]} does not repeat with the motor's revolution; give a model without it"
        )
    around = jnp.linspace(0.0, 2 * jnp.pi, 4096, endpoint=False)
    whole = np.asarray(sum(jax.vmap(error.error)(around) for error in own))
    size = float(np.max(np.abs(whole)))
    if not size > 0.0:
        raise InputError(f"{drive.model}: its kinematic error is zero; give a model with one, or none and a preset")
    limit = 3.0 * size if limit is None else limit
    orders = _orders(whole)
    model = TwoInertiaModel(made, own)
    with spinning("following the response over the speed"):
        branches = from_both_ends(
            model, None, slowest / _RPM, fastest / _RPM, rotating=True, harmonics=max(12, 2 * orders[-1])
        )
    if not any(bool(b.complete) for b in branches):
        raise DataError(
            "the response could not be followed from --slowest to --fastest; narrow the range, or give more --B_sp"
        )
    bands = speeds_to_avoid(*branches, limit=limit)
    both = _coexisting(branches)
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


def _orders(error: np.ndarray) -> list[int]:
    """Cycles of a kinematic error in a revolution of the motor: of every line above a share of the largest."""
    lines = np.abs(np.fft.rfft(error))[1:]
    return [int(n) for n in np.flatnonzero(lines > _SMALLEST_LINE * lines.max()) + 1]


def _coexisting(branches: Sequence[Branch]) -> tuple[float, float] | None:
    """The widest range of motor speeds [rpm] with two motions that can persist; None without any."""
    ranges = []
    for branch in branches:
        rows = np.flatnonzero(can_persist(branch))
        for run in np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1):
            if run.size:
                speeds = np.asarray(branch.omega)[run] * _RPM
                ranges.append((float(speeds.min()), float(speeds.max())))
    both = [(max(a[0], b[0]), min(a[1], b[1])) for a, b in itertools.combinations(ranges, 2)]
    return max((pair for pair in both if pair[0] < pair[1]), key=lambda pair: pair[1] - pair[0], default=None)


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
