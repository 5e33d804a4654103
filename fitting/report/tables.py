"""The rows of the page's tables."""

from collections.abc import Mapping
from typing import Any

from fitting import formatting

# Symbol and meaning of quantities derived from a drive's parameters.
_FIGURES = {
    "omega_0": ("ω₀", "natural frequency at small twist"),
    "natural_frequency": ("f₀", "natural frequency at small twist"),
    "mu": ("μ", "damping of the twist"),
    "zeta": ("ζ", "damping ratio, μ / (2 ω₀)"),
    "nonlinear_share": ("α x²", "cubic share of the restoring torque at the largest measured twist"),
    "stiffness_at_full_twist": ("K(1 + 3 α x²)", "stiffness at the largest measured twist"),
}
# Without inertias the restoring torque is known only over the inertia.
_OF_A_REDUCED_LOG = {
    "stiffness_at_full_twist": ("ω₀²(1 + 3 α x²)", "slope of the restoring acceleration at the largest measured twist")
}


def parameter_rows(report: Mapping[str, Any], final: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The drive's parameters and derived quantities, each in a suitable unit."""
    rows = []
    entries = [(p, p, e["description"], "parameters", e) for p, e in final["parameters"].items()]
    figures = _FIGURES if "K" in final["parameters"] else _FIGURES | _OF_A_REDUCED_LOG
    entries += [(k, *figures[k], "derived", e) for k, e in final["derived"].items()]
    for key, symbol, meaning, kind, estimate in entries:
        factor, unit = formatting.scaled_unit(abs(estimate["value"] or 0.0), estimate["unit"])
        before = report["before"][kind][key]
        rows.append(
            {
                "path": key,
                "symbol": symbol,
                "derived": kind == "derived",
                "meaning": meaning,
                "unit": unit,
                "factor": factor,
                "before": before,
                "final": estimate,
                "flag": estimate["flag"] if kind == "parameters" else None,
            }
        )
    return rows


def changes(report: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The drive's parameters without and with the accepted effects."""
    if not report["after"]["effects"]:
        return []
    rows = []
    for path, with_it in report["after"]["parameters"].items():
        without = report["before"]["parameters"].get(path)
        if without is None or None in (without["value"], with_it["value"]):
            continue
        change = with_it["value"] - without["value"]
        rows.append(
            {
                "path": path,
                "without": without,
                "with": with_it,
                "relative": change / abs(without["value"]) if without["value"] else None,
                "in_std": change / without["std"] if without["std"] else None,
            }
        )
    return rows
