"""Results of a sweep per point: names, units, dimensions, and the values of a chunk."""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax
import numpy as np
from jaxtyping import Float

from hdjax.sweep.balance import MOTIONS
from hdjax.sweep.cheapest_route import choose
from hdjax.sweep.check import Check
from hdjax.sweep.request import Case, Request, duration
from hdjax.sweep.steady_states import SteadyRoute, choose_steady, steady_states
from hdjax.sweep.transients import TransientRoute, transients


@dataclasses.dataclass(frozen=True)
class Variable:
    """A variable of the result.

    Attributes:
        name: of the variable.
        unit: SI unit.
        doc: its meaning in one line.
        dims: dimensions after those of the points.
        kind: NumPy's type.
    """

    name: str
    unit: str
    doc: str
    dims: tuple[str, ...] = ()
    kind: str = "float64"


@dataclasses.dataclass(frozen=True)
class Plan:
    """Method of a sweep, chosen once, so that a resumed run uses the same.

    Attributes:
        route: of steady or of transient motions.
        check: the route against the reference.
    """

    route: TransientRoute | SteadyRoute
    check: Check

    def as_dict(self) -> dict[str, Any]:
        """The plan for a JSON file."""
        return {"route": dataclasses.asdict(self.route), "check": dataclasses.asdict(self.check)}

    @staticmethod
    def from_dict(content: Mapping[str, Any], request: Request) -> "Plan":
        """The plan from a JSON file."""
        kind = SteadyRoute if request.response == "steady" else TransientRoute
        return Plan(kind(**content["route"]), Check(**content["check"]))


def plan(case: Case, request: Request) -> Plan:
    """Choose the route of a sweep and check it."""
    return Plan(*(choose_steady if request.response == "steady" else choose)(case, request))


def variables(request: Request) -> tuple[Variable, ...]:
    """Variables of a request's result."""
    if request.response == "transient":
        possible = {
            "peak": (Variable("peak", "rad", "largest |x| of the transient"),),
            "settling_time": (
                Variable("settling_time", "s", "end of the last window whose largest |x| is out of the band"),
            ),
            "trace": (Variable("x", "rad", "dynamic error", ("window",)),),
            "final": (
                Variable("x_end", "rad", "dynamic error at the end"),
                Variable("v_end", "rad/s", "its rate at the end"),
            ),
        }
        return tuple(v for output in request.outputs for v in possible[output])
    by_motion, by_harmonic = ("motion",), ("motion", "harmonic")
    possible = {
        "amplitude": (Variable("amplitude", "rad", "amplitude of the first harmonic", by_motion),),
        "peak": (Variable("peak", "rad", "largest |x| over a period", by_motion),),
        "harmonics": (
            Variable("mean", "rad", "mean of x", by_motion),
            Variable("harmonic_amplitude", "rad", "B_k of B_k cos(k omega t + psi_k)", by_harmonic),
            Variable("harmonic_phase", "rad", "psi_k", by_harmonic),
        ),
    }
    always = (
        Variable("motions", "1", "how many steady motions there are", (), "int8"),
        Variable("stable", "1", "no real multiplier above 1: not the motion between two folds", by_motion, "bool"),
        Variable("lost", "1", "a motion that should be there was not found, mostly at a fold", (), "bool"),
    )
    return tuple(v for output in request.outputs for v in possible[output]) + always


def extra_dims(request: Request, plan: Plan) -> dict[str, np.ndarray]:
    """Coordinates of the dimensions after those of the points."""
    if isinstance(plan.route, SteadyRoute):
        return {"motion": np.arange(1, MOTIONS + 1), "harmonic": np.array(plan.route.orders)}
    return {"window": np.arange(1, request.windows + 1) / request.windows}


def answers(
    case: Case, request: Request, plan: Plan, values: Mapping[str, Float[np.ndarray, " points"]]
) -> dict[str, np.ndarray]:
    """The variables of a chunk's points, one point per row."""
    found = (_steady if isinstance(plan.route, SteadyRoute) else _transient)(case, request, plan, values)
    return {v.name: np.asarray(found[v.name]).astype(v.kind) for v in variables(request)}


def _steady(case: Case, request: Request, plan: Plan, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    assert isinstance(plan.route, SteadyRoute)
    found = steady_states(case, plan.route, values)
    size = np.hypot(found.cosine, found.sine)
    # The series' phase is relative to that of the forcing.
    behind = np.asarray(values.get("forcing.phase", case.forcing.phase))  # pyright: ignore[reportFunctionMemberAccess]
    phase = np.arctan2(-found.sine, found.cosine) + np.multiply.outer(behind, plan.route.orders).reshape(
        -1, 1, len(plan.route.orders)
    )
    return {
        "amplitude": size[..., 0],
        "peak": found.peak,
        "mean": found.mean,
        "harmonic_amplitude": size,
        "harmonic_phase": np.remainder(phase + np.pi, 2 * np.pi) - np.pi,
        "motions": found.exists.sum(axis=1),
        "stable": found.stable,
        "lost": found.lost,
    }


def _transient(case: Case, request: Request, plan: Plan, values: Mapping[str, np.ndarray]) -> dict[str, np.ndarray]:
    assert isinstance(plan.route, TransientRoute)
    found, reached = transients(case, request, plan.route, values)
    x, v, peak = (np.where(reached[:, None], a, np.nan) for a in (found.x, found.v, found.peak))
    length = jax.vmap(lambda v: duration(case.at(v), request.duration, request.periods))(dict(values))
    out = np.abs(peak - peak[:, -1:]) > request.band * peak[:, -1:]
    last = np.where(out.any(axis=1), request.windows - np.argmax(out[:, ::-1], axis=1), 0)
    settled = np.where(reached, last * np.asarray(length) / request.windows, np.nan)
    return {"peak": peak.max(axis=1), "settling_time": settled, "x": x, "x_end": x[:, -1], "v_end": v[:, -1]}
