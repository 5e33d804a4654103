"""The load as a filter of the motor's motion: starting values and twist where the dynamic error was not measured.

The load responds to the motor's motion q = theta_m/N and to the load torque alone,

    theta_l = G q + (G_0 / J_l) T_l,   G = (c_B s + c_K) G_0,   G_0 = 1 / (s^2 + c_B s + c_K),

with c_K = K/J_l (the square of the antiresonance) and c_B = B_sp/J_l. For given c_K and c_B, the measured signals are
linear in all other unknowns,

    N k_T T_m + G T_l = N^2 J_m q'' + J_l (G q)'' + friction of the motor      (momentum of the motor)
    tau + G T_l = J_l (G q)''                                                   (a sensor of the joint torque)
    theta_l'' = (G q)'' + (1 - G) T_l / J_l                                     (a sensor of the load)

so that only c_K and c_B are searched. Test functions replace derivatives as in
[`fitting.estimation.starting_values`][]. Friction and inertia of the motor do not affect the antiresonance.
"""

from collections.abc import Iterator, Sequence
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Float

from fitting.estimation.experiment import Experiment, Stretch
from fitting.estimation.weak_form import WIDTHS, against, bump_functions, solved
from hdjax import Drive, Model, TwoInertiaModel

Signal = Float[np.ndarray, " samples"]
Rows = Float[np.ndarray, " rows"]
"""Inner products of a signal with test functions."""
Order = Literal[0, 1]
"""0 for an angle, 1 for a velocity."""

# Search grid of antiresonances over the decades that a log can resolve, and the damping ratio of the first pass, large
# enough to make minima wide.
_FREQUENCIES, _DAMPING = 60, 0.1
_STEPS = 60
# Least damping ratio of a filter whose initial state is unknown.
_LEAST_DAMPING = 0.02
# Windows of each width at most: they determine c_K to a percent.
_MOST_WINDOWS = 500
# Largest unexplained share of the measured signals for a start to be accepted.
_MOST_MISSED = 0.5
# Objective of infeasible values.
_NO_START = 1e6


class Seen(NamedTuple):
    """A side's motion: its angle or its velocity."""

    values: Signal
    order: Order


def seen_motor(experiment: Experiment, N: float) -> Seen | None:
    """The motor's angle theta_m/N or its rate; None where neither was measured."""
    return _seen(experiment, {"motor_turn": (1.0, 0), "motor_angle": (N, 0), "motor_velocity": (N, 1)})


def seen_load(experiment: Experiment) -> Seen | None:
    """The load's angle or its rate; None where neither was measured."""
    return _seen(experiment, {"load_angle": (1.0, 0), "load_velocity": (1.0, 1)})


def _seen(experiment: Experiment, names: dict[str, tuple[float, Order]]) -> Seen | None:
    for name, (scale, order) in names.items():
        values = experiment.output(name)
        if values is not None:
            return Seen(values / scale, order)
    return None


def through_load(signal: Signal, c_K: float, c_B: float, time_step: float) -> Signal:
    """G applied to a signal that was constant before, linear between samples."""
    return _filtered(signal, [c_B, c_K], float(np.sqrt(c_K)), c_B, time_step) + signal[0]


def starts_from_motor(model: TwoInertiaModel, stretches: Sequence[Stretch]) -> list[dict[str, float]]:
    """Starting values of K, B_sp and the unknown inertias, for each width of test functions that explains the measured
    signals, the median antiresonance first; none where the motor was not measured.

    Args:
        model: supplies the known parameters.
        stretches: the data.
    """
    balances = (_Balance.of(model, stretches, width) for width in WIDTHS)
    solved = [balance.solved() for balance in balances if balance is not None]
    found = [values for missed, values in solved if missed < _MOST_MISSED]
    if not found:
        return []
    # Narrow functions see mostly noise, wide ones only slow motion: most widths agree, and single ones are far off.
    antiresonances = [np.log(values["K"] / values.get("J_l", float(model.drive.J_l))) for values in found]
    return [found[i] for i in np.argsort(np.abs(antiresonances - np.median(antiresonances)))]


def friction_from_motor(model: TwoInertiaModel, stretches: Sequence[Stretch]) -> tuple[float, float]:
    """Coulomb torque [N m] and viscous coefficient [N m s/rad] of the motor's friction, by the balance of its momentum
    with the model's drive; not positive where the balance shows no friction.

    Args:
        model: the drive.
        stretches: the data.
    """
    drive, balances = model.drive, (_Balance.of(model, stretches, width) for width in WIDTHS)
    found = [b.missed(float(drive.K / drive.J_l), float(drive.B_sp / drive.J_l)) for b in balances if b is not None]
    _, _, (direction, speed) = min(found, key=lambda solution: solution[0])
    N = float(drive.N)
    return direction / N, speed / N**2


