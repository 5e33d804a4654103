"""Logs prepared for simulation: torque between samples, measured outputs, and stretches of them."""

import functools
from collections.abc import Sequence
from dataclasses import replace
from math import comb
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from fitting.errors import DataError
from fitting.logs.gaps import bridged
from fitting.logs.log import Log
from fitting.record import Record
from hdjax import Hold, PiecewisePolynomial, sampled
from hdjax.dynamics import BOTH_ANGLES

# Both assumed: largest step over the usual one, beyond which samples are inserted; most samples inserted per row.
_LONGEST_STEP = 1.5
_MOST_PUT_IN = 10
# Distance of stamps that differ by rounding, in typical steps.
_ROUNDING = 1e-3


class Moved(NamedTuple):
    """Times by which a log's readings are from later rows [s].

    Attributes:
        load: those of the load's encoder.
        joint_torque: those of the joint torque's sensor.
    """

    load: float = 0.0
    joint_torque: float = 0.0


class Experiment(Record):
    """One log on its sample grid.

    Attributes:
        name: the log's name.
        time: sample stamps [s].
        torque: motor torque [N m] or forcing, as logged, between samples.
        load_torque: torque on the load [N m], or None.
        measured: outputs by row; (theta_m/N, dynamic error) [rad], or the dynamic error alone, where `outputs` does not
            say otherwise. The last one is the principal output, by which a fit is judged.
        motor_angle: measured motor angle [rad], or the integral of its velocity; None where neither was measured.
        weight: 1 for a valid sample, 0 for an inserted or invalid one; None where all are valid. Outputs of samples
            with weight zero are interpolated.
        rows: which samples are rows of the log; the others were inserted. None where all are.
        temperature: of the drive [K], or None.
        origin: start of the log, on the clock of `time` [s].
        log: the name of the log that it is a part of.
        rate_std: relative standard deviation of the sample interval, from the rounding of the log's stamps.
        zero: what was subtracted from its dynamic error, see [`fitting.logs.zeroing`][].
        has_own_zero: whether its zero is not known from other logs, so that a free run estimates it with its initial
            state.
        outputs: names of the measured outputs, see `hdjax.dynamics.OUTPUTS`.
        moved: times by which readings are from later rows, see [`fitting.estimation.late_readings`][].
        shaft_torques: unit torques on a shaft whose estimated strengths are part of the torques, or None, see
            [`fitting.estimation.one_side`][].
    """

    name: str = eqx.field(static=True)
    time: Float[np.ndarray, " n"]
    torque: PiecewisePolynomial
    load_torque: PiecewisePolynomial | None
    measured: Float[np.ndarray, "n outputs"]
    motor_angle: Float[np.ndarray, " n"] | None
    weight: Float[np.ndarray, " n"] | None = None
    rows: Bool[np.ndarray, " n"] | None = None
    temperature: PiecewisePolynomial | None = None
    origin: float = eqx.field(static=True, default=0.0)
    log: str = eqx.field(static=True, default="")
    rate_std: float = eqx.field(static=True, default=0.0)
    zero: float = eqx.field(static=True, default=0.0)
    has_own_zero: bool = eqx.field(static=True, default=False)
    outputs: tuple[str, ...] = eqx.field(static=True, default=())
    moved: Moved = eqx.field(static=True, default=Moved())
    shaft_torques: Float[np.ndarray, "n torques"] | None = None

    def __len__(self) -> int:
        return self.time.size

    def output(self, name: str) -> Float[np.ndarray, " n"] | None:
        """A measured output by its name; None where it was not measured."""
        return self.measured[:, self.names.index(name)] if name in self.names else None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the measured outputs; where none are given, of both angles or the dynamic error alone."""
        return self.outputs or BOTH_ANGLES[-self.measured.shape[1] :]

    def less(self, offset: float) -> "Experiment":
        """The experiment with so much subtracted from its dynamic error, the last output."""
        if offset == 0.0:
            return self
        measured = self.measured.copy()
        measured[:, -1] -= offset
        return replace(self, measured=measured, zero=self.zero + offset)

    @functools.cached_property
    def time_step(self) -> float:
        """Median sampling interval [s]."""
        return float(np.median(np.diff(self.time)))


class Stretch(eqx.Module):
    """Samples `start` to `stop` (exclusive) of one experiment."""

    experiment: Experiment
    start: int = eqx.field(static=True)
    stop: int = eqx.field(static=True)

    def __len__(self) -> int:
        return self.stop - self.start

    @property
    def name(self) -> str:
        """The log's name."""
        return self.experiment.name

    @property
    def weight(self) -> Float[np.ndarray, " n"]:
        """1 for a valid sample, 0 for the others."""
        weight = self.experiment.weight
        return np.ones(len(self)) if weight is None else weight[self.start : self.stop]

    def beginning(self, count: int) -> "Stretch":
        """The shortest part from the start that has `count` valid samples; else the whole stretch."""
        enough = np.flatnonzero(np.cumsum(self.weight) >= count)
        known = np.flatnonzero(self.weight)
        last = enough[0] if len(enough) else known[-1] if len(known) else len(self) - 1
        return replace(self, stop=self.start + int(last) + 1)


