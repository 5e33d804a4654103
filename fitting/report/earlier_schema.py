"""Names of report schema 1, kept beside the new ones for one version, for compatibility."""

from typing import Any

# Held-out or validation data are now test data, or selection data where there are none.
_RENAMED = {
    "gain": "validation_gain",
    "selection_rmse": "validation_rmse",
    "selection_rmse_of_found": "validation_rmse_of_found",
    "selection_segments_rmse": "held_out_rmse",
}


def with_old_names(report: dict[str, Any]) -> dict[str, Any]:
    """The report with the old names beside the new ones.

    Args:
        report: of the present schema.
    """
    on = report["judged_on"]
    for stage in ("before", "after"):
        for name in ("rmse", "rmse_motor_angle"):
            report[stage][name]["validation"] = report[stage][name][on]
    if report.get("goodness"):
        for name in ("fit_percent", "rmse_over_noise"):
            report["goodness"][name]["validation"] = report["goodness"][name][on]
    for log in report["logs"]:
        log["held_out"] = log.get(on, 0)
    entries = [*report["after"]["effects"], *report["alternatives"], *report["steps"], report.get("unknown") or {}]
    for entry in entries:
        entry |= {old: entry[new] for new, old in _RENAMED.items() if new in entry}
    return report
