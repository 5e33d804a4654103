"""A second resonance: a third inertia on the load."""

from typing import ClassVar

import jax.numpy as jnp
from jaxtyping import Array, Float

from hdjax.drive import Drive, ReducedDrive
from hdjax.effects.effect import Effect, LoadSideEffect, Motion, Scales
from hdjax.parameters import Scalar, parameter


class _Resonance(LoadSideEffect):
    """A third inertia J_3 on a spring K_3 and a damper B_3:

        J_3 theta_3'' = -K_3 (theta_3 - theta_l) - B_3 (theta_3' - theta_l')

    and the opposite torque on the load. Parametrised by quantities that a log determines well, with J_3 = 0 for the
    drive alone: `J_3 = mass_ratio J_l`, `K_3 = J_3 omega_3^2`, `B_3 = 2 zeta omega_3 J_3`. The load's response has its
    zero at omega_3. States: `theta_3 - theta_l`, which stays small on a load that turns, and `theta_3'`; both are
    driven by the load's rate alone.
    """

    family: ClassVar[str] = "extra_resonance"
    states: ClassVar[tuple[str, ...]] = ("twist", "omega")
    drawn_against: ClassVar[str | None] = None

    mass_ratio: Scalar = parameter(0.0, unit="1", doc="J_3 / J_l", bounds=(0.0, 1.0), role="strength")
    omega_3: Scalar = parameter(
        unit="rad/s", doc="natural frequency on a load that stands still", bounds=(0.0, 1e6), role="shape"
    )
    # Half the loss factor of steel, 2e-4 (Cremer, Heckl 1988): joints damp more. An undamped part that begins anew in
    # each segment would imitate any line.
    zeta: Scalar = parameter(0.02, unit="1", doc="damping ratio", bounds=(1e-4, 10.0), role="shape")
    twist_span: Scalar = parameter(unit="rad", doc="twist that it may start with", bounds=(0.0, 1e9))
    rate_span: Scalar = parameter(unit="rad/s", doc="rate against the load's that it may start with", bounds=(0.0, 1e9))

    @classmethod
    def proposals(cls, scales: Scales) -> tuple[Effect, ...]:
        base = scales.natural_frequency
        grid = tuple(base * 1.15**k for k in range(-8, 9))
        return tuple(cls._at(omega, scales) for omega in (*scales.residual_frequencies, *grid))

    @classmethod
    def typical(cls, scales: Scales) -> tuple[Effect, ...]:
        # The fit of a drive alone is between the two resonances, and far off for a large third inertia.
        return tuple(cls._at(scales.natural_frequency * ratio, scales, mass_ratio=0.2) for ratio in (0.7, 1.0, 1.4))

    @classmethod
    def _at(cls, omega_3: float, scales: Scales, mass_ratio: float = 0.0) -> "_Resonance":
        # Near its resonance it moves far more than the drive's twist.
        rate = 10.0 * scales.x * scales.natural_frequency
        return cls(mass_ratio=mass_ratio, omega_3=omega_3, twist_span=rate / omega_3, rate_span=rate)

    def torque(self, motion: Motion, drive: Drive, state: Array) -> Array:
        return self.mass_ratio * drive.J_l * self._pull(motion, state)

    def _pull(self, motion: Motion, state: Array) -> Array:
        """Acceleration of the load, over the mass ratio [rad/s^2]."""
        assert motion.omega_l is not None
        return self.omega_3**2 * state[0] + 2 * self.zeta * self.omega_3 * (state[1] - motion.omega_l)

    def initial_state(self, motion: Motion | None = None) -> Float[Array, "2"]:
        nothing = jnp.zeros_like(self.omega_3)
        return jnp.stack([nothing, nothing if motion is None or motion.omega_l is None else motion.omega_l])

    def state_rates(self, motion: Motion, state: Array) -> Float[Array, "2"]:
        assert motion.omega_l is not None
        return jnp.stack([state[1] - motion.omega_l, -self._pull(motion, state)])

    def state_scale(self) -> Float[Array, "2"]:
        return jnp.stack([self.twist_span, self.rate_span])

    def derived(self, drive: Drive | ReducedDrive) -> dict[str, tuple[Array, str]]:
        assert isinstance(drive, Drive)
        J_3 = self.mass_ratio * drive.J_l
        return {
            "J_3": (J_3, "kg m^2"),
            "K_3": (J_3 * self.omega_3**2, "N m/rad"),
            "B_3": (2 * self.zeta * self.omega_3 * J_3, "N m s/rad"),
            "zero": (self.omega_3 / (2 * jnp.pi), "Hz"),
        }


class ExtraResonance(_Resonance):
    """A part J_3 of the load's inertia is on a spring and a damper, a flexible link; `J_l - J_3` is left on the load.

    `J_3 theta_3'' = -K_3 (theta_3 - theta_l) - B_3 (theta_3' - theta_l')`, and the opposite torque on the load, with
    `J_3 = mass_ratio J_l`, `K_3 = J_3 omega_3^2`, `B_3 = 2 zeta omega_3 J_3`. The drive's J_l is the whole.
    """

    name: ClassVar[str] = "extra_resonance"

    def inertia_taken(self, drive: Drive) -> Array:
        return self.mass_ratio * drive.J_l


class ResonanceBesideLoad(_Resonance):
    """A third inertia J_3 that the drive's J_l does not count, on a spring and a damper: a payload or a fixture.

    The same equations as of [`ExtraResonance`][], with the whole of J_l left on the load.
    """

    name: ClassVar[str] = "resonance_beside_load"
