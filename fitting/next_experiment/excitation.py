"""Typical motor torques of test benches, as sums of shapes: starts of the search for an experiment."""

from collections.abc import Sequence

import equinox as eqx
import numpy as np
from jaxtyping import Float

from fitting.estimation.experiment import Stretch
from hdjax import Model, TwoInertiaModel

# Share of the duration over which a command is faded in and out.
_FADE = 0.02
# Low-frequency lines that a command may contain, and number of further ones up to the highest.
_SLOW_LINES = (1, 2, 3, 4)
_FAST_LINES = 10
# Frequency of the highest line over the natural frequency, and its limit over the sampling frequency.
_HIGHEST, _MOST_SAMPLED = 2.5, 0.1
# Samples over which an encoder's angle is differenced, to limit the noise of the speed.
_SPEED_SPAN = 8
# Share of each limit that a command may use.
_MARGIN = 0.98


class Limits(eqx.Module):
    """Limits and sampling of a command.

    Attributes:
        torque: largest motor torque [N m], or forcing of a reduced drive.
        speed: largest motor speed [rad/s]; infinite for a reduced drive.
        travel: largest output angle from the start [rad]; infinite for a reduced drive.
        twist: largest dynamic error [rad]; infinite where none is stated.
        duration: of the command [s].
        time_step: sampling interval [s].
    """

    torque: float
    speed: float
    travel: float
    twist: float
    duration: float
    time_step: float

    @property
    def samples(self) -> int:
        """Number of samples."""
        return max(2, round(self.duration / self.time_step))


class Excitation(eqx.Module):
    """A command as a sum of shapes, `torque * shapes @ coefficients`.

    Attributes:
        name: of its first shape.
        shapes: by column, over the samples; the first one gives the name.
        coefficients: starting values of the search.
        torque: the limit, which is the unit of the shapes.
    """

    name: str = eqx.field(static=True)
    shapes: Float[np.ndarray, "samples shapes"]
    coefficients: Float[np.ndarray, " shapes"]
    torque: float

    def command(self, coefficients: Float[np.ndarray, " shapes"]) -> Float[np.ndarray, " samples"]:
        """The torque at the samples [N m]."""
        return self.torque * self.shapes @ coefficients


def reached(model: Model, stretches: Sequence[Stretch], *, most_samples: int) -> Limits:
    """The largest values in the logs, as limits.

    Args:
        model: supplies the reduction ratio.
        stretches: of the logs.
        most_samples: longest command.
    """
    first = stretches[0].experiment
    step = first.time_step
    torque, speed, turned = 0.0, 0.0, 0.0
    for stretch in stretches:
        part = slice(stretch.start, stretch.stop)
        torque = max(torque, float(np.max(np.abs(np.asarray(stretch.experiment.torque.coefficients)[part, 0]))))
        motor = stretch.experiment.motor_angle
        if motor is not None:
            angle = motor[part]
            span = min(_SPEED_SPAN, len(angle) - 1)
            speed = max(speed, float(np.max(np.abs(angle[span:] - angle[:-span]))) / (span * step))
            turned = max(turned, float(np.max(np.abs(angle - np.asarray(first.motor_angle)[0]))))
    longest = max(len(s) for s in stretches)
    travel = turned / float(model.drive.N) if isinstance(model, TwoInertiaModel) else np.inf
    free = first.motor_angle is None
    return Limits(
        torque=torque,
        speed=np.inf if free else speed,
        travel=np.inf if free else travel,
        twist=np.inf,
        duration=min(longest, most_samples) * step,
        time_step=step,
    )


def excitations(limits: Limits, model: Model, *, logged: Float[np.ndarray, " n"]) -> tuple[Excitation, ...]:
    """Typical commands, scaled to the limits for a drive without friction and loads, with further lines as degrees of
    freedom of the search.

    Args:
        limits: of the command.
        model: supplies natural frequency and inertias.
        logged: the torque of a log from its start, which is one of the commands.
    """
    time = np.arange(limits.samples) * limits.time_step
    fade = _fade(time, limits.duration)
    lines = _lines(limits, model)
    shapes = _typical(time, limits.duration, _frequency(model))
    own = np.zeros(time.size)
    own[: logged.size] = logged[: time.size] / limits.torque
    shapes["the log's own torque"] = own
    beside = [fade * _within(line, limits, model) for line in lines]
    found = []
    for name, shape in shapes.items():
        first = _within(fade * shape, limits, model)
        if np.any(first):
            columns = np.stack([first, *beside], axis=1)
            start = np.zeros(columns.shape[1])
            start[0] = 1.0
            found.append(Excitation(name, columns, start, limits.torque))
    return tuple(found)


