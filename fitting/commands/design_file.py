"""The design file: drive, variables, objective, limits and uncertainty."""

import dataclasses
from pathlib import Path
from typing import Any

from fitting.commands.model_sections import SOURCES, stated_model, stated_range, with_stated_effects
from fitting.commands.parameter_draws import drawn_from_report, fitted_model, spread_around
from fitting.logs.toml_sections import Sections
from hdjax import TwoInertiaModel
from hdjax.design import MEASURES, Case, Draws, Excitation, Limit, Measure, Replaced, Study, Term, Variable
from hdjax.design.catalogue_gear import SIZE, CatalogueGear
from hdjax.design.robustness import CRITERIA
from hdjax.design.variables import SPACINGS
from hdjax.parameters import ParameterInfo

_SECTIONS = ("drive", "effects", "forcing", "variables", "objective", "limits", "robust", "search")
_ROBUST = ("report", "spread", "hold", "draws", "criterion", "share", "seed")


@dataclasses.dataclass(frozen=True)
class Search:
    """Settings of the search and its confirmation; see [`hdjax.design.optimise`][] and [`hdjax.design.confirm`][]."""

    starts: int = 8
    seed: int = 0
    width: float = 0.1
    points: int = 9


@dataclasses.dataclass(frozen=True)
class DesignFile:
    """Content of a design file.

    Attributes:
        study: the study.
        search: its settings.
    """

    study: Study
    search: Search


def read_design_file(path: Path) -> DesignFile:
    """Read a design file.

    Raises:
        InputError: it is missing or not understood; names section and key.
        DataError: draws are requested from a report whose log does not determine a parameter.
    """
    file = Sections(path, _SECTIONS)
    try:
        case = Case(_model(file), _excitation(file))
        variables = _variables(file)
        terms = tuple(
            Term(
                label,
                _measure(file, "objective", label, table, ("weight",)),
                file.number(f"objective.{label}", "weight", table.get("weight", 1.0)),
            )
            for label, table in _tables(file, "objective")
        )
        limits = tuple(_limit(file, label, table) for label, table in _tables(file, "limits"))
        robust = file.section("robust")
        study = Study(
            case,
            variables,
            terms,
            limits,
            _draws(file, case, robust),
            file.one_of("robust", "criterion", robust.get("criterion", "worst"), CRITERIA),
            file.number("robust", "share", robust.get("share", 0.05)),
            CatalogueGear() if SIZE in {v.path for v in variables} else Replaced(),
        )
        if isinstance(study.maker, CatalogueGear) and study.draws and {"K", "alpha"} & {*study.draws.paths}:
            raise file.refuse(
                f"[robust] K and alpha follow from `{SIZE}`: leave them out of spread, or name them in hold"
            )
        study.refuse()
        return DesignFile(study, _search(file))
    except (TypeError, ValueError) as error:
        if type(error) in (TypeError, ValueError):
            raise file.refuse(str(error)) from error
        raise


def _model(file: Sections) -> TwoInertiaModel:
    drive, robust = file.section("drive"), file.section("robust")
    if "model" not in drive and "report" in robust:
        model = fitted_model(file.path.parent / str(robust["report"]))
    else:
        model = stated_model(file)
    if not isinstance(model, TwoInertiaModel):
        raise file.refuse("[drive] model is a reduced model, which has no inertias to design; give one of both angles")
    own = {k: v for k, v in drive.items() if k not in SOURCES}
    names = {name: info for name, (_, info) in model.parameters().items() if "." not in name}
    file.known("drive", own, (*SOURCES, *names))
    changed = model.replace({k: _within(file, "drive", k, v, names[k]) for k, v in own.items()})
    changed = with_stated_effects(file, changed)
    assert isinstance(changed, TwoInertiaModel)
    return changed


def _within(file: Sections, section: str, key: str, value: object, info: ParameterInfo) -> float:
    """A number inside a parameter's bounds."""
    found, (low, high) = file.number(section, key, value), info.bounds
    if not low < found < high:
        raise file.refuse(f"[{section}] {key} must be between {low:g} and {high:g}, but is {found:g}")
    return found


def _excitation(file: Sections) -> Excitation:
    names = [f.name for f in dataclasses.fields(Excitation)]
    return Excitation(**file.numbers("forcing", file.section("forcing"), names))


