"""The sweep file: which drive, which forcing, which points, and what is wanted of them."""

import dataclasses
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fitting.errors import InputError
from fitting.model_file import read_model
from hdjax import PRESETS, Harmonic, Model, TwoInertiaModel
from hdjax.effects import BY_NAME
from hdjax.sweep import Points, Request, drawn, spread_values
from hdjax.sweep.points import RULES
from hdjax.sweep.request import OUTPUTS

_SECTIONS = ("drive", "effects", "forcing", "axes", "sample", "sweep")
_FORCING = ("amplitude", "omega", "phase", "offset")
_RANGE = ("from", "to", "points", "spacing")
_SWEEP = tuple(f.name for f in dataclasses.fields(Request) if f.name != "points")


@dataclasses.dataclass(frozen=True)
class SweepFile:
    """What a sweep file asks for.

    Attributes:
        model: the equations.
        forcing: the motor torque, or a reduced drive's forcing.
        request: the points, and what is wanted.
    """

    model: Model
    forcing: Harmonic
    request: Request


def read_sweep_file(path: Path) -> SweepFile:
    """Read a sweep file.

    Raises:
        InputError: where it is missing or can't be understood; names the section and the key.
    """
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InputError(f"{path}: the sweep file can't be read ({error.strerror}); check the path") from error
    except ValueError as error:
        raise InputError(f"{path}: not a TOML file ({error})") from error
    _known(path, "", content, _SECTIONS)
    sections = {name: _table(path, name, content.get(name, {})) for name in _SECTIONS}
    try:
        model = _model(path, sections["drive"], sections["effects"])
        forcing = _forcing(path, sections["forcing"])
        settings = _settings(path, sections["sweep"])
        points = Points(_axes(path, sections["axes"]), _sample(path, sections["sample"]))
        return SweepFile(model, forcing, Request(points, **settings))
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: {error}") from error


def _model(path: Path, drive: dict[str, Any], effects: dict[str, Any]) -> Model:
    if "model" in drive:
        model = read_model(path.parent / str(drive["model"])).model
    else:
        preset = drive.get("preset", "HDC-40-050")
        if preset not in PRESETS:
            raise InputError(f"{path}: [drive] preset must be one of {', '.join(PRESETS)}, but is {preset}")
        model = TwoInertiaModel(PRESETS[preset]())
    own = {k: v for k, v in drive.items() if k not in ("preset", "model")}
    _known(path, "drive", own, [name for name in model.parameters() if "." not in name])
    model = model.replace({k: _number(path, f"[drive] {k}", v) for k, v in own.items()})
    for name, values in effects.items():
        if name not in BY_NAME:
            raise InputError(f"{path}: [effects.{name}] is no effect; there are {', '.join(BY_NAME)}")
        table = _table(path, f"effects.{name}", values)
        fields = [f for f in dataclasses.fields(BY_NAME[name]) if "parameter" in f.metadata]
        _known(path, f"effects.{name}", table, [f.name for f in fields])
        for f in fields:
            if f.default is dataclasses.MISSING and f.name not in table:
                raise InputError(f"{path}: [effects.{name}] must have `{f.name}`")
        numbers = {k: _number(path, f"[effects.{name}] {k}", v) for k, v in table.items()}
        model = model.with_effects(BY_NAME[name](**numbers))
    return model


def _forcing(path: Path, table: dict[str, Any]) -> Harmonic:
    _known(path, "forcing", table, _FORCING)
    numbers = {k: _number(path, f"[forcing] {k}", v) for k, v in table.items()}
    return Harmonic(**({"amplitude": 1.0, "omega": 1.0} | numbers))


def _settings(path: Path, table: dict[str, Any]) -> dict[str, Any]:
    """What is wanted of each point, of the right kinds."""
    _known(path, "sweep", table, _SWEEP)
    found: dict[str, Any] = {}
    for key, value in table.items():
        if key == "response":
            found[key] = _one_of(path, "[sweep] response", value, tuple(OUTPUTS))
        elif key == "outputs":
            if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
                raise InputError(f"{path}: [sweep] outputs must be a list of names, but is {value!r}")
            found[key] = tuple(value)
        elif key in ("windows", "seed"):
            number = _number(path, f"[sweep] {key}", value)
            if number != int(number) or number < 0:
                raise InputError(f"{path}: [sweep] {key} must be a whole number, but is {value!r}")
            found[key] = int(number)
        else:
            found[key] = _number(path, f"[sweep] {key}", value)
    return found


def _one_of(path: Path, where: str, value: object, names: tuple[str, ...]) -> Any:
    if value not in names:
        raise InputError(f"{path}: {where} must be one of {', '.join(names)}, but is {value!r}")
    return value


def _axes(path: Path, table: dict[str, Any]) -> dict[str, np.ndarray]:
    found = {}
    for name, values in table.items():
        if isinstance(values, list):
            found[name] = np.array([_number(path, f"[axes] {name}", v) for v in values])
            continue
        one = _table(path, f"axes.{name}", values)
        _known(path, f"axes.{name}", one, _RANGE)
        start, end, spacing = _range(path, f"axes.{name}", one)
        found[name] = spread_values(start, end, _count(path, f"axes.{name}", one), spacing)
    return found


def _sample(path: Path, table: dict[str, Any]) -> dict[str, np.ndarray]:
    if not table:
        return {}
    _known(path, "sample", table, ("points", "rule", "seed", "ranges"))
    ranges = _table(path, "sample.ranges", table.get("ranges", {}))
    if not ranges:
        raise InputError(f'{path}: [sample.ranges] must name a parameter, such as "K" = {{ from = 6e3, to = 8e3 }}')
    for name, one in ranges.items():
        _known(path, f"sample.ranges.{name}", _table(path, f"sample.ranges.{name}", one), ("from", "to", "spacing"))
    asked = {name: _range(path, f"sample.ranges.{name}", one) for name, one in ranges.items()}
    rule = _one_of(path, "[sample] rule", table.get("rule", RULES[0]), RULES)
    seed = int(_number(path, "[sample] seed", table.get("seed", 0)))
    return drawn(asked, _count(path, "sample", table), rule=rule, seed=seed)


def _range(path: Path, section: str, table: Mapping[str, Any]) -> tuple[float, float, Any]:
    for key in ("from", "to"):
        if key not in table:
            raise InputError(f"{path}: [{section}] must have `{key}`")
    spacing = table.get("spacing", "linear")
    if spacing not in ("linear", "log"):
        raise InputError(f"{path}: [{section}] spacing must be linear or log, but is {spacing}")
    start, end = (_number(path, f"[{section}] {key}", table[key]) for key in ("from", "to"))
    if spacing == "log" and not (start > 0.0 and end > 0.0):
        raise InputError(
            f"{path}: [{section}] must run from above zero for spacing log, but runs from {start} to {end}"
        )
    return start, end, spacing


def _count(path: Path, section: str, table: Mapping[str, Any]) -> int:
    points = table.get("points")
    if not isinstance(points, int) or isinstance(points, bool) or points < 1:
        raise InputError(f"{path}: [{section}] points must be a whole number above 0, but is {points}")
    return points


def _number(path: Path, where: str, value: object) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"{path}: {where} must be a number, but is {value!r}")
    return float(value)


def _table(path: Path, name: str, value: object) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise InputError(f"{path}: [{name}] must be a table, but is {value!r}")
    return value


def _known(path: Path, section: str, table: Mapping[str, Any], names: Any) -> None:
    for key in table:
        if key not in names:
            where = f"[{section}] {key}" if section else f"[{key}]"
            raise InputError(f"{path}: {where} is not known here; there are {', '.join(names)}")
