"""Experiments that separate two families of effects."""

_PLAIN_FAMILY = {"torque_sensor": "torque sensor error", "unknown": "unknown term"}


# Experiment that separates two families; symmetric.
_SEPARATING = {
    ("kinematic_error", "cogging"): "Run at two constant speeds: the force behind a geometric error grows with the "
    "square of the speed, a cogging torque does not.",
    ("kinematic_error", "encoder_eccentricity"): "Pass slowly through the speed at which the order meets the natural "
    "frequency: a kinematic error is amplified there, an encoder's error is not.",
    ("kinematic_error", "position_dependent_stiffness"): "Step the mean torque at one speed: a ripple of the stiffness "
    "grows with it, a kinematic error does not.",
    (
        "kinematic_error",
        "load_disturbance",
    ): "Change the motor speed: an error of the gear moves with it, a disturbance stays at its frequency.",
    ("cogging", "load_disturbance"): "Change the motor speed: cogging moves with it, a disturbance stays at its "
    "frequency.",
    ("cogging", "encoder_eccentricity"): "Lock the output and turn the motor slowly by hand: cogging takes torque, an "
    "encoder's error does not.",
    ("cogging", "position_dependent_friction"): "Run the same path in both directions: friction changes its sign, "
    "cogging does not.",
    ("stiffness_shape", "stiffness_shape"): "Drive to larger twists, past the knee of the stiffness, in both "
    "directions.",
    ("stiffness_shape", "backlash"): "Repeat with a preload: a dead zone disappears, a nonlinear stiffness does not.",
    ("stiffness_shape", "hysteresis"): "Cycle the torque slowly at several amplitudes: hysteresis opens a loop, a "
    "nonlinear stiffness does not.",
    ("stiffness_shape", "nonlinear_damping"): "Cycle the torque slowly: damping vanishes with the rate, stiffness does "
    "not.",
    ("backlash", "hysteresis"): "Repeat with a preload: a dead zone disappears, hysteresis does not.",
    ("backlash", "coulomb_friction"): "Repeat with a preload: a dead zone disappears, friction does not.",
    ("hysteresis", "coulomb_friction"): "Cycle the torque as a slow triangle at three rates, with small loops inside "
    "large ones: hysteresis has a slope before sliding, and depends on earlier reversals.",
    ("hysteresis", "nonlinear_damping"): "Repeat the same twist at three rates: the area of a hysteresis loop is "
    "constant, that of a damping loop grows with the rate.",
    ("hysteresis", "motor_friction"): "Lock the output and cycle the torque slowly: friction of the motor does not "
    "affect the twist, hysteresis appears in torque against twist.",
    ("hysteresis", "creep"): "Stop under load and wait: creep continues for minutes, hysteresis does not.",
    ("coulomb_friction", "motor_friction"): "Turn the motor at constant speed, unloaded: its friction needs torque, "
    "friction between the mesh's sides does not.",
    ("coulomb_friction", "load_friction"): "Drive one side at a time, the other one locked.",
    ("coulomb_friction", "nonlinear_damping"): "Excite at several levels: the loss per cycle grows more slowly than "
    "the amplitude squared with Coulomb friction, and faster with nonlinear damping.",
    ("motor_friction", "motor_friction"): "Reverse slowly and dwell near standstill, where the two laws differ.",
    ("motor_friction", "load_friction"): "Drive one side at a time, the other one locked or uncoupled.",
    ("motor_friction", "torque_sensor"): "Run the same path in both directions: friction changes its sign, a bias does "
    "not.",
    ("motor_friction", "nonlinear_damping"): "Turn at several constant speeds: motor friction needs torque, damping of "
    "the mesh does not.",
    ("motor_friction", "position_dependent_friction"): "Turn slowly over several revolutions: a ripple that repeats "
    "with the angle belongs to the position.",
    ("position_dependent_friction", "kinematic_error"): "Run the same path in both directions: friction changes its "
    "sign, a kinematic error keeps its phase.",
    ("gravity_load", "torque_sensor"): "Turn the mount, or add a known mass: gravity follows, a sensor's bias does "
    "not.",
    ("gravity_load", "encoder_eccentricity"): "Turn the mount: gravity keeps to the vertical, the encoder's error to "
    "its disc.",
    ("gravity_load", "load_disturbance"): "Rest in several poses: gravity depends on the pose, not on time.",
    ("load_disturbance", "extra_resonance"): "Switch the excitation off, or change the load's inertia: a resonance "
    "needs the one and moves with the other.",
    ("temperature", "creep"): "Hold a constant torque at a constant temperature: creep relaxes, a thermal drift stays "
    "away.",
    ("temperature", "hysteresis"): "Cool down and repeat: thermal drift is reversible.",
    (
        "inertia_error",
        "torque_sensor",
    ): "Hold a known torque at rest: a wrong scale of the sensor shows, an inertia does not.",
    ("inertia_error", "inertia_error"): "Add a known inertia to the load and record again.",
    ("inertia_error", "extra_resonance"): "Excite well below the natural frequency: a wrong inertia still shows, a "
    "resonance does not.",
    ("torque_sensor", "torque_sensor"): "Rest without load, then apply a known torque: the first shows a bias, the "
    "second a gain error.",
    ("input_delay", "nonlinear_damping"): "Excite up to several times the natural frequency: the phase of a delay "
    "keeps growing, that of damping saturates.",
    ("kinematic_error", "kinematic_error"): "Turn the output by several whole revolutions at constant speed: "
    "sidebands vary with the output's revolution.",
    ("cogging", "cogging"): "Turn slowly at constant speed for many motor revolutions: this separates the orders.",
    ("cogging", "gravity_load"): "Turn the mount: gravity keeps to the vertical, cogging to the motor.",
    ("hysteresis", "hysteresis"): "Cycle the torque slowly with small loops inside large ones, up to several times the "
    "yield: the laws differ after a reversal, and in whether small loops close.",
    ("coulomb_friction", "coulomb_friction"): "Repeat under a preload: one friction grows with the transmitted "
    "torque, the other does not.",
    ("nonlinear_damping", "nonlinear_damping"): "Excite at the natural frequency at several levels, with and without "
    "a preload: this separates the powers of rate and twist.",
    ("coulomb_friction", "position_dependent_friction"): "Turn slowly over several revolutions: a ripple that repeats "
    "with the angle belongs to the position.",
    ("position_dependent_friction", "position_dependent_friction"): "Turn the motor at constant speed, unloaded: "
    "friction on the motor takes torque, friction between the mesh's sides does not.",
    ("position_dependent_stiffness", "stiffness_shape"): "Cycle the torque slowly at several motor angles: a stiffness "
    "that depends on the position differs between them.",
    ("position_dependent_stiffness", "cogging"): "Step the mean torque at one speed: a ripple of the stiffness grows "
    "with it, cogging does not.",
    ("load_disturbance", "torque_sensor"): "Lock the motor: a torque on the load still twists the drive, a bias of the "
    "motor's sensor does not.",
    ("load_disturbance", "load_friction"): "Run the same path in both directions: friction changes its sign, a "
    "constant torque does not.",
    ("load_disturbance", "load_disturbance"): "Record a longer log, which resolves close lines.",
    ("load_disturbance", "encoder_eccentricity"): "Change the speed: an encoder's error moves with it, a disturbance "
    "stays at its frequency.",
    ("gravity_load", "load_friction"): "Hold several poses and approach each from both sides: friction depends on the "
    "side, gravity on the pose.",
    ("load_friction", "load_friction"): "Turn the load at several constant speeds in both directions.",
    ("extra_resonance", "input_delay"): "Excite up to several times the natural frequency: a second resonance "
    "changes the phase within a band, a delay increasingly with frequency.",
    ("extra_resonance", "nonlinear_damping"): "Repeat at another level: a second resonance does not move.",
    ("extra_resonance", "stiffness_shape"): "Repeat at another level: a second resonance does not move, a nonlinear "
    "stiffness changes the natural frequency.",
    ("extra_resonance", "creep"): "Stop under load and wait: creep continues, a second resonance decays.",
    ("creep", "nonlinear_damping"): "Excite at the natural frequency at several levels, then stop under load and wait: "
    "creep is linear in the level and slow, nonlinear damping neither.",
    ("temperature", "motor_friction"): "Repeat the same path cold and warm: only effects of temperature change.",
    ("temperature", "stiffness_shape"): "Repeat the same torque cycle cold and warm, with the same twists.",
    ("temperature", "temperature"): "Ring the drive down freely, cold and warm, and turn the motor unloaded: the "
    "frequency shows the stiffness, the decay the damping, the torque the friction.",
    ("encoder_eccentricity", "encoder_eccentricity"): "Turn the output by more than one revolution: the load's encoder "
    "repeats with it, the motor's with the motor.",
    (
        "encoder_offset",
        "encoder_eccentricity",
    ): "Turn the output by more than one revolution: an offset is constant, an eccentric disc's error repeats.",
    ("encoder_offset", "torque_sensor"): "Release the drive without load: an encoder's offset remains, a torque's bias "
    "twists nothing.",
    ("encoder_offset", "load_disturbance"): "Release the drive without load: an encoder's offset remains.",
    ("encoder_offset", "gravity_load"): "Turn the mount: gravity follows, an encoder's offset does not.",
    ("encoder_offset", "hysteresis"): "Reverse a large torque: hysteresis changes the twist at rest, an offset stays.",
    ("motor_friction", "gravity_load"): "Run the same path in both directions: friction changes its sign, gravity does "
    "not.",
    (
        "sensor_delay",
        "sensor_delay",
    ): "Excite both sides at several times the natural frequency, where the two inertias move differently.",
    ("sensor_delay", "nonlinear_damping"): "Repeat at another level: a delay does not depend on it.",
    (
        "sensor_delay",
        "input_delay",
    ): "Drive the load by hand: a delay of an encoder remains, one of the torque does not.",
    ("input_delay", "input_delay"): "Excite up to several times the natural frequency, log the torque faster, and "
    "state its hold in the drive file. A lag also weakens fast torques, a delay does not.",
}


