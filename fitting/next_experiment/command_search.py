"""Search for the command that separates explanations best: sequential quadratic programming (Kraft 1988, DFVLR-FB
88-28) with gradients through the simulator, from several typical commands.

The criterion is the logarithm of the least divergence of the first explanation from any rival, within the limits of
torque, speed, travel and twist under all of them.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from fitting.next_experiment.discrimination import (
    Bench,
    Explanation,
    Refit,
    Response,
    Signals,
    refit,
    respond,
    signals,
    start,
)
from fitting.next_experiment.excitation import Excitation
from hdjax import Hold

# Number of starts of the search, and its iterations.
_BEST_STARTS = 2
_ITERATIONS = 15
# Least improvement of the logarithm.
_TOLERANCE = 1e-2
# Number of parts of the command; in each, the largest torque, speed, travel and twist are constrained.
_PARTS = 12
# Penalty on the squared excess over the limits when starts are compared.
_BEYOND = 10.0
# Least divergence, which bounds the logarithm.
_NO_SQUARES = 1e-3
# Number of steps to scale down a command that slightly exceeds a limit.
_SHRINKS = 10
# Number of stored evaluations, latest and best.
_KEPT = 2
# Tried amplitudes of each start.
_SIZES = (1.0, 0.3)
_FARTHEST = 5.0
# Number of commands on which the derivatives of an explanation are checked.
_TRIED = 2


class Evaluation(eqx.Module):
    """Responses, divergences and limits of a command.

    Attributes:
        coefficients: of the command.
        own: response of each explanation.
        forward: each rival refitted to the first explanation's response.
        backward: the first explanation refitted to each rival's response; empty if not needed.
        over: largest torque, speed, travel and twist in each part of the command, in units of the limits.
        over_slopes: their derivatives by the coefficients.
    """

    coefficients: Float[np.ndarray, " shapes"]
    own: tuple[Response, ...]
    forward: tuple[Refit, ...]
    backward: tuple[Refit, ...]
    over: Float[np.ndarray, " places"]
    over_slopes: Float[np.ndarray, "places shapes"]

    @property
    def usable(self) -> bool:
        """Whether no simulation diverges."""
        return all(r.usable for r in self.own) and bool(np.isfinite(self.divergences).all())

    @property
    def divergences(self) -> Float[np.ndarray, " rivals"]:
        """Divergence of each rival: the refits' sums of squares, summed over both cases of the right model."""
        total = np.array([f.squares for f in self.forward])
        return total + np.array([f.squares for f in self.backward]) if self.backward else total

    @property
    def divergence_slopes(self) -> Float[np.ndarray, "rivals shapes"]:
        """Their derivatives by the coefficients."""
        slopes = np.stack([f.slope(self.own[0]) for f in self.forward])
        if not self.backward:
            return slopes
        return slopes + np.stack([b.slope(own) for b, own in zip(self.backward, self.own[1:], strict=True)])

    @property
    def within(self) -> bool:
        """Whether the command respects the limits under every explanation."""
        return self.usable and bool(np.max(np.abs(self.over)) <= 1.0)


class Candidate(eqx.Module):
    """An evaluated command."""

    excitation: Excitation
    evaluation: Evaluation

    @property
    def command(self) -> Float[np.ndarray, " samples"]:
        """The torque at the samples."""
        return self.excitation.command(self.evaluation.coefficients)

    @property
    def merit(self) -> float:
        """Criterion of the search minus a penalty for exceeded limits."""
        if not self.evaluation.usable:
            return -np.inf
        beyond = max(float(np.max(self.evaluation.over**2)) - 1.0, 0.0)
        return float(np.min(_logarithm(self.evaluation.divergences))) - _BEYOND * beyond


class _Stage(eqx.Module):
    """Explanations, and the shapes of a command under each one's hold."""

    explanations: tuple[Explanation, ...]
    excitation: Excitation
    signals: tuple[Signals, ...]
    bench: Bench
    both_ways: bool


