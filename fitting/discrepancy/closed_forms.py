"""Closed forms that resemble a learned function: sign of a rate, dead zone, orders of an angle, powers."""

import itertools
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from fitting.discrepancy.curve import LearnedCurve
from fitting.discrepancy.learn import without
from hdjax.effects.learned_axes import ANGLES, DRIFTS

Kind = Literal["constant", "linear", "even", "odd", "magnitude", "knee", "sign", "stribeck", "order"]

# Share of a curve's mean square that an expression must explain to describe it.
_STANDS_FOR = 0.99
_TOLD = 4
_IN_PAIRS = 14
# Knees, dead zones and Stribeck rates, as shares of the largest value.
_FRACTIONS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8)

# Family of the catalogue for a closed form at a place.
_FAMILIES: dict[tuple[str, str, Kind], str] = {
    ("mesh", "x", "even"): "stiffness_shape",
    ("mesh", "x", "odd"): "stiffness_shape",
    ("mesh", "x", "magnitude"): "stiffness_shape",
    ("mesh", "v", "sign"): "coulomb_friction",
    ("mesh", "v", "stribeck"): "coulomb_friction",
    ("mesh", "v", "odd"): "nonlinear_damping",
    ("mesh", "theta_m", "order"): "kinematic_error",
    ("mesh angle", "theta_m", "order"): "kinematic_error",
    ("motor encoder", "theta_m", "order"): "encoder_eccentricity",
    ("load encoder", "theta_l", "order"): "encoder_eccentricity",
    ("motor", "theta_m", "order"): "cogging",
    ("motor", "omega_m", "sign"): "motor_friction",
    ("motor", "omega_m", "linear"): "motor_friction",
    ("motor", "omega_m", "stribeck"): "motor_friction",
    ("motor", "T_m", "linear"): "torque_sensor",
    ("load", "omega_l", "sign"): "load_friction",
    ("load", "omega_l", "linear"): "load_friction",
    ("load", "omega_l", "stribeck"): "load_friction",
    ("load", "theta_l", "order"): "gravity_load",
    ("load", "time", "order"): "load_disturbance",
    ("motor", "", "constant"): "torque_sensor",
}
# A knee at less than this share of the largest twist is a dead zone rather than a change of slope.
_DEAD_ZONE = 0.2


@dataclass(frozen=True)
class Shape:
    """A closed form compared with a learned function.

    Attributes:
        expression: the form with its coefficients, all in SI units.
        explained: share of the learned function's mean square over the data that it accounts for.
        families: families of the catalogue with this form.
    """

    expression: str
    explained: float
    families: tuple[str, ...]


@dataclass(frozen=True)
class Shapes:
    """Closed forms that resemble a learned function.

    Attributes:
        closest: single closed forms, best first.
        symbolic: the shortest expression of one or two of them that explains more than 99 %, or None.
    """

    closest: tuple[Shape, ...]
    symbolic: Shape | None


@dataclass(frozen=True)
class _Form:
    """A closed form; several labels are the two phases of an order."""

    labels: tuple[str, ...]
    columns: Float[np.ndarray, "instants labels"]
    family: str | None


def shapes(curve: LearnedCurve) -> Shapes:
    """Project a learned function on closed forms, beside the influence of the drive's parameters."""
    target = without(curve.value, curve.known)
    forms = [f for f in _forms(curve) if _is_own(f, curve)]
    single = sorted((_fitted(curve, target, (f,))[0], i) for i, f in enumerate(forms))[::-1]
    ranked = [forms[i] for _, i in single]
    closest = tuple(_shape(curve, target, (f,)) for f in _distinct(ranked)[:_TOLD])
    if closest and closest[0].explained > _STANDS_FOR:
        return Shapes(closest, closest[0])
    pairs = itertools.combinations(ranked[:_IN_PAIRS], 2)
    both = max(pairs, key=lambda p: _fitted(curve, target, p)[0], default=None)
    best = None if both is None else _shape(curve, target, both)
    return Shapes(closest, best if best is not None and best.explained > _STANDS_FOR else None)


def _distinct(ranked: list[_Form]) -> list[_Form]:
    """The best of the forms that differ only in the position of their knee."""
    heads = {_without_place(f): f for f in reversed(ranked)}
    return [f for f in ranked if heads[_without_place(f)] is f]


def _without_place(form: _Form) -> str:
    """The label of a form without the position of its knee."""
    return re.sub(r"[±/][^) ]+", "", form.labels[0])


def _forms(curve: LearnedCurve) -> Iterator[_Form]:
    count = len(curve.value)
    yield _Form(("1",), np.ones((count, 1)), _FAMILIES.get((curve.place, "", "constant")))
    if curve.period is not None:
        yield from _waves(curve.place, curve.at[:, 0], 2 * np.pi / curve.period)
        return
    parts = [list(_of_one(curve.place, n, curve.at[:, i])) for i, n in enumerate(curve.variables)]
    for forms in parts:
        yield from forms
    if len(parts) == 2:
        for one, other in itertools.product(*parts):
            labels = tuple(f"{a} {b}" for a in one.labels for b in other.labels)
            columns = (one.columns[:, :, None] * other.columns[:, None, :]).reshape(count, -1)
            yield _Form(labels, columns, _family_of_product(curve, one, other))


