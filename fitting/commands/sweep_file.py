"""The sweep file: drive, forcing, points and outputs."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from fitting.commands.model_sections import SOURCES, stated_model, stated_range, with_stated_effects
from fitting.errors import InputError
from fitting.logs.toml_sections import Sections
from hdjax import Harmonic, Model
from hdjax.sweep import Points, Request, drawn, spread_values
from hdjax.sweep.points import RULES
from hdjax.sweep.request import OUTPUTS

_SECTIONS = ("drive", "effects", "forcing", "axes", "sample", "sweep")
_FORCING = ("amplitude", "omega", "phase", "offset")
_RANGE = ("from", "to", "points", "spacing")
_SWEEP = tuple(f.name for f in dataclasses.fields(Request) if f.name != "points")


@dataclasses.dataclass(frozen=True)
class SweepFile:
    """Content of a sweep file.

    Attributes:
        model: the equations.
        forcing: the motor torque, or a reduced drive's forcing.
        request: the points and outputs.
    """

    model: Model
    forcing: Harmonic
    request: Request


def read_sweep_file(path: Path) -> SweepFile:
    """Read a sweep file.

    Raises:
        InputError: it is missing or not understood; names section and key.
    """
    file = Sections(path, _SECTIONS)
    sections = {name: file.section(name) for name in _SECTIONS}
    try:
        model = _model(file)
        forcing = _forcing(file, sections["forcing"])
        settings = _settings(file, sections["sweep"])
        points = Points(_axes(file, sections["axes"]), _sample(file, sections["sample"]))
        return SweepFile(model, forcing, Request(points, **settings))
    except (TypeError, ValueError) as error:
        if isinstance(error, InputError):
            raise
        raise file.refuse(f"{error}") from error


def _model(file: Sections) -> Model:
    model = stated_model(file)
    own = {k: v for k, v in file.section("drive").items() if k not in SOURCES}
    numbers = file.numbers("drive", own, [name for name in model.parameters() if "." not in name])
    return with_stated_effects(file, model.replace(numbers))


def _forcing(file: Sections, table: dict[str, Any]) -> Harmonic:
    return Harmonic(**({"amplitude": 1.0, "omega": 1.0} | file.numbers("forcing", table, _FORCING)))


def _settings(file: Sections, table: dict[str, Any]) -> dict[str, Any]:
    """Settings of a sweep, with their types checked."""
    file.known("sweep", table, _SWEEP)
    found: dict[str, Any] = {}
    for key, value in table.items():
        if key == "response":
            found[key] = file.one_of("sweep", "response", value, tuple(OUTPUTS))
        elif key == "outputs":
            if not isinstance(value, list) or not all(isinstance(v, str) for v in value):
                raise file.refuse(f"[sweep] outputs must be a list of names, but is {value!r}")
            found[key] = tuple(value)
        elif key in ("windows", "seed"):
            found[key] = file.count("sweep", key, value, least=0)
        else:
            found[key] = file.number("sweep", key, value)
    return found


def _axes(file: Sections, table: dict[str, Any]) -> dict[str, np.ndarray]:
    found = {}
    for name, values in table.items():
        if isinstance(values, list):
            found[name] = np.array([file.number("axes", name, v) for v in values])
            continue
        one = file.table(f"axes.{name}", values)
        file.known(f"axes.{name}", one, _RANGE)
        start, end, spacing = _range(file, f"axes.{name}", one)
        found[name] = spread_values(start, end, file.count(f"axes.{name}", "points", one.get("points")), spacing)
    return found


def _sample(file: Sections, table: dict[str, Any]) -> dict[str, np.ndarray]:
    if not table:
        return {}
    file.known("sample", table, ("points", "rule", "seed", "ranges"))
    ranges = file.table("sample.ranges", table.get("ranges", {}))
    if not ranges:
        raise file.refuse('[sample.ranges] must name a parameter, such as "K" = { from = 6e3, to = 8e3 }')
    for name, one in ranges.items():
        file.known(f"sample.ranges.{name}", file.table(f"sample.ranges.{name}", one), ("from", "to", "spacing"))
    asked = {name: _range(file, f"sample.ranges.{name}", one) for name, one in ranges.items()}
    rule = file.one_of("sample", "rule", table.get("rule", RULES[0]), RULES)
    seed = file.count("sample", "seed", table.get("seed", 0), least=0)
    return drawn(asked, file.count("sample", "points", table.get("points")), rule=rule, seed=seed)


def _range(file: Sections, section: str, table: Mapping[str, Any]) -> tuple[float, float, Any]:
    start, end = stated_range(file, section, table)
    spacing = table.get("spacing", "linear")
    if spacing not in ("linear", "log"):
        raise file.refuse(f"[{section}] spacing must be linear or log, but is {spacing}")
    if spacing == "log" and not (start > 0.0 and end > 0.0):
        raise file.refuse(f"[{section}] must run from above zero for spacing log, but runs from {start} to {end}")
    return start, end, spacing
