"""Frequency response from torque to dynamic error: estimate from the log, and that of the fitted model."""

import math
from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Complex, Float
from scipy.linalg import expm

from fitting.estimation.driven_load import twist
from fitting.estimation.experiment import Experiment, Stretch
from fitting.estimation.linear_drive import rates_of, readings
from fitting.validation.welch import cross_density, density
from hdjax import Drive, Hold, Model, TwoInertiaModel

# Number of averages for a meaningful coherence, and smallest window.
_AVERAGES = 8
_SHORTEST, _LONGEST = 128, 1 << 15
# Number of rigid-body integrations from torque to each output.
_ORDER = {"motor_angle": 2, "load_angle": 2, "motor_velocity": 1, "load_velocity": 1}
_OF_MOTOR = ("motor_angle", "motor_velocity")
# Lines across the width of the resonance.
_LINES = 8
# Negligible deviation of a sample from the grid, as a share of the step.
_JITTER = 0.01
# Power, relative to the strongest line, above which the input counts as strong.
_STRONG = 1e-2
HIGH_COHERENCE, LOW_COHERENCE = 0.9, 0.6
# Least share of incoherent strong lines to be reported.
_WORTH_A_WORD = 0.05
# Damping ratio above which there is no peak.
_OVERDAMPED = 0.6
# Lines to either side of a sharp peak that a Hann window mixes with it: its main lobe (Harris 1978).
_LOBE = 2.0
# Largest gap within a band, in lines.
_GAP = 3
# Largest ratio of the log's and the model's peak frequency.
_NEAR = 2.0
# Least share of the stiffness at rest that a softening spring leaves.
_LEAST_STIFFNESS = 1e-6


class FrequencyResponse(eqx.Module):
    """Frequency response from motor torque (or forcing) to the principal output, mostly the dynamic error.

    Attributes:
        frequency: without zero [Hz].
        measured: H1 estimate, cross-spectrum over input spectrum.
        coherence: share of the output's power that follows linearly from the input.
        input_density: power spectral density of the input.
        noise_coherence: expected coherence with measurement noise as the only disturbance.
        model: of the fitted drive, linearised, with the hold of the torque.
        resonance: natural frequency of the linearised drive [Hz].
        width: of its peak at half power [Hz].
        averages: number of windows.
        source: name of the input.
        output: name of the principal output.
        order: number of rigid-body integrations from torque to output.
        antiresonance: frequency at which load and spring hold the motor still [Hz], where the output is the motor's
            motion; else None.
    """

    frequency: Float[np.ndarray, " frequencies"]
    measured: Complex[np.ndarray, " frequencies"]
    coherence: Float[np.ndarray, " frequencies"]
    input_density: Float[np.ndarray, " frequencies"]
    noise_coherence: Float[np.ndarray, " frequencies"]
    model: Complex[np.ndarray, " frequencies"]
    resonance: float
    width: float
    averages: int = eqx.field(static=True)
    source: str = eqx.field(static=True)
    output: str = eqx.field(static=True, default="dynamic_error")
    order: int = eqx.field(static=True, default=0)
    antiresonance: float | None = None

    @property
    def resolution(self) -> float:
        """Distance of the lines [Hz]."""
        return float(self.frequency[0])