class _Part(NamedTuple):
    """The signals of one stretch."""

    motor: Seen
    load: Seen | None
    joint: Signal | None
    torque: Signal
    load_torque: Signal | None
    time_step: float

    @staticmethod
    def of(stretch: Stretch, model: TwoInertiaModel) -> "_Part | None":
        experiment, part, N = stretch.experiment, slice(stretch.start, stretch.stop), float(model.drive.N)
        motor, load, joint = seen_motor(experiment, N), seen_load(experiment), experiment.output("joint_torque")
        if motor is None:
            return None
        on_load = experiment.load_torque
        return _Part(
            Seen(motor.values[part], motor.order),
            None if load is None else Seen(load.values[part], load.order),
            None if joint is None else joint[part],
            N * float(model.drive.k_T) * np.asarray(experiment.torque.coefficients)[part, 0],
            None if on_load is None else np.asarray(on_load.coefficients)[part, 0],
            experiment.time_step,
        )


class _Equation(NamedTuple):
    """One momentum or torque balance in weak form.

    Attributes:
        inertias: regressor of each inertia.
        beside: regressors of the motor's friction.
        right: right-hand side.
        whole: the measured signal, by which the balance is normalised.
        known: the inertias that are not estimated.
    """

    inertias: dict[str, Rows]
    beside: list[Rows]
    right: Rows
    whole: Rows
    known: dict[str, float]

    def rows(self, wanted: Sequence[str]) -> tuple[np.ndarray, np.ndarray]:
        """Regressors of the inertias to estimate and of friction, and the right-hand side."""
        size = np.linalg.norm(self.whole) or 1.0
        left = self.right - sum((J * self.inertias[path] for path, J in self.known.items()), np.zeros(1))
        return np.stack([*(self.inertias[path] for path in wanted), *self.beside], axis=1) / size, left / size