def experiments_from_log(
    log: Log, *, hold: Hold, N: float | None = None, stated: Hold | None = None
) -> tuple[Experiment, ...]:
    """The stretches of a log between its gaps, each as an experiment; arguments as in [`experiment_from_log`][]."""
    if log.pieces is None:
        return (experiment_from_log(log, hold=hold, N=N, stated=stated),)
    several = len(log.pieces) > 1
    parts = (
        experiment_from_log(
            replace(log.rows(start, stop), pieces=None, name=f"{log.name}, part {i + 1}" if several else log.name),
            hold=hold,
            N=N,
            stated=stated,
        )
        for i, (start, stop) in enumerate(log.pieces)
    )
    return tuple(replace(part, origin=float(log.time[0]), log=log.name) for part in parts)


def experiment_from_log(log: Log, *, hold: Hold, N: float | None = None, stated: Hold | None = None) -> Experiment:
    """Turn a log without wide gaps into an experiment.

    Where samples are missing, the torque is interpolated and samples are inserted at the usual interval, with weight
    zero.

    Args:
        log: the log.
        hold: inter-sample behaviour of the torque.
        N: reduction ratio of a drive log.
        stated: inter-sample behaviour of torques that the user states; that of a load torque does not change with
            `hold` then.

    Raises:
        DataError: the log is mostly a gap.
    """
    drive_log = log.kind == "drive"
    lasts = (log.time[-1] - log.time[0]) / np.median(np.diff(log.time))
    if lasts > _MOST_PUT_IN * len(log):
        raise DataError(
            f"{log.path}: the log is mostly gaps, since its {len(log)} samples are spread over {lasts:.3g} sampling "
            "intervals; cut it into logs without gaps"
        )
    known = np.ones(len(log), dtype=bool) if log.input_known is None else log.input_known.copy()
    known[[0, -1]] = True
    stamps, samples = bridged(log.time[known], log.input[known])
    stamps = _at_rows(stamps, log.time)
    time, rows = _grid(log, stamps)
    torque = _on_grid(sampled(stamps, samples, hold=hold), time)
    # Commands of a digital drive are held between samples; measured torques are continuous and interpolated linearly.
    load_hold = "zero-order" if (stated or hold) == "zero-order" else "linear"
    load_torque = _channel(log, log.load_torque, time, load_hold) if drive_log else None
    outputs = fitted_outputs(log)
    columns = [_column(log, name, N) for name in outputs]
    weight = rows.astype(float)
    if log.trusted is not None:
        weight[rows] = log.trusted
    if log.outputs_until is not None:
        weight[np.cumsum(rows) > log.outputs_until] = 0.0
    measured = np.stack([_filled(log, column, time, rows) for column in columns], axis=1)
    return Experiment(
        name=log.name,
        time=time,
        torque=torque,
        load_torque=load_torque,
        measured=measured,
        motor_angle=_motor_angle(log, time, rows) if drive_log else None,
        weight=None if weight.all() else weight,
        rows=None if rows.all() else rows,
        temperature=_channel(log, log.temperature, time, "linear"),
        origin=float(log.time[0]),
        log=log.name,
        rate_std=log.rate_std,
        zero=log.zero,
        has_own_zero=log.has_own_zero,
        outputs=outputs,
    )


def fitted_outputs(log: Log) -> tuple[str, ...]:
    """Names of a log's fitted outputs, from `hdjax.dynamics.OUTPUTS`, the principal one last."""
    return BOTH_ANGLES if log.outputs == ("motor_angle", "load_angle") else log.outputs


def _column(log: Log, output: str, N: float | None) -> np.ndarray:
    """The measured values of an output."""
    if output == "motor_turn":
        assert log.motor_angle is not None and N is not None
        return log.motor_angle / N
    return getattr(log, output)


