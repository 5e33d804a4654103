"""Reasons of a decision: every rule with its statistic and threshold."""

from collections.abc import Sequence
from typing import Any

from fitting.attribution.decisions import Check
from fitting.attribution.rules import rules_table

# A threshold per form, in the code of the effect; and a test whose statistic and threshold are not the rule's p-value.
_APPLIED = {
    "imperfection": {
        "unit": "share of rms",
        "meaning": "what earlier effects' laws may leave, relative to what they removed",
    },
    "tie_level": {
        "unit": "standard errors",
        "meaning": "largest mean difference to the best one, over blocks, at which a candidate is tied with it",
    },
}


def rules_dict(checks: Sequence[Check]) -> list[dict[str, Any]]:
    """The applied rules, in the order of the loop.

    Args:
        checks: of a decision.
    """
    known = {rule["name"]: rule for rule in rules_table()} | _APPLIED
    return [_entry(check, known.get(check.rule, {})) for check in checks]


def _entry(check: Check, rule: dict[str, Any]) -> dict[str, Any]:
    return {
        "name": check.rule,
        "about": check.about,
        "statistic": check.statistic,
        "threshold": check.threshold,
        "outcome": "holds" if check.holds else "fails",
        "unit": rule.get("unit", ""),
        "meaning": rule.get("meaning", ""),
    }


def rules_page() -> str:
    """The rules as a page of Markdown."""
    rows = [
        f"| `{rule['name']}` | {rule['threshold']:g} | {rule['unit']} | {rule['meaning']} | {rule['source']} |"
        for rule in rules_table()
    ]
    return "\n".join(
        [
            "# Rules of decision",
            "",
            "Thresholds of all decisions of a loop (`fitting/attribution/rules.py`). A report has each rule with its",
            "statistic and its outcome, under `rules` and in the section *Why this decision*. There is one more rule,",
            "`imperfection`. Each form of an effect states what its law may get wrong, as a share of what it has",
            "removed. A further effect must remove `law_errors` times as much, unless it leaves only noise.",
            "",
            "| rule | threshold | unit | meaning | source |",
            "|---|---|---|---|---|",
            *rows,
            "",
        ]
    )
