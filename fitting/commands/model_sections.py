"""Sections of sweep and design files that state a model: `[drive]`, `[effects]`, and ranges of parameters."""

import dataclasses
from collections.abc import Mapping
from typing import Any

from fitting.logs.toml_sections import Sections
from fitting.stored_model import read_model
from hdjax import PRESETS, Model, TwoInertiaModel
from hdjax.effects import BY_NAME

SOURCES = ("preset", "model")
"""Keys of `[drive]` that are not parameters."""


def stated_model(file: Sections) -> Model:
    """The base of `[drive]`: a `model.json` of a report, or a preset."""
    drive = file.section("drive")
    if "model" in drive:
        return read_model(file.path.parent / str(drive["model"])).model
    return TwoInertiaModel(PRESETS[file.one_of("drive", "preset", drive.get("preset", "HDC-40-050"), PRESETS)]())


def with_stated_effects(file: Sections, model: Model) -> Model:
    """The model with the effects of `[effects]`."""
    for name, values in file.section("effects").items():
        where = f"effects.{name}"
        if name not in BY_NAME:
            raise file.refuse(f"[{where}] is not an effect; known are {', '.join(BY_NAME)}")
        table = file.table(where, values)
        fields = {f.name: f for f in dataclasses.fields(BY_NAME[name]) if "parameter" in f.metadata}
        numbers = file.numbers(where, table, fields)
        file.needs(where, table, [n for n, f in fields.items() if f.default is dataclasses.MISSING])
        for key, value in numbers.items():
            low, high = fields[key].metadata["parameter"].bounds
            if not low <= value <= high:
                raise file.refuse(f"[{where}] {key} must lie within {low:g} to {high:g}, but is {value:g}")
        model = model.with_effects(BY_NAME[name](**numbers))
    return model


def stated_range(file: Sections, section: str, table: Mapping[str, Any]) -> tuple[float, float]:
    """Lower and upper end of a range."""
    file.needs(section, table, ("from", "to"))
    return file.number(section, "from", table["from"]), file.number(section, "to", table["to"])
