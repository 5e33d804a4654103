"""Time offsets of several logs from a spectral line of the residual. A disturbance of constant frequency that is
independent of the logs starts each one in another phase."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float

from fitting.attribution.candidate_fit import Trial, attempt
from fitting.attribution.rules import RULES
from fitting.attribution.study import Study
from fitting.estimation.estimate import Fit, log_of, segments_by
from fitting.estimation.experiment import Stretch
from fitting.estimation.free_parameters import effect_paths
from fitting.estimation.projection import solved
from fitting.first_order.gains import LinearisedFit, best_steps, left_after, linearise_along, products
from fitting.first_order.motion import place_of
from fitting.first_order.spectral_lines import spectral_lines
from hdjax import Hold
from hdjax.effects.learned import LEARNED_TORQUES, Learned, LearnedPeriodic, LearnedTorque
from hdjax.effects.learned_axes import PeriodicAxis

# Refits until offsets converge, and their tolerance in standard errors of a phase.
_REFITS = 4
_SETTLED = 0.1


class Phasors(eqx.Module):
    """A spectral line in several logs, as a torque.

    Attributes:
        place: where the torque acts.
        omega: its frequency [rad/s].
        torque: `C + i S` of the torque `C cos(omega t) + S sin(omega t)` in each log [N m].
        information: Fisher information of each log about either part [1/(N m)^2].
        values: number of measured values.
    """

    place: type[LearnedTorque] = eqx.field(static=True)
    omega: float
    torque: Complex[np.ndarray, " logs"]
    information: Float[np.ndarray, " logs"]
    values: float

    @property
    def share(self) -> float:
        """Share of the squared residual that the line explains with a free phase in each log."""
        explained = float(np.sum(self.told**2))
        return explained / (explained + self.values)

    @property
    def told(self) -> Float[np.ndarray, " logs"]:
        """Amplitude of the line in each log, in standard errors."""
        return np.sqrt(self.information) * np.abs(self.torque)

    @property
    def mean(self) -> complex:
        """Mean of the torque over the logs."""
        return complex(np.sum(self.information * self.torque) / np.sum(self.information))

    @property
    def effect(self) -> Learned:
        """An effect with the mean torque."""
        axes = (PeriodicAxis("time", self.omega, orders=1),)
        return self.place.made_of(axes, np.eye(axes[0].count)[:, 1:], (self.mean.real, self.mean.imag))

    @property
    def first(self) -> int:
        """The first log that has the line."""
        return int(np.argmax(self.told > RULES.line_errors))

    @property
    def late(self) -> Float[np.ndarray, " logs"]:
        """Delay of the line in each log relative to the first log that has it [s], within half a period either way;
        zero in a log without it."""
        turned = np.angle(self.torque * self.in_phase.torque.conj())
        return np.where(np.arange(turned.size) == self.first, 0.0, turned) / self.omega

    @property
    def in_phase(self) -> "Phasors":
        """The same with the phase of the first log in all logs that have the line."""
        turned = np.abs(self.torque) * np.exp(1j * np.angle(self.torque[self.first]))
        return replace(self, torque=np.where(self.told > RULES.line_errors, turned, self.torque))


def with_clocks_set(base: Trial, study: Study) -> tuple[Trial, Study]:
    """The logs with time offsets that bring a significant line of the base model's residual into phase. They are
    unchanged where there is no such line, or it is in phase already.

    The clock of the first log that has the line is unchanged. A base model does not depend on time otherwise.

    Args:
        base: the base model.
        study: the data and their segmentation.
    """
    if len({log_of(stretch) for stretch in study.data[base.hold][0]}) < 2:
        return base, study
    seen = max(_lines(base.training), key=lambda line: line.share, default=None)
    if seen is None or seen.share < RULES.line_share or np.sum(seen.told > RULES.line_errors) < 2:
        return base, study
    if abs(seen.mean) >= RULES.line_in_phase * abs(seen.in_phase.mean):
        return base, study
    study.progress("aligning the logs' clocks by a spectral line")
    clocked = _set_by(seen, base, study)
    if clocked is None:
        return base, study
    return attempt(base.model, clocked, base.hold, start=base, hold_parameters=base.training.was_held), clocked


def clock_shifts(before: Sequence[Stretch], after: Sequence[Stretch]) -> tuple[float, ...]:
    """Time offset that was subtracted from each stretch's clock [s]."""
    return tuple(a.experiment.origin - b.experiment.origin for b, a in zip(before, after, strict=True))


