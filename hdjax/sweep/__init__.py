"""Sweeps: the response of very many drives and forcings, on all devices of a machine or of many machines."""

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
