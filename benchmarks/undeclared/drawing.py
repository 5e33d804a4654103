"""Cases: a drive, its encoders, three experiments and what is hidden, all from a seed and the case's name."""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from undeclared.detection import detectability
from undeclared.equations import integrate
from undeclared.excitation import STANDING, TURNING, Excitation, excitation
from undeclared.hidden import FAMILIES, Form, forms_of
from undeclared.mechanism import Mechanism, log_torque, read_encoders
from undeclared.noise import Encoders, draw_encoders

LEAST = 2.0
"""Least strength of a hidden effect, in units of its detection limit."""

FAINT = 20.0
"""A faint effect is drawn between LEAST and this."""

LOGS = ("train_1", "train_2", "heldout")
# Longest solver step [s]: the dry friction is resolved to a few percent of the noise, as the tests check.
FINEST = 5e-6
_ATTEMPTS = 12
_FAINT_SHARE = 0.25
# A log whose twist stays this far below what was meant is one of a drive that is stuck.
_STUCK = 0.3
# What depends on an angle needs a motor that turns; whoever looks for it would turn it.
_OF_ANGLE = {
    "kinematic_error",
    "cogging",
    "encoder_eccentricity",
    "gravity_load",
    "position_dependent_friction",
    "position_dependent_stiffness",
}
# How much later than the first one a log begins [s], on the clock of what goes on between them.
_LATER = (20.0, 600.0)
# Sampling rate [Hz] and samples of the three logs.
_SIZES = ((1000.0, (10000, 10000, 8000)), (2000.0, (16000, 12000, 12000)), (4000.0, (20000, 16000, 16000)))


@dataclass(frozen=True)
class Case:
    """What to draw.

    Attributes:
        name: of the case; with the seed it fixes everything.
        forms: what is hidden; nothing in a clean case.
        seed: of the study.
        faint: whether what is hidden is drawn near its detection limit instead of from its usual range.
        coloured: whether the noise is; where None, by chance.
        remembering: whether all of the noise has a memory instead.
        noisy_torque: whether the torque was logged with noise of 1 to 5 % of its rms.
    """

    name: str
    forms: tuple[Form, ...]
    seed: int
    faint: bool = False
    coloured: bool | None = None
    remembering: bool = False
    noisy_torque: bool = False


class NoExperimentError(RuntimeError):
    """No experiment shows what is to be hidden at a plausible strength."""


@dataclass(frozen=True)
class Run:
    """One experiment as it went.

    Attributes:
        mechanism: the drive as it was.
        excitation: what was commanded.
        states: true ones, (samples, states).
        readings: of noiseless encoders, (samples, 2).
        torque: motor torque, as logged.
        warm: kelvin above the reference.
    """

    mechanism: Mechanism
    excitation: Excitation
    states: np.ndarray
    readings: np.ndarray
    torque: np.ndarray
    warm: np.ndarray


@dataclass(frozen=True)
class Drawn:
    """A case that was drawn and run.

    Attributes:
        case: what was asked for.
        base: the drive without what is hidden.
        changes: the hidden parameters, by field.
        strengths: of the forms, in their own units.
        detectable: strength of each in units of its detection limit.
        encoders: their noise.
        runs: the three experiments.
        dt: sampling interval [s].
    """

    case: Case
    base: Mechanism
    changes: dict
    strengths: tuple[float, ...]
    detectable: tuple[float, ...]
    encoders: Encoders
    runs: tuple[Run, ...]
    dt: float


def single_cases(count: int, seed: int, families: Sequence[str]) -> list[Case]:
    """Cases with one effect each: the families in turn, and the forms of each in turn; a quarter of them faint."""
    cases = []
    for i in range(count):
        family, turn = families[i % len(families)], i // len(families)
        forms = forms_of(family)
        faint = bool(stream(seed, f"{family}-{turn}/faint").uniform() < _FAINT_SHARE)
        cases.append(Case(f"{family}-{turn}", (forms[turn % len(forms)],), seed, faint))
    return cases


def clean_cases(count: int, seed: int) -> list[Case]:
    """Cases with nothing hidden; the noise is white in even ones and coloured in odd ones."""
    names = ("white", "coloured")
    return [Case(f"clean_{names[i % 2]}-{i // 2}", (), seed, coloured=bool(i % 2)) for i in range(count)]


def pair_cases(count: int, seed: int) -> list[Case]:
    """Cases with two effects of different families."""
    families = [family for family in FAMILIES if family != "unknown"]
    return [Case(f"pair-{i}", _pair(stream(seed, f"pair-{i}"), families), seed) for i in range(count)]


