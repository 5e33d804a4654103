"""Data and settings of a loop: training and selection data, segmentation, seed of the surrogates, progress."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import equinox as eqx

from fitting.attribution.rules import RULES
from fitting.estimation.base_fit import leaves_white_noise
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.problem import Segmentation
from fitting.estimation.scales import scales
from fitting.estimation.solver_steps import needed_substeps
from fitting.progress import Progress, silent
from fitting.uncertainty.one_side import contradicts
from hdjax import Hold, Model, MotorDrivenModel
from hdjax.effects import Effect, LoadSideEffect, MotorSideEffect, Scales

# Least decrease of the objective, times two, over a few steps for an iteration to go on; the second one applies while
# several candidates compete.
LEAST_PROGRESS, _LEAST_OF_A_RIVAL = 0.1 * RULES.least_gain, RULES.least_gain

Data = dict[Hold, tuple[tuple[Stretch, ...], tuple[Stretch, ...]]]
"""Training and held-out stretches for each hold of the torque."""


class Setting(eqx.Module):
    """Segmentation and iteration settings; the same for all trials, so that they share programs.

    Attributes:
        segmentation: segment lengths and solver steps.
        least_progress: least relative decrease of the sum of squares over a few steps of a fit.
        thorough: whether all forms of the catalogue are refitted in each round.
    """

    segmentation: Segmentation = eqx.field(static=True)
    least_progress: float = eqx.field(static=True, default=LEAST_PROGRESS)
    thorough: bool = eqx.field(static=True, default=False)

    @property
    def halo(self) -> int:
        """Intervals of torque before a segment."""
        return self.segmentation.halo


@dataclass(frozen=True)
class Study:
    """Data and settings of a loop.

    Attributes:
        data: the stretches, for every hold that may be tried.
        setting: segmentation and iteration.
        seed: of the surrogates for p-values.
        progress: receives messages.
        load_late: see [`hdjax.effects.Scales`][].
        side: the fit of one side's equation that leaves only noise, where the base model's parameters are from it.
    """

    data: Data
    setting: Setting
    seed: int = 0
    progress: Progress = silent
    load_late: float = 0.0
    side: Fit | None = None

    def scales(self, stretches: Sequence[Stretch], model: Model) -> Scales:
        """Orders of magnitude of a motion, see [`fitting.estimation.scales.scales`][]."""
        return replace(scales(stretches, model), load_late=self.load_late)

    def side_of(self, model: Model) -> Fit | None:
        """The side whose equation determines a model's K, alpha and B_sp; None without any, or where an effect
        contradicts it."""
        return None if any(contradicts(effect, self.side) for effect in model.effects) else self.side

    def lacking(self, model: Model) -> type[Effect] | None:
        """The kind of effect that a model lacks according to the equation of `side`, if that needs torques on its own
        side. An inexact law of friction on the other side does not enter that equation.
        """
        side = self.side_of(model)
        if side is None or side.stretches[0].experiment.shaft_torques is None:
            return None
        kind = LoadSideEffect if isinstance(side.model, MotorDrivenModel) else MotorSideEffect
        return None if any(isinstance(effect, kind) for effect in model.effects) else kind

    def beside_imperfect(self, found: Fit, catalogue: Sequence[type[Effect]]) -> list[type[Effect]]:
        """The forms that may improve a model although the inexact laws of its effects may explain its residual."""
        lacking, another = self.lacking(found.model), not leaves_white_noise(found)
        return [
            form
            for form in catalogue
            if (lacking and issubclass(form, lacking)) or (another and _is_another_law(form, found.model))
        ]

    def suspects(self, effect: Effect, model: Model) -> bool:
        """Whether a model may lack an effect that screening does not show.

        Where the equation of `side` leaves only noise, that is friction of the other side, or what contradicts the
        equation: the motion may be far off without. Beside other effects it may also be another law of a friction,
        whose law was chosen while they were missing.
        """
        if any(effect.family == other.family for other in model.effects):
            return _is_another_law(effect, model)
        side = self.side_of(model)
        if side is None:
            return False
        friction = "motor_friction" if isinstance(side.model, MotorDrivenModel) else "load_friction"
        return effect.family == friction or contradicts(effect, side)

    def with_substeps(self, count: int) -> "Study":
        """The same with a given number of solver steps per sample interval."""
        segmentation = replace(self.setting.segmentation, substeps=count)
        return replace(self, setting=replace(self.setting, segmentation=segmentation))

    def for_rivals(self) -> "Study":
        """The same with the least progress for one of several models."""
        least = max(self.setting.least_progress, _LEAST_OF_A_RIVAL)
        return replace(self, setting=replace(self.setting, least_progress=least))

    def fine_enough(self, found: Fit) -> "Study":
        """The same with as many solver steps as the fitted motion needs."""
        substeps = needed_substeps(found)
        return self.with_substeps(substeps) if substeps > (self.setting.segmentation.substeps or 0) else self


def _is_another_law(effect: Effect | type[Effect], model: Model) -> bool:
    """Whether an effect is another law of one that was chosen before others of the model were there."""
    return len(model.effects) > 1 and any(effect.replaces(other) for other in model.effects)
