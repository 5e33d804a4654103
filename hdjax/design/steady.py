"""Steady motions over a range of speeds, followed from both ends, and the largest of them.

The search for motions is not differentiated. Its result is refined by a Newton step of the differentiable equations,
which has exact first derivatives (implicit function theorem); the peak comes from [`hdjax.response.resonance.peak`][].
The largest value over a range has the gradient of the place where it is largest (Danskin 1967), whether that is inside
or at an end. A smooth maximum would exceed the largest value by an amount that depends on the number of speeds, and
would miss a peak between two of them.
"""

from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from hdjax.design.case import Case
from hdjax.dynamics import ReducedModel
from hdjax.fourier import harmonic_series
from hdjax.parameters import Scalar
from hdjax.response.continuation import Branch, follow
from hdjax.response.harmonic_balance import BalancedMotion, SteadyState, balance
from hdjax.response.resonance import peak
from hdjax.where import where

HARMONICS = 5
_ANOTHER = 1e-3
_CORRECTIONS = 4
_SOLVED = 1e-7
# Motions along a branch, and steps of its continuation at most.
_ROWS, _STEPS = 60, 120


class Range(eqx.Module):
    """A range of forcing frequencies, or of motor speeds.

    Attributes:
        slow: lowest [rad/s].
        fast: highest [rad/s].
    """

    slow: Scalar
    fast: Scalar


def balanced(case: Case, *, rotating: bool) -> BalancedMotion:
    """The balance of a case; without effects that of the dynamic error alone, which is the same motion and cheaper.

    Args:
        case: drive and torques.
        rotating: the motor turns at the speeds of the range and its kinematic error excites it; the torques are not
            used.
    """
    torque, load = case.excitation.amplitude, case.excitation.load_amplitude
    if rotating:
        return balance(case.model, None, harmonics=HARMONICS, rotating=True)
    if case.model.effects:
        forcing, load_torque = (harmonic_series(1.0, t) for t in (torque, load))
        return balance(case.model, forcing, load_torque=load_torque, harmonics=HARMONICS)
    reduced = case.drive.reduced()
    forcing = harmonic_series(1.0, case.drive.error_forcing(torque, load) / reduced.gain)
    return balance(ReducedModel(reduced), forcing, harmonics=HARMONICS)


def followed(system: BalancedMotion, ranges: Sequence[Range]) -> list[Branch]:
    """For each range the branches from its slow end and from its fast end, as two lanes.

    All are lanes of one search, which takes longest to compile.
    """
    still = jax.lax.stop_gradient(system)

    def of_one(start: Array, end: Array) -> Branch:
        branch = follow(still, "omega", start, end, points=_ROWS, steps=_STEPS)
        return jax.lax.stop_gradient(branch.within(jnp.minimum(start, end), jnp.maximum(start, end)))

    starts, ends = zip(*((r.slow, r.fast) for r in ranges), strict=True)
    found = jax.vmap(of_one)(jnp.stack([*starts, *ends]), jnp.stack([*ends, *starts]))
    lanes = [np.array([i, i + len(ranges)]) for i in range(len(ranges))]
    return [jax.tree.map(lambda a, pair=pair: a[pair], found) for pair in lanes]


def with_system(branch: Branch, system: BalancedMotion) -> Branch:
    """A branch whose motions depend on the differentiable system."""
    return eqx.tree_at(lambda b: b.system, branch, system)


def solved_once_more(system: BalancedMotion, unknowns: Array, omega: Array) -> SteadyState:
    """The motion near a solution, with gradients by all parts of the system."""
    u = jax.lax.stop_gradient(unknowns)
    slope = jax.jacfwd(jax.lax.stop_gradient(system).residual)(u, omega)
    left = system.residual(u, omega)
    found = u - jnp.linalg.solve(slope, left)
    return system.steady_state(found, omega, jnp.max(jnp.abs(left)) < _SOLVED)


