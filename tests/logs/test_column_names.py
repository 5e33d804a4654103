"""Quantity, side, joint and unit that follow from common column names."""

import pytest

from fitting.logs.column_names import likely_columns, sense

# name: quantity, side, command, joint, unit
NAMES = {
    "time": ("time", None, False, None, None),
    "Timestamp": ("time", None, False, None, None),
    "time_ms": ("time", None, False, None, "ms"),
    "Zeit [ms]": ("time", None, False, None, "ms"),
    "header.stamp.nsecs": ("time", None, False, None, "ns"),
    "field.header.seq": ("counter", None, False, None, None),
    "q_motor": ("angle", "motor", False, None, None),
    "qm": ("angle", "motor", False, None, None),
    "ql": ("angle", "load", False, None, None),
    "enc_m": ("angle", "motor", False, None, None),
    "theta_l": ("angle", "load", False, None, None),
    "Motor Position [rad]": ("angle", "motor", False, None, "rad"),
    "theta_motor_deg": ("angle", "motor", False, None, "deg"),
    "encoder_motorinc": ("angle", "motor", False, None, "counts"),
    "encoder_loadinc_3": ("angle", "load", False, "3", "counts"),
    "position": ("angle", None, False, None, None),
    "linkPosition": ("angle", "load", False, None, None),
    "q[1]": ("angle", None, False, "1", None),
    "q_d[1]": ("angle", None, True, "1", None),
    "actual_q_0": ("angle", None, False, "0", None),
    "target_q_0": ("angle", None, True, "0", None),
    "Axis 1.ActPos": ("angle", None, False, "1", None),
    "Axis 1.SetPos": ("angle", None, True, "1", None),
    "/joint_states/joint_a1/position": ("angle", None, False, "1", None),
    "Motorwinkel": ("angle", "motor", False, None, None),
    "Abtriebswinkel [°]": ("angle", "load", False, None, "°"),
    "Sollposition": ("angle", None, True, None, None),
    "dq": ("velocity", None, False, None, None),
    "actual_qd_0": ("velocity", None, False, "0", None),
    "omega_m": ("velocity", "motor", False, None, None),
    "Motordrehzahl / rpm": ("velocity", "motor", False, None, "rpm"),
    "velocity": ("velocity", None, False, None, None),
    "effort": ("torque", None, False, None, None),
    "tau_J": ("torque", "joint", False, None, None),
    "tau_J_d[3]": ("torque", "joint", True, "3", None),
    "tau_J[3]": ("torque", "joint", False, "3", None),
    "T_m": ("torque", "motor", False, None, None),
    "Drehmoment [Nm]": ("torque", None, False, None, "Nm"),
    "target_moment_0": ("torque", None, True, "0", None),
    "joint_torque_current_1": ("torque", "joint", False, "1", None),
    "iq": ("current", None, False, None, None),
    "Motorstrom [A]": ("current", None, False, None, "A"),
    "motorCurrent": ("current", "motor", False, None, None),
    "joint_temperatures_0": ("temperature", None, False, "0", None),
    "deflection": ("twist", None, False, None, None),
    "dynamic_error": ("twist", None, False, None, None),
    "multisine/u": ("input", None, False, None, None),
    "position_error": ("other", None, False, None, None),
    "twist_tx": ("other", None, False, None, None),
    "target_qdd_0": ("other", None, True, "0", None),
    "actual_main_voltage": ("other", None, False, None, None),
    "ch3": (None, None, False, "3", None),
}


@pytest.mark.parametrize("name", NAMES)
def test_column_name_gives_quantity_side_joint_and_unit(name: str):
    quantity, side, commanded, joint, unit = NAMES[name]
    found = sense(name)
    assert (found.quantities[0] if found.quantities else None) == quantity
    # The side of time and temperature does not matter.
    assert found.side == side or quantity in ("time", "temperature", "current", "other")
    assert (found.commanded, found.joint, found.unit) == (commanded, joint, unit)


def test_likely_columns_exclude_commands_and_the_other_side():
    names = ["time", "q_motor", "q_cmd", "link_pos", "encoder", "tau", "temp"]
    assert likely_columns("load_angle", names) == ["link_pos", "encoder"]
    assert likely_columns("motor_angle", names) == ["q_motor", "encoder"]
    assert likely_columns("motor_torque", names) == ["tau"]
    assert likely_columns("forcing", names) == []