def frequency_response(
    model: Model, experiments: Sequence[Experiment], *, hold: Hold, noise: float
) -> FrequencyResponse | None:
    """Estimate the frequency response of the logs, and compute that of the model.

    Welch's method with Hann windows that overlap by half; a log with irregular stamps is interpolated linearly onto a
    grid, for this estimate only. The mean of each window is removed.

    Args:
        model: fitted; its stiffness is linearised as its mean slope over the measured twist.
        experiments: the logs.
        hold: inter-sample behaviour of the torque.
        noise: rms measurement noise of the output.

    Returns:
        The responses; None where the logs are too short, or the input is constant.
    """
    step = max(e.time_step for e in experiments)
    output = model.measured[-1]
    order = _ORDER.get(output, 0)
    signals = [_differenced(*_on_grid(e, step), order) for e in experiments]
    linear = _linearised(model, experiments)
    width = abs(float(linear.drive.mu)) / (2 * math.pi)
    window = _window([u.size for u, _ in signals], step, width)
    signals = [(u, x) for u, x in signals if u.size >= window]
    if window < _SHORTEST or not any(np.ptp(u) > 0 for u, _ in signals):
        return None
    windows = [2 * u.size // window - 1 for u, _ in signals]
    share = np.array(windows) / sum(windows)
    frequency, _ = density(signals[0][0], step=step, window=window)
    S_uu = share @ np.array([density(u, step=step, window=window)[1] for u, _ in signals])
    S_xx = share @ np.array([density(x, step=step, window=window)[1] for _, x in signals])
    S_ux = share @ np.array([cross_density(u, x, step=step, window=window)[1] for u, x in signals])
    kept = slice(1, -1 if window % 2 == 0 else None)
    frequency, S_uu, S_xx, S_ux = frequency[kept], S_uu[kept], S_xx[kept], S_ux[kept]
    tiny = np.finfo(float).tiny
    # Accelerations of a freely turning side: rigid-body motion would mask the resonance.
    differences = (np.exp(2j * np.pi * frequency * step) - 1.0) ** order
    noise_density = 2.0 * step * noise**2 * np.abs(differences) ** 2
    return FrequencyResponse(
        frequency=frequency,
        measured=S_ux / np.maximum(S_uu, tiny) / differences,
        coherence=np.clip(np.abs(S_ux) ** 2 / np.maximum(S_uu * S_xx, tiny), 0.0, 1.0),
        input_density=S_uu,
        noise_coherence=np.clip(1.0 - noise_density / np.maximum(S_xx, tiny), 0.0, 1.0),
        model=_model_response(linear, frequency, hold=hold, step=step),
        resonance=float(linear.drive.omega_0) / (2 * math.pi),
        width=width,
        averages=sum(windows),
        source="torque" if isinstance(model.drive, Drive) else "forcing",
        output=output,
        order=order,
        antiresonance=_antiresonance(linear),
    )


def _differenced(u: np.ndarray, y: np.ndarray, order: int) -> tuple[np.ndarray, np.ndarray]:
    """An input, and the differences of an output."""
    return (u[: u.size - order], np.diff(y, n=order)) if order else (u, y)


def _on_grid(experiment: Experiment, step: float) -> tuple[np.ndarray, np.ndarray]:
    """Input and principal output at even distances."""
    time = experiment.time
    u, x = np.asarray(experiment.torque.coefficients)[:, 0], experiment.measured[:, -1]
    grid = time[0] + step * np.arange(int((time[-1] - time[0]) / step + 1e-6) + 1)
    if grid.size == time.size and np.max(np.abs(grid - time)) < _JITTER * step:
        return u, x
    return np.interp(grid, time, u), np.interp(grid, time, x)


def _window(samples: Sequence[int], step: float, width: float) -> int:
    """Samples in a window: enough to resolve the resonance, and few enough for averaging."""
    wanted = _LINES / (width * step) if width > 0 else math.inf
    averaged = 2.0 * sum(samples) / (_AVERAGES + len(samples))
    allowed = min(max(wanted, 1024.0), averaged, max(samples), _LONGEST)
    return 1 << int(math.log2(max(allowed, 1.0)))


def _linearised(model: Model, experiments: Sequence[Experiment]) -> Model:
    """The model with its mean stiffness over the measured twist."""
    x = np.concatenate([twist(Stretch(e, 0, len(e)), model) for e in experiments])
    drive = model.drive
    # A softening spring may leave no stiffness, by which widths of peaks are divided, and with which no drive can be
    # made anew.
    hardening = max(1.0 + 3.0 * float(drive.alpha) * float(np.mean(x**2)), _LEAST_STIFFNESS)
    if isinstance(drive, Drive):
        return eqx.tree_at(lambda m: m.drive.K, model, drive.K * hardening)
    return eqx.tree_at(lambda m: m.drive.omega_0, model, drive.omega_0 * math.sqrt(hardening))


def _antiresonance(model: Model) -> float | None:
    """Frequency at which load and spring hold the motor still [Hz]; None of another output."""
    if model.measured[-1] not in _OF_MOTOR or not isinstance(model, TwoInertiaModel):
        return None
    return math.sqrt(model.drive.K / model.drive.J_l) / (2 * math.pi)


def _linear_system(model: Model) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Derivatives of the state's rate by state and torque, and of the principal output by the state, without alpha."""
    drive = model.drive
    if isinstance(model, TwoInertiaModel) and model.measured[-1] != "dynamic_error":
        by_state, by_torque = rates_of(model.drive)
        return by_state, by_torque[:, :1], readings(model)[-1]
    reduced = drive.reduced() if isinstance(drive, Drive) else drive
    by_state = np.array([[0.0, 1.0], [-(float(reduced.omega_0) ** 2), -float(reduced.mu)]])
    return by_state, np.array([[0.0], [float(reduced.gain)]]), np.array([1.0, 0.0])


def _model_response(model: Model, frequency: np.ndarray, *, hold: Hold, step: float) -> np.ndarray:
    """Response of a linear drive's principal output to a sampled torque, from sample to sample."""
    by_state, by_torque, reads = _linear_system(model)
    s, count = 2j * np.pi * frequency[:, None, None], len(by_state)
    if hold not in ("zero-order", "linear"):
        # For a smooth input the sampled response equals the continuous one.
        return np.linalg.solve(s * np.eye(count) - by_state, by_torque[None])[:, :, 0] @ reads
    # One step of the state, the torque and its change, which a zero-order hold ignores (Franklin, Powell and Workman
    # 1998, 6.3).
    rates = np.zeros((count + 2, count + 2))
    rates[:count, : count + 1], rates[count, count + 1] = step * np.hstack([by_state, by_torque]), 1.0
    across = expm(rates)
    z = np.exp(s * step)
    change = np.zeros_like(z) if hold == "zero-order" else z - 1.0
    driven = across[:count, [count]] + across[:count, [count + 1]] * change
    return np.linalg.solve(z * np.eye(count) - across[:count, :count], driven)[:, :, 0] @ reads


def strong_lines(found: FrequencyResponse) -> np.ndarray:
    """Which lines the input excites strongly."""
    return found.input_density > _STRONG * np.max(found.input_density)


def excites_resonance(found: FrequencyResponse) -> bool:
    """Whether the log holds the resonance: a line near it where the output follows the input."""
    reach = max(found.width, 2.0 * found.resolution)
    near = np.abs(found.frequency - found.resonance) <= reach
    return bool(np.any(found.coherence[near] > LOW_COHERENCE))


def excites_antiresonance(found: FrequencyResponse) -> bool:
    """Whether the log holds the antiresonance: the motor follows the torque on both sides of it, though it hardly moves
    there; not where the output has none."""
    if found.antiresonance is None:
        return False
    octaves = np.log(found.frequency / found.antiresonance) / math.log(_NEAR)
    coherent = octaves[found.coherence > HIGH_COHERENCE]
    return bool(np.any(np.abs(coherent + 0.5) < 0.5) and np.any(np.abs(coherent - 0.5) < 0.5))


def resonance_seen(found: FrequencyResponse) -> float | None:
    """Frequency of the measured peak [Hz] near the model's resonance; None where there is none to see."""
    return _extreme(found, found.resonance, found.width) if excites_resonance(found) else None


def antiresonance_seen(found: FrequencyResponse) -> float | None:
    """Frequency of the measured dip [Hz] near the model's antiresonance; None where there is none to see."""
    if found.antiresonance is None or not excites_antiresonance(found):
        return None
    return _extreme(found, found.antiresonance, _antiresonance_width(found), dip=True)


def _antiresonance_width(found: FrequencyResponse) -> float:
    """Of the dip [Hz]: damping goes with the stiffness, as both act in the mesh."""
    return found.width * ((found.antiresonance or 0.0) / found.resonance) ** 2


def _extreme(found: FrequencyResponse, frequency: float, width: float, *, dip: bool = False) -> float | None:
    """Frequency of the measured peak or dip [Hz] near one of the model's, which is so wide."""
    if width > 2 * _OVERDAMPED * frequency:
        return None
    # Lines outside the excited band may be coherent by chance; the band of the resonance is contiguous.
    near = (found.coherence > LOW_COHERENCE) & (np.abs(np.log(found.frequency / frequency)) < math.log(_NEAR))
    if not near.any():
        return None
    band = min(_bands(near), key=lambda b: float(np.min(np.abs(found.frequency[b] - frequency))))
    size = np.abs(found.measured[band]) * found.frequency[band] ** found.order
    peak = int(band[np.argmin(size) if dip else np.argmax(size)])
    return float(found.frequency[peak]) if band[0] < peak < band[-1] else None


def coherent_band(found: FrequencyResponse) -> tuple[float, float] | None:
    """The widest band of high coherence [Hz], over gaps of a few lines."""
    return _widest(found, found.coherence > HIGH_COHERENCE)


def unexplained_band(found: FrequencyResponse) -> tuple[float, float] | None:
    """The widest band of strong input where noise does not explain the low coherence [Hz]; None where there are few
    such lines."""
    strong = strong_lines(found)
    lacking = strong & (found.coherence < LOW_COHERENCE) & (found.noise_coherence > HIGH_COHERENCE)
    lacking &= ~_blurred(found)
    if np.sum(lacking) <= _WORTH_A_WORD * np.sum(strong):
        return None
    return _widest(found, lacking)


def _blurred(found: FrequencyResponse) -> np.ndarray:
    """Lines at which a peak or dip that the lines don't resolve lowers the coherence of any log."""
    sharp = [(found.resonance, found.width)]
    if found.antiresonance is not None:
        sharp.append((found.antiresonance, _antiresonance_width(found)))
    beside = [np.abs(found.frequency - f) <= _LOBE * found.resolution for f, width in sharp if is_blurred(found, width)]
    return np.any([np.zeros(found.frequency.shape, dtype=bool), *beside], axis=0)


def is_blurred(found: FrequencyResponse, width: float) -> bool:
    """Whether lines lie too far apart for a peak or dip of this width [Hz]."""
    return width < 2.0 * found.resolution


def _widest(found: FrequencyResponse, chosen: np.ndarray) -> tuple[float, float] | None:
    """Limits of the band with the most lines."""
    if not chosen.any():
        return None
    longest = max(_bands(chosen), key=len)
    return float(found.frequency[longest[0]]), float(found.frequency[longest[-1]])


def _bands(chosen: np.ndarray) -> list[np.ndarray]:
    """Chosen lines in bands, over gaps of a few lines."""
    index = np.flatnonzero(chosen)
    return np.split(index, np.flatnonzero(np.diff(index) > _GAP) + 1)
