"""Evidence as reports store it, ready to be decided anew."""

import math
from collections.abc import Mapping
from typing import Any

from fitting.attribution.decisions import (
    CaseEvidence,
    ChallengeEvidence,
    EffectEvidence,
    FinalEvidence,
    ModelEvidence,
    NoiseEvidence,
    Rival,
    RoundEvidence,
)

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
