"""Sweeps: responses of many drives and forcings, on all devices of one or many machines."""

from hdjax.sweep.points import Points, drawn, spread_values
from hdjax.sweep.request import Request
from hdjax.sweep.run import sweep

__all__ = [
    "Points",
    "Request",
    "drawn",
    "spread_values",
    "sweep",
]