def _variables(file: Sections) -> tuple[Variable, ...]:
    found = []
    for name, value in file.section("variables").items():
        where = f"variables.{name}"
        table = file.table(where, value)
        file.known(where, table, ("from", "to", "spacing"))
        low, high = stated_range(file, where, table)
        spacing = file.one_of(where, "spacing", table.get("spacing", "linear"), SPACINGS)
        found.append(Variable(name, low, high, spacing))
    if not found:
        raise file.refuse('[variables] must name the design variables, such as "B_sp" = { from = 0.1, to = 10.0 }')
    return tuple(found)


def _tables(file: Sections, section: str) -> list[tuple[str, dict[str, Any]]]:
    found = [(label, file.table(f"{section}.{label}", value)) for label, value in file.section(section).items()]
    if section == "objective" and not found:
        raise file.refuse("[objective] must name what to minimise, such as [objective.peak_error]")
    return found


def _measure(file: Sections, section: str, label: str, table: dict[str, Any], beside: tuple[str, ...]) -> Measure:
    """The measure that a table names, or that its name states, with its arguments."""
    where = f"{section}.{label}"
    name = table.get("measure", label)
    if name not in MEASURES:
        raise file.refuse(f"[{where}] measure must be one of {', '.join(MEASURES)}, but is {name!r}")
    kind = MEASURES[name]
    fields = {f.name: f for f in dataclasses.fields(kind)}
    given = {k: v for k, v in table.items() if k not in ("measure", *beside)}
    file.known(where, given, (*fields, "measure", *beside))
    file.needs(where, given, [n for n, f in fields.items() if f.default is dataclasses.MISSING])
    return kind(**{k: _argument(file, where, k, v, fields[k].default) for k, v in given.items()})


def _argument(file: Sections, where: str, key: str, value: object, default: object) -> Any:
    """A measure's number, count or switch, of the type of its default."""
    if isinstance(default, bool):
        if not isinstance(value, bool):
            raise file.refuse(f"[{where}] {key} must be true or false, but is {value!r}")
        return value
    return file.count(where, key, value) if isinstance(default, int) else file.number(where, key, value)


def _limit(file: Sections, label: str, table: dict[str, Any]) -> Limit:
    sides = [key for key in ("at_most", "at_least") if key in table]
    if len(sides) != 1:
        raise file.refuse(f"[limits.{label}] must have one of `at_most` and `at_least`")
    (side,) = sides
    measure = _measure(file, "limits", label, table, ("at_most", "at_least"))
    return Limit(label, measure, file.number(f"limits.{label}", side, table[side]), side == "at_least")


def _draws(file: Sections, case: Case, table: dict[str, Any]) -> Draws | None:
    file.known("robust", table, _ROBUST)
    if not table:
        return None
    count = file.count("robust", "draws", table.get("draws", 32), 2)
    seed = file.count("robust", "seed", table.get("seed", 0), 0)
    if ("report" in table) == ("spread" in table):
        raise file.refuse("[robust] must have one of `report`, the folder of a fit, and `spread`")
    if "report" in table:
        hold = table.get("hold", [])
        if not isinstance(hold, list) or not all(isinstance(h, str) for h in hold):
            raise file.refuse(f"[robust] hold must be a list of parameters, but is {hold!r}")
        return drawn_from_report(file.path.parent / str(table["report"]), count, hold=hold, seed=seed)
    spreads = {k: file.number("robust.spread", k, v) for k, v in file.table("robust.spread", table["spread"]).items()}
    values = {name: float(value) for name, (value, _) in case.parameters().items()}
    file.known("robust.spread", spreads, values)
    for name, spread in spreads.items():
        if not 0.0 < spread < 1.0 or values[name] == 0.0:
            raise file.refuse(f"[robust.spread] {name} must be between 0 and 1 and of a value other than zero")
    if not spreads:
        raise file.refuse("[robust.spread] must name a parameter, such as K = 0.05")
    return spread_around(values, spreads, count, seed)


def _search(file: Sections) -> Search:
    table = file.section("search")
    file.known("search", table, [f.name for f in dataclasses.fields(Search)])
    least = {"starts": 1, "points": 2, "seed": 0}
    counts = {k: file.count("search", k, v, least[k]) for k, v in table.items() if k in least}
    width = file.number("search", "width", table.get("width", Search.width))
    if not 0.0 < width <= 1.0:
        raise file.refuse(f"[search] width must be above 0 and at most 1, but is {width:g}")
    return Search(**counts, width=width)