def with_remembering_noise(case: Case) -> Case:
    """A case of the same kind whose noise has a memory altogether: another drive, since its name is another."""
    return replace(case, name=f"{case.name}-remembering", remembering=True)


def with_noisy_torque(case: Case) -> Case:
    """A case of the same kind whose torque was logged with noise."""
    return replace(case, name=f"{case.name}-noisy_torque", noisy_torque=True)


def _pair(random: np.random.Generator, families: Sequence[str]) -> tuple[Form, ...]:
    """Two forms that change different parameters of the mechanism: a second motor friction would replace the first."""
    while True:
        chosen = [forms_of(families[i]) for i in random.choice(len(families), size=2, replace=False)]
        # Not with what goes on between logs: the cases of earlier studies would be others.
        once = [[form for form in forms if not form.goes_on] for forms in chosen]
        pair = tuple(forms[random.integers(len(forms))] for forms in once)
        first, second = (set(form.changes(form.high, random, Mechanism())) for form in pair)
        if not first & second:
            return pair


def draw(case: Case) -> Drawn:
    """Draw and run a case until each of its effects is at least LEAST detection limits strong.

    Raises:
        NoExperimentError: where no experiment shows the effect at a plausible strength.
    """
    for attempt in range(_ATTEMPTS):
        drawn = _attempt(case, stream(case.seed, case.name, attempt))
        if drawn is not None:
            return drawn
    raise NoExperimentError(f"{case.name}: no experiment of {_ATTEMPTS} shows {[f.name for f in case.forms]}")


def stream(seed: int, name: str, attempt: int = 0) -> np.random.Generator:
    """Random numbers of one purpose of a study."""
    return np.random.default_rng([seed, zlib.crc32(name.encode()), attempt])


def substeps_of(dt: float) -> int:
    """Solver steps in a sampling interval [s]."""
    return int(np.ceil(dt / FINEST))


def _attempt(case: Case, random: np.random.Generator) -> Drawn | None:
    dt, counts = _size(random)
    base = _base(random, dt)
    if any(form.straight for form in case.forms):
        base = base._replace(k3=0.0)
    by_chance = bool(random.uniform() < 0.3)
    colour = by_chance if case.coloured is None else case.coloured
    encoders = draw_encoders(random, colour=colour, remembering=case.remembering)
    heats = any(form.heats for form in case.forms) or random.uniform() < 0.15
    turning = TURNING[:2] if any(form.family in _OF_ANGLE for form in case.forms) else TURNING
    bench = _Bench(base, encoders, dt, substeps_of(dt), _excitations(random, base, counts, dt, turning), heats)
    warm = bench.temperatures(random)
    changes, strengths, detectable = {}, [], []
    for form in case.forms:
        shape = int(random.integers(2**31))
        aim = _between(random, LEAST, FAINT) if case.faint else None
        strength, alone, seen = _strength(form, shape, _between(random, form.low, form.high), aim, bench, warm)
        # Whatever leaves the numbers is no experiment.
        if not LEAST <= seen < np.inf:
            return None
        changes |= alone
        strengths.append(strength)
        detectable.append(seen)
    begun = np.zeros(len(LOGS))
    if any(form.goes_on for form in case.forms):
        begun[1:] = random.uniform(*_LATER, size=begun.size - 1)
    runs = tuple(bench.run(base._replace(**changes, begun=late), i, warm) for i, late in enumerate(begun))
    if not all(_plausible(run, base) for run in runs):
        return None
    return Drawn(case, base, changes, tuple(strengths), tuple(detectable), encoders, runs, dt)


def _strength(
    form: Form, shape: int, strength: float, aim: float | None, bench: "_Bench", warm: Sequence[np.ndarray]
) -> tuple[float, dict, float]:
    """A strength that can be found, the changes that it makes, and how detectable they are.

    It is the one drawn, or more where that is too little, or the one that is as faint as aimed at.
    """
    for _ in range(_ATTEMPTS):
        alone = form.changes(strength, np.random.default_rng(shape), bench.base)
        seen = bench.detectability(alone, warm)
        if not np.isfinite(seen):
            break
        if aim is not None and form.low < form.high and not 0.7 < seen / aim < 1.4:
            # Most effects leave a trace in proportion to their strength; those that do not are met after a few rounds.
            strength = min(strength * np.clip(aim / max(seen, 1e-3), 1e-4, 1e2), form.high)
            continue
        if aim is not None or seen >= LEAST or strength >= form.high:
            break
        strength = min(1.5 * strength, form.high)
    return strength, alone, seen


