"""A fit's report on a terminal: plain text, in aligned columns."""

import math
import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

from fitting.formatting import open_interval, p_value, percent, plain
from fitting.report.outputs import in_words, others, outputs, principal
from fitting.report.parameters import parts_of
from fitting.report.posterior import QUANTILES
from fitting.report.proposal import next_lines

_WIDTH = 100
_INDENT = "    "
# Beyond these a number is written with a power of ten.
_SMALLEST, _LARGEST = 1e-4, 1e8
_VERDICTS = {"passed": "passed", "slight": "slight", "failed": "FAILED"}


def fit_lines(report: Mapping[str, Any]) -> list[str]:
    """The lines of the report.

    Args:
        report: from [`fitting.report.report_dict`][].
    """
    return [
        *_section("Result", _prose([report["summary"], *report["meaning"]])),
        *_section("Parameters", _parameters(report["before"])),
        *_section("Derived", _table(_derived_rows(report["before"]["derived"]), left=(0, 5))),
        *_section("Posterior", _posterior(report["posterior"], report["before"]["parameters"])),
        *_section("What this log can't tell", _prose(report["cannot_tell"])),
        *_section("The next experiment", _prose(next_lines(report))),
        *_section("Correlations above 0.1", _correlations(report["before"]["correlations"])),
        *_section("Goodness", _goodness(report)),
        *_section("Residual", _tests(report["residual_tests"])),
        *_section("Frequency response", _prose((report["frequency_response"] or {"says": ()})["says"])),
        *_section("Log health", _health(report["health"])),
    ]


def _section(head: str, lines: Sequence[str]) -> list[str]:
    """A heading and its lines; empty without lines."""
    return [f"[{head}]", *(f"{_INDENT}{line}".rstrip() for line in lines)] if lines else []


def _prose(sentences: Sequence[str]) -> list[str]:
    return [line for s in sentences for line in textwrap.wrap(s, _WIDTH, subsequent_indent="  ")]


def _parameters(account: Mapping[str, Any]) -> list[str]:
    entries = account["parameters"]
    rows = [["", "value", "std error", "%", "95 % interval", "start", "unit", ""]]
    for path, e in entries.items():
        rows.append([path, *_figures(e), plain(e["start"], 5), e["unit"], _flags(e)])
    return _table(rows, left=(0, 6, 7))


def _flags(entry: Mapping[str, Any]) -> str:
    flags = [entry["flag"].upper()] if entry["flag"] else []
    if entry["interval"] == "profile":
        flags.append("interval from profile")
    return ", ".join(flags)


def _derived_rows(derived: Mapping[str, Any]) -> list[list[str]]:
    rows = [["", "value", "std error", "%", "95 % interval", "unit"]]
    return rows + [[name, *_figures(e), e["unit"]] for name, e in derived.items()]


def _figures(entry: Mapping[str, Any]) -> list[str]:
    """Value, standard error, percent and interval, to the digits justified by the standard error."""
    ends = [e for e in entry["ci95"] if e is not None]
    value, std, *known = rounded([entry["value"], entry["std"], *ends], entry["std"])
    return [value, std, plain(entry["percent"], 2), open_interval(entry["ci95"]).format(*known)]


def _posterior(found: Mapping[str, Any] | None, parameters: Mapping[str, Any]) -> list[str]:
    """Quantiles by parameter, and whether the chains have converged; empty without draws."""
    if found is None:
        return []
    rows = [["", *(f"{100 * q:g} %" for q in QUANTILES), "R-hat", "effective", "unit"]]
    for path, e in found["parameters"].items():
        quantiles = rounded(list(e["quantiles"].values()), parameters[path]["std"])
        rows.append([path, *quantiles, plain(e["r_hat"]), plain(e["effective_samples"]), parameters[path]["unit"]])
    return _table(rows, left=(0, len(rows[0]) - 1)) + _prose([found["says"]])


