"""Choice of the method for a sweep's transients: the cheapest within the tolerance on random points."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np

from hdjax.sweep.check import Check, drawn_points
from hdjax.sweep.machine_code import address
from hdjax.sweep.request import Case, Request, duration
from hdjax.sweep.splitting import splits
from hdjax.sweep.transients import Method, TransientRoute, transients
from hdjax.sweep.windows import Windows

_REFERENCE = 1e-11
# Cost of a step relative to a Strang step in double precision, measured on a CPU; Runge-Kutta steps by machine code
# with motor friction.
_COST = {"strang": 1.0, "aba864": 3.0, "srkn14": 6.0, "tsit5": 1.0, "dopri8": 1.7}
_LOOKS_PER_TURN = 24
_MOST_STEPS_PER_TURN = 512
_FINER = 1.25
_SAFETY = 0.5
# Steps of ABA(8,6,4) for a turn below which a Strang step, and above which a step of higher order, may be cheaper.
_FEW_STEPS, _MANY_STEPS = 10.0, 24.0
# Tolerance below which single precision is insufficient.
_SINGLE_FROM = 1e-4
_ATTEMPTS = 4


def choose(case: Case, request: Request) -> tuple[TransientRoute, Check]:
    """Choose and check a route for transients.

    Args:
        case: the model and its forcing.
        request: of the sweep.
    """
    pilot, other = drawn_points(request)
    values, others = request.points.values(pilot), request.points.values(other)
    turns = _turns_per_window(case, request, values)
    reference = TransientRoute("adaptive", _looks(turns), tolerance=min(_REFERENCE, 1e-3 * request.tolerance))
    route = _cheapest(case, request, values, transients(case, request, reference, values), turns)
    truth = transients(case, request, reference, others)
    for attempts in range(_ATTEMPTS, 0, -1):
        errors, unfinished = _errors(transients(case, request, route, others), truth)
        check = Check(
            other.size,
            unfinished,
            float(np.max(errors)) if errors.size else math.nan,
            float(np.median(errors)) if errors.size else math.nan,
            reference.description,
        )
        # Where no point could be checked, the error is NaN.
        if not check.error > request.tolerance or attempts == 1:
            break
        if route.method == "adaptive":
            route = dataclasses.replace(route, tolerance=0.1 * route.tolerance)
        else:
            # The critical points are rare: use finer steps than the pilot needed.
            route = dataclasses.replace(route, substeps=math.ceil(_FINER * route.substeps))
    return route, check


def _cheapest(
    case: Case, request: Request, values: dict, truth: tuple[Windows, np.ndarray], turns: float
) -> TransientRoute:
    """The cheapest route within half the tolerance on the pilot."""
    split = splits(case.model, case.forcing)
    singles = (True, False) if split and request.tolerance >= _SINGLE_FROM else (False,)
    for single in singles:

        def needed(method: Method, most: float, single: bool = single, by_code: bool = False) -> TransientRoute | None:
            route = TransientRoute(method, 1, single, by_code=by_code)
            return _fewest_steps(case, request, route, values, truth, turns, most)

        if not split:
            found = needed("tsit5", math.inf, by_code=address(case, request, "tsit5") is not None)
            if found is not None and found.by_code:
                found = needed("dopri8", found.substeps * _COST["tsit5"] / _COST["dopri8"], by_code=True) or found
        elif (found := needed("aba864", math.inf)) is not None:
            each = found.substeps / turns
            # Each further method must be compiled: only if it may be cheaper.
            other = "strang" if each < _FEW_STEPS else "srkn14" if each > _MANY_STEPS else None
            if other is not None:
                most = found.substeps * _COST["aba864"] / _COST[other]
                found = needed(other, most) or found
        if found is not None:
            return found
    return TransientRoute("adaptive", _looks(turns), tolerance=0.01 * request.tolerance)


def _fewest_steps(
    case: Case, request: Request, route: TransientRoute, values: dict, truth: tuple, turns: float, most: float
) -> TransientRoute | None:
    """The method with the fewest steps that the pilot allows; None where more steps don't help or cost more than
    others."""
    substeps, least, rises = max(1, math.ceil(turns)), math.inf, 0
    while substeps <= min(most, max(1.0, turns) * _MOST_STEPS_PER_TURN) and rises < 3:
        tried = dataclasses.replace(route, substeps=substeps)
        errors, _ = _errors(transients(case, request, tried, values), truth)
        if not errors.size:
            return None
        worst = float(np.max(errors))
        if worst <= _SAFETY * request.tolerance:
            return tried
        # Rounding errors don't decrease with the step.
        rises = rises + 1 if worst > 0.9 * least and worst < 0.1 else 0
        least, substeps = min(least, worst), math.ceil(_FINER * substeps)
    return None


def _errors(found: tuple[Windows, np.ndarray], truth: tuple[Windows, np.ndarray]) -> tuple[np.ndarray, int]:
    """Largest error of each point that the reference could integrate, and how many it could not."""
    (windows, _), (true, reached) = found, truth
    size = np.maximum(np.max(np.abs(true.peak), axis=1, keepdims=True), 1e-300)
    errors = np.abs(np.asarray(windows.x, dtype=float) - true.x) / size
    if np.any(windows.peak):
        errors = np.maximum(errors, np.abs(np.asarray(windows.peak, dtype=float) - true.peak) / size)
    worst = np.max(np.where(np.isfinite(errors), errors, np.inf), axis=1)
    return worst[reached], int(np.sum(~reached))


def _turns_per_window(case: Case, request: Request, values: dict) -> float:
    """Turns of the fastest of the natural frequency and the forcing within the longest window."""

    def one(values: dict) -> tuple[jax.Array, jax.Array]:
        own = case.at(values)
        omega_0 = own.model.drive.omega_0
        return jnp.maximum(omega_0, getattr(own.forcing, "omega", omega_0)), duration(
            own, request.duration, request.periods
        )

    fastest, longest = jax.vmap(one)({path: jnp.asarray(v) for path, v in values.items()})
    return float(jnp.max(fastest * longest)) / (2 * math.pi) / request.windows


def _looks(turns: float) -> int:
    """Points between which the largest |x| is searched, enough for a motion twice as fast as a linear one."""
    return max(4, math.ceil(2 * _LOOKS_PER_TURN * turns))
