"""What a loop works on: training and selection data, how they are cut, the seed of its surrogates, who is told."""

from dataclasses import dataclass, replace

import equinox as eqx

from fitting.attribution.rules import RULES
from fitting.estimation.estimate import Fit
from fitting.estimation.experiment import Stretch
from fitting.estimation.problem import Segmentation
from fitting.estimation.solver_steps import needed_substeps
from fitting.progress import Progress, silent
from hdjax import Hold

# A few steps that together lower the objective by less than half of this are not worth another; nor by less than half
# of the latter while a model is but one of several.
LEAST_PROGRESS, _LEAST_OF_A_RIVAL = 0.1 * RULES.least_gain, RULES.least_gain

Data = dict[Hold, tuple[tuple[Stretch, ...], tuple[Stretch, ...]]]
"""Training and held-out stretches for each assumption about the torque between samples."""


class Setting(eqx.Module):
    """How the data are cut and simulated; the same for all trials, so that they share programs.

    Attributes:
        segmentation: into segments, and how finely these are simulated.
        least_progress: share of the sum of squares that a few steps of a fit must take off it.
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
    """What a loop works on.

    Attributes:
        data: the stretches; every hold that is here may be tried.
        setting: how they are cut.
        seed: of the surrogates behind the p-values.
        progress: told what is being done.
    """

    data: Data
    setting: Setting
    seed: int = 0
    progress: Progress = silent

    def with_substeps(self, count: int) -> "Study":
        """The same, with so many solver steps in a sample interval."""
        segmentation = replace(self.setting.segmentation, substeps=count)
        return replace(self, setting=replace(self.setting, segmentation=segmentation))

    def for_rivals(self) -> "Study":
        """The same, with no more patience than one of several models needs."""
        least = max(self.setting.least_progress, _LEAST_OF_A_RIVAL)
        return replace(self, setting=replace(self.setting, least_progress=least))

    def fine_enough(self, found: Fit) -> "Study":
        """The same, with as many solver steps as the fitted motion needs; itself where these are enough."""
        substeps = needed_substeps(found)
        return self.with_substeps(substeps) if substeps > (self.setting.segmentation.substeps or 0) else self
