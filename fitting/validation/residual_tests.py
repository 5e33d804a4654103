"""Residual tests: zero mean, whiteness, independence of the input, normality.

With many samples, tests detect negligible correlations, so each verdict also considers the size.
"""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy import linalg
from scipy.special import chdtrc

from fitting.estimation.estimate import Fit
from fitting.estimation.whiteness import autocovariance, left_over, ljung_box
from fitting.uncertainty.normal_law import NORMAL_95
from fitting.validation.residual_diagnostics import ResidualDiagnostics, at_first_rate
from hdjax import TwoInertiaModel

Verdict = Literal["passed", "slight", "failed"]

LAGS = 25
"""Number of lags in the tests, as in system identification toolboxes."""

_LEVEL = 0.01
# Correlations below this are reported as slight, however significant.
_SLIGHT_CORRELATION = 0.1
_SLIGHT_SKEWNESS, _SLIGHT_KURTOSIS = 0.2, 0.5
# Singular values of the input's covariance below this share are cut off.
_BLIND = 1e-3
# Beyond this lag the product of two autocorrelations is only noise.
_MEMORY = 500


class ResidualTest(eqx.Module):
    """One test.

    Attributes:
        name: "zero mean", "whiteness", "independence of ..." or "normality".
        statistic: chi-squared distributed under the null hypothesis.
        degrees: its degrees of freedom.
        p_value: chance of so large a statistic under the null hypothesis.
        verdict: "slight" for a significant but small deviation.
        says: the verdict in plain words.
    """

    name: str = eqx.field(static=True)
    statistic: float
    degrees: int = eqx.field(static=True)
    p_value: float
    verdict: Verdict = eqx.field(static=True)
    says: str = eqx.field(static=True)


class InputCorrelation(eqx.Module):
    """Correlation of the residual with an input.

    Attributes:
        name: of the input.
        lag: of the residual behind the input, in samples.
        correlation: at each lag.
        limit: 95 % limit of each for a residual independent of the input.
    """

    name: str = eqx.field(static=True)
    lag: Float[np.ndarray, " lags"]
    correlation: Float[np.ndarray, " lags"]
    limit: float


class ResidualTests(eqx.Module):
    """All tests of a fit's residual.

    Attributes:
        tests: in the order in which they matter.
        inputs: correlation with each input that is not constant.
    """

    tests: tuple[ResidualTest, ...]
    inputs: tuple[InputCorrelation, ...]


def residual_tests(fit: Fit, diagnostics: ResidualDiagnostics) -> ResidualTests:
    """Test the residual of a fit's principal output.

    Args:
        fit: the fit.
        diagnostics: of the same fit; its autocorrelation is used.
    """
    residual = left_over(fit)
    step = fit.stretches[0].experiment.time_step if at_first_rate(fit).all() else None
    memory = diagnostics.autocorrelation
    tests = [zero_mean(residual, memory), whiteness(memory, residual.size)]
    residual = residual - residual.mean()
    inputs = []
    for name, signal in _inputs(fit).items():
        found, test = independence(residual, signal - signal.mean(), name=name, step=step)
        inputs.append(found)
        tests.append(test)
    return ResidualTests((*tests, normality(residual, memory)), tuple(inputs))


def zero_mean(residual: Float[np.ndarray, " n"], autocorrelation: Float[np.ndarray, " lags"]) -> ResidualTest:
    """Test whether the residual's mean is zero, corrected for autocorrelation.

    Args:
        residual: of the fit.
        autocorrelation: of the residual, at lags 0, 1, 2, ...
    """
    n, mean, spread = residual.size, float(residual.mean()), float(residual.std()) or 1.0
    statistic = n * (mean / spread) ** 2 / _memory(autocorrelation, n, power=1)
    p_value = float(chdtrc(1, statistic))
    share = mean / float(np.sqrt(np.mean(residual**2)) or 1.0)
    verdict = _verdict(p_value, abs(share) < _SLIGHT_CORRELATION)
    says = {
        "passed": "Its mean is not significantly nonzero.",
        "slight": f"Its mean is small, but significantly nonzero ({100 * share:+.2g} % of its rms).",
        "failed": f"Its mean is not zero ({100 * share:+.2g} % of its rms): an offset of a sensor or of the torque.",
    }[verdict]
    return ResidualTest("zero mean", float(statistic), 1, p_value, verdict, says)


def _memory(autocorrelation: np.ndarray, samples: int, *, power: int) -> float:
    """Variance inflation of a mean of powers by autocorrelation."""
    r = autocorrelation[1:]
    # Insignificant correlations would only add noise.
    r = np.where(np.abs(r) > NORMAL_95 / np.sqrt(samples), r, 0.0)
    return max(1.0 + 2.0 * float(np.sum(r**power)), 1.0)


def whiteness(autocorrelation: Float[np.ndarray, " lags"], samples: int) -> ResidualTest:
    """The test of Ljung and Box (1978).

    Args:
        autocorrelation: at lags 0, 1, 2, ...
        samples: number of samples of the estimate.
    """
    r = autocorrelation[1 : min(LAGS, samples - 1) + 1]
    statistic, p_value = ljung_box(r, samples)
    worst = int(np.argmax(np.abs(r))) if r.size else 0
    seen = f"autocorrelation {r[worst]:+.2g} at lag {worst + 1}" if r.size else ""
    verdict = _verdict(p_value, bool(np.max(np.abs(r), initial=0.0) < _SLIGHT_CORRELATION))
    says = {
        "passed": "White: no significant autocorrelation.",
        "slight": f"Nearly white: a significant, but small autocorrelation ({seen}).",
        "failed": f"Not white ({seen}): the residual is autocorrelated, unlike white noise.",
    }[verdict]
    return ResidualTest("whiteness", statistic, int(r.size), p_value, verdict, says)