def with_clock_shifts(
    late: Sequence[float], tests: dict[Hold, tuple[Stretch, ...]], fitted: Sequence[Stretch]
) -> dict[Hold, tuple[Stretch, ...]]:
    """Test stretches with the time offsets of the logs that they belong to."""
    by_log = {log_of(s): by for s, by in zip(fitted, late, strict=True)}
    return {hold: _put_back(some, by_log) for hold, some in tests.items()}


def _put_back(stretches: Sequence[Stretch], late: Mapping[str, float]) -> tuple[Stretch, ...]:
    """Stretches with the time offset of their log, if it has one, subtracted from the clock."""

    def each(stretch: Stretch) -> Stretch:
        experiment = stretch.experiment
        origin = experiment.origin + float(late.get(log_of(stretch), 0.0))
        return replace(stretch, experiment=replace(experiment, origin=origin))

    return tuple(map(each, stretches))


def _set_by(seen: Phasors, base: Trial, study: Study) -> Study | None:
    """The data with clocks aligned by a line, refined by refits with it; None where these do not improve the fit."""
    near = base
    for _ in range(_REFITS):
        late = dict(zip(segments_by(near.training, log_of), seen.late.tolist(), strict=True))
        data = {hold: (_put_back(one, late), _put_back(other, late)) for hold, (one, other) in study.data.items()}
        study = replace(study, data=data)
        near = attempt(base.model.with_effects(seen.in_phase.effect), study, base.hold, start=near)
        if not near.training.objective < base.training.objective - RULES.least_gain:
            return None
        seen = _fitted(near.training)
        if np.all(np.abs(seen.late) * seen.omega * seen.told < _SETTLED):
            break
    return study


def _lines(found: Fit) -> list[Phasors]:
    """Significant lines of a fit's residual, each at the place where it explains most."""
    frequencies = spectral_lines(found)
    if not frequencies:
        return []
    look = linearise_along(found)
    places = [place for place in LEARNED_TORQUES if place.name in look.pushes]
    return [max((_at(p, omega, look, found) for p in places), key=lambda line: line.share) for omega in frequencies]


def _fitted(found: Fit) -> Phasors:
    """The line of a fit's last effect, with its remainder in the residual of each log."""
    line = found.model.effects[-1]
    place = place_of(line)
    assert isinstance(line, LearnedPeriodic) and place is not None
    left = _at(place, float(line.omega), linearise_along(found), found, own=effect_paths(line))
    return replace(left, torque=left.torque + complex(*line.c))


def _at(place: type[LearnedTorque], omega: float, look: LinearisedFit, found: Fit, own: Sequence[str] = ()) -> Phasors:
    """First-order estimate of a line as a torque at one place in each log of a fit, with all free parameters except
    `own`."""
    angle = omega * np.asarray(look.conditions.time)
    size = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    by_log = products(look, look.acting(place.name), (size,)).added(np.stack([*segments_by(found, log_of).values()]))
    kept = by_log.columns([*(i for i, path in enumerate(found.free.paths) if path not in own), -2, -1])
    steps = best_steps(kept)
    weight = np.linalg.pinv(left_after(kept, steps) / np.maximum(kept.samples, 1.0)[:, None, None], hermitian=True)
    gram = np.einsum("sij,sijpq->spq", weight, kept.gram)
    information = np.array([_information(g) for g in gram])
    values = float(np.sum(kept.samples)) * kept.square.shape[1]
    return Phasors(place, omega, steps[:, -2] + 1j * steps[:, -1], information, values)


def _information(gram: Float[np.ndarray, "columns columns"]) -> float:
    """Fisher information about either of the last two columns, with the others free."""
    across = gram[:-2, -2:]
    own = gram[-2:, -2:] - across.T @ solved(gram[:-2, :-2], across)
    return float(max(np.trace(own) / 2, 0.0))
