"""Stability of a steady motion: the Floquet multipliers of its first variation over one period."""

import math

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Complex, Float

from hdjax.response.harmonic_balance import BalancedMotion

_TABLEAU = dfx.Dopri8.tableau


def monodromy(
    system: BalancedMotion, unknowns: Float[Array, " unknowns"], omega: Array, *, steps: int = 64
) -> Float[Array, "states states"]:
    """Monodromy matrix: growth of a small deviation from a steady motion over one period of the motion.

    The variational equation is integrated with the coefficients of diffrax's eighth-order Dormand-Prince method, whose
    stages fall at the same phases for every motion, so that many motions are lanes of one program.

    Args:
        system: from [`hdjax.response.balance`][].
        unknowns: a solution of it.
        omega: forcing frequency [rad/s].
        steps: of a period; at least a dozen for each natural oscillation within it.
    """
    nodes = np.concatenate([[0.0], np.asarray(_TABLEAU.c)])
    phases = (np.arange(steps)[:, None] + nodes) / steps * (2 * np.pi)
    h = 2 * jnp.pi * system.subharmonic / (omega * steps)
    matrices = jax.vmap(system.jacobian, in_axes=(None, None, 0))(unknowns, omega, jnp.asarray(phases.reshape(-1)))
    matrices = matrices.reshape(steps, nodes.size, *matrices.shape[1:])

    def step(Y: Array, A: Array) -> tuple[Array, None]:
        slopes = [A[0] @ Y]
        for i, row in enumerate(_TABLEAU.a_lower):
            slopes.append(A[i + 1] @ _advanced(Y, h, np.asarray(row), slopes))
        return _advanced(Y, h, np.asarray(_TABLEAU.b_sol), slopes), None

    end, _ = jax.lax.scan(step, jnp.eye(matrices.shape[-1]), matrices)
    return end


def _advanced(Y: Array, h: Array, weights: np.ndarray, slopes: list[Array]) -> Array:
    return Y + h * sum(float(w) * k for w, k in zip(weights, slopes, strict=False) if w != 0.0)


@eqx.filter_jit
def multipliers(
    system: BalancedMotion, unknowns: Float[Array, " unknowns"], omega: Array, *, steps: int = 64
) -> Complex[Array, " multipliers"]:
    """Floquet multipliers of a steady motion; it is stable where all lie inside the unit circle.

    For two inertias those of the rigid rotation are among them: one, or two where no friction holds the mean speed,
    are one to rounding.

    Args:
        system: from [`hdjax.response.balance`][].
        unknowns: a solution of it.
        omega: forcing frequency [rad/s].
        steps: of a period; at least a dozen for each natural oscillation within it.
    """
    matrix = monodromy(system, unknowns, omega, steps=steps)
    if matrix.shape[0] == 2:
        # In closed form: a general eigenvalue solver would dominate the cost.
        half, determinant = 0.5 * jnp.trace(matrix), jnp.linalg.det(matrix)
        root = jnp.sqrt(jnp.astype(half**2 - determinant, complex))
        half = jnp.astype(half, complex)
        return jnp.stack([half + root, half - root])
    return jnp.linalg.eigvals(matrix)


def resolving_steps(turns: float) -> int:
    """Steps of a period in which the drive oscillates so many times: a dozen for each, as a power of two (few shapes,
    few programs)."""
    return max(64, 2 ** math.ceil(math.log2(12.0 * max(turns, 1.0))))


def is_stable(multipliers: Complex[Array, "*rows multipliers"]) -> Bool[Array, "*rows"]:
    """Whether no Floquet multiplier lies outside the unit circle.

    A rigid rotation's double multiplier of one is exact to the root of rounding only.
    """
    margin = 0.0 if multipliers.shape[-1] == 2 else 1e-6
    return jnp.all(jnp.abs(multipliers) < 1.0 + margin, axis=-1)
