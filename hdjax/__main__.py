"""`python -m hdjax`: the command `hdjax`."""

import sys
from importlib.metadata import entry_points

# Loaded by name: the command line belongs to `fitting`, which this package does not import.
(script,) = entry_points(group="console_scripts", name="hdjax")
sys.exit(script.load()())
