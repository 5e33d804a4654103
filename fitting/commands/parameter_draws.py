"""Draws of the fitted parameters, from the folder of a report."""

import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import Any

import jax.numpy as jnp
import numpy as np
import polars as pl
from scipy.stats import qmc

from fitting.errors import DataError, InputError
from fitting.report.outputs import final_account
from fitting.report.posterior import DRAWS_FILE
from fitting.stored_model import read_model
from hdjax import TwoInertiaModel
from hdjax.design import Draws


def drawn_from_report(folder: Path, count: int, *, hold: Collection[str] = (), seed: int = 0) -> Draws:
    """Draws of a fitted drive's parameters.

    Those of `hdjax fit --posterior` where the report has them, evenly thinned. Else from the normal distribution with
    the report's standard errors and correlations, in the logarithm of positive parameters. Correlations below 0.1,
    which a report omits, count as zero.

    Args:
        folder: of a report of `hdjax fit` or `hdjax close-loop`.
        count: number of draws.
        hold: fixed parameters.
        seed: of the normal distribution.

    Raises:
        InputError: the folder has no such report.
        DataError: the log does not determine a parameter, so that its draws have no meaning.
    """
    model = fitted_model(folder)
    try:
        report = json.loads((folder / "report.json").read_text(encoding="utf-8"))
        account = final_account(report)
        estimates = {p: e for p, e in account["parameters"].items() if p not in hold}
        spreads = {
            p: (float(e["value"]), float(e["std"] or np.inf), bool(e["identifiable"])) for p, e in estimates.items()
        }
        correlation = _correlation(account, tuple(spreads))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{folder}: no report.json of `hdjax fit` ({error}); give the folder of a report") from error
    if not spreads:
        raise InputError(f"{folder}: all parameters are held, so that there is nothing to draw; hold fewer")
    for path, (_, std, identifiable) in spreads.items():
        if not (identifiable and np.isfinite(std)):
            raise DataError(
                f"{folder}: its log does not determine {path}, so that draws of it have no meaning; "
                f'add hold = ["{path}"] to [robust]'
            )
    paths = tuple(spreads)
    # An earlier fit may have left its draws in the folder.
    if report.get("posterior") and (folder / DRAWS_FILE).exists():
        try:
            table = pl.read_parquet(folder / DRAWS_FILE).select(paths)
        except (OSError, pl.exceptions.PolarsError) as error:
            raise InputError(
                f"{folder / DRAWS_FILE}: not the draws of {', '.join(paths)} ({error}); fit again"
            ) from error
        rows = np.linspace(0, table.height - 1, min(count, table.height)).round().astype(int)
        return Draws(paths, jnp.asarray(table.to_numpy()[rows]))
    positive = np.array([model.parameters()[p][1].positive for p in paths])
    return Draws(paths, jnp.asarray(_normal(spreads, correlation, positive, count, seed)))


def fitted_model(folder: Path) -> TwoInertiaModel:
    """The model of a report.

    Raises:
        InputError: there is none, or it is a reduced one.
    """
    model = read_model(folder / "model.json").model
    if not isinstance(model, TwoInertiaModel):
        raise InputError(f"{folder}: a reduced model has no inertias to design; fit a log of both angles")
    return model


def _correlation(account: Mapping[str, Any], paths: tuple[str, ...]) -> np.ndarray:
    found = np.eye(len(paths))
    for pair in account["correlations"]:
        if all(name in paths for name in pair["between"]):
            i, j = (paths.index(name) for name in pair["between"])
            found[i, j] = found[j, i] = pair["value"]
    return found


def _normal(
    spreads: Mapping[str, tuple[float, float, bool]],
    correlation: np.ndarray,
    positive: np.ndarray,
    count: int,
    seed: int,
) -> np.ndarray:
    """Quasi-random draws of a normal distribution."""
    values, stds = (np.array(column) for column in zip(*((v, s) for v, s, _ in spreads.values()), strict=True))
    eigenvalues, vectors = np.linalg.eigh(correlation)
    # Without the omitted correlations, the matrix may not be positive definite.
    root = vectors * np.sqrt(np.maximum(eigenvalues, 0.0))
    standard = qmc.MultivariateNormalQMC(np.zeros(values.size), engine=qmc.LatinHypercube(values.size, rng=seed))
    z = standard.random(count) @ root.T
    relative = np.where(positive, stds / np.abs(values), 0.0)
    return np.where(positive, values * np.exp(relative * z - 0.5 * relative**2), values + stds * z)


def spread_around(values: Mapping[str, float], spreads: Mapping[str, float], count: int, seed: int = 0) -> Draws:
    """Draws of independent parameters with relative standard deviations, log-normal about their values.

    Args:
        values: by path, other than zero.
        spreads: relative standard deviation by path.
        count: number of draws.
        seed: of the draws.
    """
    told = {path: (values[path], abs(values[path]) * spread, True) for path, spread in spreads.items()}
    positive = np.ones(len(told), dtype=bool)
    return Draws(tuple(told), jnp.asarray(_normal(told, np.eye(len(told)), positive, count, seed)))
