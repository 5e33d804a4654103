"""What the health gate has to say about a log."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Finding:
    """One observation about a log and what it does to a fit.

    Attributes:
        severity: "note" (good to know), "warning" (the fit suffers), "refusal" (no fit).
        what: What was seen, with the numbers.
        where: The column, and the rows or times where they matter.
        consequence: What it does to the fit, and the remedy where there is one.
    """

    severity: Literal["note", "warning", "refusal"]
    what: str
    where: str
    consequence: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.where}: {self.what}; {self.consequence}"
