"""Evidence for the decisions on a case, as reports store it.

Nothing here fits, simulates or decides.
"""

import math
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np

from fitting.files import finite

Question = Literal["instead", "beside"]


@dataclass(frozen=True)
class EffectEvidence:
    """Evidence for the best candidate of a round.

    Attributes:
        name: of the form.
        gain: decrease of the objective on selection data.
        p_value: chance that the best form gains as much where nothing is missing.
        removed: error that it removes, over the error that preceding effects have removed (rms).
        imperfection: error that the laws of preceding effects may cause, likewise.
        strength_errors: standard errors by which its most significant strength differs from zero.
        over_noise: log likelihood ratio against noise; infinite where noise does not explain the residual.
        at_bounds: number of its parameters that ended at a bound.
    """

    name: str
    gain: float
    p_value: float
    removed: float = np.inf
    imperfection: float = 0.0
    strength_errors: float = np.inf
    over_noise: float = np.inf
    at_bounds: int = 0


@dataclass(frozen=True)
class Rival:
    """A candidate that competes with the best one.

    Attributes:
        name: of the form.
        gain: over short segments.
        long_gain: over whole stretches; over short segments where these are inconclusive.
        tied: whether it is tied with the best one over short segments.
        parameters: number of free parameters.
        states: number of states.
        plausible: whether no parameter is larger than real drives show.
        remembers: whether it adds states to the preceding model.
    """

    name: str
    gain: float
    long_gain: float
    tied: bool
    parameters: int
    states: int
    plausible: bool
    remembers: bool


@dataclass(frozen=True)
class RoundEvidence:
    """Evidence of one round of the search.

    Attributes:
        asked: evidence for the leading candidate, and for better ones that the data do not support.
        behind: score of the candidate that led when ties were marked, minus that of each refitted one, block by block.
        rivals: those that competed over whole stretches.
        lost: gain of the candidate that led when ties were marked, minus that of each refitted one.
    """

    asked: tuple[EffectEvidence, ...] = ()
    behind: dict[str, tuple[float, ...]] = field(default_factory=dict)
    rivals: tuple[Rival, ...] = ()
    lost: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class ModelEvidence:
    """Evidence on a fitted model for the final decision.

    Attributes:
        training: objective on training data: half the log-determinant of the error's covariance.
        selection: likewise on selection data.
        parameters: number of free parameters.
        excess: residual of each output over short segments of the selection data, over the measurement noise.
        white: whether the training residual of the principal output is white, and that of each output within the noise.
    """

    training: float
    selection: float
    parameters: int
    excess: tuple[float, ...]
    white: bool


@dataclass(frozen=True)
class NoiseEvidence:
    """Innovations of a Kalman filter with noise of sensors and torque.

    Attributes:
        share: the noise of the torque over its rms.
        predictable: share of the innovations' variance that is predictable from earlier ones.
        size: rms of the innovations over its expected value, of the output where it is largest.
    """

    share: float
    predictable: float
    size: float


@dataclass(frozen=True)
class ChallengeEvidence:
    """Evidence where a learned term challenges named effects.

    Attributes:
        base: the model without effects.
        named: the model with the named effects; the base model where there are none.
        names: number of named effects.
        noise: objective of pure measurement noise.
        imperfect: whether inexact laws of the named effects may explain the residual.
        beside: the named model with a learned term as well; None where none is supported or none was fitted.
        instead: the base model with a learned term in place of named effects; likewise.
        asked: the learned terms that were tried.
        come_out: share of the replacing term that the named effects reproduce.
        shown: whether every named effect keeps a significantly nonzero strength beside the learned term.
        one_shape: whether a named effect is one shape of the function that was learned both beside it and in its place.
        left: noise evidence of the named model; None where its residual is white measurement noise.
        longer_worse: log of the rms error of free runs with the replacing term, over that with the named effects; zero
            where free runs are inconclusive.
        behind: score of the accepted named effects alone minus that of the replacing term, block by block.
    """

    base: ModelEvidence
    named: ModelEvidence
    names: int
    noise: float
    imperfect: bool
    beside: ModelEvidence | None = None
    instead: ModelEvidence | None = None
    asked: tuple[Question, ...] = ()
    come_out: float = 0.0
    shown: bool = True
    one_shape: bool = False
    left: NoiseEvidence | None = None
    longer_worse: float = 0.0
    behind: tuple[float, ...] = ()

    @property
    def enough(self) -> bool:
        """Whether the named effects leave nothing to be learned."""
        return self.named.white or self.imperfect

    def answered(self, question: Question, found: ModelEvidence | None, **changes: Any) -> "ChallengeEvidence":
        """The same with the result of one more learned term."""
        return replace(self, asked=(*self.asked, question), **{question: found}, **changes)