def independence(
    residual: Float[np.ndarray, " n"], signal: Float[np.ndarray, " n"], *, name: str, step: float | None
) -> tuple[InputCorrelation, ResidualTest]:
    """Test whether the residual is independent of an input at lags from 0 to [`LAGS`][].

    The distribution of the correlations accounts for the autocorrelation of both (Bartlett 1946; Soderstrom and Stoica
    1989, section 11.2).

    Args:
        residual: with mean zero.
        signal: the input, with mean zero.
        name: of the input.
        step: sampling interval [s]; None where logs have different ones.
    """
    n = residual.size
    most = min(LAGS, n // 4)
    scale = np.sqrt(np.sum(residual**2) * np.sum(signal**2)) or 1.0
    lags = np.arange(-most, most + 1)
    spectra = (np.fft.rfft(values, 2 * n) for values in (residual, signal))
    both = np.fft.irfft(next(spectra) * np.conj(next(spectra)), 2 * n)[lags] / scale
    law = _joint_law(residual, signal, most)
    causal = both[most:]
    values, vectors = linalg.eigh(linalg.toeplitz(law) / n)
    seen = values > _BLIND * values[-1]
    statistic = float(np.sum((vectors[:, seen].T @ causal) ** 2 / values[seen]))
    degrees = int(np.sum(seen))
    p_value = float(chdtrc(degrees, statistic))
    worst = int(np.argmax(np.abs(causal)))
    verdict = _verdict(p_value, bool(np.abs(causal[worst]) < _SLIGHT_CORRELATION))
    later = f"{worst} samples" if step is None else f"{1e3 * worst * step:.2g} ms"
    behind = "at once" if worst == 0 else f"{later} later"
    told = f"correlation {causal[worst]:+.2g} {behind}"
    says = {
        "passed": f"The residual is independent of the {name}.",
        "slight": f"The residual is slightly correlated with the {name} ({told}).",
        "failed": f"The residual is correlated with the {name} ({told}): the model lacks a part of the response to it.",
    }[verdict]
    limit = NORMAL_95 * float(np.sqrt(max(law[0], 0.0) / n))
    test = ResidualTest(f"independence of {name}", statistic, degrees, p_value, verdict, says)
    return InputCorrelation(name, lags.astype(float), both, limit), test


def normality(residual: Float[np.ndarray, " n"], autocorrelation: Float[np.ndarray, " lags"]) -> ResidualTest:
    """Skewness and kurtosis against those of a Gaussian law, corrected for autocorrelation (Lobato and Velasco 2004).

    Args:
        residual: with mean zero.
        autocorrelation: of the residual, at lags 0, 1, 2, ...
    """
    n = residual.size
    standard = residual / np.sqrt(np.mean(residual**2))
    skewness, kurtosis = float(np.mean(standard**3)), float(np.mean(standard**4) - 3.0)
    third, fourth = (_memory(autocorrelation, n, power=power) for power in (3, 4))
    statistic = n * (skewness**2 / (6.0 * third) + kurtosis**2 / (24.0 * fourth))
    p_value = float(chdtrc(2, statistic))
    small = abs(skewness) < _SLIGHT_SKEWNESS and abs(kurtosis) < _SLIGHT_KURTOSIS
    verdict = _verdict(p_value, small)
    seen = f"skewness {skewness:+.2g}, excess kurtosis {kurtosis:+.2g}"
    lopsided = abs(skewness) > _SLIGHT_SKEWNESS
    shape = "rare large values" if kurtosis > _SLIGHT_KURTOSIS else "lopsided" if lopsided else "too flat"
    says = {
        "passed": "Gaussian.",
        "slight": f"Nearly Gaussian ({seen}).",
        "failed": f"Not Gaussian ({seen}): {shape}.",
    }[verdict]
    return ResidualTest("normality", float(statistic), 2, p_value, verdict, says)


def _verdict(p_value: float, small: bool) -> Verdict:
    if p_value > _LEVEL:
        return "passed"
    return "slight" if small else "failed"


def _inputs(fit: Fit) -> dict[str, np.ndarray]:
    """Inputs of the model that are not constant, at the samples of the residual."""
    segments = fit.problem.segments
    weight = np.asarray(segments.weight) > 0
    first = "motor torque" if isinstance(fit.model, TwoInertiaModel) else "forcing"
    found = {first: np.asarray(segments.torque.coefficients)[:, segments.halo :, 0][weight]}
    if segments.load_torque is not None:
        found["load torque"] = np.asarray(segments.load_torque.coefficients)[..., 0][weight]
    return {name: signal for name, signal in found.items() if np.ptp(signal) > 0}


def _joint_law(residual: np.ndarray, signal: np.ndarray, most: int) -> np.ndarray:
    """Covariance of two independent signals' correlations at lags that differ by 0, 1, ..., times the number of
    samples."""
    reach = min(_MEMORY, residual.size - most - 1)
    one = autocovariance(residual, reach)
    other = autocovariance(signal, reach + most)
    one, other = one / (one[0] or 1.0), other / (other[0] or 1.0)
    two_sided = np.concatenate([one[:0:-1], one])
    lag = np.arange(-reach, reach + 1)
    return np.array([np.sum(two_sided * other[np.abs(lag + shift)]) for shift in range(most + 1)])
