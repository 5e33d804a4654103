"""Draws from the posterior: quantiles and diagnostics for the report, and the draws as a table."""

from io import BytesIO
from typing import Any

import numpy as np

from fitting.uncertainty.posterior import Posterior

QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
"""Quantile levels in a report."""

DRAWS_FILE = "posterior.parquet"
"""File of the draws, beside the report."""


def posterior_dict(found: Posterior | None) -> dict[str, Any] | None:
    """Quantiles of each parameter and diagnostics of the draws; None without draws."""
    if found is None:
        return None
    chains, draws, _ = found.values.shape
    quantiles = found.quantiles(*QUANTILES)
    parameters = {
        path: {
            "quantiles": dict(zip(map(str, QUANTILES), quantiles[path].tolist(), strict=True)),
            "r_hat": float(found.r_hat[i]),
            "effective_samples": float(found.effective_samples[i]),
        }
        for i, path in enumerate(found.paths)
    }
    return {
        "chains": chains,
        "draws": draws,
        "divergences": found.divergences,
        "settled": found.settled,
        "says": _says(found),
        "file": DRAWS_FILE,
        "parameters": parameters,
    }


def _says(found: Posterior) -> str:
    chains, draws, _ = found.values.shape
    made = f"{draws} draws from each of {chains} chains, {found.divergences} divergent transitions"
    if found.settled:
        return f"{made}: the chains agree."
    return f"{made}: the chains have NOT converged (R-hat above 1.01 or divergences); don't rely on these quantiles."


def draws_table(found: Posterior) -> bytes:
    """The draws as a Parquet file: `chain`, `draw`, and each parameter in the unit of the report."""
    # Imported here: few fits draw from the posterior.
    import polars as pl

    chains, draws, _ = found.values.shape
    columns = {"chain": np.repeat(np.arange(chains), draws), "draw": np.tile(np.arange(draws), chains)}
    columns |= {path: found.values[:, :, i].ravel() for i, path in enumerate(found.paths)}
    buffer = BytesIO()
    pl.DataFrame(columns).write_parquet(buffer)
    return buffer.getvalue()