# Experiment that reveals one family, for pairs that are not in the table.
_REVEALING = {
    "kinematic_error": "repeat at two speeds and look for amplification at the natural frequency",
    "stiffness_shape": "cycle the torque slowly to larger twists",
    "backlash": "repeat with a preload, which removes a dead zone",
    "hysteresis": "cycle the torque slowly at three rates, with small loops inside large ones",
    "coulomb_friction": "let the drive ring down freely: the envelope falls along a straight line",
    "motor_friction": "run the same path in both directions at several constant speeds",
    "load_friction": "drive one side at a time, the other one locked",
    "nonlinear_damping": "excite at the natural frequency at several levels",
    "position_dependent_stiffness": "step the mean torque",
    "position_dependent_friction": "run the same path in both directions",
    "cogging": "turn slowly at two constant speeds",
    "gravity_load": "turn the mount, or add a known mass",
    "load_disturbance": "repeat at another motor speed and without excitation",
    "extra_resonance": "change the load's inertia",
    "temperature": "cool down and repeat",
    "inertia_error": "add a known inertia and record again",
    "torque_sensor": "reverse the direction, and check the sensor with a known torque",
    "input_delay": "excite up to several times the natural frequency",
    "encoder_offset": "release the drive without load: the reading that is left is the offset",
    "encoder_eccentricity": "pass slowly through the natural frequency",
    "sensor_delay": "move the unloaded drive slowly to and fro: all sensors must show the same motion",
    "creep": "stop under load and wait for minutes",
}


def separating_experiment(one: str, other: str) -> str:
    """The experiment that separates two families."""
    known = _SEPARATING.get((one, other)) or _SEPARATING.get((other, one))
    if known:
        return known
    hints = [f"for {plain_family(f)}, {_REVEALING[f]}" for f in dict.fromkeys((one, other)) if f in _REVEALING]
    if not hints:
        return "Repeat at another amplitude, speed and mean torque."
    sentence = "; ".join(hints)
    return f"{sentence[0].upper()}{sentence[1:]}."


def look_alikes(family: str) -> dict[str, str]:
    """The families with a similar residual, each with the separating experiment.

    Args:
        family: of effects; it is its own look-alike where its forms are hard to separate.
    """
    pairs = {other: experiment for pair, experiment in _SEPARATING.items() for other in _other(pair, family)}
    return dict(sorted(pairs.items()))


def _other(pair: tuple[str, str], family: str) -> tuple[str, ...]:
    return (pair[1],) if pair[0] == family else (pair[0],) if pair[1] == family else ()


def plain_family(family: str) -> str:
    """A family's name in prose."""
    return _PLAIN_FAMILY.get(family, family.replace("_", " "))
