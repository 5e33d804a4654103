"""Covariance of least-squares estimates with coloured residuals.

Stationary noise of any spectrum is uncorrelated between Fourier frequencies. Least squares on a stretch's Fourier
coefficients is therefore a regression with independent errors of unequal variance, and the sandwich for that case
(White 1980) with each squared residual divided by one minus its leverage (MacKinnon and White 1985, HC2) needs neither
a bandwidth nor a model of the noise (Robinson 1998, Econometrica 66, "Inference without smoothing in the presence of
nonparametric autocorrelation"). Where leverage is high, as at the line of a single sine, residuals are pooled with
those of neighbouring frequencies.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.special import fdtri

from fitting.estimation.engines import linearise
from fitting.estimation.estimate import Fit
from fitting.estimation.problem import natural_frequency
from fitting.estimation.projection import FirstStates

# Number of simulations above which they are treated as independent clusters.
_MANY_CHAINS = 20
# Number of time chunks to test noise for stationarity, and least natural periods in each.
_CHUNKS = 64
_CHUNK_PERIODS = 2.0
# Significance level at which the estimate from chunks replaces that from the spectrum.
_OVERRULE = 0.99
# Least share of noise left in a frequency's residual for it to represent its noise.
_LEAST_LEFT = 0.5
# Least remaining share that a cluster's residual is corrected for.
_LEAST_CLUSTER = 0.05
# Eigenvalues of the scaled information below this are directions without information.
_BLIND = 1e-12


class Record(eqx.Module):
    """The residual of one stretch in order of time, and its derivatives.

    Attributes:
        residual: whitened output error; zero at missing samples.
        slopes: its derivative with respect to the free vector, projected orthogonal to the initial states.
        states: first sample and derivative with respect to the initial state of each simulation in the stretch.
        present: share of valid samples.
    """

    residual: Float[np.ndarray, "n outputs"]
    slopes: Float[np.ndarray, "n outputs parameters"]
    states: tuple[tuple[int, np.ndarray], ...]
    present: float

    def bases(self) -> Iterator[tuple[int, Float[np.ndarray, "samples outputs directions"]]]:
        """First sample and orthonormal basis of the initial state's effect, of each simulation with valid samples."""
        for start, columns in self.states:
            flat = columns.reshape(-1, columns.shape[2])
            length = np.linalg.norm(flat, axis=0)
            if (length > 0).any():
                basis, _ = np.linalg.qr(flat[:, length > 0] / length[length > 0])
                yield start, basis.reshape(*columns.shape[:2], -1)


class Linearised(eqx.Module):
    """A fit as a linear regression.

    Attributes:
        records: by stretch.
        information: J^T J of the free vector after elimination of the initial states.
        prior: the part of it due to priors of hidden states and parameters.
        chunk: samples in a time chunk, longer than the correlation of the estimates' scores.
    """

    records: tuple[Record, ...]
    information: Float[np.ndarray, "parameters parameters"]
    prior: Float[np.ndarray, "parameters parameters"]
    chunk: int = eqx.field(static=True)

    @property
    def rows(self) -> int:
        """Number of measured values."""
        return sum(round(r.present * r.residual.size) for r in self.records)

    @property
    def fitted(self) -> int:
        """Number of fitted values, including initial states."""
        return self.information.shape[0] + sum(c.shape[2] for r in self.records for _, c in r.states)


class Covariance(eqx.Module):
    """Covariance of the free vector.

    Attributes:
        robust: for a residual of any spectrum.
        classical: for a white residual.
        unit: for a white residual of the variance used as weight, (J^T J)^-1.
        degrees_of_freedom: of the robust variances, as in Student's t.
    """

    robust: Float[np.ndarray, "parameters parameters"]
    classical: Float[np.ndarray, "parameters parameters"]
    unit: Float[np.ndarray, "parameters parameters"]
    degrees_of_freedom: Float[np.ndarray, " parameters"]


def linearised(fit: Fit) -> Linearised:
    """A fit as a linear regression at its solution."""
    problem = fit.at_solution
    found = linearise(problem, fit.unknowns)
    states = FirstStates.of(found, problem.segments.joined)
    residual, projected = np.asarray(found.residual), states.parameters_without(found)
    with np.errstate(over="ignore", invalid="ignore"):
        # Derivatives that overflow, as at nonlinearities that solver steps do not resolve, carry no information.
        projected = np.where(np.isfinite(np.sum(projected**2, axis=(0, 1))), projected, 0.0)
    samples = problem.segments.measured.shape[1] * problem.segments.measured.shape[2]
    prior = projected[:, samples:]
    known = np.diag(np.asarray(problem.free.precision) ** 2)
    fastest = min(stretch.experiment.time_step for stretch in fit.stretches)
    period = 2 * np.pi / natural_frequency(fit.model, fit.stretches) / fastest
    total = sum(len(s) for s in fit.stretches)
    return Linearised(
        records=_records(fit, residual, projected, states.by_first),
        information=np.einsum("srp,srq->pq", projected, projected) + known,
        prior=np.einsum("srp,srq->pq", prior, prior) + known,
        chunk=max(1, round(max(_CHUNK_PERIODS * period, total / _CHUNKS))),
    )


