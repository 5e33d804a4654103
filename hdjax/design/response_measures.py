"""Measures of the steady response, by harmonic balance."""

import abc
from collections.abc import Sequence
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from hdjax.design.case import Case
from hdjax.design.measure import SpeedRange, number
from hdjax.design.steady import (
    HARMONICS,
    Range,
    balanced,
    followed,
    largest_swing,
    motions_at,
    with_system,
)
from hdjax.drive import restoring
from hdjax.dynamics import TwoInertiaModel
from hdjax.effects import ActuatorEffect, LoadSideEffect, MeshGeometryEffect
from hdjax.effects.kinematic import KinematicHarmonic
from hdjax.fourier import FourierSeries
from hdjax.parameters import Scalar
from hdjax.response.continuation import Branch
from hdjax.response.fold import folds
from hdjax.response.harmonic_balance import BalancedMotion, SteadyState
from hdjax.where import where

# Of a revolution, for the largest twist of the mesh.
_SAMPLES = 64


class ResponseMeasure(SpeedRange):
    """A measure of the steady motions over a range of forcing frequencies, or of motor speeds where `rotating`."""

    rotating: eqx.AbstractVar[bool]

    @property
    def looked_at(self) -> Range:
        """Range in which motions are searched."""
        return Range(self.slow, self.fast)

    @abc.abstractmethod
    def of(self, case: Case, system: BalancedMotion, branches: Branch) -> Array:
        """The measure, from the branches from either end of `looked_at`."""

    def __call__(self, case: Case) -> Array:
        return responses(case, [self])[0]

    def refuse(self, case: Case) -> None:
        super().refuse(case)
        rotating = self.rotating
        if not case.drive.mu > 0.0:
            raise ValueError(f"`{self.name}` needs damping, but B_sp is {case.drive.B_sp:g}: no motion would be steady")
        for effect in case.model.effects:
            if effect.states or isinstance(effect, ActuatorEffect):
                raise ValueError(f"`{self.name}` rests on harmonic balance, which can't carry the effect {effect.name}")
            if rotating and isinstance(effect, LoadSideEffect):
                raise ValueError(f"`{self.name}` takes no torque on the load where the motor rotates: {effect.name}")
        if not rotating and not (case.excitation.amplitude != 0.0 or case.excitation.load_amplitude != 0.0):
            raise ValueError(f"`{self.name}` needs a torque: forcing.amplitude and forcing.load_amplitude are zero")
        errors = [e for e in case.model.effects if isinstance(e, MeshGeometryEffect)]
        if rotating and not errors:
            raise ValueError(f"`{self.name}` needs a kinematic error where the motor rotates, but there is none")
        for effect in errors if rotating else ():
            if "theta_l" in effect.angles:
                raise ValueError(f"`{self.name}` rests on harmonic balance, but {effect.name} has a longer period")
            if isinstance(effect, KinematicHarmonic) and not (effect.repeats() and float(effect.n) <= HARMONICS):
                raise ValueError(
                    f"`{self.name}` balances whole orders up to {HARMONICS}, but {effect.name} has order "
                    f"{float(effect.n):g}"
                )


def responses(case: Case, measures: Sequence[ResponseMeasure]) -> list[Array]:
    """Several measures of a case whose steady motions are searched for together."""
    found: dict[int, Array] = {}
    for rotating in (False, True):
        own = {i: m for i, m in enumerate(measures) if m.rotating == rotating}
        if not own:
            continue
        system = balanced(case, rotating=rotating)
        searched = followed(system, [m.looked_at for m in own.values()])
        found |= {i: m.of(case, system, branches) for (i, m), branches in zip(own.items(), searched, strict=True)}
    return [found[i] for i in range(len(measures))]


class PeakError(ResponseMeasure):
    """Largest deviation of the dynamic error from its mean over a range of speeds [rad].

    All motions found from either end of the range count, so that a design is safe for each of them. Detached branches
    are not found.
    """

    name: ClassVar[str] = "peak_error"
    unit: ClassVar[str] = "rad"
    says: ClassVar[str] = "largest swing of the dynamic error between slow and fast"
    slow: Scalar = number()
    fast: Scalar = number()
    rotating: bool = False

    def of(self, case: Case, system: BalancedMotion, branches: Branch) -> Array:
        return largest_swing(system, self.looked_at, branches)[0]


