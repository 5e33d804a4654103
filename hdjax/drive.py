"""Parameters of a drive (two inertias and a nonlinear, damped mesh), and derived quantities."""

from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.parameters import Scalar, parameter, refuse_unphysical

SEED = "seed document, Table 1"


class Prior(NamedTuple):
    """Prior of a parameter.

    Attributes:
        path: its symbol.
        value: the most likely one [SI].
        tolerance: standard deviation of its logarithm, or of its value where it may be negative; infinite for a free
            parameter.
    """

    path: str
    value: float
    tolerance: float


class Drive(eqx.Module):
    """A harmonic drive between a motor and a load.

    The mesh transmits `tau = K (x + alpha x^3) + B_sp x'` at the dynamic error `x = theta_m / N - theta_l`.
    """

    N: Scalar = parameter(unit="1", doc="reduction ratio", source=SEED, bounds=(0.0, 1e4))
    J_m: Scalar = parameter(unit="kg m^2", doc="motor inertia", source=SEED, bounds=(0.0, 1e3))
    J_l: Scalar = parameter(unit="kg m^2", doc="load inertia", source=SEED, bounds=(0.0, 1e6))
    K: Scalar = parameter(unit="N m/rad", doc="torsional stiffness", source=SEED, bounds=(0.0, 1e9))
    alpha: Scalar = parameter(0.0, unit="rad^-2", doc="cubic stiffness coefficient", source=SEED)
    B_sp: Scalar = parameter(0.0, unit="N m s/rad", doc="mesh damping", source=SEED)
    k_T: Scalar = parameter(
        1.0, unit="1", doc="motor torque over the torque as logged", source="one where it is right", bounds=(0.0, 1e9)
    )
    priors: tuple[Prior, ...] = eqx.field(static=True, default=(), kw_only=True)

    def __check_init__(self):
        refuse_unphysical(self)

    @property
    def c(self) -> Scalar:
        """Inverse of the reduced inertia, `(N^2 J_m + J_l) / (N^2 J_m J_l)` [1/(kg m^2)]."""
        motor = self.N**2 * self.J_m
        return (motor + self.J_l) / (motor * self.J_l)

    @property
    def mu(self) -> Scalar:
        """Damping of the dynamic error, `c B_sp` [1/s]."""
        return self.c * self.B_sp

    @property
    def omega_0(self) -> Scalar:
        """Natural frequency of the dynamic error for small twist, `sqrt(c K)` [rad/s]."""
        return jnp.sqrt(self.c * self.K)

    @property
    def stiffness(self) -> Scalar:
        """Factor of `f(x)` in the mesh torque: K [N m/rad]."""
        return self.K

    def mesh_torque(self, x: Array, v: Array) -> Array:
        """Torque on the load through the mesh [N m] at twist `x` [rad] and twist rate `v` [rad/s]."""
        return self.K * restoring(x, self.alpha) + self.B_sp * v

    def error_forcing(self, T_m: Array, T_l: Array) -> Array:
        """Forcing of the dynamic error, `F = k_T T_m/(N J_m) - T_l/J_l` [rad/s^2].

        The seed prints `(T_m J_l - T_l J_m)/(N J_m J_l)`, which lacks a factor N on the load torque.
        """
        return self.k_T * T_m / (self.N * self.J_m) - T_l / self.J_l

    def reduced(self) -> "ReducedDrive":
        """The equation of this drive's dynamic error, forced by the motor torque."""
        values = self.mu, self.omega_0, self.alpha, self.k_T / (self.N * self.J_m)
        # A spring that has softened altogether is no reason to refuse: the values are put in afterwards.
        return eqx.tree_at(lambda d: (d.mu, d.omega_0, d.alpha, d.gain), ReducedDrive(mu=0.0, omega_0=1.0), values)


class ReducedDrive(eqx.Module):
    """The dynamic error's own equation, `x'' + mu x' + omega_0^2 (x + alpha x^3) = gain u(t)`.

    Represents a drive (or any Duffing oscillator) with a forcing `u` and a response `x`, in any units.
    """

    mu: Scalar = parameter(unit="1/s", doc="damping of the dynamic error", source="DESIGN eq. 2.1")
    omega_0: Scalar = parameter(unit="rad/s", doc="natural frequency", source="DESIGN eq. 2.1", bounds=(0.0, 1e9))
    alpha: Scalar = parameter(0.0, unit="1/[x]^2", doc="cubic stiffness coefficient", source="DESIGN eq. 2.1")
    gain: Scalar = parameter(1.0, unit="[x]/s^2/[u]", doc="acceleration per unit of forcing", source="DESIGN eq. 2.1")

    def __check_init__(self):
        refuse_unphysical(self)

    @property
    def c(self) -> float:
        """Deceleration of x by a unit of mesh torque: one, by definition of the torque."""
        return 1.0

    @property
    def stiffness(self) -> Scalar:
        """Factor of `f(x)`: omega_0^2 [1/s^2]."""
        return self.omega_0**2

    def mesh_torque(self, x: Array, v: Array) -> Array:
        """Restoring and damping acceleration [x/s^2], which takes the place of the mesh torque."""
        return self.stiffness * restoring(x, self.alpha) + self.mu * v


def restoring(x: Float[Array, "..."], alpha: Array) -> Float[Array, "..."]:
    """The restoring shape `f(x) = x + alpha x^3`."""
    return x * (1.0 + alpha * x * x)