def _motor_angle(log: Log, time: np.ndarray, rows: np.ndarray) -> np.ndarray | None:
    """The motor's angle on the grid; where it was not measured, the integral of its velocity."""
    if log.motor_angle is not None:
        return _filled(log, log.motor_angle, time, rows)
    if log.motor_velocity is None:
        return None
    velocity = _filled(log, log.motor_velocity, time, rows)
    return np.append(0.0, np.cumsum(0.5 * (velocity[1:] + velocity[:-1]) * np.diff(time)))


def _channel(log: Log, values: np.ndarray | None, time: np.ndarray, hold: Hold) -> PiecewisePolynomial | None:
    """A channel of the log on the grid; None where the log has none."""
    return None if values is None else _on_grid(sampled(log.time, values, hold=hold), time)


def _at_rows(stamps: np.ndarray, time: np.ndarray) -> np.ndarray:
    """Stamps of a bridged torque, those within rounding of a row's stamp equal to it."""
    after = np.clip(np.searchsorted(time, stamps), 1, len(time) - 1)
    nearest = time[np.where(stamps - time[after - 1] < time[after] - stamps, after - 1, after)]
    return np.where(np.abs(stamps - nearest) < _ROUNDING * np.median(np.diff(time)), nearest, stamps)


def _grid(log: Log, stamps: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The log's stamps with those of the torque and inserted ones where a step would be long; and which are the
    log's."""
    time = np.union1d(log.time, stamps)
    step = np.diff(time)
    usual = max(float(np.median(step)), float(np.median(np.diff(log.time))))
    lacking = np.where(step > _LONGEST_STEP * usual, np.rint(step / usual) - 1, 0.0)
    if lacking.any():
        count = lacking.astype(int)
        part = np.concatenate([np.arange(1, n + 1) / (n + 1) for n in count if n])
        where = np.repeat(np.arange(len(step)), count)
        time = np.insert(time, where + 1, time[where] + part * step[where])
    return time, np.isin(time, log.time)


def _on_grid(signal: PiecewisePolynomial, time: np.ndarray) -> PiecewisePolynomial:
    """The same signal with more knots."""
    knots, coefficients = np.asarray(signal.knots), np.asarray(signal.coefficients)
    if time.size == knots.size - 1 and (time == knots[:-1]).all():
        return signal
    piece = np.clip(np.searchsorted(knots, time, side="right") - 1, 0, coefficients.shape[0] - 1)
    late = (time - knots[piece])[:, None]
    own, powers = coefficients[piece], np.arange(coefficients.shape[1])
    # A polynomial about a later point (Taylor).
    shifted = [
        sum((comb(k, i) * own[:, [k]] * late ** (k - i) for k in powers[i:]), np.zeros_like(late)) for i in powers
    ]
    return PiecewisePolynomial(
        jnp.asarray(np.append(time, max(knots[-1], time[-1] + np.median(np.diff(time))))),
        jnp.asarray(np.concatenate(shifted, axis=1)),
    )


def _filled(log: Log, values: np.ndarray, time: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """An output on the grid, interpolated linearly where it is missing or invalid."""
    if log.trusted is None and log.outputs_until is None and rows.all():
        return values
    known = np.ones(len(log), dtype=bool) if log.trusted is None else log.trusted
    known = known & (np.arange(len(log)) < (log.outputs_until or len(log)))
    return np.interp(time, log.time[known], values[known])


def whole(experiments: Sequence[Experiment]) -> tuple[Stretch, ...]:
    """Each experiment as one stretch."""
    return tuple(Stretch(e, 0, len(e)) for e in experiments)


def split(
    experiments: Sequence[Experiment], *, held_out: float = 0.2
) -> tuple[tuple[Stretch, ...], tuple[Stretch, ...]]:
    """Training and selection stretch of each experiment.

    Args:
        experiments: without the test data.
        held_out: share of the selection data.
    """
    training, selection = [], []
    for experiment in experiments:
        border = _border(experiment, held_out)
        training.append(Stretch(experiment, 0, border))
        selection.append(Stretch(experiment, border, len(experiment)))
    return tuple(training), tuple(selection)


def _border(experiment: Experiment, held_out: float) -> int:
    """The sample that divides the experiment so that each side has its share of the valid samples."""
    if experiment.weight is None:
        return round(len(experiment) * (1.0 - held_out))
    total = np.cumsum(experiment.weight)
    return int(np.clip(np.searchsorted(total, total[-1] * (1.0 - held_out)) + 1, 1, len(experiment) - 1))
