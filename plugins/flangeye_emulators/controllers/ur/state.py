"""The modes a controller can be in, with the numbers RTDE and the words the dashboard give them."""

from __future__ import annotations

from enum import IntEnum


class RobotMode(IntEnum):
    """RTDE ``robot_mode``."""

    POWER_OFF = 3
    IDLE = 5
    RUNNING = 7


class SafetyMode(IntEnum):
    """RTDE ``safety_mode``."""

    NORMAL = 1
    PROTECTIVE_STOP = 3
    ROBOT_EMERGENCY_STOP = 7

    @property
    def status_bits(self) -> int:
        """RTDE ``safety_status_bits``: 0 normal, 2 protective, 6 and 7 emergency, 10 stopped."""
        bits = {
            SafetyMode.NORMAL: (0,),
            SafetyMode.PROTECTIVE_STOP: (2, 10),
            SafetyMode.ROBOT_EMERGENCY_STOP: (6, 7, 10),
        }
        return sum(1 << bit for bit in bits[self])


class Runtime(IntEnum):
    """RTDE ``runtime_state``."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class Registers:
    """The general-purpose registers: clients write the inputs, programs the outputs.

    Attributes:
        input_int: 48 integers.
        input_double: 48 floats.
        output_int: 48 integers.
        output_double: 48 floats.
    """

    COUNT = 48

    def __init__(self) -> None:
        self.input_int = [0] * self.COUNT
        self.input_double = [0.0] * self.COUNT
        self.output_int = [0] * self.COUNT
        self.output_double = [0.0] * self.COUNT