def search(
    explanations: Sequence[Explanation],
    starts: Sequence[Excitation],
    bench: Bench,
    *,
    both_ways: bool = True,
    progress: Callable[[str], None],
) -> Candidate | None:
    """The best command of the search.

    Args:
        explanations: the found one, then its rivals.
        starts: starting commands.
        bench: how experiments are simulated, and their limits.
        both_ways: whether each rival may also be the right one.
        progress: receives messages.

    Returns:
        The command, or None where none respects the limits.
    """
    begun: list[tuple[_Stage, Candidate]] = []
    for excitation in starts:
        progress(f"the next experiment: trying {excitation.name}")
        stage = _stage(explanations, excitation, bench, both_ways)
        tried = [Candidate(excitation, evaluate(stage, size * excitation.coefficients)) for size in _SIZES]
        begun.append((stage, max(tried, key=lambda c: c.merit)))
    begun.sort(key=lambda pair: -pair[1].merit)
    found = [candidate for _, candidate in begun if candidate.evaluation.within]
    for stage, candidate in begun[:_BEST_STARTS]:
        if np.isfinite(candidate.merit):
            progress(f"the next experiment: improving {candidate.excitation.name}")
            found += _improved(stage, candidate)
    return max(found, key=lambda c: c.merit, default=None)


def is_smooth(explanation: Explanation, starts: Sequence[Excitation], bench: Bench) -> bool:
    """Whether an explanation has usable derivatives on at least one of the first commands."""
    stages = (_stage([explanation], excitation, bench, False) for excitation in starts[:_TRIED])
    return any(evaluate(s, s.excitation.coefficients).own[0].usable for s in stages)


def largest_twist(of: Explanation, starts: Sequence[Excitation], bench: Bench) -> float:
    """The largest dynamic error of an explanation under any of the commands [rad]."""
    stages = (_stage([of], excitation, bench, False) for excitation in starts)
    own = (evaluate(s, s.excitation.coefficients).own[0] for s in stages)
    return max(float(np.max(np.abs(r.twist))) for r in own)


def _stage(explanations: Sequence[Explanation], excitation: Excitation, bench: Bench, both_ways: bool) -> _Stage:
    by_hold: dict[Hold, Signals] = {}
    for explanation in explanations:
        if explanation.hold not in by_hold:
            by_hold[explanation.hold] = signals(excitation, hold=explanation.hold, bench=bench)
    return _Stage(tuple(explanations), excitation, tuple(by_hold[e.hold] for e in explanations), bench, both_ways)


def evaluate(stage: _Stage, coefficients: Float[np.ndarray, " shapes"], near: Evaluation | None = None) -> Evaluation:
    """Evaluate a command; refits start from those of a similar evaluation."""
    pairs = zip(stage.explanations, stage.signals, strict=True)
    own = tuple(respond(e, start(e), coefficients, signals=s, bench=stage.bench) for e, s in pairs)

    def fitted(of: int, to: int, before: Refit | None) -> Refit:
        return refit(
            stage.explanations[of],
            own[to],
            coefficients,
            signals=stage.signals[of],
            bench=stage.bench,
            begin=None if before is None else before.unknowns,
        )

    rivals = range(1, len(own))
    none = (None,) * len(rivals)
    forward = none if near is None else near.forward
    backward = none if near is None else near.backward
    over, slopes = _over(stage, coefficients, own)
    return Evaluation(
        coefficients=coefficients,
        own=own,
        forward=tuple(fitted(k, 0, before) for k, before in zip(rivals, forward, strict=True)),
        backward=tuple(fitted(0, k, before) for k, before in zip(rivals, backward, strict=True))
        if stage.both_ways
        else (),
        over=over,
        over_slopes=slopes,
    )