def largest_swing(
    system: BalancedMotion,
    looked_at: Range,
    branches: Branch,
    size_of: Callable[[SteadyState], Float[Array, ""]] = lambda motion: motion.swing,
) -> tuple[Float[Array, ""], SteadyState]:
    """The largest swing, or another size, of all steady motions found in a range, stable or not, and the motion.

    NaN where neither branch could be followed to the other end, so that the peak may have been missed.

    The middle branch between two folds is smaller than the one above it, so that it is never the largest.
    """

    def of_one(branch: Branch) -> tuple[Array, SteadyState]:
        live = with_system(branch, system)
        rows = jax.vmap(lambda u, w: size_of(system.steady_state(u, w, w > 0.0)))(branch.unknowns, branch.omega)
        rows = where(branch.valid, jax.lax.stop_gradient(rows), -1.0)
        top = peak(live)
        within = top.converged & (top.value >= looked_at.slow) & (top.value <= looked_at.fast)
        last = jnp.max(where(branch.valid, jnp.arange(rows.size), 0))
        picked = jnp.stack([jnp.argmax(rows), jnp.zeros_like(last), last])
        at_rows = jax.vmap(lambda i: solved_once_more(system, branch.unknowns[i], branch.omega[i]))(picked)
        motions = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), top.steady_state, at_rows)
        sizes = jax.vmap(size_of)(motions)
        # The largest row is used where the peak was not located, or is another one: the peak is that of the mean
        # square. Near the same peak it is slightly smaller, and jumps from row to row.
        same = within & (picked[0] > 0) & (picked[0] < last) & (sizes[1] < (1.0 + _ANOTHER) * sizes[0])
        usable = jnp.stack([within, ~same, jnp.asarray(True), jnp.asarray(True)])
        return where(usable & branch.valid[picked[0]], sizes, -1.0), motions

    sizes, motions = jax.vmap(of_one)(branches)
    motions = jax.tree.map(lambda a: a.reshape(-1, *a.shape[2:]), motions)
    best = jnp.argmax(sizes.reshape(-1))
    size = sizes.reshape(-1)[best]
    return where((size >= 0.0) & jnp.any(branches.complete), size, jnp.nan), jax.tree.map(lambda a: a[best], motions)


def motions_at(
    system: BalancedMotion, branches: Branch, speeds: Float[Array, " speeds"]
) -> tuple[SteadyState, Bool[Array, " speeds"]]:
    """At each speed the largest of the steady motions found, and whether there is one.

    Args:
        system: of the case.
        branches: of a range that holds the speeds, see [`followed`][].
        speeds: [rad/s].
    """
    still = jax.lax.stop_gradient(system)

    def crossings(branch: Branch) -> tuple[Array, Array, Array]:
        """Size of each segment that crosses each speed, and the unknowns of both of its ends."""
        size = jnp.linalg.norm(branch.unknowns, axis=1)
        start, end = branch.omega[:-1, None], branch.omega[1:, None]
        crossed = ((start - speeds[None]) * (end - speeds[None]) <= 0.0) & (branch.valid[:-1] & branch.valid[1:])[
            :, None
        ]
        share = where(crossed, (speeds[None] - start) / where(end == start, 1.0, end - start), 0.0)
        return where(crossed, jnp.maximum(size[:-1], size[1:])[:, None], -1.0), share, branch.unknowns

    sizes, shares, unknowns = jax.vmap(crossings)(branches)
    segments = sizes.shape[1]
    best = jnp.argmax(sizes.reshape(-1, speeds.size), axis=0)

    def at(column: Array, index: Array, omega: Array) -> tuple[SteadyState, Array]:
        lane, row = index // segments, index % segments
        share = shares[lane, row, column]
        u = (1.0 - share) * unknowns[lane, row] + share * unknowns[lane, row + 1]
        for _ in range(_CORRECTIONS):
            u = u - jnp.linalg.solve(jax.jacfwd(still.residual)(u, omega), still.residual(u, omega))
        motion = solved_once_more(system, u, omega)
        return motion, motion.converged & (sizes[lane, row, column] >= 0.0) & jnp.any(branches.complete)

    return jax.vmap(at)(jnp.arange(speeds.size), best, speeds)
