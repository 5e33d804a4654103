"""The clocks of several logs, set by a line in what a fit leaves over: a disturbance of its own frequency does not wait
for a log to start, so that it begins each one in another phase."""

from collections.abc import Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from fitting.attribution.candidate_fit import Trial, attempt
from fitting.attribution.rules import RULES
from fitting.attribution.study import Data, Study
from fitting.estimation.estimate import Fit, segments_of_logs
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import effect_paths
from fitting.estimation.projection import solved
from fitting.first_order.gains import Acting, Look, best_steps, left_after, look_along, products
from fitting.first_order.motion import place_of
from fitting.first_order.spectral_lines import spectral_lines
from hdjax import Hold
from hdjax.effects.learned import LEARNED_TORQUES, Learned, LearnedPeriodic, LearnedTorque
from hdjax.effects.learned_axes import PeriodicAxis

# Refits after which the clocks have settled, and by how many standard errors of a phase they may still be off.
_REFITS = 4
_SETTLED = 0.1


class Phasors(eqx.Module):
    """A line in several logs, as a torque.

    Attributes:
        place: where the torque acts.
        omega: its frequency [rad/s].
        torque: `C + i S` of the torque `C cos(omega t) + S sin(omega t)` in each log [N m].
        information: of each log about either part [1/(N m)^2].
        values: how many measured values tell of it.
    """

    place: type[LearnedTorque] = eqx.field(static=True)
    omega: float
    torque: Complex[np.ndarray, " logs"]
    information: Float[np.ndarray, " logs"]
    values: float

    @property
    def share(self) -> float:
        """Of the squares of what is left, what the line explains with a phase of each log's own."""
        explained = float(np.sum(self.told**2))
        return explained / (explained + self.values)

    @property
    def told(self) -> Float[np.ndarray, " logs"]:
        """Standard errors by which the line is told from zero in each log."""
        return np.sqrt(self.information) * np.abs(self.torque)

    @property
    def mean(self) -> complex:
        """Of the torque over the logs."""
        return complex(np.sum(self.information * self.torque) / np.sum(self.information))

    @property
    def effect(self) -> Learned:
        """The torque of that mean, inside the equations."""
        axes = (PeriodicAxis("time", self.omega, orders=1),)
        return self.place.made_of(axes, np.eye(axes[0].count)[:, 1:], (self.mean.real, self.mean.imag))

    @property
    def first(self) -> int:
        """The first log that has the line."""
        return int(np.argmax(self.told > RULES.line_errors))

    @property
    def late(self) -> Float[np.ndarray, " logs"]:
        """By how much later than in the first log that has the line it comes in each of them [s], within half a period
        either way; zero in one that does not have it."""
        turned = np.angle(self.torque * self.in_phase.torque.conj())
        return np.where(np.arange(turned.size) == self.first, 0.0, turned) / self.omega

    @property
    def in_phase(self) -> "Phasors":
        """The same with the first phase in all logs that have the line."""
        turned = np.abs(self.torque) * np.exp(1j * np.angle(self.torque[self.first]))
        return replace(self, torque=np.where(self.told > RULES.line_errors, turned, self.torque))


def with_clocks_set(base: Trial, study: Study) -> tuple[Trial, Study]:
    """The logs with their clocks set so that a line that stands out of what the base model leaves over is in phase; as
    they are where there is no such line, or where it is in phase already.

    The time of the first log that has the line stays as it is. Nothing else in a base model looks at a clock.

    Args:
        base: the base model.
        study: the data, and how they are cut.
    """
    if len(study.data[base.hold][0]) < 2:
        return base, study
    seen = max(_lines(base.training), key=lambda line: line.share, default=None)
    if seen is None or seen.share < RULES.line_share or np.sum(seen.told > RULES.line_errors) < 2:
        return base, study
    if abs(seen.mean) >= RULES.line_in_phase * abs(seen.in_phase.mean):
        return base, study
    study.progress("setting the logs' clocks by a line")
    clocked = _set_by(seen, base, study)
    if clocked is None:
        return base, study
    return attempt(base.model, clocked, base.hold, start=base, hold_parameters=True), clocked


