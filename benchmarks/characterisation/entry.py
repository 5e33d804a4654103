"""Start the command line of whichever checkout Python finds first, by its own entry point.

It runs by `python -P entry.py ARGUMENTS`, so that nothing beside this file is imported by mistake.
"""

import importlib
import importlib.metadata
import importlib.util
import sys
import tomllib
from pathlib import Path

_SCRIPT = "hdjax"


def entry_point() -> str:
    """`module:function` as the checkout's pyproject.toml states it, or as the installed package does."""
    spec = importlib.util.find_spec("fitting")
    if spec is not None and spec.origin is not None:
        project = Path(spec.origin).parents[1] / "pyproject.toml"
        if project.is_file():
            return tomllib.loads(project.read_text(encoding="utf-8"))["project"]["scripts"][_SCRIPT]
    (found,) = importlib.metadata.entry_points(group="console_scripts", name=_SCRIPT)
    return found.value


if __name__ == "__main__":
    sys.argv[0] = _SCRIPT
    module, _, function = entry_point().partition(":")
    sys.exit(getattr(importlib.import_module(module), function)())
