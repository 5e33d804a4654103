"""How templates become pages that read without a network."""

from collections.abc import Callable, Mapping
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from fitting import formatting
from fitting.files import finite


def environment(filters: Mapping[str, Callable[..., Any]]) -> Environment:
    """The templates' environment: it escapes every name, and an unknown one is an error.

    Args:
        filters: of the page, besides those for quantities, numbers and units.
    """
    found = Environment(
        loader=PackageLoader("fitting.report", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    # `tojson` writes <, >, & and ' as escapes, so that no name can end the script.
    found.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    found.filters |= {
        "quantity": formatting.quantity,
        "number": formatting.number,
        "unit": formatting.pretty_unit,
        # What is no number leaves a gap in a figure.
        "finite": finite,
    }
    found.filters |= filters
    return found
