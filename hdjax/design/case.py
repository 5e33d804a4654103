"""Case of a design study: a drive and its excitation."""

from collections.abc import Mapping

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike

from hdjax.drive import Drive
from hdjax.dynamics import TwoInertiaModel
from hdjax.parameters import ParameterInfo, Scalar, own_parameters, parameter

FORCING = "forcing"


class Excitation(eqx.Module):
    """Torques on the drive: `amplitude cos(omega t) + second_amplitude cos(second_omega t)` on the motor, and
    `load_amplitude cos(omega t)` on the load.

    Measures over a range of speeds use the amplitudes alone; their frequencies are the range's.
    """

    amplitude: Scalar = parameter(0.0, unit="N m", doc="amplitude of the motor torque", source="the user's")
    omega: Scalar = parameter(1.0, unit="rad/s", doc="its frequency", source="the user's", bounds=(0.0, 1e9))
    second_amplitude: Scalar = parameter(0.0, unit="N m", doc="amplitude of a second sine", source="the user's")
    second_omega: Scalar = parameter(1.0, unit="rad/s", doc="its frequency", source="the user's", bounds=(0.0, 1e9))
    load_amplitude: Scalar = parameter(0.0, unit="N m", doc="amplitude of the load torque", source="the user's")

    def __call__(self, t: Array) -> Array:
        """The motor torque at a time [N m]."""
        return self.amplitude * jnp.cos(self.omega * t) + self.second_amplitude * jnp.cos(self.second_omega * t)


class Case(eqx.Module):
    """A drive and its excitation.

    Attributes:
        model: the equations; a reduced model lacks inertias and ratio, which most designs need.
        excitation: torques.
    """

    model: TwoInertiaModel
    excitation: Excitation = Excitation()

    @property
    def drive(self) -> Drive:
        """The drive's parameters."""
        return self.model.drive

    def parameters(self) -> dict[str, tuple[Array, ParameterInfo]]:
        """Possible design variables by dotted path: the model's parameters, and those of the torques as
        `forcing.symbol`."""
        own = {f"{FORCING}.{n}": (getattr(self.excitation, n), i) for n, i in own_parameters(self.excitation)}
        return self.model.parameters() | own

    def replace(self, values: Mapping[str, ArrayLike]) -> "Case":
        """The same case with other values at the given dotted paths.

        Raises:
            ValueError: a path is not one of [`Case.parameters`][].
        """
        known = self.parameters()
        for path in values:
            if path not in known:
                raise ValueError(f"`{path}` is no parameter of this drive; there are {', '.join(known)}")
        torques = {p.removeprefix(f"{FORCING}."): v for p, v in values.items() if p.startswith(f"{FORCING}.")}
        excitation = self.excitation
        for name, value in torques.items():
            excitation = eqx.tree_at(lambda e, n=name: getattr(e, n), excitation, jnp.asarray(value, dtype=float))
        model = self.model.replace({p: v for p, v in values.items() if not p.startswith(f"{FORCING}.")})
        assert isinstance(model, TwoInertiaModel)
        return Case(model, excitation)
