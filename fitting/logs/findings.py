"""Findings of the health check."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """An observation on a log and its effect on a fit.

    Attributes:
        severity: "note" (good to know), "warning" (the fit suffers), "refusal" (no fit).
        what: The observation, with numbers.
        where: The column, and rows or times where relevant.
        consequence: Its effect on the fit, and a remedy if any.
    """

    severity: Literal["note", "warning", "refusal"]
    what: str
    where: str
    consequence: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.where}: {self.what}; {self.consequence}"
