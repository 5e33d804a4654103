"""Which route a sweep's transients take: the cheapest that keeps the tolerance on points drawn from the sweep itself."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Int

from hdjax.sweep.request import Case, Request, duration
from hdjax.sweep.splitting import splits
from hdjax.sweep.transients import Route, transients
from hdjax.sweep.windows import Windows

SAMPLED = 64
"""Points that a route is chosen on, and as many others that it is checked on."""
_REFERENCE = 1e-11
# What a step costs beside a Strang step in double precision, measured on a CPU.
_COST = {"strang": 1.0, "aba864": 3.0, "tsit5": 6.0}
_LOOKS_PER_TURN = 24
_MOST_STEPS_PER_TURN = 512
_FINER = 1.5
# Below this the rounding errors of single precision would be asked too much of.
_SINGLE_FROM = 1e-4
_ATTEMPTS = 4


@dataclasses.dataclass(frozen=True)
class Check:
    """A route against the reference on points that it was not chosen on.

    Attributes:
        points: how many were drawn.
        unfinished: how many of them the reference could not integrate.
        error: largest error, as a part of each motion's largest |x|.
        median: the median over the points.
        reference: what the reference was.
    """

    points: int
    unfinished: int
    error: float
    median: float
    reference: str


def choose(case: Case, request: Request) -> tuple[Route, Check]:
    """Choose and check a route for transients.

    Args:
        case: the model and its forcing.
        request: what is wanted.
    """
    pilot, other = drawn_points(request)
    reference = Route("adaptive", _looks(case, request, pilot), tolerance=min(_REFERENCE, 1e-3 * request.tolerance))
    values, others = request.design.values(pilot), request.design.values(other)
    route = _cheapest(case, request, values, transients(case, request, reference, values))
    truth = transients(case, request, reference, others)
    for _ in range(_ATTEMPTS):
        errors, unfinished = _errors(transients(case, request, route, others), truth)
        check = Check(
            other.size,
            unfinished,
            float(np.max(errors, initial=0.0)),
            float(np.median(errors)) if errors.size else 0.0,
            reference.description,
        )
        if check.error <= request.tolerance:
            break
        if route.method == "adaptive":
            route = dataclasses.replace(route, tolerance=0.1 * route.tolerance)
        else:
            # The points that decide are rare: steps finer than the pilot asked for.
            route = dataclasses.replace(route, substeps=math.ceil(_FINER * route.substeps))
    return route, check


def drawn_points(request: Request) -> tuple[Int[np.ndarray, " pilot"], Int[np.ndarray, " check"]]:
    """Points to choose a route on, and others to check it on; the same where the sweep has too few."""
    random = np.random.default_rng(request.seed)
    size = request.design.size
    if size <= 2 * SAMPLED:
        every = np.arange(size)
        return every[:: -(-size // SAMPLED)], every[-SAMPLED:]
    found = np.unique(random.integers(0, size, 4 * SAMPLED))
    random.shuffle(found)
    return found[:SAMPLED], found[SAMPLED : 2 * SAMPLED]


def _cheapest(case: Case, request: Request, values: dict, truth: tuple[Windows, np.ndarray]) -> Route:
    turns = _turns_per_window(case, request, values)
    methods = ("strang", "aba864") if splits(case.model, case.forcing) else ("tsit5",)
    singles = (True, False) if request.tolerance >= _SINGLE_FROM and methods[0] == "strang" else (False,)
    best, least = None, math.inf
    for method in methods:
        for single in singles:
            cost = _COST[method] * (0.5 if single else 1.0)
            substeps, before, rises = max(1, math.ceil(turns)), math.inf, 0
            while cost * substeps < least and substeps <= max(1.0, turns) * _MOST_STEPS_PER_TURN and rises < 3:
                route = Route(method, substeps, single)
                errors, _ = _errors(transients(case, request, route, values), truth)
                worst = float(np.max(errors, initial=0.0))
                if worst <= 0.5 * request.tolerance:
                    best, least = route, cost * substeps
                    break
                # Rounding errors don't shrink with the step.
                rises = rises + 1 if worst > 0.9 * before and worst < 0.1 else 0
                before, substeps = min(before, worst), math.ceil(_FINER * substeps)
    if best is None:
        best = Route("adaptive", _looks_for(turns), tolerance=0.01 * request.tolerance)
    return best


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
        return jnp.maximum(omega_0, getattr(own.forcing, "omega", omega_0)), duration(request, own)

    fastest, longest = jax.vmap(one)({path: jnp.asarray(v) for path, v in values.items()})
    return float(jnp.max(fastest * longest)) / (2 * math.pi) / request.windows


def _looks(case: Case, request: Request, points: np.ndarray) -> int:
    return _looks_for(_turns_per_window(case, request, request.design.values(points)))


def _looks_for(turns: float) -> int:
    """Points between which the largest |x| is looked for, enough for a motion twice as fast as a linear one."""
    return max(4, math.ceil(2 * _LOOKS_PER_TURN * turns))
