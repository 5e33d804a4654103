"""Criteria of an uncertain measure: its expected value, or the mean of its worst share.

The mean of the worst share is the conditional value at risk (Rockafellar and Uryasev 2000), `min over t of t + E[max(f
- t, 0)]/share`, convex in f. If it is at most a limit, the limit is met with a probability of at least `1 - share`. For
draws it is the mean of the worst few, with a kink wherever their order changes; `max` is therefore smoothed over a
hundredth of the draws' standard deviation.
"""

from typing import Literal, get_args

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

Criterion = Literal["expected", "worst"]
CRITERIA: tuple[Criterion, ...] = get_args(Criterion)

_ROUNDED = 0.01
_BISECTIONS = 60


class Draws(eqx.Module):
    """Uncertain parameters, as equally probable draws.

    Attributes:
        paths: dotted paths of the parameters.
        values: in SI units, by draw.
    """

    paths: tuple[str, ...] = eqx.field(static=True)
    values: Float[Array, "draws paths"]

    def at(self, row: Float[Array, " paths"]) -> dict[str, Array]:
        """One draw by path."""
        return {path: row[i] for i, path in enumerate(self.paths)}


def worst_share(values: Float[Array, " draws"], share: float) -> Float[Array, ""]:
    """Mean of the largest `share` of equally probable values, smoothed where their order changes; differentiable."""
    mean = jnp.mean(values)
    spread = jnp.sqrt(jnp.mean((values - mean) ** 2) + (1e-9 * mean) ** 2 + 1e-300)
    scaled = (values - mean) / spread
    still = jax.lax.stop_gradient(scaled)

    def halved(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        too_low = jnp.mean(jax.nn.sigmoid((still - middle) / _ROUNDED)) > share
        return jnp.where(too_low, middle, low), jnp.where(too_low, high, middle)

    # The derivative by t is zero there, so that of t does not matter.
    low, high = jax.lax.fori_loop(0, _BISECTIONS, halved, (jnp.min(still) - 1.0, jnp.max(still) + 1.0))
    t = 0.5 * (low + high)
    above = _ROUNDED * jax.nn.softplus((scaled - t) / _ROUNDED)
    return mean + spread * (t + jnp.mean(above) / share)


def exact_worst_share(values: np.ndarray, share: float) -> float:
    """Mean of the largest `share` of equally probable values, the last of them counted in part."""
    ordered = np.sort(values)[::-1]
    count = share * ordered.size
    weights = np.clip(count - np.arange(ordered.size), 0.0, 1.0)
    return float(weights @ ordered / count)
