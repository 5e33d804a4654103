"""The drive of a command without a log."""

import dataclasses

from fitting.commands.options import DriveOptions, require_number
from fitting.errors import InputError
from fitting.stored_model import read_model
from hdjax import PRESETS, Drive, ReducedDrive
from hdjax.effects import Effect


def read_drive(options: DriveOptions) -> tuple[Drive | ReducedDrive, tuple[Effect, ...]]:
    """The drive, and the effects of its model.

    Raises:
        InputError: unknown preset, bad model or number, or a drive without damping.
    """
    if options.preset not in PRESETS:
        raise InputError(f"--preset must be one of {', '.join(PRESETS)}, but is {options.preset}")
    stored = None if options.model is None else read_model(options.model).model
    drive, effects = (PRESETS[options.preset](), ()) if stored is None else (stored.drive, stored.effects)
    for name in ("K", "alpha", "B_sp"):
        value = getattr(options, name)
        if value is None:
            continue
        if not hasattr(drive, name):
            raise InputError(f"{options.model}: a reduced model has no {name}; leave --{name} out")
        require_number(f"--{name}", value, positive=name != "alpha")
        drive = dataclasses.replace(drive, **{name: value})
    if not float(drive.mu) > 0.0:
        raise InputError("the drive has no damping, and so no steady response; give --B_sp or another --model")
    return drive, effects
