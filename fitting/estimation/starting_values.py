"""Starting values from the data, by the weak form of the equation of motion.

Multiplied by a compact test function phi and integrated by parts, the equation of the dynamic error needs no
derivative of a measured signal,

    int phi'' x + mu int (-phi') x + omega_0^2 int phi x + omega_0^2 alpha int phi x^3 = gain int phi u,

and is linear in the unknowns (Schaeffer and McCalla 2017; Messenger and Bortz 2021). Test functions whose integral is
zero are insensitive to an unlogged constant load.
"""

import itertools
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from fitting.errors import DataError
from fitting.estimation import weak_form
from fitting.estimation.driven_load import starts_from_motor
from fitting.estimation.experiment import Stretch
from fitting.estimation.weak_form import WIDTHS, blind_functions, bump_functions, solved
from hdjax import Drive, Model, ReducedModel, TwoInertiaModel

# Starts whose log stiffness differs by less than this end in the same minimum.
_DISTINCT = 0.1

MOST_LEFT = 0.5
"""Largest share of an rms error that is left where a cause of a wrong minimum explains most of it; assumed."""


def starting_models(model: Model, stretches: Sequence[Stretch]) -> tuple[Model, ...]:
    """Models with starting values of K, alpha, B_sp (or mu, omega_0, alpha, gain), one for each weak form that gives a
    stable oscillator; near duplicates are dropped.

    Args:
        model: supplies all other parameters.
        stretches: the data.

    Raises:
        DataError: no weak form gives a positive stiffness.
    """
    if not sees_twist(stretches):
        assert isinstance(model, TwoInertiaModel)
        return _distinct(model, _usable(starts_from_motor(model, stretches), stretches, "the motor's motion"))
    found = _usable(_estimates(model, stretches, blind=False), stretches, "the dynamic error")
    return _distinct(model, [*found, *_estimates(model, stretches, blind=True)])


def sees_twist(stretches: Sequence[Stretch]) -> bool:
    """Whether the dynamic error was measured."""
    return all(s.experiment.output("dynamic_error") is not None for s in stretches)


def _usable(found: list[dict[str, float]], stretches: Sequence[Stretch], what: str) -> list[dict[str, float]]:
    """The estimates; an error where there are none."""
    if found:
        return found
    outputs = dict.fromkeys(name for s in stretches for name in s.experiment.outputs)
    logged = ["motor_angle", "load_angle"] if not outputs or "dynamic_error" in outputs else list(outputs)
    raise DataError(
        f"{', '.join(s.name for s in stretches)}: {what} does not follow from the torque by any positive stiffness; "
        f"check the signs and units of motor_torque{', ' if len(logged) > 1 else ''}{', '.join(logged[:-1])} and "
        f"{logged[-1]} in the drive file"
    )


def starts_blind_to_loads(model: Model, stretches: Sequence[Stretch]) -> tuple[Model, ...]:
    """Starting values from the weak forms that are insensitive to constant loads; may be empty. Arguments as in
    [`starting_models`][]."""
    return _distinct(model, _estimates(model, stretches, blind=True))


def starts_of_equation(side: str, model: TwoInertiaModel, stretches: Sequence[Stretch]) -> tuple[Model, ...]:
    """Starting values from the equation of "load" or "motor", which holds whatever acts on the other side; may be
    empty. Other arguments as in [`starting_models`][]."""
    found = (_estimates(model, stretches, blind=blind, equations=(side,)) for blind in (False, True))
    return _distinct(model, list(itertools.chain(*found)))


def start_beside_torques(
    side: str, model: TwoInertiaModel, stretches: Sequence[Stretch]
) -> tuple[Model, Float[np.ndarray, " torques"]] | None:
    """Starting values from one side's equation with gravity and friction on that side, and the strengths of these
    torques, see [`shaft_torques`][]; None where they do not explain most of what the equation alone leaves.

    Arguments as in [`starts_of_equation`][].
    """
    # Test functions that are insensitive to a constant torque do not determine the cosine of a small angle.
    solved = {width: _solved(model, stretches, width, side, blind=False, beside=True) for width in WIDTHS}
    told = {width: found for width, found in solved.items() if found is not None}
    usable = {width: _values(model, found[0], stretches, side) for width, found in told.items()}
    width = min((w for w, values in usable.items() if values is not None), key=lambda w: told[w][1], default=None)
    alone = None if width is None else _solved(model, stretches, width, side, blind=False)
    if width is None or alone is None or told[width][1] >= MOST_LEFT * alone[1]:
        return None
    return model.replace(usable[width] or {}), told[width][0][3:]


