"""Write the pages of `docs/`, or the parts of them between two marks, that are made from the code.

`make docs` runs this before it builds the site.
"""

import inspect
import math
import re
import sys
from pathlib import Path
from unittest import mock

from fitting.commands.main import app
from fitting.report.rules import rules_page
from fitting.report.separating import look_alikes
from hdjax.effects import (
    CATALOGUE,
    FAMILIES,
    ActuatorEffect,
    Effect,
    LoadSideEffect,
    MeshGeometryEffect,
    MeshTorqueEffect,
    MotorSideEffect,
    SensorEffect,
)
from hdjax.effects.signatures import SIGNATURES
from hdjax.parameters import ParameterInfo

DOCS = Path(__file__).parent
_BEGIN, _END = "<!-- generated -->\n", "<!-- end of generated -->"
_PLACES = {
    MotorSideEffect: "motor side",
    MeshTorqueEffect: "mesh torque",
    MeshGeometryEffect: "mesh geometry",
    LoadSideEffect: "load side",
    SensorEffect: "sensor",
    ActuatorEffect: "actuator",
}
# Sources that a reader can't look up.
_UNTOLD = {"EFFECTS", "assumed"}


def command_line() -> str:
    """The commands and their options, as `hdjax --help` has them."""
    # Usage lines begin with the name of the running program.
    with mock.patch.object(sys, "argv", ["hdjax"]):
        # The page has a title of its own, and one list of the commands is enough.
        text = app.generate_docs().removeprefix("# hdjax\n")
    return re.sub(r"## Table of Contents\n.*?(?=\*\*Commands\*\*)", "", text, flags=re.DOTALL)


def effects() -> str:
    """A table of the families, and of each its signature, forms with equations and parameters, and look-alikes."""
    rows = [f"| [{family}](#{family}) | {_names(family)} | {_places(family)} |" for family in FAMILIES]
    table = ["| family | forms | enter at |", "|---|---|---|", *rows, "", ""]
    return "\n".join(table) + "\n".join(_family(family) for family in FAMILIES)


def _names(family: str) -> str:
    return ", ".join(f"`{form.name}`" for form in CATALOGUE if form.family == family)


def _places(family: str) -> str:
    return ", ".join(dict.fromkeys(_place(form) for form in CATALOGUE if form.family == family))


def _family(family: str) -> str:
    forms = [form for form in CATALOGUE if form.family == family]
    alike = [f"- `{other}`: {experiment}" for other, experiment in look_alikes(family).items()]
    lines = [f"### {family}", "", f"*In the residual:* {SIGNATURES[family]}", ""]
    for form in forms:
        lines += [
            f"**`{form.name}`** ({_place(form)}{', with memory' if form.states else ''}). {_law(form)}",
            "",
            *_parameters(form),
            "",
        ]
    if alike:
        lines += ["*Look-alikes, and what separates them:*", "", *alike, ""]
    return "\n".join(lines)


def _place(form: type[Effect]) -> str:
    return next(name for base, name in _PLACES.items() if issubclass(form, base))


def _law(form: type[Effect]) -> str:
    # Links between classes are code here.
    return re.sub(r"\[(`[^`]+`)\]\[\]", r"\1", inspect.getdoc(form) or "").replace("\n", " ").replace("  ", " ")


def _parameters(form: type[Effect]) -> list[str]:
    known = [(f.name, f.metadata["parameter"]) for f in form.__dataclass_fields__.values() if "parameter" in f.metadata]
    rows = [f"| `{name}` | {info.unit} | {info.doc} | {_plausible(info)} | {_source(info)} |" for name, info in known]
    return ["| parameter | unit | meaning | real drives | source |", "|---|---|---|---|---|", *rows]


def _source(info: ParameterInfo) -> str:
    return "" if info.source in _UNTOLD else info.source


def _plausible(info: ParameterInfo) -> str:
    low, high = info.plausible
    if math.isinf(high):
        return ""
    return f"{low:g} to {high:g}" if low else f"up to {high:g}"


def between_marks(page: str, text: str) -> str:
    """A page with what stands between its marks replaced."""
    before, rest = page.split(_BEGIN)
    return f"{before}{_BEGIN}\n{text.strip()}\n\n{_END}{rest.split(_END)[1]}"


def generated() -> dict[Path, str]:
    """Each page that holds what is generated, as it should be."""
    pages = {DOCS / "reference" / "cli.md": command_line(), DOCS / "effects.md": effects()}
    made = {path: between_marks(path.read_text(encoding="utf-8"), text) for path, text in pages.items()}
    return made | {DOCS / "rules.md": rules_page()}


if __name__ == "__main__":
    for path, text in generated().items():
        path.write_text(text, encoding="utf-8")