def _waves(place: str, time: np.ndarray, omega: float) -> Iterator[_Form]:
    """The multiples of a frequency."""
    for n in (1, 2, 3):
        labels = (f"cos({n * omega:.6g} time)", f"sin({n * omega:.6g} time)")
        columns = np.stack([np.cos(n * omega * time), np.sin(n * omega * time)], axis=1)
        yield _Form(labels, columns, _FAMILIES.get((place, "time", "order")))


def _of_one(place: str, variable: str, values: np.ndarray) -> Iterator[_Form]:
    """Closed forms of one variable, each of order one over the data."""
    size = float(np.max(np.abs(values))) or 1.0

    def form(kind: Kind, labels: tuple[str, ...], *columns: np.ndarray, family: str | None = None) -> _Form:
        return _Form(labels, np.stack(columns, axis=1), family or _FAMILIES.get((place, variable, kind)))

    if variable in ANGLES:
        for n in range(1, ANGLES[variable] + 1):
            times = "" if n == 1 else f"{n} "
            labels = (f"cos({times}{variable})", f"sin({times}{variable})")
            yield form("order", labels, np.cos(n * values), np.sin(n * values))
        if variable == "theta_l":
            # A spring from load to ground is not periodic in a revolution.
            yield form("linear", (variable,), values)
            yield form("odd", (f"{variable}^3",), values**3)
        return
    if variable in DRIFTS:
        middle = float(np.mean(values))
        yield form("linear", (f"({variable} - {middle:.4g})",), values - middle)
        yield form("even", (f"({variable} - {middle:.4g})^2",), (values - middle) ** 2)
        return
    yield form("linear", (variable,), values)
    yield form("even", (f"{variable}^2",), values**2)
    yield form("odd", (f"|{variable}| {variable}",), np.abs(values) * values)
    yield form("odd", (f"{variable}^3",), values**3)
    yield form("odd", (f"{variable}^5",), values**5)
    yield form("magnitude", (f"|{variable}|",), np.abs(values))
    for fraction in _FRACTIONS:
        turn = fraction * size
        at = f"{turn:.3g}"
        if variable in ("x", "T_m"):
            family = "backlash" if fraction < _DEAD_ZONE else "stiffness_shape"
            columns = np.clip(values, -turn, turn)
            yield form("knee", (f"clip({variable}, ±{at})",), columns, family=family if place == "mesh" else None)
        else:
            decay = np.exp(-((values / turn) ** 2)) * np.tanh(values / (0.1 * turn))
            yield form("stribeck", (f"exp(-({variable}/{at})^2) sgn({variable})",), decay)
    for fraction in (0.002, 0.005, 0.01, 0.03):
        yield form("sign", (f"sgn({variable})",), np.tanh(values / (fraction * size)))


def _family_of_product(curve: LearnedCurve, one: _Form, other: _Form) -> str | None:
    """Family of a product in the catalogue."""
    if "temperature" in curve.variables:
        return "temperature"
    if curve.place == "load" or not set(curve.variables) & set(ANGLES):
        return "nonlinear_damping" if curve.place == "mesh" and set(curve.variables) == {"x", "v"} else None
    names = {one.labels[0], other.labels[0]}
    if any(n.startswith("sgn") for n in names):
        return "position_dependent_friction"
    return "position_dependent_stiffness" if "x" in names and curve.place == "mesh" else None


def _is_own(form: _Form, curve: LearnedCurve) -> bool:
    """Whether a form is independent of the drive's parameters."""
    left = without(form.columns, curve.known)
    return bool(np.all(np.mean(left**2, axis=0) > 1e-6 * np.mean(form.columns**2, axis=0)))


def _fitted(curve: LearnedCurve, target: np.ndarray, forms: tuple[_Form, ...]) -> tuple[float, np.ndarray]:
    """Share of a curve's mean square that forms explain, and their coefficients, by least squares."""
    columns = without(np.concatenate([f.columns for f in forms], axis=1), curve.known)
    scale = np.sqrt(np.mean(columns**2, axis=0))
    found = np.linalg.lstsq(columns / scale, target, rcond=1e-8)[0] / scale
    left = target - columns @ found
    return 1.0 - float(left @ left) / max(float(target @ target), 1e-300), found


def _shape(curve: LearnedCurve, target: np.ndarray, forms: tuple[_Form, ...]) -> Shape:
    explained, coefficients = _fitted(curve, target, forms)
    labels = [label for f in forms for label in f.labels]
    terms = [f"{c:+.3g} {n}".removesuffix(" 1") for c, n in zip(coefficients, labels, strict=True)]
    families = tuple(dict.fromkeys(f.family for f in forms if f.family is not None))
    return Shape(" ".join(terms).removeprefix("+"), explained, families)