def _frequency(model: Model) -> float:
    """Natural frequency [Hz]."""
    return float(model.drive.omega_0) / (2 * np.pi)


def _fade(time: np.ndarray, duration: float) -> np.ndarray:
    """A window that is zero at both ends of a command and one in between."""
    rise = np.clip(np.minimum(time, duration - time) / (_FADE * duration), 0.0, 1.0)
    return 0.5 - 0.5 * np.cos(np.pi * rise)


def _lines(limits: Limits, model: Model) -> list[np.ndarray]:
    """Lines: a constant, and sines and cosines."""
    time = np.arange(limits.samples) * limits.time_step
    highest = min(_HIGHEST * _frequency(model), _MOST_SAMPLED / limits.time_step) * limits.duration
    fast = np.geomspace(_SLOW_LINES[-1] + 1, max(highest, _SLOW_LINES[-1] + 2), _FAST_LINES)
    phases = 2 * np.pi * np.outer([*_SLOW_LINES, *fast], time / limits.duration)
    return [np.ones(time.size), *np.sin(phases), *np.cos(phases)]


def _typical(time: np.ndarray, duration: float, frequency: float) -> dict[str, np.ndarray]:
    """Typical bench commands by name, without the mean that would accelerate a free drive."""
    turns = time / duration
    step = time[1]
    top = min(3.0 * frequency, _MOST_SAMPLED / step)
    bottom = min(0.3 * frequency, 0.5 * top)
    lines = np.arange(max(1.0, np.ceil(bottom * duration)), np.floor(top * duration) + 1) / duration
    # Schroeder's phases give a flat spectrum low peaks (IEEE Trans. Inf. Theory 16, 1970).
    order = np.arange(lines.size)
    schroeder = -np.pi * order * (order + 1) / max(lines.size, 1)
    multisine = np.zeros(time.size)
    for line, phase in zip(lines, schroeder, strict=True):
        multisine += np.cos(2 * np.pi * line * time + phase)
    rate = (top - 0.1 * bottom) / duration
    shapes = {
        "a slow triangle": 2.0 / np.pi * np.arcsin(np.sin(4 * np.pi * turns)),
        "a multisine around the natural frequency": multisine,
        "runs at constant speed": np.interp(
            turns % 0.5, [0, 0.04, 0.08, 0.12, 0.2, 0.24, 0.28, 0.32, 0.5], [0, 1, 0, 0, 0, -1, 0, 0, 0]
        )
        * np.where(turns < 0.5, 1.0, -1.0),
        "steps with dwell": np.sign(np.sin(10 * np.pi * turns)) * (np.abs(np.sin(10 * np.pi * turns)) > 0.5),
        "a sweep through the natural frequency": np.sin(2 * np.pi * (0.1 * bottom + 0.5 * rate * time) * time),
    }
    return {name: shape - np.mean(shape) for name, shape in shapes.items()}


def _within(shape: np.ndarray, limits: Limits, model: Model) -> np.ndarray:
    """A shape in units of the torque limit, scaled to the limits for a rigid drive without friction."""
    peak = float(np.max(np.abs(shape)))
    if not peak:
        return shape
    scale = 1.0 / peak
    if isinstance(model, TwoInertiaModel):
        drive, step = model.drive, limits.time_step
        inertia = float(drive.J_m + drive.J_l / drive.N**2)
        speed = np.cumsum(limits.torque * shape) * step / inertia
        turned = np.cumsum(speed) * step / float(drive.N)
        for motion, limit in ((speed, limits.speed), (turned, limits.travel)):
            scale = min(scale, limit / max(float(np.max(np.abs(motion))), 1e-300))
    return _MARGIN * scale * shape
