"""Stretches of logs cut into segments of equal length, the lanes of a simulation."""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from fitting.estimation.experiment import Experiment, Stretch
from hdjax import PiecewisePolynomial


class Segments(eqx.Module):
    """Stretches cut into segments of equal length, simulated in parallel. Missing samples have weight zero.

    A segment starts with a free state, or is joined to the one before and must start where that one ends. Which of the
    two is data, so that one compiled program fits short horizons and whole logs.

    Attributes:
        torque: logged torque of each segment; its first `halo` intervals lie before the segment, for delays. Its knots
            count from the log's start.
        load_torque: coefficients of the load torque, or None.
        measured: outputs at the samples.
        weight: 1 for a valid sample, 0 for the others and for padding.
        goes_on: whether a segment's data continue those of the one before without a gap.
        joined: whether a segment's simulation also continues that of the one before.
        halo: intervals before each segment's first sample.
        temperature: coefficients of the drive's temperature, or None where a log lacks it.
    """

    torque: PiecewisePolynomial
    load_torque: PiecewisePolynomial | None
    measured: Float[Array, "segments samples outputs"]
    weight: Float[Array, "segments samples"]
    goes_on: Bool[Array, " segments"]
    joined: Bool[Array, " segments"]
    halo: int = eqx.field(static=True)
    temperature: PiecewisePolynomial | None = None

    @property
    def count(self) -> Array:
        """Number of valid samples."""
        return jnp.sum(self.weight)

    @property
    def knots(self) -> Float[np.ndarray, "segments knots"]:
        """Stamps of each segment's own samples, and of its end."""
        return np.asarray(self.torque.knots)[:, self.halo :]

    @property
    def width(self) -> Float[np.ndarray, "segments samples"]:
        """Sample intervals."""
        return np.diff(self.knots)


def segment_count(stretches: Sequence[Stretch], length: int) -> int:
    """Number of segments of `length` samples for the stretches, rounded up so that logs of similar length share a
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
        horizon: samples of one simulation; the length where not given.
        halo: intervals of torque before each segment.
        count: number of segments, the superfluous ones with weight zero; [`segment_count`][] where not given.
    """
    pieces = 1 if horizon is None else max(1, -(-horizon // length))
    loads = [s.experiment.load_torque for s in stretches]
    powers = max((np.shape(load.coefficients)[1] for load in loads if load is not None), default=0)
    warm = all(s.experiment.temperature is not None for s in stretches)
    parts = [_cut_one(s, length, pieces, halo, powers=powers, warm=warm) for s in stretches]
    found = [np.concatenate(column) for column in zip(*parts, strict=True)]
    goes_on = np.concatenate([_goes_on(*pair, length) for pair in zip((None, *stretches), stretches, strict=False)])
    missing = max(0, (segment_count(stretches, length) if count is None else count) - found[0].shape[0])
    filled = [np.concatenate([column, np.repeat(column[-1:], missing, axis=0)]) for column in found]
    knots, torque, load, warmth, measured, weight, joined = filled
    weight[weight.shape[0] - missing :] = 0.0
    joined[joined.shape[0] - missing :] = False
    own_knots = jnp.asarray(knots)
    return Segments(
        torque=PiecewisePolynomial(own_knots, jnp.asarray(torque)),
        load_torque=PiecewisePolynomial(own_knots[:, halo:], jnp.asarray(load)) if powers else None,
        measured=jnp.asarray(measured),
        weight=jnp.asarray(weight),
        goes_on=jnp.asarray(np.append(goes_on, np.zeros(missing, dtype=bool))),
        joined=jnp.asarray(joined),
        halo=halo,
        temperature=PiecewisePolynomial(own_knots[:, halo:], jnp.asarray(warmth)) if warm else None,
    )


def _goes_on(before: Stretch | None, stretch: Stretch, length: int) -> Bool[np.ndarray, " segments"]:
    """Whether each segment of a stretch continues the one before; for the first one, the last segment of the preceding
    stretch, if that consists of whole segments."""
    found = np.ones(-(-len(stretch) // length), dtype=bool)
    ends = None if before is None or len(before) % length else (before.name, before.stop)
    found[0] = ends == (stretch.name, stretch.start)
    return found


def _cut_one(
    stretch: Stretch, length: int, pieces: int, halo: int, *, powers: int, warm: bool
) -> tuple[np.ndarray, ...]:
    """Arrays of one stretch's segments, by row: knots, torque, load torque (zero where only other logs have one),
    temperature, measured outputs, weight, whether joined."""
    experiment = stretch.experiment
    last = len(experiment) - 1
    begin = np.arange(stretch.start, stretch.stop, length)
    index = begin[:, None] + np.arange(-halo, length)
    inside = np.clip(index, 0, last)
    # Before the log the first torque is assumed to have been held; after it the last.
    torque = np.asarray(experiment.torque.coefficients)[inside]
    torque[index != inside, 1:] = 0.0
    outer = begin[:, None] + np.arange(-halo, length + 1)
    known = np.clip(outer, 0, last + 1)
    knots = np.asarray(experiment.torque.knots)[known] + (outer - known) * experiment.time_step
    own = index[:, halo:]
    load, warmth = experiment.load_torque, experiment.temperature
    on_load = np.zeros((last + 1, 0)) if load is None else np.asarray(load.coefficients)
    on_load = np.pad(on_load, ((0, 0), (0, powers - on_load.shape[1])))
    # Linear interpolation needs no higher powers.
    line = np.asarray(warmth.coefficients)[:, :2] if warm and warmth is not None else np.zeros((last + 1, 0))
    own_row = np.clip(own, 0, last)
    return (
        knots - experiment.origin,
        torque,
        on_load[own_row],
        line[own_row],
        experiment.measured[np.clip(own, 0, stretch.stop - 1)],
        _weight(experiment, own) * (own < stretch.stop),
        np.arange(begin.size) % pieces != 0,
    )


def _weight(experiment: Experiment, index: np.ndarray) -> np.ndarray:
    if experiment.weight is None:
        return np.ones(index.shape)
    return experiment.weight[np.clip(index, 0, len(experiment) - 1)]
