"""A log made ready for simulation: torque between samples, measured outputs, and the stretches they are cut into."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.logs import Log
from hdjax import Hold, PiecewisePolynomial, sampled
from hdjax.effects import Scales


class Experiment(eqx.Module):
    """One log on its sample grid.

    Attributes:
        name: the log's name.
        time: sample stamps [s].
        torque: motor torque [N m] or forcing, as logged, between samples.
        load_torque: torque on the load [N m], or None.
        measured: (theta_m/N, dynamic error) [rad] by row, or the dynamic error alone.
        motor_angle: measured motor angle [rad], or None in a reduced log.
        weight: 1 for a sample whose outputs count, 0 for one that was put in or is not believed; None where all count.
            The outputs of a sample without weight are something finite in between.
    """

    name: str = eqx.field(static=True)
    time: Float[np.ndarray, " n"]
    torque: PiecewisePolynomial
    load_torque: PiecewisePolynomial | None
    measured: Float[np.ndarray, "n outputs"]
    motor_angle: Float[np.ndarray, " n"] | None
    weight: Float[np.ndarray, " n"] | None = None

    def __len__(self) -> int:
        return self.time.size

    @property
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


class Segments(eqx.Module):
    """Stretches cut into equally long pieces, the lanes of one program. Missing samples have weight zero.

    A segment either starts anew, or it is joined to the one before and must start where that one ends. Which it is
    are data, so that one compiled program fits short horizons and whole logs.

    Attributes:
        torque: logged torque of each segment; its first `halo` intervals lie before the segment, so that a delay
            has something to reach back to.
        load_torque: coefficients of the load torque, or None.
        measured: outputs at the samples.
        weight: 1 for a sample whose outputs count, 0 for the others and for padding.
        joined: whether a segment starts where the one before it ends.
        halo: intervals before each segment's first sample.
    """

    torque: PiecewisePolynomial
    load_torque: PiecewisePolynomial | None
    measured: Float[Array, "segments samples outputs"]
    weight: Float[Array, "segments samples"]
    joined: Bool[Array, " segments"]
    halo: int = eqx.field(static=True)

    @property
    def count(self) -> Array:
        """Number of samples that carry weight."""
        return jnp.sum(self.weight)


def experiment_from_log(log: Log, *, hold: Hold, N: float | None = None) -> Experiment:
    """Turn a log into an experiment.

    Args:
        log: what was measured.
        hold: what the torque does between samples.
        N: reduction ratio of a drive log.
    """
    drive_log = log.kind == "drive"
    input_samples = log.motor_torque if drive_log else log.forcing
    assert input_samples is not None
    torque = sampled(log.time, input_samples, hold=hold)
    load_torque = None
    if drive_log and log.load_torque is not None:
        load_torque = sampled(log.time, log.load_torque, hold="linear")
    columns = [log.dynamic_error]
    if drive_log:
        assert log.motor_angle is not None and N is not None
        columns.insert(0, log.motor_angle / N)
    return Experiment(
        name=log.name,
        time=log.time,
        torque=torque,
        load_torque=load_torque,
        measured=np.stack(columns, axis=1),
        motor_angle=log.motor_angle if drive_log else None,
    )


def split(
    experiments: Sequence[Experiment], *, held_out: float = 0.2
) -> tuple[tuple[Stretch, ...], tuple[Stretch, ...]]:
    """The training part of each log and the stretch at its end that the fit never sees."""
    training, validation = [], []
    for experiment in experiments:
        border = round(len(experiment) * (1.0 - held_out))
        training.append(Stretch(experiment, 0, border))
        validation.append(Stretch(experiment, border, len(experiment)))
    return tuple(training), tuple(validation)


def segment_count(stretches: Sequence[Stretch], length: int) -> int:
    """How many segments of `length` samples the stretches need, rounded up so that logs of similar length share a
    compiled program."""
    needed = sum(-(-len(s) // length) for s in stretches)
    return needed if needed <= 8 else needed + -needed % 16


def cut(
    stretches: Sequence[Stretch], length: int, *, horizon: int | None = None, halo: int = 0, count: int | None = None
) -> Segments:
    """Cut stretches into segments of `length` samples; the last one of each stretch is padded.

    Args:
        stretches: the data.
        length: samples in a segment.
        horizon: samples until a simulation starts anew; the length where not given.
        halo: intervals of torque before each segment.
        count: number of segments, the superfluous ones without weight; [`segment_count`][] where not given.
    """
    pieces = 1 if horizon is None else max(1, -(-horizon // length))
    parts = [_cut_one(s, length, pieces, halo) for s in stretches]
    found = [np.concatenate(column) for column in zip(*parts, strict=True)]
    missing = max(0, (segment_count(stretches, length) if count is None else count) - found[0].shape[0])
    filled = [np.concatenate([column, np.repeat(column[-1:], missing, axis=0)]) for column in found]
    knots, torque, load, measured, weight, joined = filled
    weight[weight.shape[0] - missing :] = 0.0
    joined[joined.shape[0] - missing :] = False
    own_knots = jnp.asarray(knots)
    loaded = any(s.experiment.load_torque is not None for s in stretches)
    return Segments(
        torque=PiecewisePolynomial(own_knots, jnp.asarray(torque)),
        load_torque=PiecewisePolynomial(own_knots[:, halo:], jnp.asarray(load)) if loaded else None,
        measured=jnp.asarray(measured),
        weight=jnp.asarray(weight),
        joined=jnp.asarray(joined),
        halo=halo,
    )


def _cut_one(stretch: Stretch, length: int, pieces: int, halo: int) -> tuple[np.ndarray, ...]:
    """Knots, torque, load torque, measured outputs, weight, and whether joined, of one stretch's segments by row."""
    experiment = stretch.experiment
    last = len(experiment) - 1
    begin = np.arange(stretch.start, stretch.stop, length)
    index = begin[:, None] + np.arange(-halo, length)
    inside = np.clip(index, 0, last)
    # Before the record the first torque is assumed to have been held; beyond it the last.
    torque = np.asarray(experiment.torque.coefficients)[inside]
    torque[index != inside, 1:] = 0.0
    outer = begin[:, None] + np.arange(-halo, length + 1)
    known = np.clip(outer, 0, last + 1)
    knots = np.asarray(experiment.torque.knots)[known] + (outer - known) * experiment.time_step
    own = index[:, halo:]
    load = experiment.load_torque
    coefficients = np.zeros((last + 1, 0)) if load is None else np.asarray(load.coefficients)
    return (
        knots,
        torque,
        coefficients[np.clip(own, 0, last)],
        experiment.measured[np.clip(own, 0, stretch.stop - 1)],
        _weight(experiment, own) * (own < stretch.stop),
        np.arange(begin.size) % pieces != 0,
    )