class MeshTorque(ResponseMeasure):
    """Largest elastic torque in the mesh, `K f(x)` [N m], to be held below the gear's rating.

    It is that at the largest swing of the dynamic error; where the motor rotates, at the largest twist of the mesh.
    """

    name: ClassVar[str] = "mesh_torque"
    unit: ClassVar[str] = "N m"
    says: ClassVar[str] = "largest elastic mesh torque between slow and fast"
    slow: Scalar = number()
    fast: Scalar = number()
    rotating: bool = False

    def of(self, case: Case, system: BalancedMotion, branches: Branch) -> Array:
        def size(motion: SteadyState) -> Array:
            return mesh_twist(case.model, motion) if self.rotating else motion.swing

        return case.drive.K * restoring(largest_swing(system, self.looked_at, branches, size)[0], case.drive.alpha)


def mesh_twist(model: TwoInertiaModel, motion: SteadyState) -> Array:
    """Largest twist of the mesh over a revolution of the motor, kinematic error included [rad]."""
    angles = jnp.arange(float(_SAMPLES)) * (2 * jnp.pi / _SAMPLES)
    series = motion.motion
    x, theta_l = FourierSeries(1.0, series.mean, series.cosine, series.sine)(angles).T
    theta_m = angles + model.drive.N * (x + theta_l)
    states = jnp.stack([theta_m, theta_m / model.drive.N - x, jnp.zeros_like(x), jnp.zeros_like(x)], axis=1)
    return jnp.max(jnp.abs(jax.vmap(lambda state: model.motion(state).x)(states)))


class Loss(ResponseMeasure):
    """Mean dissipated power between slow and fast, over evenly spaced speeds [W].

    In a steady motion all input power is dissipated, so the input power is computed. Of coexisting motions the largest
    counts.
    """

    name: ClassVar[str] = "loss"
    unit: ClassVar[str] = "W"
    says: ClassVar[str] = "mean power lost between slow and fast"
    slow: Scalar = number()
    fast: Scalar = number()
    rotating: bool = False
    speeds: int = 32

    def of(self, case: Case, system: BalancedMotion, branches: Branch) -> Array:
        width = (self.fast - self.slow) / self.speeds
        at = self.slow + width * (jnp.arange(float(self.speeds)) + 0.5)
        motions, found = motions_at(system, branches, at)
        power = jax.vmap(lambda m: power_in(case, m, rotating=self.rotating))(motions)
        mean = jnp.sum(where(found, power, 0.0)) / jnp.maximum(jnp.sum(where(found, 1.0, 0.0)), 1.0)
        # A speed next to a fold may lack its motion; if half of a range lacks them, the loss is unknown.
        return where(jnp.mean(where(found, 1.0, 0.0)) > 0.5, mean, jnp.nan)


def power_in(case: Case, motion: SteadyState, *, rotating: bool) -> Array:
    """Mean power of the torques on a steady motion [W]."""
    series, torques = motion.motion, case.excitation
    if rotating:
        return case.drive.k_T * motion.mean_torque * series.omega
    x = series.sine[0, 0]
    if not case.model.effects:
        push = case.drive.error_forcing(torques.amplitude, torques.load_amplitude)
        return 0.5 * series.omega * x * push / case.drive.c
    load = series.sine[1, 0]
    motor = case.drive.k_T * torques.amplitude * case.drive.N * (x + load)
    return 0.5 * series.omega * (motor + torques.load_amplitude * load)


class FoldDistance(ResponseMeasure):
    """Distance of the folds, at which the response jumps, from the range of speeds: `|log(fold/speed)|` of the nearest.

    Negative inside the range, zero at its ends. Where the branches have no fold within `reach` times the range it is
    `log(reach)`, with no gradient.
    """

    name: ClassVar[str] = "fold_distance"
    unit: ClassVar[str] = "1"
    says: ClassVar[str] = "logarithmic distance of the nearest fold from slow and fast, negative between them"
    slow: Scalar = number()
    fast: Scalar = number()
    rotating: bool = False
    reach: Scalar = number(2.0)

    def refuse(self, case: Case) -> None:
        super().refuse(case)
        if not self.reach > 1.0:
            raise ValueError(f"`fold_distance` must have a reach above 1, but has {self.reach:g}")

    @property
    def looked_at(self) -> Range:
        return Range(self.slow / self.reach, self.fast * self.reach)

    def of(self, case: Case, system: BalancedMotion, branches: Branch) -> Array:
        def of_one(branch: Branch) -> Array:
            found = folds(with_system(branch, system))
            value = where(found.exists, found.value, 1.0)
            distance = outside(value, self.slow, self.fast)
            return jnp.min(where(found.exists, distance, jnp.inf))

        nearest = jnp.min(jax.vmap(of_one)(branches))
        far = jnp.log(self.reach)
        return where(nearest < far, nearest, far)


def outside(value: Array, slow: Array, fast: Array) -> Array:
    """Logarithmic distance of frequencies from a range; negative inside it."""
    return jnp.maximum(jnp.log(slow / value), jnp.log(value / fast))