def with_further(
    fit: Fit,
    found: Linearised,
    columns: Float[np.ndarray, "segments rows further"],
    prior: Float[np.ndarray, " further"],
) -> Linearised:
    """The regression with further unknowns appended to the free vector.

    Args:
        fit: the fit.
        found: its regression.
        columns: derivative of the residual by them, projected orthogonal to the initial states.
        prior: prior information about each.
    """
    _, samples, outputs = fit.problem.segments.measured.shape
    rows = columns[:, : samples * outputs].reshape(len(columns), samples, outputs, -1)
    further = fit.by_stretch(rows)
    records = tuple(
        replace(r, slopes=np.concatenate([r.slopes, f], axis=2)) for r, f in zip(found.records, further, strict=True)
    )
    slopes = [r.slopes.reshape(-1, r.slopes.shape[2]) for r in records]
    information = np.sum([s.T @ s for s in slopes], axis=0)
    own = len(found.information)
    information[:own, :own] = found.information
    further_prior = np.zeros_like(information)
    further_prior[:own, :own] = found.prior
    further_prior[own:, own:] = np.diag(prior)
    information[own:, own:] += np.diag(prior)
    return replace(found, records=records, information=information, prior=further_prior)


def covariance(found: Linearised) -> Covariance:
    """Classical and robust covariance of a fit's free vector.

    Many short simulations are clusters (Liang and Zeger 1986). Fewer and longer ones use the residual's spectrum. Noise
    that is correlated with the regressors' amplitude is not stationary. Scores of time chunks then scatter more than
    the spectrum predicts, and replace it.
    """
    # Each parameter in units of its standard error: powers of poorly determined ones would overflow.
    diagonal = np.diag(found.information)
    unit = 1.0 / np.sqrt(np.where(diagonal > 0, diagonal, 1.0))
    both = np.outer(unit, unit)
    records = [replace(r, slopes=r.slopes * unit) for r in found.records]
    inverse, blind = _inverse(found.information * both)
    square = sum(float(np.sum(r.residual**2)) for r in records)
    classical = inverse * square / max(found.rows - found.fitted, 1)
    simulations = sum(len(r.states) for r in records)
    if simulations >= _MANY_CHAINS + inverse.shape[0]:
        borders = [[start for start, _ in r.states] for r in records]
        robust, freedom = _clustered(records, borders, inverse)
    else:
        robust, freedom = _spectral(records, inverse)
        chunks = [range(0, r.residual.shape[0], found.chunk) for r in records]
        robust, freedom = _overruled(robust, freedom, *_clustered(records, chunks, inverse))
    unseen = inverse @ (found.prior * both) @ inverse + blind
    return Covariance((robust + unseen) * both, classical * both, inverse * both, freedom)


def directions(found: Float[np.ndarray, "parameters parameters"]) -> list[tuple[float, np.ndarray]]:
    """Standard error along each principal axis of a covariance, and the axis with its largest entry positive; the
    least certain first."""
    values, vectors = np.linalg.eigh(found)
    made = []
    for value, axis in zip(values[::-1], vectors.T[::-1], strict=True):
        made.append((float(np.sqrt(max(value, 0.0))), axis * np.sign(axis[np.argmax(np.abs(axis))])))
    return made