@dataclass(frozen=True)
class FinalEvidence:
    """Evidence for the final decision.

    Attributes:
        names: of the accepted effects.
        learned: whether a term was learned beside them or in place of all.
        excess: residual of each output over short segments of the selection data, with the named effects alone, over
            the noise.
        excess_at_first: likewise of the base model.
        noise_explains: whether coloured noise of sensors and torque explains the residual.
        surprise: free-run error over its prediction band, the larger one of selection and training data; None where
            that is not checked, or the band says nothing.
        free_runs_explained: share of the free runs' error beyond noise that the effects remove; None where that is not
            checked, or all runs diverge.
        at_bounds: parameters of the named effects that the data put at a bound in the final fit.
        wide_bands: whether prediction bands say nothing: they are wider than the measured motion.
        replaced: whether a learned term replaced the names since these do not explain free runs; the rest is still
            evidence for the names.
    """

    names: tuple[str, ...]
    learned: bool
    excess: tuple[float, ...]
    excess_at_first: tuple[float, ...]
    noise_explains: bool = False
    surprise: float | None = None
    free_runs_explained: float | None = None
    at_bounds: int = 0
    wide_bands: bool = False
    replaced: bool = False


@dataclass(frozen=True)
class CaseEvidence:
    """Evidence for all decisions on one case.

    Attributes:
        rounds: of the search.
        challenge: of the named effects.
        final: evidence for the final decision.
    """

    rounds: tuple[RoundEvidence, ...]
    challenge: ChallengeEvidence
    final: FinalEvidence


# The number that stands for infinity, which JSON lacks.
_ENDLESS = sys.float_info.max
# What null means in earlier reports. Long simulations of a rival may diverge, which no gain offsets.
_INFINITE = dict.fromkeys(
    ("removed", "strength_errors", "over_noise", "gain", "training", "selection", "noise", "longer_worse"), math.inf
) | {"long_gain": -math.inf}


def stored_evidence(case: CaseEvidence) -> dict[str, Any]:
    """The evidence of a case, as report.json stores it."""
    return finite(asdict(case), infinite=_ENDLESS)


def case_evidence(stored: Mapping[str, Any]) -> CaseEvidence:
    """The stored evidence of a case.

    Args:
        stored: `evidence` of its report.json.
    """
    challenge = stored["challenge"]
    known: dict[str, Any] = _as_found(challenge)
    known["asked"] = tuple(challenge["asked"])
    known["behind"] = tuple(challenge.get("behind", ()))
    for name in ("base", "named", "beside", "instead"):
        known[name] = None if challenge[name] is None else _model(challenge[name])
    left = challenge["left"]
    known["left"] = None if left is None else NoiseEvidence(**left)
    final = _as_found(stored["final"])
    for name in ("names", "excess", "excess_at_first"):
        final[name] = tuple(final[name])
    rounds = tuple(_round(this) for this in stored["rounds"])
    return CaseEvidence(rounds, ChallengeEvidence(**known), FinalEvidence(**final))


def _round(stored: Mapping[str, Any]) -> RoundEvidence:
    return RoundEvidence(
        tuple(EffectEvidence(**_as_found(seen)) for seen in stored["asked"]),
        {name: tuple(blocks) for name, blocks in stored["behind"].items()},
        tuple(Rival(**_as_found(rival)) for rival in stored["rivals"]),
        stored.get("lost", {}),
    )


def _model(stored: Mapping[str, Any]) -> ModelEvidence:
    known = _as_found(stored)
    known["excess"] = tuple(known["excess"])
    return ModelEvidence(**known)


def _as_found(stored: Mapping[str, Any]) -> dict[str, Any]:
    """The fields, with infinity where it is stored by a number or a null."""
    known = {k: _INFINITE[k] if v is None and k in _INFINITE else v for k, v in stored.items()}
    return {k: math.copysign(math.inf, v) if v in (_ENDLESS, -_ENDLESS) else v for k, v in known.items()}