@dataclass(frozen=True)
class _Bench:
    """The bench on which drives of one case run."""

    base: Mechanism
    encoders: Encoders
    dt: float
    substeps: int
    excitations: tuple[Excitation, ...]
    heats: bool

    def run(self, mechanism: Mechanism, index: int, warm: Sequence[np.ndarray]) -> Run:
        """One of the experiments on one mechanism."""
        commanded = self.excitations[index]
        angle, rate = commanded.start
        states, torque = integrate(
            mechanism,
            np.array([angle, rate, angle / mechanism.ratio, rate / mechanism.ratio]),
            commanded.shaking,
            dt=self.dt,
            substeps=self.substeps,
            follow=commanded.follow,
            pull=commanded.pull,
            brake=commanded.brake,
            warm=warm[index],
        )
        readings = np.column_stack(read_encoders(mechanism, states))
        return Run(mechanism, commanded, states, readings, log_torque(mechanism, torque, self.dt), warm[index])

    def detectability(self, changes: dict, warm: Sequence[np.ndarray]) -> float:
        """Of changes alone, in the two logs that the loop is given."""
        runs = [self.run(self.base._replace(**changes), i, warm) for i in range(2)]
        if not all(np.isfinite(run.states).all() for run in runs):
            return np.inf
        logs = [(run.states, run.readings, run.torque, run.excitation.brake) for run in runs]
        return detectability(self.base, logs, encoders=self.encoders, dt=self.dt)

    def temperatures(self, random: np.random.Generator) -> list[np.ndarray]:
        """Kelvin above the reference in each log: a start and an exponential drift; zero where nothing heats."""
        found = []
        for commanded in self.excitations:
            share = np.linspace(0, 1, commanded.shaking.size)
            start, drift, pace = random.uniform(-5, 15), random.uniform(-8, 12), random.uniform(0.2, 1.0)
            found.append(self.heats * (start + drift * (1 - np.exp(-share / pace))))
        return found


def _size(random: np.random.Generator) -> tuple[float, tuple[int, ...]]:
    rate, counts = _SIZES[random.choice(len(_SIZES), p=[0.25, 0.5, 0.25])]
    return 1 / rate, counts


def _base(random: np.random.Generator, dt: float) -> Mechanism:
    """A drive: stiffness of sizes 14 to 25, a natural frequency that the sampling resolves, light damping."""

    k1, ratio = _between(random, 4e3, 2.2e4), float(random.choice([50, 50, 80, 100, 120]))
    omega_0 = 2 * np.pi * _between(random, 35.0, min(80.0, 1 / (14 * dt)))
    share, zeta = _between(random, 4.0, 30.0), _between(random, 0.005, 0.03)
    load_inertia = (1 + share) / share * k1 / omega_0**2
    return Mechanism(
        ratio=ratio,
        motor_inertia=share * load_inertia / ratio**2,
        load_inertia=load_inertia,
        k1=k1,
        k3=k1 * _between(random, 1e3, 1.5e4),
        c1=2 * zeta * k1 / omega_0,
    )


def _excitations(
    random: np.random.Generator, base: Mechanism, counts: Sequence[int], dt: float, turning: Sequence[str]
) -> tuple[Excitation, ...]:
    """A log at about one angle, one in which the motor turns or the load is braked, and one of either kind."""
    kinds = [str(random.choice(STANDING)), str(random.choice(turning))]
    kinds.append(str(random.choice(kinds)))
    found = []
    for kind, count in zip(kinds, counts, strict=True):
        twist = _between(random, 3e-4, 1e-3)
        found.append(excitation(kind, random, base, twist=twist, count=count, dt=dt))
    return tuple(found)


def _plausible(run: Run, base: Mechanism) -> bool:
    """Whether the drive stayed in one piece (finite, with less than ten milliradians of twist) and was not stuck."""
    twist = run.states[:, 0] / base.ratio - run.states[:, 2]
    if not (np.isfinite(run.states).all() and np.abs(twist).max() < 1e-2):
        return False
    return bool(np.std(twist) > _STUCK * run.excitation.twist)


def _between(random: np.random.Generator, low: float, high: float) -> float:
    """Log-uniform."""
    return float(np.exp(random.uniform(np.log(low), np.log(high))))