def rounded(values: Sequence[float | None], std: float | None) -> list[str]:
    """Numbers to the second digit of their standard error."""
    largest = max((abs(v) for v in values if v is not None), default=0.0)
    if not std or not _SMALLEST < largest < _LARGEST:
        return [plain(v, 5) for v in values]
    digits = min(1 - math.floor(math.log10(std)), 12)
    return ["n/a" if v is None else f"{round(v, digits):.{max(digits, 0)}f}" for v in values]


def _correlations(correlations: Sequence[Mapping[str, Any]]) -> list[str]:
    return _table([[", ".join(c["between"]), f"{c['value']:+.3f}"] for c in correlations], left=(0,))


def _goodness(report: Mapping[str, Any]) -> list[str]:
    g, rmse, (output, unit, _) = report["goodness"], report["before"]["rmse"], principal(report)
    sides = parts_of(report)
    rows = [
        [f"free run, {output}", *sides, ""],
        ["fit", *(plain(g["fit_percent"][s]) for s in sides), "%"],
        ["rms error", *(plain(rmse[s]) for s in sides), unit],
        ["rms error / noise", *(plain(g["rmse_over_noise"][s], 3) for s in sides), ""],
    ]
    for other in others(report):
        errors = report["before"]["rmse_of_outputs"][other]
        rows.append([f"rms error of {in_words(other)}", *(plain(errors[s]) for s in sides), report["units"][other]])
    met = "converged" if g["converged"] else "NOT CONVERGED"
    samples = sum(log["samples"] for log in report["logs"])
    left = ", ".join(f"{output} {plain(v, 3)}" for output, v in g["error_over_noise"].items())
    test = sum(log["test"] for log in report["logs"])
    return _table(rows, left=(0, len(sides) + 1)) + _prose(
        [
            "measurement noise, rms: "
            + ", ".join(f"{in_words(o)} {plain(report['noise'][o])} {report['units'][o]}" for o in outputs(report)),
            f"{report['judged_on']} samples inside the 95 % band of the free runs: {_share(g['band_coverage'])}",
            f"residual of short simulations, in units of the noise: {left}",
            f"reduced chi-square {plain(g['reduced_chi_square'])}; log-likelihood {plain(g['log_likelihood'], 8)}, "
            f"AIC {plain(g['aic'], 8)}, BIC {plain(g['bic'], 8)}",
            f"{len(report['logs'])} log(s), {samples} samples, {test} of them test data; "
            f"{g['data']} numbers fitted by "
            f"{g['parameters']} parameters and {g['initial_states']} initial states",
            f"{g['iterations']} iterations ({met}); {g['substeps']} solver step(s) a sample; {report['hold']} hold",
            "residual evaluated by " + ", since ".join(filter(None, report["engine"].values())),
            "time: " + ", ".join(f"{stage} {seconds:.2g} s" for stage, seconds in report["seconds"].items()),
        ]
    )


def _share(value: float | None) -> str:
    return "n/a" if value is None else percent(value)


def _tests(tests: Sequence[Mapping[str, Any]]) -> list[str]:
    """A line per test, and a sentence for those that did not pass."""
    rows = [["test", "verdict", "p"]] + [[t["name"], _VERDICTS[t["verdict"]], p_value(t["p_value"])] for t in tests]
    return _table(rows, left=(0, 1, 2)) + _prose([t["says"] for t in tests if t["verdict"] != "passed"])


def _health(health: Sequence[Mapping[str, Any]]) -> list[str]:
    return _prose([health_line(h) for h in health])


def health_line(seen: Mapping[str, Any]) -> str:
    """A finding of the health check in one line."""
    return f"{seen['severity']}: {seen['log']}, {seen['where']}: {seen['what']}; {seen['consequence']}"


def _table(rows: Sequence[Sequence[str]], *, left: Sequence[int]) -> list[str]:
    """Rows in aligned columns, flush right except those named."""
    columns = []
    for i, column in enumerate(zip(*rows, strict=True)):
        width = max(map(len, column))
        columns.append([cell.ljust(width) if i in left else cell.rjust(width) for cell in column])
    return ["  ".join(row) for row in zip(*columns, strict=True)]
