"""RTDE protocol, version 2: big-endian packages of a length, a type letter and a body.

A client negotiates the version and sets up the variables to receive (one output recipe) and to send
(input recipes, numbered from 1). It then starts the stream, and data packages go both ways.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from typing import NamedTuple

from flangeye_emulators.controllers.network import Connection, Network
from flangeye_emulators.controllers.ur.controller import Registers, RobotMode, Runtime, URController

RTDE_TYPES = {
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
"""Names and types of the inputs that a client may write."""

DIGITAL_SHIFTS = {
    "standard_digital_output": 0,
    "configurable_digital_output": 8,
    "tool_digital_output": 16,
}
"""First bit of each group in ``actual_digital_output_bits``."""


class Output(NamedTuple):
    """A variable that a client may read: its type and a function that returns its values."""

    type: str
    values: Callable[[URController], Values]


def _raw_wrench(box: URController) -> Values:
    """Return the contact wrench at the flange in flange axes, without tare."""
    tool, base_T_tcp = box.arm.chain.flange_T_tcp, box.arm.stance.base_T_tcp
    fx, fy, fz = tool[:3, :3] @ base_T_tcp[:3, :3].T @ box.arm.felt[:3]
    x, y, z = tool[:3, 3]
    return [fx, fy, fz, y * fz - z * fy, z * fx - x * fz, x * fy - y * fx]


def _robot_status(box: URController) -> Values:
    """Return the robot status bits: 0 power on, 1 program running."""
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


_ZEROS = Output("VECTOR6D", _nothing(6))

OUTPUTS: dict[str, Output] = {
    "timestamp": Output("DOUBLE", lambda box: (box.time,)),
    "target_qdd": _ZEROS,
    "target_current": _ZEROS,
    "target_moment": _ZEROS,
    "actual_q": Output("VECTOR6D", lambda box: box.arm.stance.joints.tolist()),
    "actual_qd": Output("VECTOR6D", lambda box: box.arm.speeds.tolist()),
    "actual_current": _ZEROS,
    "actual_current_as_torque": _ZEROS,
    "joint_control_output": _ZEROS,
    "actual_TCP_pose": Output("VECTOR6D", lambda box: box.tcp_pose().tolist()),
    "actual_TCP_speed": Output("VECTOR6D", lambda box: box.arm.twist.tolist()),
    "actual_TCP_force": Output("VECTOR6D", lambda box: box.arm.felt.tolist()),
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
    "target_speed_fraction": Output("DOUBLE", _ambient(1.0)),
    "actual_momentum": Output("DOUBLE", _nothing(1)),
    "actual_main_voltage": Output("DOUBLE", _ambient(48.0)),
    "actual_robot_voltage": Output("DOUBLE", _ambient(48.0)),
    "actual_robot_current": Output("DOUBLE", _nothing(1)),
    "actual_joint_voltage": Output("VECTOR6D", lambda box: (48.0,) * 6),
    "runtime_state": Output("UINT32", lambda box: (box.runtime,)),
    "standard_analog_input0": Output("DOUBLE", _nothing(1)),
    "standard_analog_input1": Output("DOUBLE", _nothing(1)),
    "standard_analog_output0": Output("DOUBLE", _nothing(1)),
    "standard_analog_output1": Output("DOUBLE", _nothing(1)),
    "robot_status_bits": Output("UINT32", _robot_status),
    "safety_status_bits": Output("UINT32", lambda box: (box.safety.status_bits,)),
    "payload": Output("DOUBLE", _nothing(1)),
    "payload_cog": Output("VECTOR3D", _nothing(3)),
    "payload_inertia": _ZEROS,
    "output_bit_registers0_to_31": Output("UINT32", lambda box: (0,)),
    "output_bit_registers32_to_63": Output("UINT32", lambda box: (0,)),
    **{f"output_int_register_{i}": _integer_output(i) for i in range(Registers.COUNT)},
    **{f"output_double_register_{i}": _double_output(i) for i in range(Registers.COUNT)},
}
"""Outputs that a client may read."""
# The arm goes exactly where it was told to.
for _name in ("q", "qd", "TCP_pose", "TCP_speed"):
    OUTPUTS[f"target_{_name}"] = OUTPUTS[f"actual_{_name}"]


def write_inputs(box: URController, values: dict[str, float]) -> None:
    """Apply one input package: registers and digital outputs; no other inputs are emulated."""
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


RTDE_PORT = 30004

_HEADER = struct.Struct(">HB")


class RtdePort:
    """The RTDE port of a controller, with its sessions and their claimed inputs."""

    def __init__(self, network: Network, box: URController) -> None:
        self._network = network
        self.box = box
        self.sessions: set[RtdeSession] = set()
        network.offer(RTDE_PORT, lambda: RtdeSession(network, self))

    def publish(self, cycle: int) -> None:
        """Send this control cycle's data package to every session."""
        for session in self.sessions:
            session.publish(cycle)

    def claim(self, names: list[str], session: RtdeSession) -> list[str]:
        """Claim inputs for a session; return those already claimed by another session."""
        taken = [
            name
            for name in names
            if any(name in other.inputs for other in self.sessions if other is not session)
        ]
        if not taken:
            session.inputs.update(names)
        return taken


