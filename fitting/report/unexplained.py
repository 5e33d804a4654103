"""Size of a model's residual, and the quantity that it depends on most."""

from typing import Any

import numpy as np

from fitting.outcome import Loop
from fitting.report.outcome import Outcome
from fitting.validation.residual_diagnostics import Dependence, diagnose


def unexplained(outcome: Outcome, noise: float) -> dict[str, Any] | None:
    """Size of the residual, and the quantity that it depends on most; None for other decisions."""
    if not isinstance(outcome, Loop) or outcome.decision != "unexplained":
        return None
    residual = outcome.residual_after if outcome.unknown is None else diagnose(outcome.unknown.before.training)
    shares = {name: explained_share(d, residual.rms) for name, d in residual.dependence.items()}
    most = max(shares, key=lambda name: shares[name])
    words = {"x": "dynamic error", "v": "rate of the dynamic error"}
    return {
        "rms": residual.rms,
        "times_noise": residual.rms / noise,
        "depends_on": words.get(most, most),
        "explained_share": shares[most],
        "explained_shares": shares,
    }


def explained_share(dependence: Dependence, rms: float) -> float:
    """Share of the residual's mean square explained by its mean over bins of a quantity."""
    # Corrected for the scatter of bin means without any dependence.
    square = np.mean(dependence.mean**2 - dependence.standard_error**2)
    return float(np.clip(square / rms**2, 0.0, 1.0)) if rms > 0 else 0.0