def put_back(before: Sequence[Stretch], after: Sequence[Stretch]) -> tuple[float, ...]:
    """By how much the clock of each stretch was put back [s]."""
    return tuple(a.experiment.origin - b.experiment.origin for b, a in zip(before, after, strict=True))


def put_back_as(
    late: Sequence[float], tests: dict[Hold, tuple[Stretch, ...]], fitted: Sequence[Stretch]
) -> dict[Hold, tuple[Stretch, ...]]:
    """Test stretches with their clocks put back as those of the logs that they are the end of."""
    by_log = {s.experiment.log: by for s, by in zip(fitted, late, strict=True)}
    return {h: tuple(_put_back(s, by_log.get(s.experiment.log, 0.0)) for s in some) for h, some in tests.items()}


def _put_back(stretch: Stretch, by: float) -> Stretch:
    experiment = stretch.experiment
    return replace(stretch, experiment=replace(experiment, origin=experiment.origin + float(by)))


def _set_by(seen: Phasors, base: Trial, study: Study) -> Study | None:
    """The data with their clocks set by a line, refined by refits with it; None where these do not explain more."""
    near = base
    for _ in range(_REFITS):
        study = replace(study, data=_with_clocks_put_back(study.data, seen.late))
        near = attempt(base.model.with_effects(seen.in_phase.effect), study, base.hold, start=near)
        if not near.training.objective < base.training.objective - RULES.least_gain:
            return None
        seen = _fitted(near.training)
        if np.all(np.abs(seen.late) * seen.omega * seen.told < _SETTLED):
            break
    return study


def _with_clocks_put_back(data: Data, late: Float[np.ndarray, " logs"]) -> Data:
    def each(stretches: Sequence[Stretch]) -> tuple[Stretch, ...]:
        return tuple(_put_back(s, by) for s, by in zip(stretches, late, strict=True))

    return {hold: (each(training), each(selection)) for hold, (training, selection) in data.items()}


def _lines(found: Fit) -> list[Phasors]:
    """The lines that stand out of what a fit leaves over, each at the place where it explains most."""
    frequencies = spectral_lines(found)
    if not frequencies:
        return []
    look = look_along(found)
    places = [place for place in LEARNED_TORQUES if place.name in look.pushes]
    return [max((_at(p, omega, look, found) for p in places), key=lambda line: line.share) for omega in frequencies]


def _fitted(found: Fit) -> Phasors:
    """The line that a fit has as its last effect, with what it leaves over of it in each log."""
    line = found.model.effects[-1]
    place = place_of(line)
    assert isinstance(line, LearnedPeriodic) and place is not None
    left = _at(place, float(line.omega), look_along(found), found, own=effect_paths(line))
    return replace(left, torque=left.torque + complex(*line.c))


def _at(place: type[LearnedTorque], omega: float, look: Look, found: Fit, own: Sequence[str] = ()) -> Phasors:
    """What a torque at one place makes of a line in each log of a fit, to first order, beside all that is free but the
    parameters `own`."""
    angle = omega * np.asarray(look.conditions.time)
    size = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    by_log = products(look, Acting((look.pushes[place.name],)), (size,)).added(segments_of_logs(found))
    kept = by_log.columns([*(i for i, path in enumerate(found.free.paths) if path not in own), -2, -1])
    steps = best_steps(kept)
    weight = np.linalg.pinv(left_after(kept, steps) / np.maximum(kept.samples, 1.0)[:, None, None], hermitian=True)
    gram = np.einsum("sij,sijpq->spq", weight, kept.gram)
    information = np.array([_information(g) for g in gram])
    values = float(np.sum(kept.samples)) * kept.square.shape[1]
    return Phasors(place, omega, steps[:, -2] + 1j * steps[:, -1], information, values)


def _information(gram: Float[np.ndarray, "columns columns"]) -> float:
    """About either of the last two columns, whatever the others are."""
    across = gram[:-2, -2:]
    own = gram[-2:, -2:] - across.T @ solved(gram[:-2, :-2], across)
    return float(max(np.trace(own) / 2, 0.0))
