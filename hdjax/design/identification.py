"""Precision of a parameter in a planned log.

The standard error of one parameter follows from the sensitivities of the dynamic error: the influence of the other
parameters and the initial state is projected out (the Schur complement of Fisher's information; Ljung 1999, chapter
13).
"""

from typing import ClassVar

import diffrax as dfx
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from hdjax.design.case import Case
from hdjax.design.measure import Measure, number
from hdjax.dynamics import ReducedModel
from hdjax.parameters import Scalar
from hdjax.signals import PiecewisePolynomial
from hdjax.simulate import march
from hdjax.where import where

_HALVINGS = 50
# Solver steps in a sample interval.
_SUBSTEPS = 2
OTHERS = ("alpha", "K", "B_sp")


class LogMeasure(Measure):
    """A measure of a planned log, which starts at rest under the case's motor torque, with zero-order hold.

    Attributes:
        rate: samples a second [Hz].
        duration: length of the log [s].
    """

    rate: eqx.AbstractVar[float]
    duration: eqx.AbstractVar[float]

    @property
    def samples(self) -> int:
        """Number of samples."""
        return max(round(self.rate * self.duration), 8)

    def errors(self, case: Case, start: Float[Array, "2"]) -> Float[Array, " samples"]:
        """The dynamic error at the samples from a twist [rad] and its rate [rad/s]."""
        time = jnp.arange(self.samples + 1.0) / self.rate
        torque = PiecewisePolynomial(time, jax.vmap(case.excitation)(time[:-1])[:, None])
        model = ReducedModel(case.drive.reduced())
        states, _ = march(model, torque, None, start, solver=dfx.Tsit5(), substeps=_SUBSTEPS)
        return states[:, 0]

    def refuse(self, case: Case) -> None:
        if case.model.effects:
            raise ValueError(f"`{self.name}` plans a log of the base model, but there is {case.model.effects[0].name}")
        if not (self.rate > 0.0 and self.duration > 0.0):
            raise ValueError(
                f"`{self.name}` must have positive rate and duration, but has {self.rate:g} Hz and {self.duration:g} s"
            )
        if self.rate < 3.0 * float(case.drive.omega_0) / (2.0 * jnp.pi):
            raise ValueError(f"`{self.name}` must sample three times a natural period at least; raise rate")


class LargestTwist(LogMeasure):
    """Largest dynamic error of a planned log [rad]."""

    name: ClassVar[str] = "largest_twist"
    unit: ClassVar[str] = "rad"
    says: ClassVar[str] = "largest dynamic error of the planned log"
    rate: float
    duration: float

    def __call__(self, case: Case) -> Array:
        sizes = jnp.abs(self.errors(case, jnp.zeros(2)))
        # The maximum of the parabola through the largest sample and its neighbours, which is smooth from sample to
        # sample.
        k = jnp.clip(jnp.argmax(sizes), 1, sizes.size - 2)
        before, top, after = sizes[k - 1], sizes[k], sizes[k + 1]
        bend = before - 2.0 * top + after
        return top - where(bend < 0.0, 0.125 * (after - before) ** 2 / where(bend < 0.0, bend, 1.0), 0.0)