def _weight(experiment: Experiment, index: np.ndarray) -> np.ndarray:
    if experiment.weight is None:
        return np.ones(index.shape)
    return experiment.weight[np.clip(index, 0, len(experiment) - 1)]


def scales(stretches: Sequence[Stretch]) -> Scales:
    """Orders of magnitude of the measured motion."""
    x = np.concatenate([s.experiment.measured[s.start : s.stop, -1] for s in stretches])
    x = x - np.median(x)
    step = stretches[0].experiment.time_step

    def rate(values: np.ndarray) -> float:
        """Rms slope over a few samples, so that encoder noise does not pass for speed."""
        span = 8
        return float(np.sqrt(np.mean(((values[span:] - values[:-span]) / (span * step)) ** 2)))

    angles = [s.experiment.motor_angle[s.start : s.stop] for s in stretches if s.experiment.motor_angle is not None]
    motor = float(np.sqrt(np.mean([rate(a) ** 2 for a in angles]))) if angles else 1.0
    output = [rate(s.experiment.measured[s.start : s.stop, 0]) for s in stretches]
    return Scales(
        x=float(np.std(x)),
        x_max=float(np.max(np.abs(x))),
        v=rate(x),
        omega_m=motor,
        omega_l=float(np.sqrt(np.mean(np.square(output)))),
        time_step=step,
    )
