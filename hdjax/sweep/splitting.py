"""Forced motion by splitting: exact flow of the linear drive, kicks by the nonlinear spring.

`x'' + mu x' + omega_0^2 x = F(t)` under a harmonic F has a closed form; the nonlinear spring torque depends on the
twist alone and changes only the rate. Alternating the two costs a rotation and a power of x for each kick, and the
error is proportional to alpha x^2: a weakly nonlinear drive takes steps of more than a radian, where Runge-Kutta steps
resolve the oscillation itself (McLachlan 1995; Blanes, Casas, Farres, Laskar, Makazaga and Murua 2013).
"""

import itertools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from hdjax.dynamics import Model
from hdjax.forcing import Harmonic
from hdjax.sweep.twist_equation import SPRINGS, TwistEquation, twist_equation
from hdjax.sweep.windows import Windows, largest_between
from hdjax.where import where

# Of the linear drive from its resonance, as a part of omega_0^2: its forced motion is at most 1,000 times as large as
# the twist that the torque would hold, and so are rounding errors.
_LEAST_DETUNING = 1e-3
_LEAST_RATE = 1e-3


class Splitting(NamedTuple):
    """A symmetric sequence: exact motion for `flows[0] h`, kick of `kicks[0] h`, motion for `flows[1] h`, and so on."""

    name: str
    flows: tuple[float, ...]
    kicks: tuple[float, ...]


STRANG = Splitting("Strang splitting", (0.5, 0.5), (1.0,))
_A = (0.0711334264982231177779387300061549964174, 0.241153427956640098736487795326289649618)
_A += (0.521411761772814789212136078067994229991, -0.333698616227678005726562603400438876027)
_B = (0.183083687472197221961703757166430291072, 0.310782859898574869507522291054262796375)
_B += (-0.0265646185119588006972121379164987592663, 0.0653961422823734184559721793911134363710)
ABA864 = Splitting("splitting ABA(8,6,4)", _A + _A[::-1], _B + _B[2::-1])
"""Blanes et al. 2013, table 3: error of order alpha x^2 h^8, (alpha x^2)^2 h^6 and (alpha x^2)^3 h^4."""
_C = (0.0378593198406116, 0.102635633102435, -0.0258678882665587, 0.314241403071447, -0.130144459517415)
_C += (0.106417700369543, -0.00879424312851058)
_D = (0.09171915262446165, 0.183983170005006, -0.05653436583288827, 0.004914688774712854, 0.143761127168358)
_D += (0.328567693746804,)
_D += (0.5 - sum(_D),)
SRKN14 = Splitting("splitting SRKN14 of order 6", (*_C, 1.0 - 2.0 * sum(_C), *_C[::-1]), _D + _D[::-1])
"""Blanes and Moan 2002, table 3: for strong nonlinearity and motions that magnify errors."""


def splits(model: Model, forcing: object) -> bool:
    """Whether a model under a forcing can be split."""
    return isinstance(forcing, Harmonic) and all(type(e) in SPRINGS for e in model.effects)


class _Flow(NamedTuple):
    """Exact free motion over a time, of `p = (v + mu y / 2) / rate` and `q = y`."""

    keep: Array
    to_p: Array
    to_q: Array

    def __call__(self, p: Array, q: Array) -> tuple[Array, Array]:
        return self.keep * p - self.to_p * q, self.keep * q + self.to_q * p


