"""The seed document's Tables 1 to 4 and its figure, recomputed and compared with the printed values."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from scipy.integrate import odeint

from hdjax.drive import ReducedDrive
from hdjax.parameters import as_scalar
from hdjax.presets import TORQUE_AMPLITUDE, hdc_40_050
from hdjax.response.multiple_scales import backbone_slope
from hdjax.response.nearest_motion import largest, nearest_motions
from hdjax.response.seed_data import FIGURE_1, OMEGA_0, TABLE_2, TABLE_3, TABLE_4
from hdjax.response.seed_fit import AmplitudeFit

AGREEMENT = 0.01
"""Relative difference up to which a cell agrees: a digit or more of every printed number."""


@dataclasses.dataclass(frozen=True)
class Cell:
    """A printed number compared with that of the stated model.

    Attributes:
        row: which row.
        column: which column.
        printed: what the seed prints.
        recomputed: from its model; None without one.
        unit: of both.
        note: how it was computed, or why it can't be.
    """

    row: str
    column: str
    printed: float
    recomputed: float | None
    unit: str
    note: str = ""

    @property
    def verdict(self) -> str:
        """Whether the printed number agrees with the stated model."""
        if self.recomputed is None:
            return "does not follow from the stated model"
        if abs(self.printed - self.recomputed) <= AGREEMENT * abs(self.recomputed):
            return "agrees"
        ratio = self.printed / self.recomputed if self.recomputed else np.inf
        if 0.5 < ratio < 2.0:
            return f"differs by {abs(ratio - 1.0):.0%}"
        return f"differs by a factor {ratio if ratio >= 1.0 else 1.0 / ratio:.3g}"


@dataclasses.dataclass(frozen=True)
class Table:
    """A table of the seed, cell by cell."""

    title: str
    cells: tuple[Cell, ...]


def seed_tables() -> tuple[Table, ...]:
    """Recompute everything; takes a second."""
    return _table_1(), _table_2(), _table_3(), _table_4(), _figure_1()


def _forcing_amplitude() -> float:
    """A of the motor torque in Table 1, without load [rad/s^2]."""
    return float(hdc_40_050().error_forcing(as_scalar(TORQUE_AMPLITUDE), as_scalar(0.0)))


def _table_1() -> Table:
    drive = hdc_40_050()
    cells = (
        Cell("natural frequency", "omega_0", OMEGA_0, float(drive.omega_0), "rad/s", "from the printed formula itself"),
        Cell("damping", "mu", FIGURE_1[0], float(drive.mu), "1/s", "c B_sp, against the value beside the figure"),
    )
    return Table("Table 1: what follows from its parameters", cells)


def _table_2() -> Table:
    """The true largest |x| of the stable motion nearest to the printed analytical one, by harmonic balance.

    Two readings: the parameters of Table 1 as they are, and with the printed omega_0 and mu in their place. Either has
    the torque's A. Coexisting motions count, sub-harmonic ones too.
    """
    drive, A = hdc_40_050(), _forcing_amplitude()
    readings = (
        ("Table 1's parameters", ReducedDrive(mu=drive.mu, omega_0=drive.omega_0, alpha=drive.alpha)),
        ("printed omega_0 and mu", ReducedDrive(mu=FIGURE_1[0], omega_0=OMEGA_0, alpha=drive.alpha)),
    )
    omega, printed = np.array([(case.omega, case.analytical) for case in TABLE_2]).T
    motions = [nearest_motions(reading, A, omega, printed) for _, reading in readings]
    sizes = [np.where(found.exists, largest(found.motion), np.nan) for found in motions]
    cells = []
    for i, case in enumerate(TABLE_2):
        row = f"{case.kind}, omega = {case.omega:g}"
        for (name, reading), size in zip(readings, sizes, strict=True):
            size = float(size[i]) if np.isfinite(size[i]) else None
            linear = abs(complex(float(reading.omega_0) ** 2 - case.omega**2, float(reading.mu) * case.omega))
            note = f"{name}; A = {case.analytical * linear:.4g} rad/s^2 would give the printed one"
            cells.append(Cell(row, "analytical amplitude", case.analytical, size, "rad", note))
            cells.append(Cell(row, "numerical amplitude", case.numerical, size, "rad", name))
        error = 100.0 * abs(case.analytical / case.numerical - 1.0)
        cells.append(Cell(row, "relative error", case.error, error, "%", "of the two printed amplitudes"))
    return Table("Table 2: amplitudes", tuple(cells))


def _table_3() -> Table:
    alpha, A = hdc_40_050().alpha, _forcing_amplitude()
    cells = []
    for case in TABLE_3:
        row = f"mu = {case.mu:g}"
        drive = ReducedDrive(mu=case.mu, omega_0=OMEGA_0, alpha=alpha)
        top = A / (case.mu * OMEGA_0)
        cells.append(Cell(row, "peak amplitude", case.peak, top, "rad", "A/(mu omega_0), A of Table 1's torque"))
        width = _half_power_bandwidth(case.mu, OMEGA_0)
        cells.append(Cell(row, "half-power bandwidth", case.bandwidth, width, "rad/s", "of the linear response; is mu"))
        shift = float(backbone_slope(drive)) * case.peak**2
        cells.append(Cell(row, "nonlinear shift", case.shift, shift, "rad/s", "3/8 omega_0 alpha a^2, printed peak"))
        if case is not TABLE_3[0]:
            ratio = TABLE_3[0].peak / case.peak
            cells.append(Cell(row, "first peak over this", ratio, case.mu / TABLE_3[0].mu, "1", "whatever A: 1/mu"))
    return Table("Table 3: damping", tuple(cells))


def _half_power_bandwidth(mu: float, omega_0: float) -> float:
    """Between the frequencies at which the linear response `1/|omega_0^2 - w^2 + i mu w|` is its peak over sqrt(2)."""
    centre, reach = omega_0**2 - 0.5 * mu**2, mu * np.sqrt(omega_0**2 - 0.25 * mu**2)
    return float(np.sqrt(centre + reach) - np.sqrt(centre - reach))


def _table_4() -> Table:
    """Of the named effects the stated model only contains the cubic stiffness."""
    cubic = float(hdc_40_050().alpha) * max(case.numerical for case in TABLE_2) ** 3
    cells = []
    for source in TABLE_4:
        stated = cubic if source.effect == "cubic stiffness" else None
        cells.append(Cell(source.source, "lowest magnitude", source.low, stated, "rad", source.known))
        cells.append(Cell(source.source, "highest magnitude", source.high, stated, "rad", source.known))
    return Table("Table 4: error sources", tuple(cells))


def _figure_1() -> Table:
    mu, omega_0, alpha, x_0 = FIGURE_1
    times = np.linspace(0.0, 4.0 / mu, 16001)

    def rates(state: np.ndarray, _: float) -> tuple[float, float]:
        x, v = state.tolist()
        return v, -mu * v - omega_0**2 * x * (1.0 + alpha * x * x)

    scale = 1e-10 * np.array([x_0, omega_0 * x_0])
    x, v = odeint(rates, (x_0, 0.0), times, rtol=1e-10, atol=1e-3 * scale, mxstep=5000).T
    V = 0.5 * v**2 + omega_0**2 * (0.5 * x**2 + 0.25 * alpha * x**4)
    radius = float(np.hypot(x[-1], v[-1] / omega_0))
    rises = float(np.sum(np.diff(V) > 1e-9 * V[0]))
    decay = float(-np.log(V[-1] / V[0]) / float(times[-1]))
    drive = hdc_40_050()
    cells = (
        Cell(
            "spirals to the origin", "radius at 4/mu over x(0)", float(np.exp(-2.0)), radius / x_0, "1", "exp(-mu t/2)"
        ),
        Cell("V falls throughout", "samples at which it rises", 0.0, rises, "1", "monotone; V' is zero at v = 0"),
        Cell("decay of V", "rate", mu, decay, "1/s", "mean of mu v^2/V is mu"),
        Cell("parameters", "mu", mu, float(drive.mu), "1/s", "Table 1's own"),
        Cell("parameters", "omega_0", omega_0, float(drive.omega_0), "rad/s", "Table 1's own"),
    )
    return Table("Figure 1: phase portrait", cells)


def as_text(tables: Sequence[Table], fit: AmplitudeFit) -> str:
    """The tables and the best fit to Table 2 as plain text."""
    lines = []
    for table in tables:
        lines += [table.title, f"  {'row':38}{'column':26}{'printed':>11}{'recomputed':>12}  {'unit':7}verdict"]
        for c in table.cells:
            recomputed = "-" if c.recomputed is None else f"{c.recomputed:.4g}"
            lines.append(
                f"  {c.row:38}{c.column:26}{c.printed:11.4g}{recomputed:>12}  {c.unit:7}{c.verdict} ({c.note})"
            )
        lines.append("")
    lines += [
        "Best fit of (A, omega_0, mu, alpha) to Table 2, any stable motion at each frequency allowed:",
        f"  A = {fit.A:.4g} rad/s^2, omega_0 = {fit.omega_0:.4g} rad/s, mu = {fit.mu:.4g} 1/s, "
        f"alpha = {fit.alpha:.4g} rad^-2",
    ]
    for omega, given, fitted, slow in zip(fit.omega, fit.given, fit.fitted, fit.subharmonic, strict=True):
        lines.append(
            f"  omega = {omega:6g}: printed {given:.3g}, nearest {fitted:.3g} rad, ratio {fitted / given:.2f}"
            + (", a sub-harmonic motion" if slow else "")
        )
    lines.append(
        f"  Misfit {fit.rms:.0%} rms, a factor {fit.worst:.2f} at worst: "
        + ("no parameters of the stated model give Table 2." if fit.worst > 1.1 else "the table is consistent.")
    )
    return "\n".join(lines)
