"""The response over a frequency range, followed from both ends; the branches differ if a fold is beyond the range."""

from typing import Any

import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Float

from hdjax.dynamics import Model
from hdjax.fourier import FourierSeries
from hdjax.response.continuation import Branch, frequency_response

# Difference of equal motions in scaled unknowns, from the tolerance of the continuation (assumed).
_SAME = 1e-4


def from_both_ends(
    model: Model, forcing: FourierSeries | None, slow: ArrayLike, fast: ArrayLike, **options: Any
) -> tuple[Branch, ...]:
    """The branch from the slow end of a range, and the one from the fast end if it differs.

    A hardening drive's branch may leave the range at large amplitude; motions reached from higher speeds are then on
    the second branch. A softening drive's may turn back before the fast end. Rows are valid up to where a branch leaves
    the range.

    Args:
        model: see [`hdjax.response.frequency_response`][], as for the other arguments.
        forcing: its omega is not used.
        slow: lowest forcing frequency [rad/s].
        fast: highest forcing frequency [rad/s].
        **options: of [`hdjax.response.frequency_response`][].
    """
    up, down = (
        frequency_response(model, forcing, start, end, **options) for start, end in ((slow, fast), (fast, slow))
    )
    met = bool(up.complete & jnp.allclose(_last(up, down.omega[0]), down.unknowns[0], rtol=0.0, atol=_SAME))
    return tuple(branch.within(slow, fast) for branch in ((up,) if met else (up, down)))


def _last(branch: Branch, omega: Array) -> Float[Array, " unknowns"]:
    """The last motion of a branch at a frequency close to its end, where the continuation stops within a tolerance."""
    (before, last), (start, end) = branch.unknowns[-2:], branch.omega[-2:]
    return last + (last - before) * (omega - end) / (end - start)
