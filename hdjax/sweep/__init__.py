"""Sweeps: the response of very many drives and forcings, on all devices of a machine or of many machines."""

from hdjax.sweep.points import Points as Points
from hdjax.sweep.points import drawn as drawn
from hdjax.sweep.points import spread_values as spread_values
from hdjax.sweep.request import Request as Request
from hdjax.sweep.run import sweep as sweep