def shaft_torques(angle: Float[np.ndarray, " samples"], step: float) -> Float[np.ndarray, "samples torques"]:
    """Unit torques that may act on a shaft as it moves: gravity or one ripple a turn, Coulomb and viscous friction.

    Args:
        angle: of the shaft at each sample [rad].
        step: time between samples [s].
    """
    rate = np.gradient(angle, step)
    return np.stack([np.sin(angle), np.cos(angle), np.sign(rate), rate], axis=1)


def with_starting_inertias(model: TwoInertiaModel, stretches: Sequence[Stretch]) -> Model:
    """The model with starting values of the unknown inertias.

    The balance of both sides' momenta, in which the mesh torque cancels, is

        N J_m theta_m'' + J_l theta_l'' = N k_T T_m + T_l,

    without friction. The motor's friction may be large: it is estimated together with the inertias.

    Raises:
        DataError: no positive inertias follow from the torque.
    """
    wanted = [p.path for p in model.drive.priors if np.isinf(p.tolerance) and p.path in ("J_m", "J_l")]
    if not wanted:
        return model
    found = [_momentum(model, stretches, width, wanted) for width in WIDTHS]
    usable = [(missed, values) for missed, values in filter(None, found) if min(values) > 0]
    if not usable:
        names = ", ".join(s.name for s in stretches)
        raise DataError(
            f"{names}: {' and '.join(wanted)} do not follow from the torque; check the signs and units of "
            "motor_torque, motor_angle and load_angle in the drive file, or state the inertias"
        )
    _, values = min(usable)
    return model.replace(dict(zip(wanted, values, strict=True)))


