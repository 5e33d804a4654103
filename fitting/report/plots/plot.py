"""A figure with its position in the report."""

from dataclasses import dataclass
from typing import Any

Figure = dict[str, Any]


@dataclass(frozen=True)
class Plot:
    """A figure with its position in the report.

    Attributes:
        key: unique within a report; used as an element's id.
        section: "fit", "left_over", "look", "found" or "next".
        title: what it shows, as plain text.
        caption: how to read it, as plain text.
        figure: for plotly.js, finite numbers and nulls only.
    """

    key: str
    section: str
    title: str
    caption: str
    figure: Figure
