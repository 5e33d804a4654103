"""Draws from the posterior of a fit's parameters by the no-U-turn sampler (Hoffman and Gelman 2014) of blackjax.

The log density is minus half the sum of squares with the initial states refitted at each draw, so that only the few
shared parameters are sampled. Its gradient is the projected one: at optimal initial states, their contribution
vanishes. The prior is flat in the free vector: in the logarithm of a positive parameter, in the value of any other.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from fitting.estimation.arrow_system import normal_equations, project
from fitting.estimation.engines import blocks_inside
from fitting.estimation.estimate import Fit
from fitting.estimation.residual import Problem, Products, Unknowns
from fitting.uncertainty.standard_errors import Uncertainty
from hdjax.where import where

# Gauss-Newton steps from the fit's initial states to those of a draw.
_STATE_STEPS = 2
# Largest R-hat of converged chains (Vehtari et al. 2021).
_SETTLED = 1.01


class Posterior(eqx.Module):
    """Draws of the free parameters.

    Attributes:
        paths: dotted paths.
        vectors: of the free vector, by chain and draw.
        values: the same in SI units.
        r_hat: potential scale reduction by parameter; 1 where the chains agree.
        effective_samples: by parameter.
        divergences: divergent transitions of the integrator; more than a few make draws unreliable.
    """

    paths: tuple[str, ...] = eqx.field(static=True)
    vectors: Float[np.ndarray, "chains draws parameters"]
    values: Float[np.ndarray, "chains draws parameters"]
    r_hat: Float[np.ndarray, " parameters"]
    effective_samples: Float[np.ndarray, " parameters"]
    divergences: int

    @property
    def settled(self) -> bool:
        """Whether the chains have converged."""
        return bool((self.r_hat < _SETTLED).all()) and self.divergences == 0

    def quantiles(self, *levels: float) -> dict[str, np.ndarray]:
        """Quantiles of each parameter in SI units, by path."""
        flat = self.values.reshape(-1, len(self.paths))
        return dict(zip(self.paths, np.quantile(flat, levels, axis=0).T, strict=True))


def posterior(
    fit: Fit,
    found: Uncertainty,
    *,
    seed: int,
    chains: int = 4,
    draws: int = 500,
    warmup: int = 300,
    coloured: bool = True,
) -> Posterior:
    """Sample the posterior of a fit's parameters.

    Args:
        fit: the fit.
        found: its uncertainty, which sets the sampler's scales.
        seed: of the random numbers.
        chains: number of parallel chains.
        draws: number kept of each chain.
        warmup: number of adaptation steps.
        coloured: whether draws are rescaled about the optimum to the robust covariance (the open-faced sandwich of
            Shaby 2014); else the residual is assumed white.

    Raises:
        ImportError: blackjax is not installed.
        ValueError: no parameter is free.
    """
    if not fit.free.paths:
        raise ValueError("`fit` must have free parameters, but has none")
    sampler()
    problem = fit.at_solution
    root = np.linalg.cholesky(found.unit_covariance)
    keys = jax.random.split(jax.random.key(seed), chains)
    # The library mixes dtypes and ranks, which strict settings forbid.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        drawn, divergent, r_hat, effective = _sample(problem, fit.unknowns, jnp.asarray(root), keys, warmup, draws)
    centre = np.asarray(fit.unknowns.parameters)
    # For whitened entries, the robust covariance is a linear rescaling.
    stretch = _root(np.linalg.solve(root, np.linalg.solve(root, found.covariance).T)) if coloured else np.eye(len(root))
    vectors = centre + np.asarray(drawn) @ (root @ stretch).T
    return Posterior(
        paths=fit.free.paths,
        vectors=vectors,
        values=_physical(fit, vectors),
        r_hat=np.atleast_1d(r_hat),
        effective_samples=np.atleast_1d(effective),
        divergences=int(divergent),
    )


def sampler() -> Any:
    """The sampling library.

    Raises:
        ImportError: it is not installed.
    """
    try:
        import blackjax  # pyright: ignore[reportMissingImports]
    except ImportError:
        raise ImportError("sampling needs blackjax: install the extra, `pip install 'hdjax[posterior]'`") from None
    return blackjax


def _root(matrix: np.ndarray) -> np.ndarray:
    """The symmetric root of a covariance."""
    values, vectors = np.linalg.eigh(matrix)
    return (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T


def _physical(fit: Fit, vectors: np.ndarray) -> np.ndarray:
    logarithmic = np.array(fit.free.logarithmic)
    with np.errstate(over="ignore"):
        return np.where(logarithmic, np.exp(vectors), vectors * np.asarray(fit.free.scale))


@eqx.filter_jit
def _sample(
    problem: Problem, optimum: Unknowns, root: Array, keys: Array, warmup: int, draws: int
) -> tuple[Array, Array, Array, Array]:
    """Whitened draws by chain, number of divergences, R-hat and effective sample size by parameter."""
    blackjax = sampler()

    def density(z: Array) -> Array:
        return _log_density(root @ z, (problem, optimum))

    def chain(key: Array) -> tuple[Array, Array]:
        scatter, adapt, sample = jax.random.split(key, 3)
        start = jax.random.normal(scatter, optimum.parameters.shape)
        (state, tuned), _ = blackjax.window_adaptation(blackjax.nuts, density).run(adapt, start, warmup)
        kernel = blackjax.nuts(density, **tuned)

        def step(state, key):
            state, info = kernel.step(key, state)
            return state, (state.position, info.is_divergent)

        _, (positions, divergent) = jax.lax.scan(step, state, jax.random.split(sample, draws))
        return positions, divergent

    positions, divergent = jax.vmap(chain)(keys)
    parameters = jnp.einsum("pq,cdq->cdp", root, positions)
    return (
        positions,
        jnp.sum(divergent),
        blackjax.diagnostics.potential_scale_reduction(parameters),
        blackjax.diagnostics.effective_sample_size(parameters),
    )


@eqx.filter_custom_jvp
def _log_density(change: Float[Array, " parameters"], given: tuple[Problem, Unknowns]) -> Float[Array, ""]:
    """Log density, up to a constant, at parameters that differ by `change` from the optimum."""
    return _density_and_gradient(change, given)[0]


@_log_density.def_jvp
def _log_density_jvp(primals, tangents):
    change, given = primals
    tangent, _ = tangents
    value, gradient = _density_and_gradient(change, given)
    return value, jnp.zeros_like(value) if tangent is None else gradient @ tangent


def _density_and_gradient(change: Array, given: tuple[Problem, Unknowns]) -> tuple[Array, Array]:
    """Log density and its gradient, with the initial states fitted to the parameters."""
    problem, optimum = given
    joined = problem.segments.joined
    parameters = optimum.parameters + change

    def refine(_, carried):
        states, _, _ = carried
        found = blocks_inside(problem, Unknowns(parameters, states))
        off = problem.free.off_prior(parameters)
        value = -0.5 * jnp.sum(found.residual**2) - 0.5 * jnp.sum(off**2)
        gradient = -jnp.einsum("srp,sr->p", project(found, joined), found.residual) - problem.free.precision * off
        held = eqx.tree_at(lambda b: (b.by_parameter, b.before_by_parameter), found, replace_fn=jnp.zeros_like)
        step = normal_equations(Products.of(held), joined).step(jnp.zeros(()))
        return states + step.states, value, gradient

    # The last pass only evaluates.
    start = (optimum.states, jnp.zeros(()), jnp.zeros_like(parameters))
    _, value, gradient = jax.lax.fori_loop(0, _STATE_STEPS + 1, refine, start)
    fine = jnp.isfinite(value) & jnp.isfinite(gradient).all()
    return where(fine, value, -jnp.inf), where(fine, gradient, jnp.zeros_like(gradient))
