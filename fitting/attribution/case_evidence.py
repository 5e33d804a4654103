"""The evidence on which a case is decided, and how reports store it.

Nothing here fits, simulates or decides.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

Question = Literal["instead", "beside"]


@dataclass(frozen=True)
class EffectEvidence:
    """What the data say of the best candidate of a round.

    Attributes:
        name: of the form.
        gain: decrease of the objective on selection data.
        p_value: chance that the best of the catalogue gains as much where nothing is missing.
        removed: what it removes of the error, over what the effects before it have removed (rms).
        imperfection: what the laws of the effects before it may get wrong, likewise.
        strength_errors: standard errors by which its best known strength differs from zero.
        over_noise: log likelihood by which it betters noise; infinite where that is no explanation.
        at_bounds: how many of its parameters ended at a bound.
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
    """A candidate among those that can't be told from the best one.

    Attributes:
        name: of the form.
        gain: over short segments.
        long_gain: in free runs along whole stretches; over short segments where these tell nothing.
        tied: whether it can't be told from the best one over short segments.
        parameters: number of free parameters.
        states: likewise of states.
        plausible: whether no parameter is larger than real drives show.
        remembers: whether it has states that the model before it has not.
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
    """What one look at the catalogue rests on.

    Attributes:
        asked: what the data say of the candidate that leads, and of those before it that they do not support.
        behind: of each candidate that was refitted, how far it is behind the best one, block by block.
        rivals: those that competed over whole stretches.
    """

    asked: tuple[EffectEvidence, ...]
    behind: dict[str, tuple[float, ...]]
    rivals: tuple[Rival, ...]


@dataclass(frozen=True)
class ModelEvidence:
    """A fitted model as the final decision sees it.

    Attributes:
        training: objective on training data: half the log-determinant of the error's covariance.
        selection: likewise on selection data.
        parameters: number of free parameters.
        excess: what short segments of the selection data leave of each output, over the measurement noise.
        white: whether training data leave nothing of the dynamic error that its colour betrays, and of no output more
            than the noise.
    """

    training: float
    selection: float
    parameters: int
    excess: tuple[float, ...]
    white: bool


@dataclass(frozen=True)
class NoiseEvidence:
    """What a Kalman filter with noise of sensors and torque leaves.

    Attributes:
        share: the noise of the torque over its rms.
        predictable: share of the innovations' variance that earlier ones predict.
        size: rms of the innovations in units of what the filter expects, of the output where it is largest.
    """

    share: float
    predictable: float
    size: float


@dataclass(frozen=True)
class ChallengeEvidence:
    """What is known when a learned term challenges names.

    Attributes:
        base: the model without effects.
        named: the model with those that were found; the base model where there are none.
        names: how many there are.
        noise: the objective that nothing but measurement noise makes.
        imperfect: whether all that is left is what the laws of the names may get wrong.
        beside: the named model with a learned term beside them; None where none is supported or it was not asked.
        instead: the base model with a learned term in their place; likewise.
        asked: what was learned, or could not be.
        come_out: share of the term in their place that the names make up.
        shown: whether every name still has a strength that is told from zero beside the learned term.
        one_shape: whether a name is one shape of the function that was learned both beside it and in its place.
        left: what the names leave as noise; None where they leave no more than white measurement noise.
        longer_worse: log of the rms error of free runs with the term in their place, over that with the names; zero
            where free runs tell nothing.
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

    @property
    def enough(self) -> bool:
        """Whether the names leave nothing that could be learned."""
        return self.named.white or self.imperfect

    def answered(self, question: Question, found: ModelEvidence | None, **changes: Any) -> "ChallengeEvidence":
        """The same with one more answer."""
        return replace(self, asked=(*self.asked, question), **{question: found}, **changes)


@dataclass(frozen=True)
class FinalEvidence:
    """What the last decision rests on.

    Attributes:
        names: of the effects that are trusted.
        learned: whether a term was learned beside them, or in the place of all.
        excess: what short segments of the selection data leave of each output under the names alone, over the noise.
        excess_at_first: likewise under the base model.
        noise_explains: whether what is left is noise of the sensors, with a memory, and of the torque.
        surprise: by how much free runs are farther off than they promised; None where that is not asked.
    """

    names: tuple[str, ...]
    learned: bool
    excess: tuple[float, ...]
    excess_at_first: tuple[float, ...]
    noise_explains: bool = False
    surprise: float | None = None


@dataclass(frozen=True)
class CaseEvidence:
    """All that the decision on one case rests on.

    Attributes:
        rounds: every look at the catalogue.
        challenge: of the names that were found.
        final: what the last decision rests on.
    """

    rounds: tuple[RoundEvidence, ...]
    challenge: ChallengeEvidence
    final: FinalEvidence


# What JSON has no number for.
_UNBOUNDED = (
    "removed",
    "strength_errors",
    "over_noise",
    "gain",
    "long_gain",
    "training",
    "selection",
    "noise",
    "longer_worse",
)


def case_evidence(stored: Mapping[str, Any]) -> CaseEvidence:
    """The evidence of a case.

    Args:
        stored: `evidence` of its report.json.
    """
    challenge = stored["challenge"]
    known: dict[str, Any] = _finite(challenge)
    known["asked"] = tuple(challenge["asked"])
    for name in ("base", "named", "beside", "instead"):
        known[name] = None if challenge[name] is None else _model(challenge[name])
    left = challenge["left"]
    known["left"] = None if left is None else NoiseEvidence(**left)
    final = dict(stored["final"])
    for name in ("names", "excess", "excess_at_first"):
        final[name] = tuple(final[name])
    rounds = tuple(_round(this) for this in stored["rounds"])
    return CaseEvidence(rounds, ChallengeEvidence(**known), FinalEvidence(**final))


def _round(stored: Mapping[str, Any]) -> RoundEvidence:
    return RoundEvidence(
        tuple(EffectEvidence(**_finite(seen)) for seen in stored["asked"]),
        {name: tuple(blocks) for name, blocks in stored["behind"].items()},
        tuple(Rival(**_finite(rival)) for rival in stored["rivals"]),
    )


def _model(stored: Mapping[str, Any]) -> ModelEvidence:
    known = _finite(stored)
    known["excess"] = tuple(known["excess"])
    return ModelEvidence(**known)


def _finite(stored: Mapping[str, Any]) -> dict[str, Any]:
    """The fields, with infinity where a report has a null."""
    return {k: math.inf if v is None and k in _UNBOUNDED else v for k, v in stored.items()}