def march_split(
    model: Model,
    forcing: Harmonic,
    state: Float[Array, "2"],
    duration: Float[Array, ""],
    *,
    method: Splitting,
    windows: int,
    substeps: Int[Array, ""],
    peaks: bool,
) -> Windows:
    """March one drive from a twist and its rate; a lane of a vmapped program.

    Args:
        model: see [`splits`][].
        forcing: motor torque, or a reduced drive's forcing.
        state: x and x' at t = 0.
        duration: of the motion [s].
        method: the sequence of a step.
        windows: number of equal parts of the duration.
        substeps: steps of each window; data, so that one compiled program serves any number.
        peaks: whether to compute the largest |x| of each window.
    """
    equation = twist_equation(model)
    mu, square = equation.drive.mu, equation.drive.omega_0**2
    width = duration / windows
    h = width / substeps.astype(width.dtype)
    # At an undamped resonance there is no steady motion; a stiffer drive is used, and the kicks compensate.
    resonant = jnp.abs(square - forcing.omega**2) + jnp.abs(mu * forcing.omega) < _LEAST_DETUNING * square
    excess = where(resonant, 2.0 * _LEAST_DETUNING * square, 0.0)
    motion = _ForcedMotion(equation, forcing, square + excess)
    discriminant = square + excess - 0.25 * mu * mu
    # Any positive number: it makes the free motion of an oscillating drive a rotation.
    rate = jnp.sqrt(jnp.maximum(jnp.abs(discriminant), _LEAST_RATE**2 * square))

    def flow(part: float) -> _Flow:
        return _free_motion(mu, discriminant, rate, part * h)

    first, back, across = flow(method.flows[0]), flow(-method.flows[0]), flow(2.0 * method.flows[0])
    inner = {part: flow(part) for part in set(method.flows[1:-1])}
    flows = [inner[part] for part in method.flows[1:-1]] + [across]
    waves = [motion.wave(node * h) for node in itertools.accumulate(method.flows[:-1])]
    turn = _turn(motion.omega * h)

    def step(y: Array, phase: Array) -> Array:
        p, q = y.real, y.imag
        for kick, (cosine, sine), free in zip(method.kicks, waves, flows, strict=True):
            x = q + (cosine * phase.real - sine * phase.imag) + motion.still
            p, q = free(p + (kick * h / rate) * (excess * x + equation.kick(x)), q)
        return jax.lax.complex(p, q)

    def at(y: Array, phase: Array) -> tuple[Array, Array, Array]:
        """Twist, rate and acceleration between two steps."""
        p, q = back(y.real, y.imag)
        x, v = motion.given(q, rate * p - 0.5 * mu * q, phase)
        push = motion.push * phase
        return x, v, push.real + equation.gain * forcing.offset - mu * v - square * x + equation.kick(x)

    def start(y: Array, phase: Array) -> Array:
        q, v = motion.own(y.real, y.imag, phase)
        return jax.lax.complex(*first((v + 0.5 * mu * q) / rate, q))

    def window(carry: Array, index: Array) -> tuple[Array, tuple[Array, ...]]:
        # Recomputed from the time, so that rounding errors of the rotation do not accumulate.
        begin = _turn(motion.omega * (index * width))

        def advance(_, c):
            y, phase, peak = c
            # Each program fragment has one complex result, so that nothing is computed twice.
            moved, turned = jax.lax.optimization_barrier((step(y, phase), phase * turn))
            if peaks:
                peak = jnp.maximum(peak, largest_between(at(y, phase), at(moved, turned), h))
            return moved, turned, peak

        y, phase, peak = jax.lax.fori_loop(0, substeps, advance, (start(carry, begin), begin, jnp.zeros_like(h)))
        x, v, _ = at(y, phase)
        return jax.lax.complex(x, v), (x, v, peak)

    begin = jax.lax.complex(state[0], state[1])
    _, found = jax.lax.scan(window, begin, jnp.arange(windows, dtype=width.dtype))
    return Windows(*found)


class _ForcedMotion:
    """The steady motion of a linear drive with a squared natural frequency: `still + Re(response exp(i omega t))`."""

    def __init__(self, equation: TwistEquation, forcing: Harmonic, square: Array):
        self.omega = forcing.omega
        size = equation.gain * forcing.amplitude
        self.push = jax.lax.complex(size * jnp.cos(forcing.phase), size * jnp.sin(forcing.phase))
        self.response = self.push / jax.lax.complex(square - self.omega**2, equation.drive.mu * self.omega)
        self.still = equation.gain * forcing.offset / square

    def wave(self, later: Array) -> tuple[Array, Array]:
        """Real and imaginary part of the response, rotated by a time."""
        turned = self.response * _turn(self.omega * later)
        return turned.real, turned.imag

    def own(self, x: Array, v: Array, phase: Array) -> tuple[Array, Array]:
        """The free part of a motion."""
        z = self.response * phase
        return x - z.real - self.still, v + self.omega * z.imag

    def given(self, y: Array, v: Array, phase: Array) -> tuple[Array, Array]:
        """The motion with a given free part."""
        z = self.response * phase
        return y + z.real + self.still, v - self.omega * z.imag


def _turn(angle: Array) -> Array:
    return jax.lax.complex(jnp.cos(angle), jnp.sin(angle))


def _free_motion(mu: Array, discriminant: Array, rate: Array, t: Array) -> _Flow:
    """Oscillating, creeping or between: the same entire functions of the discriminant."""
    root = jnp.sqrt(jnp.abs(discriminant))
    angle = root * t
    small = jnp.abs(angle) < 1e-4
    safe = where(root == 0.0, 1.0, root)
    creeping = where(discriminant < 0.0, angle, 0.0)
    cosine = where(discriminant < 0.0, jnp.cosh(creeping), jnp.cos(angle))
    sine = where(discriminant < 0.0, jnp.sinh(creeping), jnp.sin(angle)) / safe
    sine = where(small, t * (1.0 - discriminant * t * t / 6.0), sine)
    decay = jnp.exp(-0.5 * mu * t)
    return _Flow(decay * cosine, decay * sine * discriminant / rate, decay * sine * rate)
