"""Effects that the torque-twist equation can't distinguish from a found one, and the experiment that separates them."""

import numpy as np

from fitting.quasi_static.points import Points

_CONSTANT = "Hold a constant torque at a constant temperature: creep relaxes, and there is no thermal drift."
_BOTH_WAYS = "Run the same path both ways: friction changes its sign, {} does not."
_ALWAYS: dict[str, tuple[tuple[str, str], ...]] = {
    "kinematic_error": (
        (
            "cogging",
            "Measure the torque at the output instead of by the motor's current: an error of the gear's geometry stays "
            "in the twist, a torque on the motor's side does not.",
        ),
        (
            "encoder_eccentricity",
            "Pass through the speed at which the order meets the natural frequency: a kinematic error is amplified "
            "there, an error of the motor's encoder is not.",
        ),
    ),
    "hysteresis": (
        (
            "motor_friction",
            "Measure the torque at the output: the loop then contains hysteresis of the gear, but no friction on the "
            "motor's side.",
        ),
        (
            "coulomb_friction",
            "Cycle the torque with small loops inside large ones: hysteresis has a slope before sliding.",
        ),
    ),
    "motor_friction": (("load_friction", "Drive one side at a time, the other one uncoupled."),),
    "creep": (("temperature", _CONSTANT),),
    "input_delay": (
        (
            "nonlinear_damping",
            "Record a step of another quantity on both channels: it shows a delay of the log, but no damping of the "
            "mesh.",
        ),
    ),
    "temperature": (("creep", _CONSTANT),),
    "encoder_eccentricity": (
        ("kinematic_error", "Turn the load's encoder on its shaft: its own error turns along, the gear's does not."),
    ),
}
_ONE_WAY = {
    "kinematic_error": (("position_dependent_friction", _BOTH_WAYS.format("a kinematic error")),),
    "motor_friction": (("torque_sensor", _BOTH_WAYS.format("an error of the torque sensor")),),
}
_AT_REST = {
    "creep": (
        (
            "load_friction",
            "Measure the torque at the output during the rest: gears creep under a constant torque, while slowly "
            "yielding friction changes it.",
        ),
    )
}
_SHIFTED = {
    "kinematic_error": (
        (
            "position_dependent_stiffness",
            "Repeat the run at a larger torque: the phase of a kinematic error between motor and load shifts in "
            "proportion, at the same amplitude; a stiffness ripple beside one at the motor adds to the amplitude.",
        ),
    )
}
_ON_POSITION = {
    "stiffness_shape": (
        (
            "encoder_eccentricity",
            "Run the same path under another load: a nonlinear stiffness depends on the torque, an encoder error on "
            "the angle.",
        ),
    )
}


def lookalikes(family: str, points: Points, *, at_rest: bool = False, shifted: bool = False) -> list[tuple[str, str]]:
    """Families with the same regressors as a found one on these logs, each with the separating experiment.

    Args:
        family: Of the found effect.
        points: Of the logs.
        at_rest: Whether it was found at rest.
        shifted: Whether the phase of a kinematic error shifts with the torque.
    """
    told = (
        (True, _ALWAYS),
        ("both ways" not in points.motion, _ONE_WAY),
        (at_rest, _AT_REST),
        (shifted, _SHIFTED),
        (points.direction is not None and _hangs_on_position(points), _ON_POSITION),
    )
    return [pair for holds, alike in told if holds for pair in alike.get(family, ())]


def _hangs_on_position(points: Points) -> bool:
    """Whether the torque was a function of the load's angle, as for a moving joint under gravity."""
    if points.load_angle is None:
        return False
    for own in points.logs:
        angle, torque = points.load_angle[own], points.torque[own]
        rest = torque - np.polyval(np.polyfit(angle - np.mean(angle), torque, 3), angle - np.mean(angle))
        if np.var(rest) > 0.1 * np.var(torque):
            return False
    return True