class _Balance:
    """Measured signals of some stretches in weak form, with test functions of one width."""

    def __init__(self, model: TwoInertiaModel, parts: Sequence[_Part], width: int) -> None:
        self.model, self.parts, self.width = model, parts, width
        longest = max(part.torque.size for part in parts)
        self.hop = max(1, width // 4, longest // _MOST_WINDOWS)
        unknown = {p.path for p in model.drive.priors if np.isinf(p.tolerance)}
        self.wanted = tuple(path for path in ("J_m", "J_l") if path in unknown)
        self.motor = [self._of_motor(part) for part in parts]

    @classmethod
    def of(cls, model: TwoInertiaModel, stretches: Sequence[Stretch], width: int) -> "_Balance | None":
        parts = [_Part.of(s, model) for s in stretches if len(s) >= 3 * width]
        return cls(model, [p for p in parts if p is not None], width) if parts and None not in parts else None

    def _against(self, values: Signal, part: _Part, derivatives: int) -> Rows:
        """Inner products of a signal's derivative of an order with the test functions."""
        functions = bump_functions(self.width, part.time_step)[derivatives]
        return (
            (-1.0) ** derivatives
            * against(values - values[0] if derivatives else values, functions, self.hop)
            * (part.time_step)
        )

    def _of_motor(self, part: _Part) -> list[Rows]:
        """Regressors of the motor (acceleration, direction, speed, a constant) and the torque."""
        values, order = part.motor
        speed = np.gradient(values) if order == 0 else values
        return [
            self._against(values, part, 2 - order),
            self._against(np.sign(speed), part, 0),
            self._against(values, part, 1 - order),
            self._against(np.ones_like(values), part, 0),
            self._against(part.torque, part, 0),
        ]

    def missed(self, c_K: float, c_B: float) -> tuple[float, dict[str, float], tuple[float, float]]:
        """The unexplained share of the measured signals, the estimated inertias, and the friction's coefficients of
        direction and speed at the output."""
        equations = [
            equation
            for part, of_motor in zip(self.parts, self.motor, strict=True)
            for equation in self._equations(part, of_motor, c_K, c_B)
        ]
        a, b = (np.concatenate(column) for column in zip(*(e.rows(self.wanted) for e in equations), strict=True))
        solution = solved(a, b)
        share = float(np.sum((b - a @ solution) ** 2)) / len(equations)
        inertias, (direction, speed, _) = np.split(solution, [len(self.wanted)])
        if not (np.all(inertias > 0) and np.isfinite(share)):
            share = _NO_START
        return share, dict(zip(self.wanted, map(float, inertias), strict=True)), (float(direction), float(speed))

    def _equations(self, part: _Part, of_motor: list[Rows], c_K: float, c_B: float) -> Iterator["_Equation"]:
        """The balances of one stretch."""
        N, drive = float(self.model.drive.N), self.model.drive
        known = {path: float(getattr(drive, path)) for path in ("J_m", "J_l") if path not in self.wanted}
        acceleration, *friction, torque = of_motor
        none = np.zeros_like(torque)
        filtered = through_load(part.motor.values, c_K, c_B, part.time_step)
        answer, on_load = self._against(filtered, part, 2 - part.motor.order), none
        if part.load_torque is not None:
            on_load = self._against(through_load(part.load_torque, c_K, c_B, part.time_step), part, 0)
        motor, load = {"J_m": N**2 * acceleration, "J_l": answer}, {"J_m": none, "J_l": answer}
        yield _Equation(motor, friction, torque + on_load, torque, known)
        if part.joint is not None:
            joint = self._against(part.joint, part, 0)
            yield _Equation(load, [none] * 3, joint + on_load, joint, known)
        # An unknown inertia would enter the load's answer to a torque of its own as 1/J_l.
        if part.load is not None and (part.load_torque is None or "J_l" in known):
            seen, pushed = self._against(part.load.values, part, 2 - part.load.order), none
            if part.load_torque is not None:
                pushed = (self._against(part.load_torque, part, 0) - on_load) / known["J_l"]
            yield _Equation({"J_m": none, "J_l": none}, [none] * 3, seen - answer - pushed, seen, known)

    def solved(self) -> tuple[float, dict[str, float]]:
        """The unexplained share, and the values that minimise it."""
        # Imported here: logs with both angles do not need it.
        from scipy.optimize import minimize

        part = max(self.parts, key=lambda p: p.torque.size)
        slowest = 4 * np.pi / (part.torque.size * part.time_step)
        grid = np.linspace(np.log(slowest), np.log(0.5 * np.pi / part.time_step), _FREQUENCIES)

        def share(logarithms: np.ndarray) -> float:
            return self.missed(*_coefficients(logarithms))[0]

        first = min((np.array([w, np.log(_DAMPING)]) for w in grid), key=share)
        around = np.array([first, [first[0] + grid[1] - grid[0], first[1]], [first[0], first[1] - 1.0]])
        options = {"maxiter": _STEPS, "initial_simplex": around}
        found = minimize(share, first, method="Nelder-Mead", options=options)
        c_K, c_B = _coefficients(found.x)
        missed, inertias, _ = self.missed(c_K, c_B)
        J_l = inertias.get("J_l", float(self.model.drive.J_l))
        return missed, {"K": J_l * c_K, "B_sp": J_l * c_B, "alpha": 0.0} | inertias


def _coefficients(logarithms: np.ndarray) -> tuple[float, float]:
    """c_K and c_B from the logarithms of an antiresonance and a damping ratio."""
    omega, damping = np.exp(logarithms[0]), np.exp(np.clip(logarithms[1], -12.0, 2.0))
    return float(omega**2), float(2.0 * damping * omega)


def twist(stretch: Stretch, model: Model | None) -> Signal:
    """The dynamic error of a stretch: as measured, or as a model filters it from the measured signals.

    Args:
        stretch: the data.
        model: the drive; needed where the dynamic error was not measured.
    """
    experiment, part = stretch.experiment, slice(stretch.start, stretch.stop)
    measured = experiment.output("dynamic_error")
    if measured is not None:
        return measured[part]
    assert model is not None and isinstance(model.drive, Drive)
    drive, joint = model.drive, experiment.output("joint_torque")
    if joint is not None:
        return joint[part] / float(drive.K)
    motor = seen_motor(experiment, float(drive.N))
    if motor is not None:
        omega = float(np.sqrt(drive.K / drive.J_l))
        damping = max(float(drive.B_sp / drive.J_l), 2.0 * _LEAST_DAMPING * omega)
        return _filtered(motor.values[part], [1.0, 0.0, 0.0][: 3 - motor.order], omega, damping, experiment.time_step)
    omega = float(drive.omega_0)
    damping = max(float(drive.mu), 2.0 * _LEAST_DAMPING * omega)
    forcing = np.asarray(experiment.torque.coefficients)[part, 0] * float(drive.reduced().gain)
    return _filtered(forcing, [1.0], omega, damping, experiment.time_step)


def _filtered(signal: Signal, top: list[float], omega: float, damping: float, time_step: float) -> Signal:
    """`top / (s^2 + damping s + omega^2)` applied to a signal that was constant before, relative to the steady
    response; linear between samples, by partial fractions."""
    # Imported here: logs with both angles do not need it.
    from scipy.signal import lfilter

    # Equal poles have no partial fractions.
    root = np.sqrt(complex(0.25 * damping**2 - omega**2) + 1e-12 * omega**2)
    moved = signal - signal[0]
    found = top[0] * moved if len(top) == 3 else np.zeros_like(moved)
    for pole, other in ((-0.5 * damping + root, -0.5 * damping - root), (-0.5 * damping - root, -0.5 * damping + root)):
        decay = np.exp(pole * time_step)
        rising = (decay - 1.0 - pole * time_step) / (pole**2 * time_step)
        steady = (decay - 1.0) / pole - rising
        part = np.polyval(top, pole) / (pole - other) * lfilter([rising, steady], [1.0, -decay], moved)
        if root.imag:
            # The other pole is the conjugate one.
            return found + 2.0 * part.real
        found = found + part.real
    return found
