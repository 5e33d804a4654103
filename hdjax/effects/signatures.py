"""Signature of each family of effects in the residual of a model without it."""

SIGNATURES: dict[str, str] = {
    "stiffness_shape": "The slow torque-twist curve bends. A quadratic term makes even harmonics, the others odd ones.",
    "nonlinear_damping": "The height of the resonance depends on the level, and loops grow faster than the amplitude "
    "squared.",
    "coulomb_friction": "The residual torque is a square wave with the sign of the twist rate. A free vibration decays "
    "along a straight line.",
    "motor_friction": "The motor's torque balance jumps where the motor reverses, and is offset by its direction.",
    "load_friction": "The load's torque balance jumps where the load reverses, and is offset by its direction.",
    "kinematic_error": "Lines at fixed orders of the motor's revolution, with one phase in both directions. The force "
    "grows with the speed squared, and the natural frequency amplifies it.",
    "torque_sensor": "The residual follows the torque itself, or is constant.",
    "inertia_error": "The residual torque on one side is proportional to that side's acceleration.",
    "input_delay": "The phase of the response lags or leads in proportion to the frequency.",
    "gravity_load": "A torque on the load that depends on the load's angle alone, once a revolution of the output.",
    "load_disturbance": "A constant, or lines at frequencies that do not move with any shaft.",
    "backlash": "The torque-twist curve is flat around zero torque. Sub-harmonics and super-harmonics appear.",
    "hysteresis": "A loop of torque over twist whose area does not depend on the rate, and which remembers reversals.",
    "creep": "The twist relaxes for seconds to hours after the torque has stopped changing.",
    "cogging": "Lines at fixed orders of the motor's revolution, whose force does not depend on the speed.",
    "position_dependent_stiffness": "Sidebands of the motor's revolution that grow with the mean torque.",
    "position_dependent_friction": "A ripple over the motor's angle that changes its sign with the direction.",
    "extra_resonance": "A zero and a pole at fixed frequencies; they need excitation and move with the load's inertia.",
    "temperature": "Stiffness, damping or friction drifts with the temperature channel.",
    "sensor_delay": "The residual of one output is proportional to its rate, whatever the torque.",
    "encoder_offset": "The dynamic error is off by a constant that no torque explains.",
    "encoder_eccentricity": "One or two cycles per revolution of an encoder, without a force: the natural frequency "
    "does not amplify them.",
}
"""By family, in a sentence or two."""
