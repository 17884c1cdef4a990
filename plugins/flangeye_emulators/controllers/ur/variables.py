"""The variables RTDE offers: names, types, and where a controller has their values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

from flangeye_emulators.controllers.poses import inverse_pose
from flangeye_emulators.controllers.ur.controller import Registers, RobotMode, Runtime, URController

FORMATS = {
    "BOOL": "?",
    "UINT8": "B",
    "UINT32": "I",
    "UINT64": "Q",
    "INT32": "i",
    "DOUBLE": "d",
    "VECTOR3D": "3d",
    "VECTOR6D": "6d",
    "VECTOR6INT32": "6i",
}
"""RTDE's types as :mod:`struct` packs them; everything is big-endian."""

NOT_FOUND = "NOT_FOUND"

Values = Sequence[float] | Sequence[int]


INPUTS: dict[str, str] = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "external_force_torque": "VECTOR6D",
    **{f"input_int_register_{i}": "INT32" for i in range(Registers.COUNT)},
    **{f"input_double_register_{i}": "DOUBLE" for i in range(Registers.COUNT)},
}
"""What a client may write: name and type."""

DIGITAL_SHIFTS = {
    "standard_digital_output": 0,
    "configurable_digital_output": 8,
    "tool_digital_output": 16,
}
"""First bit of each group in ``actual_digital_output_bits``."""


class Output(NamedTuple):
    """A variable a client may read: its type and its values."""

    type: str
    values: Callable[[URController], Values]


def _raw_wrench(box: URController) -> Values:
    """Wrench at the flange in the flange's axes, nothing subtracted."""
    force = box.arm.wrench[:3]
    tool = inverse_pose(box.arm.chain.flange_T_tcp)
    force_in_flange = tool[:3, :3].T @ box.arm.stance.base_T_tcp[:3, :3].T @ force
    lever = box.arm.chain.flange_T_tcp[:3, 3]
    x, y, z = lever
    fx, fy, fz = force_in_flange
    return [fx, fy, fz, y * fz - z * fy, z * fx - x * fz, x * fy - y * fx]


def _robot_status(box: URController) -> Values:
    """Bit 0: power on, bit 1: program running."""
    powered = box.robot_mode is not RobotMode.POWER_OFF
    return (powered | (box.runtime is Runtime.PLAYING) << 1,)


def _nothing(count: int) -> Callable[[URController], Values]:
    zeros = (0.0,) * count
    return lambda box: zeros


def _ambient(value: float) -> Callable[[URController], Values]:
    return lambda box: (value,)


def _double_output(index: int) -> Output:
    return Output("DOUBLE", lambda box: (box.registers.output_double[index],))


def _integer_output(index: int) -> Output:
    return Output("INT32", lambda box: (box.registers.output_int[index],))


_JOINTS = Output("VECTOR6D", lambda box: box.arm.stance.joints.tolist())
_SPEEDS = Output("VECTOR6D", lambda box: box.arm.speeds.tolist())
_POSE = Output("VECTOR6D", lambda box: box.tcp_pose().tolist())
_TWIST = Output("VECTOR6D", lambda box: box.arm.twist.tolist())
_STILL = Output("VECTOR6D", _nothing(6))

OUTPUTS: dict[str, Output] = {
    "timestamp": Output("DOUBLE", lambda box: (box.time,)),
    "target_q": _JOINTS,
    "target_qd": _SPEEDS,
    "target_qdd": _STILL,
    "target_current": _STILL,
    "target_moment": _STILL,
    "actual_q": _JOINTS,
    "actual_qd": _SPEEDS,
    "actual_current": _STILL,
    "actual_current_as_torque": _STILL,
    "joint_control_output": _STILL,
    "actual_TCP_pose": _POSE,
    "actual_TCP_speed": _TWIST,
    "actual_TCP_force": Output("VECTOR6D", lambda box: box.arm.felt.tolist()),
    "target_TCP_pose": _POSE,
    "target_TCP_speed": _TWIST,
    "ft_raw_wrench": Output("VECTOR6D", _raw_wrench),
    "actual_digital_input_bits": Output(
        "UINT64", lambda box: (box.digital_outputs & 0xFF,) if box.wired else (0,)
    ),
    "actual_digital_output_bits": Output("UINT64", lambda box: (box.digital_outputs,)),
    "joint_temperatures": Output("VECTOR6D", lambda box: (25.0,) * 6),
    "actual_execution_time": Output("DOUBLE", lambda box: (box.program_time,)),
    "robot_mode": Output("INT32", lambda box: (box.robot_mode,)),
    "joint_mode": Output("VECTOR6INT32", lambda box: (253,) * 6),
    "safety_mode": Output("INT32", lambda box: (box.safety,)),
    "actual_tool_accelerometer": Output("VECTOR3D", _nothing(3)),
    "speed_scaling": Output("DOUBLE", lambda box: (box.arm.fraction,)),
    "target_speed_fraction": Output("DOUBLE", lambda box: (box.arm.slider,)),
    "actual_momentum": Output("DOUBLE", _nothing(1)),
    "actual_main_voltage": Output("DOUBLE", _ambient(48.0)),
    "actual_robot_voltage": Output("DOUBLE", _ambient(48.0)),
    "actual_robot_current": Output("DOUBLE", _nothing(1)),
    "actual_joint_voltage": Output("VECTOR6D", lambda box: (48.0,) * 6),
    "runtime_state": Output("UINT32", lambda box: (box.runtime,)),
    "standard_analog_input0": Output("DOUBLE", _nothing(1)),
    "standard_analog_input1": Output("DOUBLE", _nothing(1)),
    "standard_analog_output0": Output("DOUBLE", lambda box: (box.analog_outputs[0],)),
    "standard_analog_output1": Output("DOUBLE", lambda box: (box.analog_outputs[1],)),
    "robot_status_bits": Output("UINT32", _robot_status),
    "safety_status_bits": Output("UINT32", lambda box: (box.safety.status_bits,)),
    "payload": Output("DOUBLE", lambda box: (box.payload[0],)),
    "payload_cog": Output("VECTOR3D", lambda box: box.payload[1].tolist()),
    "payload_inertia": _STILL,
    "output_bit_registers0_to_31": Output("UINT32", lambda box: (0,)),
    "output_bit_registers32_to_63": Output("UINT32", lambda box: (0,)),
    **{f"output_int_register_{i}": _integer_output(i) for i in range(Registers.COUNT)},
    **{f"output_double_register_{i}": _double_output(i) for i in range(Registers.COUNT)},
}
"""What a client may read."""


def write_inputs(box: URController, values: dict[str, float]) -> None:
    """Do what one input package says: registers, outputs, the speed slider."""
    for name, value in values.items():
        group, _, number = name.rpartition("_")
        if group == "input_int_register":
            box.set_input_int(int(number), int(value))
        elif group == "input_double_register":
            box.registers.input_double[int(number)] = value
        elif name in DIGITAL_SHIFTS:
            mask = int(values.get(f"{name}_mask", 0)) << DIGITAL_SHIFTS[name]
            bits = int(value) << DIGITAL_SHIFTS[name]
            box.digital_outputs = (box.digital_outputs & ~mask) | (bits & mask)
        elif group == "standard_analog_output" and number in "01":
            if int(values.get("standard_analog_output_mask", 0)) >> int(number) & 1:
                box.analog_outputs[int(number)] = value
        elif name == "speed_slider_fraction" and values.get("speed_slider_mask"):
            box.arm.slider = min(max(value, 0.0), 1.0)
