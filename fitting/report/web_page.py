"""Rendering of templates as self-contained pages."""

from collections.abc import Callable, Mapping
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined

from fitting import formatting
from fitting.files import finite


def environment(filters: Mapping[str, Callable[..., Any]]) -> Environment:
    """The templates' environment: values are escaped, and unknown names are errors.

    Args:
        filters: of the page, in addition to those for quantities, numbers and units.
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
        # NaN gives a gap in a figure.
        "finite": finite,
    }
    found.filters |= filters
    return found