class IdentificationTime(LogMeasure):
    """Length of the shortest log that determines `alpha` to a relative standard error [s].

    The noise of the dynamic error is white. K, B_sp and the initial state are fitted together with alpha. K and B_sp
    have priors of a factor of e, the initial state one of the motion's size, so that short times are possible. Where
    the planned log does not suffice, its end is extended as a steady motion, whose standard error decreases with the
    root of time.

    Attributes:
        rate: samples a second [Hz].
        duration: length of the log that is simulated [s].
        noise: rms noise of the dynamic error [rad].
        relative_error: required standard error of alpha over alpha.
    """

    name: ClassVar[str] = "identification_time"
    unit: ClassVar[str] = "s"
    says: ClassVar[str] = "shortest log that determines alpha to a relative standard error"
    rate: float
    duration: float
    noise: Scalar = number()
    relative_error: Scalar = number(0.05)

    def refuse(self, case: Case) -> None:
        super().refuse(case)
        if not (self.noise > 0.0 and self.relative_error > 0.0):
            raise ValueError(
                "`identification_time` must have positive noise and relative_error, but has "
                f"{self.noise:g} rad and {self.relative_error:g}"
            )
        if float(case.drive.alpha) == 0.0:
            raise ValueError("`identification_time` needs a cubic stiffness to determine, but alpha is zero")

    def __call__(self, case: Case) -> Array:
        standard = jnp.log(self.standard_errors(case) / self.relative_error)
        enough = standard <= 0.0
        # The k-th entry holds k + 1 samples.
        within = (first_below_zero(standard, enough) + 1.0) / self.rate
        beyond = standard.size / self.rate * jnp.exp(2.0 * standard[-1])
        return where(jnp.any(enough), within, beyond)

    def standard_errors(self, case: Case) -> Float[Array, " samples"]:
        """Standard error of alpha over alpha, of logs that end at each sample."""
        size = jax.lax.stop_gradient(jnp.max(jnp.abs(self.errors(case, jnp.zeros(2)))))
        units = size * jnp.stack([jnp.ones(()), jax.lax.stop_gradient(case.drive.omega_0)])

        def errors(change: Array) -> Array:
            changed = case.replace({p: case.model.get(p) * jnp.exp(change[i]) for i, p in enumerate(OTHERS)})
            return self.errors(changed, units * change[len(OTHERS) :])

        slopes = jax.jacfwd(errors)(jnp.zeros(len(OTHERS) + 2)) / self.noise
        information = jnp.cumsum(slopes[:, :, None] * slopes[:, None, :], axis=0)
        imitable = information[:, 1:, 1:] + jnp.eye(len(OTHERS) + 1)[None]
        shared = information[:, 1:, 0]
        own = information[:, 0, 0] - jnp.sum(shared * _solved(imitable, shared), axis=1)
        # Before the nonlinearity matters there is no information on alpha, and rounding may make it negative.
        return 1.0 / jnp.sqrt(jnp.maximum(own, 1e-12))


def first_below_zero(values: Float[Array, " n"], below: Bool[Array, " n"]) -> Float[Array, ""]:
    """Where a sampled function first falls below zero, in samples, by cubic interpolation.

    Linear interpolation would give a gradient that jumps from sample to sample.

    Args:
        values: at the samples.
        below: where they are below zero.
    """
    k = jnp.clip(jnp.argmax(below), 2, values.size - 2)
    y = values[k + jnp.arange(-2, 2)]
    before, after, start, end = y[1], y[2], 0.5 * (y[2] - y[0]), 0.5 * (y[3] - y[1])

    def cubic(s: Array, y: tuple[Array, Array, Array, Array]) -> Array:
        before, after, start, end = y
        steep = after - before
        return before + s * (start + s * (3.0 * steep - 2.0 * start - end + s * (start + end - 2.0 * steep)))

    live = (before, after, start, end)
    still = jax.lax.stop_gradient(live)

    def halved(_: Array, ends: tuple[Array, Array]) -> tuple[Array, Array]:
        low, high = ends
        middle = 0.5 * (low + high)
        above = cubic(middle, still) > 0.0
        return where(above, middle, low), where(above, high, middle)

    low, high = jax.lax.fori_loop(0, _HALVINGS, halved, (jnp.zeros(()), jnp.ones(())))
    s = 0.5 * (low + high)
    slope = jax.grad(cubic)(s, still)
    found = s - cubic(s, live) / where(slope < 0.0, slope, -1.0)
    return jnp.astype(k, float) - 1.0 + found


def _solved(matrices: Float[Array, "n p p"], sides: Float[Array, "n p"]) -> Float[Array, "n p"]:
    return jax.vmap(jnp.linalg.solve)(matrices, sides)