def _over(
    stage: _Stage, coefficients: Float[np.ndarray, " shapes"], own: Sequence[Response]
) -> tuple[Float[np.ndarray, " places"], Float[np.ndarray, "places shapes"]]:
    """Largest torque, speed, travel and twist in each part of the command, and their derivatives."""
    shapes = stage.excitation.shapes
    values = np.concatenate([(shapes @ coefficients)[:, None], *(r.motion for r in own)], axis=1)
    slopes = np.concatenate([shapes[:, None, :], *(r.motion_by_command for r in own)], axis=1)
    places = [
        part[np.argmax(np.abs(values[part]), axis=0)] for part in np.array_split(np.arange(values.shape[0]), _PARTS)
    ]
    quantity = np.arange(values.shape[1])
    rows = [(values[p, quantity], slopes[p, quantity]) for p in places]
    return np.concatenate([v for v, _ in rows]), np.concatenate([s for _, s in rows])


def _improved(stage: _Stage, begun: Candidate) -> list[Candidate]:
    """Commands within the limits from a search that starts at one."""
    visited = [begun.evaluation]

    def at(point: np.ndarray) -> Evaluation:
        known = next((e for e in visited if np.array_equal(e.coefficients, point[:-1])), None)
        if known is None:
            near = min(visited, key=lambda e: float(np.sum((e.coefficients - point[:-1]) ** 2)))
            known = evaluate(stage, point[:-1].copy(), near if near.usable else None)
            visited.append(known)
            # Derivatives of long commands need much memory: only the latest and the best are stored.
            best = sorted(visited[:-_KEPT], key=lambda e: -Candidate(stage.excitation, e).merit)
            visited[:-_KEPT] = best[:_KEPT]
        return known

    def limits(point: np.ndarray) -> np.ndarray:
        found = at(point)
        if not found.usable:
            return np.full(len(found.forward) + found.over.size, -_FARTHEST)
        return np.concatenate([_logarithm(found.divergences) - point[-1], 1.0 - found.over**2])

    def slopes(point: np.ndarray) -> np.ndarray:
        found = at(point)
        told = found.divergence_slopes / (found.divergences + _NO_SQUARES)[:, None]
        of_limits = -2.0 * found.over[:, None] * found.over_slopes
        last = np.concatenate([-np.ones(told.shape[0]), np.zeros(of_limits.shape[0])])
        return np.nan_to_num(np.concatenate([np.concatenate([told, of_limits]), last[:, None]], axis=1))

    # Imported here: only the search for a next experiment needs it.
    from scipy.optimize import minimize

    size = begun.evaluation.coefficients.size
    least = float(np.min(_logarithm(begun.evaluation.divergences)))
    upwards = np.append(np.zeros(size), -1.0)
    minimize(
        lambda point: -point[-1],
        np.append(begun.evaluation.coefficients, least),
        jac=lambda point: upwards,
        method="SLSQP",
        bounds=[(-_FARTHEST, _FARTHEST)] * size + [(None, None)],
        constraints={"type": "ineq", "fun": limits, "jac": slopes},
        options={"maxiter": _ITERATIONS, "ftol": _TOLERANCE},
    )
    ends = sorted((Candidate(stage.excitation, e) for e in visited), key=lambda c: -c.merit)
    made = (_made_smaller(stage, c.evaluation) for c in ends[:_KEPT] if c.evaluation.usable)
    return [Candidate(stage.excitation, e) for e in made if e.within]


def _made_smaller(stage: _Stage, found: Evaluation) -> Evaluation:
    """The command scaled down to the limits, if possible."""
    for _ in range(_SHRINKS):
        if found.within or not found.usable:
            break
        size = 0.998 / max(float(np.max(np.abs(found.over))), 1.0)
        found = evaluate(stage, size * found.coefficients, found)
    return found


def _logarithm(divergences: Float[np.ndarray, " rivals"]) -> Float[np.ndarray, " rivals"]:
    return np.log(divergences + _NO_SQUARES)