def _momentum(
    model: TwoInertiaModel, stretches: Sequence[Stretch], width: int, wanted: Sequence[str]
) -> tuple[float, tuple[float, ...]] | None:
    """The unexplained share of the torque's mean square, and the estimated inertias; None for too few data."""
    drive, parts = model.drive, []
    for stretch in stretches:
        if len(stretch) < 3 * width:
            continue
        experiment, part = stretch.experiment, slice(stretch.start, stretch.stop)
        tests, slopes, curvatures = bump_functions(width, experiment.time_step)
        output = experiment.measured[part, 0] - experiment.measured[stretch.start, 0]
        load = output - experiment.measured[part, -1]
        N, u = float(drive.N), np.asarray(experiment.torque.coefficients)[part, 0] * float(drive.k_T)
        T_l = 0.0 if experiment.load_torque is None else np.asarray(experiment.load_torque.coefficients)[part, 0]
        direction = np.sign(np.gradient(output))
        hop, dt = max(1, width // 4), experiment.time_step

        def against(signal: np.ndarray, functions: np.ndarray, hop: int = hop, dt: float = dt) -> np.ndarray:
            return weak_form.against(signal, functions, hop) * dt

        momenta = {"J_m": N**2 * against(output, curvatures), "J_l": against(load, curvatures)}
        friction = -against(output, slopes), against(direction, tests)
        right = against(N * u + T_l, tests) - sum(
            (
                float(drive_value) * momenta[p]
                for p, drive_value in (("J_m", drive.J_m), ("J_l", drive.J_l))
                if p not in wanted
            ),
            np.zeros(1),
        )
        parts.append((np.stack([*(momenta[p] for p in wanted), *friction], axis=1), right))
    if not parts:
        return None
    matrix, right = (np.concatenate(column) for column in zip(*parts, strict=True))
    solution = solved(matrix, right)
    missed = float(np.sum((right - matrix @ solution) ** 2) / np.sum(right**2))
    return missed, tuple(map(float, solution[: len(wanted)]))


def _estimates(
    model: Model, stretches: Sequence[Stretch], *, blind: bool, equations: tuple[str, ...] | None = None
) -> list[dict[str, float]]:
    forms = itertools.product(WIDTHS, _equations(model) if equations is None else equations)
    estimates = (_weak_form(model, stretches, width, equation, blind=blind) for width, equation in forms)
    return [estimate for estimate in estimates if estimate is not None]


def _distinct(model: Model, estimates: Sequence[dict[str, float]]) -> tuple[Model, ...]:
    found: list[Model] = []
    for values in estimates:
        stiffness = values["omega_0"] ** 2 if "omega_0" in values else values["K"]
        if all(_apart(stiffness, float(other.drive.stiffness)) > _DISTINCT for other in found):
            found.append(model.replace(values))
    return tuple(found)


def apart(model: Model, other: Model) -> float:
    """Difference of two models' log stiffness."""
    return _apart(float(model.drive.stiffness), float(other.drive.stiffness))


def _apart(stiffness: float, other: float) -> float:
    return float(abs(np.log(stiffness / other)))


def _equations(model: Model) -> tuple[str, ...]:
    """The weak-form equations. The load's equation does not contain the motor torque, so that torque errors do not
    affect it."""
    return ("error", "load") if isinstance(model, TwoInertiaModel) else ("error",)


def _weak_form(
    model: Model, stretches: Sequence[Stretch], width: int, equation: str, *, blind: bool = False
) -> dict[str, float] | None:
    """Starting values of the base parameters; None where the stiffness is not positive."""
    found = _solved(model, stretches, width, equation, blind=blind)
    return None if found is None else _values(model, found[0], stretches, equation)


def _solved(
    model: Model, stretches: Sequence[Stretch], width: int, equation: str, *, blind: bool, beside: bool = False
) -> tuple[np.ndarray, float] | None:
    """Solution of a weak form, and the share of the right-hand side's rms value that it leaves; None for too few data.
    Other arguments as in [`_rows`][]."""
    parts = [
        _rows(model, stretch, width, equation, blind=blind, beside=beside)
        for stretch in stretches
        if len(stretch) >= 3 * width
    ]
    if not parts:
        return None
    a, b = (np.concatenate(column) for column in zip(*parts, strict=True))
    solution = solved(a, b)
    return solution, float(np.linalg.norm(b - a @ solution) / max(np.linalg.norm(b), 1e-300))


def _values(model: Model, solution: np.ndarray, stretches: Sequence[Stretch], equation: str) -> dict[str, float] | None:
    stiffness, cubic, damping = solution[:3]
    if not np.isfinite(solution).all() or stiffness <= 0:
        return None
    x_max = max(float(np.max(np.abs(s.experiment.measured[s.start : s.stop, -1]))) for s in stretches)
    # Beyond this the restoring torque would not be monotonic within the data.
    alpha = float(np.clip(cubic / stiffness, -0.2 / x_max**2, 3.0 / x_max**2))
    if isinstance(model, ReducedModel):
        omega_0 = np.sqrt(stiffness)
        mu = max(damping, 1e-3 * omega_0)
        return {"omega_0": omega_0, "alpha": alpha, "mu": mu, "gain": solution[3]}
    drive = model.drive
    assert isinstance(drive, Drive)
    inertia = float(drive.c) if equation == "error" else 1.0
    K = stiffness / inertia
    least = 2e-3 * np.sqrt(K / float(drive.c))
    return {"K": K, "alpha": alpha, "B_sp": max(damping / inertia, least)}


def _rows(
    model: Model, stretch: Stretch, width: int, equation: str, *, blind: bool, beside: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """Weak-form regressors (stiffness, cubic, damping, and gain of a reduced drive) and right-hand side.

    Args:
        model: supplies the inertias.
        stretch: the data.
        width: samples in the support of a test function.
        equation: of the dynamic "error", of the "load" or of the "motor".
        blind: whether the test functions are insensitive to a constant torque.
        beside: whether further regressors are [`shaft_torques`][] on the side of the equation.
    """
    experiment = stretch.experiment
    part = slice(stretch.start, stretch.stop)
    dt = experiment.time_step
    x = experiment.measured[part, -1]
    u = np.asarray(experiment.torque.coefficients)[part, 0]
    load = experiment.load_torque
    T_l = np.zeros_like(u) if load is None else np.asarray(load.coefficients)[part, 0]
    tests, slopes, curvatures = blind_functions(width, dt) if blind else bump_functions(width, dt)
    hop = max(1, width // 4)

    def against(signal: np.ndarray, functions: np.ndarray) -> np.ndarray:
        return weak_form.against(signal, functions, hop) * dt

    spring, cubic, damper = against(x, tests), against(x**3, tests), -against(x, slopes)
    if equation != "error":
        drive = model.drive
        assert isinstance(drive, Drive)
        turn = experiment.measured[part, 0]
        N, angle = float(drive.N), turn - x if equation == "load" else turn
        momentum = against(angle - angle[0], curvatures)
        if equation == "load":
            right = float(drive.J_l) * momentum - against(T_l, tests)
        else:
            right = N * float(drive.k_T) * against(u, tests) - N**2 * float(drive.J_m) * momentum
        columns = [spring, cubic, damper]
        if beside:
            shaft, sign = (angle, -1.0) if equation == "load" else (N * angle, N * float(drive.k_T))
            columns += [-sign * against(torque, tests) for torque in shaft_torques(shaft, dt).T]
        return np.stack(columns, axis=1), right
    right = -against(x, curvatures)
    if isinstance(model.drive, Drive):
        forcing = u * float(model.drive.k_T) / (float(model.drive.N) * float(model.drive.J_m)) - T_l / float(
            model.drive.J_l
        )
        return np.stack([spring, cubic, damper], axis=1), right + against(forcing, tests)
    return np.stack([spring, cubic, damper, -against(u, tests)], axis=1), right