class RtdeSession(Connection):
    """Connection of one RTDE client.

    Attributes:
        inputs: Names of the variables that the client writes.
    """

    def __init__(self, network: Network, port: RtdePort) -> None:
        super().__init__(network)
        self._port = port
        self.inputs: set[str] = set()
        self._buffer = b""
        self._recipes: dict[int, InputRecipe] = {}
        self._output: OutputRecipe | None = None
        self._every = 1
        self._started = False

    def opened(self) -> None:
        """Register the session at the port."""
        self._port.sessions.add(self)

    def closed(self) -> None:
        """Release the session's inputs."""
        self._started = False
        self._port.sessions.discard(self)

    def received(self, data: bytes) -> None:
        """Handle each complete package."""
        self._buffer += data
        while len(self._buffer) >= _HEADER.size:
            size, kind = _HEADER.unpack_from(self._buffer)
            if size < _HEADER.size:
                self.abort()
                return
            if len(self._buffer) < size:
                return
            body, self._buffer = self._buffer[_HEADER.size : size], self._buffer[size:]
            act = ACTIONS.get(chr(kind))
            if act is not None:
                act(self, body)

    def publish(self, cycle: int) -> None:
        """Send a data package if the stream runs and one is due."""
        if self._started and self._output is not None and cycle % self._every == 0:
            self.stream(_package("U", self._output.pack(self._port.box)))

    def _answer(self, kind: str, body: bytes) -> None:
        self.send(_package(kind, body))

    def _negotiate(self, body: bytes) -> None:
        (version,) = struct.unpack(">H", body[:2].rjust(2, b"\0"))
        self._answer("V", bytes([version == 2]))

    def _tell_version(self, _: bytes) -> None:
        self._answer("v", struct.pack(">4I", *self._port.box.box.version))

    def _set_outputs(self, body: bytes) -> None:
        (frequency,) = struct.unpack(">d", body[:8].ljust(8, b"\0"))
        recipe = OutputRecipe(_names(body[8:]))
        rate = self._port.box.box.rate
        self._every = max(1, round(rate / frequency)) if 0 < frequency <= rate else 1
        self._output = recipe if recipe.valid else None
        self._answer("O", bytes([recipe.valid]) + ",".join(recipe.types).encode())

    def _set_inputs(self, body: bytes) -> None:
        recipe = InputRecipe(_names(body))
        taken = self._port.claim(recipe.names, self) if recipe.valid else []
        types = [
            "IN_USE" if name in taken else type_
            for name, type_ in zip(recipe.names, recipe.types, strict=True)
        ]
        number = 0
        if recipe.valid and not taken:
            number = len(self._recipes) + 1
            self._recipes[number] = recipe
        self._answer("I", bytes([number]) + ",".join(types).encode())

    def _start(self, _: bytes) -> None:
        self._started = self._output is not None
        self._answer("S", bytes([self._started]))

    def _pause(self, _: bytes) -> None:
        self._started = False
        self._answer("P", b"\1")

    def _take_data(self, body: bytes) -> None:
        recipe = self._recipes.get(body[0]) if body else None
        if recipe is not None:
            recipe.apply(body[1:], self._port.box)


ACTIONS: dict[str, Callable[[RtdeSession, bytes], None]] = {
    "V": RtdeSession._negotiate,
    "v": RtdeSession._tell_version,
    "O": RtdeSession._set_outputs,
    "I": RtdeSession._set_inputs,
    "S": RtdeSession._start,
    "P": RtdeSession._pause,
    "U": RtdeSession._take_data,
}


def _package(kind: str, body: bytes) -> bytes:
    return _HEADER.pack(_HEADER.size + len(body), ord(kind)) + body


def _names(body: bytes) -> list[str]:
    return [name.strip() for name in body.decode("ascii", "replace").split(",") if name.strip()]


class OutputRecipe:
    """The variables that are sent to a client in each data package.

    Attributes:
        types: Type of each variable; ``NOT_FOUND`` for an unknown name.
        valid: Whether all names are known.
    """

    def __init__(self, names: Sequence[str]) -> None:
        """Look up the recipe's variables."""
        self.types = [OUTPUTS[name].type if name in OUTPUTS else "NOT_FOUND" for name in names]
        self.valid = "NOT_FOUND" not in self.types
        if self.valid:
            self._values = [OUTPUTS[name].values for name in names]
            self._packing = struct.Struct(">B" + "".join(RTDE_TYPES[t] for t in self.types))

    def pack(self, box: URController) -> bytes:
        """Return the body of one data package."""
        values: list[float] = [1]  # the one recipe's id
        for values_of in self._values:
            values.extend(values_of(box))
        return self._packing.pack(*values)


class InputRecipe:
    """The variables that a client sends in one data package.

    Attributes:
        names: Names of the variables.
        types: Type of each variable; ``NOT_FOUND`` for an unknown name.
        valid: Whether all names are known.
    """

    def __init__(self, names: Sequence[str]) -> None:
        """Look up the recipe's variables."""
        self.names = list(names)
        self.types = [INPUTS.get(name, "NOT_FOUND") for name in names]
        self.valid = "NOT_FOUND" not in self.types
        if self.valid:
            self._packing = struct.Struct(">" + "".join(RTDE_TYPES[t] for t in self.types))
            # A vector has no effect on this controller: its first number stands for it.
            self._places = []
            place = 0
            for type_ in self.types:
                self._places.append(place)
                layout = struct.Struct(f">{RTDE_TYPES[type_]}")
                place += len(layout.unpack(bytes(layout.size)))

    def apply(self, body: bytes, box: URController) -> None:
        """Apply a data package; one that is too short is dropped.

        ur_rtde sends packages longer than their recipe; the excess is ignored.
        """
        if len(body) >= self._packing.size:
            values = self._packing.unpack_from(body)
            write_inputs(box, dict(zip(self.names, (values[i] for i in self._places), strict=True)))
