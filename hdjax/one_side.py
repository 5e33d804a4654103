"""Equations of one side behind the mesh, for a given motion of the other side."""

from typing import ClassVar

from jaxtyping import Array

from hdjax.drive import Drive
from hdjax.dynamics import TwistModel
from hdjax.effects import Effect


class OneSideModel(TwistModel):
    """One side behind the mesh for a given motion of the other. States: x, v.

    Attributes:
        equation: the side whose equation of motion it is.
        scaled_by: parameters of the drive that K and B_sp are in proportion to.
    """

    equation: ClassVar[str]
    scaled_by: ClassVar[tuple[str, ...]]

    drive: Drive
    effects: tuple[Effect, ...] = ()


class MotorDrivenModel(OneSideModel):
    """The load behind the mesh for a given motion of the motor.

        x'' = theta_m''/N - (tau + T_l)/J_l

    The motor's acceleration over N [rad/s^2] takes the place of the torque.
    """

    equation: ClassVar[str] = "load"
    scaled_by: ClassVar[tuple[str, ...]] = ("J_l",)

    def twist_acceleration(self, torque: Array, tau: Array, load_torque: Array) -> Array:
        return torque - (tau + load_torque) / self.drive.J_l

    def mobility(self, moved: str, opposed: str) -> Array | float:
        return 1.0 / self.drive.J_l


class LoadDrivenModel(OneSideModel):
    """The motor behind the mesh for a given motion of the load.

        x'' = (k_T T_m - tau/N)/(N J_m) - theta_l''

    The load's acceleration [rad/s^2] takes the place of the load torque.
    """

    equation: ClassVar[str] = "motor"
    scaled_by: ClassVar[tuple[str, ...]] = ("J_m", "k_T")

    def twist_acceleration(self, torque: Array, tau: Array, load_torque: Array) -> Array:
        return (self.drive.k_T * torque - tau / self.drive.N) / self.drive.J_m / self.drive.N - load_torque

    def mobility(self, moved: str, opposed: str) -> Array | float:
        return 1.0 / (self.drive.J_m * self.drive.N**2)