def _clustered(
    records: Sequence[Record], borders: Sequence[Sequence[int]], inverse: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Covariance from sums of scores between borders, assumed independent; and its degrees of freedom.

    Each cluster's residual is corrected for its leverage (CR2 of Bell and McCaffrey 2002).
    """
    sums, shares = [], []
    for record, starts in zip(records, borders, strict=True):
        scores = np.einsum("nop,no->np", record.slopes, record.residual)
        products = np.einsum("nop,noq->npq", record.slopes, record.slopes)
        sums.append(np.add.reduceat(scores, list(starts), axis=0))
        shares.append(np.add.reduceat(products, list(starts), axis=0))
    values, vectors = np.linalg.eigh(inverse)
    root = (vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T
    left, axes = np.linalg.eigh(np.eye(len(root)) - root @ np.concatenate(shares) @ root)
    white = np.concatenate(sums) @ root
    turned = np.einsum("cpk,cp->ck", axes, white) / np.sqrt(np.maximum(left, _LEAST_CLUSTER))
    found = np.einsum("cpk,ck->cp", axes, turned) @ root
    # The fourth moment of a normal score is three times its squared variance.
    square, fourth = np.sum(found**2, axis=0), np.sum(found**4, axis=0)
    freedom = 3.0 * square**2 / np.maximum(fourth, 1e-300)
    return found.T @ found, np.clip(freedom, 1.0, max(found.shape[0] - 1, 1))


def _overruled(
    robust: np.ndarray, freedom: np.ndarray, other: np.ndarray, other_freedom: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The robust covariance with larger variances where another estimate is significantly larger."""
    own, rival = np.diag(robust), np.diag(other)
    ratio = np.where(own > 0, rival / np.where(own > 0, own, 1.0), 1.0)
    larger = ratio > fdtri(other_freedom, freedom, _OVERRULE)
    stretch = np.where(larger, np.sqrt(ratio), 1.0)
    return robust * np.outer(stretch, stretch), np.where(larger, other_freedom, freedom)


def _spectral(records: Sequence[Record], inverse: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariance from the spectrum of each stretch's residual, and its degrees of freedom (Satterthwaite)."""
    total = np.zeros_like(inverse)
    square = np.zeros(inverse.shape[0])
    for record in records:
        count = record.residual.shape[0]
        influence = _spectrum(record.slopes @ inverse)
        error = _spectrum(record.residual) / np.sqrt(record.present)
        left = 1.0 - _leverage(record, inverse)
        # Each frequency also represents its negative, except the first, and the last of an even count.
        images = np.full(error.shape[0], 2.0)
        images[0] = 1.0
        if count % 2 == 0:
            images[-1] = 1.0
        own = np.zeros((error.shape[0], inverse.shape[0]))
        for place, near, noise_left in _neighbourhoods(left):
            weighted = error[near] / np.sqrt(noise_left)
            part = np.einsum("fop,fo->fp", influence[place].conj(), weighted)
            total += np.real(np.einsum("f,fp,fq->pq", images[place], part, part.conj()))
            np.add.at(own, near, images[place][:, None] * np.abs(part) ** 2)
        square += np.sum(own**2, axis=0)
    variance = np.diag(total)
    # Half the degrees of freedom of independent frequencies: finite records correlate neighbours.
    return total, np.maximum(2.0 * variance**2 / np.maximum(square, 1e-300), 1.0)


def _neighbourhoods(left: np.ndarray):
    """For each offset of a neighbour: frequencies, their neighbours, and the noise left in the whole neighbourhood.

    A neighbourhood is doubled until enough noise is left in it.

    Args:
        left: share of the noise that is left at each frequency (row) of each output.
    """
    count = left.shape[0]
    waiting = np.arange(count)
    cumulated = np.concatenate([np.zeros((1, left.shape[1])), np.cumsum(left, axis=0)])
    width = 0
    while waiting.size:
        low, high = np.maximum(waiting - width, 0), np.minimum(waiting + width, count - 1)
        inside = cumulated[high + 1] - cumulated[low]
        enough = (inside >= _LEAST_LEFT * (high + 1 - low)[:, None]).all(axis=1) | (2 * width >= count)
        place, noise_left = waiting[enough], np.maximum(inside[enough], _BLIND)
        for offset in range(-width, width + 1) if place.size else ():
            near = place + offset
            valid = (near >= 0) & (near < count)
            yield place[valid], near[valid], noise_left[valid]
        waiting = waiting[~enough]
        width = 2 * width or 1


def _leverage(record: Record, inverse: np.ndarray) -> np.ndarray:
    """Leverage: share of white noise that the fit absorbs, by frequency and output."""
    count, outputs = record.residual.shape
    values, vectors = np.linalg.eigh(inverse)
    found = _power(record.slopes @ (vectors * np.sqrt(np.maximum(values, 0.0))))
    for start, basis in record.bases():
        placed = np.zeros((count, outputs, basis.shape[2]))
        placed[start : start + len(basis)] = basis
        found += _power(placed)
    return np.minimum(found, 1.0)


def _power(columns: np.ndarray) -> np.ndarray:
    return np.sum(np.abs(_spectrum(columns)) ** 2, axis=2)


def _spectrum(series: np.ndarray) -> np.ndarray:
    return np.fft.rfft(series, axis=0) / np.sqrt(series.shape[0])


def _records(fit: Fit, residual: np.ndarray, projected: np.ndarray, by_first: np.ndarray) -> tuple[Record, ...]:
    """Residuals of segments, joined into stretches."""
    segments = fit.problem.segments
    _, samples, outputs = segments.measured.shape

    def in_time(blocks: np.ndarray) -> list[np.ndarray]:
        own = blocks[:, : samples * outputs]
        return fit.by_stretch(own.reshape(len(own), samples, outputs, *blocks.shape[2:]))

    joined = np.split(np.asarray(segments.joined), np.cumsum(fit.pieces))
    weights = fit.by_stretch(np.asarray(segments.weight))
    made = []
    for left, slopes, columns, weight, follows in zip(
        in_time(residual), in_time(projected), in_time(by_first), weights, joined, strict=False
    ):
        starts = [i * samples for i, goes_on in enumerate(follows) if i == 0 or not goes_on]
        stops = [*starts[1:], len(left)]
        states = tuple((a, columns[a:b]) for a, b in zip(starts, stops, strict=True))
        made.append(Record(left, slopes, states, float(np.mean(weight))))
    return tuple(made)


def _inverse(information: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Inverse of an information of unit diagonal, and the part of it due to directions without information, which get a
    huge variance."""
    values, vectors = np.linalg.eigh(information)
    blind = values < _BLIND
    values = np.maximum(values, _BLIND)
    return (vectors / values) @ vectors.T, vectors[:, blind] @ vectors[:, blind].T / _BLIND
