"""The control box: power, safety, the running program and the arm, advanced cycle by cycle."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.models.robots import RobotModel
from flangeye.types import Floats
from flangeye_emulators.controllers.arm import ControlUnit, MotionFault, SimulatedArm
from flangeye_emulators.controllers.poses import pose_vector

SPEEDS = {"ur3": (180,) * 3 + (360,) * 3, "ur5": (180,) * 6, "ur10": (120,) * 2 + (180,) * 4}
"""Largest joint speeds [deg/s] by size of arm: data sheets (UR3e 180 and 360 deg/s, UR5e 180 deg/s,
UR10e 120 and 180 deg/s; the CB3 arms alike)."""


class RefusedError(Exception):
    """The controller refuses a command; the message is the dashboard's answer."""


class URController(ControlUnit):
    """An emulated control box with its arm.

    Attributes:
        robot: Model of the arm.
        box: Generation of the control box.
        registers: The general-purpose registers.
        robot_mode: State of power and brakes.
        safety: Active safety stop, if any.
        runtime: State of the program.
        remote_control: Whether programs are accepted from the network.
        digital_outputs: Bit mask of outputs: standard 0-7, configurable 8-15, tool 16-17.
        wired: Whether each standard input follows the output of the same number, like the feedback
            of a device that the output switches.
    """

    def __init__(self, robot: RobotModel, joints: Floats, zeros: Floats) -> None:
        """Start powered on, with the arm at rest at ``joints`` (6,) [rad]."""
        self.robot, self.box = robot, control_box_of(robot)
        arm = SimulatedArm(robot, joint_speeds_of(robot), self.box.cycle, joints, zeros)
        # A protective stop cannot be unlocked earlier [s]: the dashboard server's manual
        super().__init__(arm, self.box.cycle, unlock_after=5.0)
        self.registers = Registers()
        self.robot_mode, self.safety = RobotMode.RUNNING, SafetyMode.NORMAL
        self.runtime = Runtime.STOPPED
        self.remote_control = True
        self.digital_outputs, self.wired = 0, True
        self._program: Callable[[], bool] | None = None
        self._program_began = 0
        self._watchdog: tuple[int, float] | None = None
        self._input_times = [0.0] * Registers.COUNT
        self._posed, self._pose = self.arm.stance, pose_vector(self.arm.stance.base_T_tcp)

    @property
    def program_time(self) -> float:
        """Running time of the present program [s]."""
        if self._program is None:
            return 0.0
        return (self._cycles - self._program_began) * self.box.cycle

    def _advance(self) -> None:
        self._check_watchdog()
        self._run_program()
        try:
            self.arm.step()
        except MotionFault as fault:
            self.protective_stop(str(fault))

    def _run_program(self) -> None:
        running = self._program if self.runtime is Runtime.PLAYING else None
        if running is not None and not running():
            self.stop_program("the program ended")

    def _check_watchdog(self) -> None:
        if self._watchdog is None or self.runtime is not Runtime.PLAYING:
            return
        register, longest = self._watchdog
        if self.time - self._input_times[register] > longest:
            self.stop_program(f"watchdog: input_int_register_{register} was not renewed")

    def set_watchdog(self, register: int, frequency: float) -> None:
        """Stop the program if a register is renewed less often than this [Hz]; 0 disables it."""
        self._watchdog = (register, 1.0 / frequency) if frequency > 0 else None
        self._input_times[register] = self.time

    def set_input_int(self, register: int, value: int) -> None:
        """Write an integer input register on behalf of a client."""
        self.registers.input_int[register] = value
        self._input_times[register] = self.time

    # Programs

    def load(self, program: Callable[[], bool], name: str) -> None:
        """Replace the present program.

        Raises:
            RefusedError: The power is off, a stop is active, or the control is local.
        """
        self._require_ready()
        self.note(f"program {name}")
        self._program = program
        self._program_began, self._watchdog = self._cycles, None
        self.runtime, self.arm.held = Runtime.PLAYING, False

    def stop_program(self, why: str) -> None:
        """End the program and brake the arm."""
        if self._program is not None:
            self.note(f"program stopped: {why}")
        self._program, self._watchdog = None, None
        self.runtime = Runtime.STOPPED
        self.arm.held = self.safety is not SafetyMode.NORMAL

    def _require_ready(self) -> None:
        if not self.remote_control:
            raise RefusedError("the robot is in local control")
        if self.safety is not SafetyMode.NORMAL:
            raise RefusedError(f"safety mode {self.safety.name}")
        if self.robot_mode is not RobotMode.RUNNING:
            raise RefusedError(f"robot mode {self.robot_mode.name}")

    # Safety and power

    def protective_stop(self, why: str) -> None:
        """Stop the arm on its path, or by its brakes off it, and pause the program."""
        if self.safety is not SafetyMode.NORMAL:
            return
        self.note(f"protective stop: {why}")
        self.safety, self._stopped_at = SafetyMode.PROTECTIVE_STOP, self._cycles
        self.arm.held = True
        if self.runtime is Runtime.PLAYING:
            self.runtime = Runtime.PAUSED

    def unlock(self) -> None:
        """Release a protective stop; the program stays paused.

        Raises:
            RefusedError: The stop was too recent to be unlocked.
        """
        if self.safety is not SafetyMode.PROTECTIVE_STOP:
            return
        if self.since_stop < self.unlock_after:
            raise RefusedError(
                f"Cannot unlock protective stop until {self.unlock_after:g}s after occurrence. "
                "Always inspect cause of protective stop before unlocking"
            )
        self.safety = SafetyMode.NORMAL
        self.arm.held = self.runtime is Runtime.PAUSED
        self.note("protective stop unlocked")

    def emergency_stop(self, why: str) -> None:
        """Switch the power off and end the program."""
        self.note(f"emergency stop: {why}")
        self.safety = SafetyMode.ROBOT_EMERGENCY_STOP
        self.power_off()

    def release_emergency_stop(self) -> None:
        """Release the emergency-stop button; the power stays off."""
        if self.safety is SafetyMode.ROBOT_EMERGENCY_STOP:
            self.safety = SafetyMode.NORMAL

    def power_off(self) -> None:
        """End the program and switch the power off."""
        self.stop_program("power off")
        self.robot_mode = RobotMode.POWER_OFF

    def power_on(self) -> None:
        """Switch the power on; the brakes stay on."""
        if self.safety is SafetyMode.NORMAL and self.robot_mode is RobotMode.POWER_OFF:
            self.robot_mode = RobotMode.IDLE

    def release_brakes(self) -> None:
        """Release the brakes; the arm is ready to move."""
        if self.safety is SafetyMode.NORMAL:
            self.robot_mode = RobotMode.RUNNING
            self.arm.held = self.runtime is Runtime.PAUSED

    def reset(self, joints: Floats) -> None:
        """Return to the initial state: no program, no stop, power on, remote control."""
        self.safety, self.robot_mode = SafetyMode.NORMAL, RobotMode.RUNNING
        self.remote_control = True
        self.stop_program("reset")
        self.arm.put(joints)

    def modes(self) -> Mapping[str, Any]:
        """Return the controller's modes by name, for the control channel."""
        return {
            "robot_mode": self.robot_mode.name,
            "safety": self.safety.name,
            "runtime": self.runtime.name,
            "remote_control": self.remote_control,
            "digital_outputs": self.digital_outputs,
        }

    def tcp_pose(self) -> Floats:
        """Return the tool's pose (6,) in base, as shown on the teach pendant."""
        if self._posed is not self.arm.stance:
            self._posed, self._pose = self.arm.stance, pose_vector(self.arm.stance.base_T_tcp)
        return self._pose


@dataclass(frozen=True)
class ControlBox:
    """A generation of control boxes.

    Attributes:
        version: Reported software version: major, minor, bugfix, build.
        rate: Control cycles and data packages per second [Hz].
    """

    version: tuple[int, int, int, int]
    rate: int

    @property
    def cycle(self) -> float:
        """Length of one control cycle [s]."""
        return 1.0 / self.rate


def control_box_of(robot: RobotModel) -> ControlBox:
    """Return the control box of an arm: e-Series if the model's name ends in ``e``."""
    if robot.model.endswith("e"):
        return ControlBox((5, 21, 3, 1), 500)
    return ControlBox((3, 15, 8, 1), 125)


def joint_speeds_of(robot: RobotModel) -> NDArray[np.float64]:
    """Return the largest joint speeds (6,) [rad/s]; an unknown arm has those of a UR5."""
    return np.radians(SPEEDS.get(robot.model.rstrip("e"), SPEEDS["ur5"]))


class RobotMode(IntEnum):
    """Values of RTDE's ``robot_mode``."""

    POWER_OFF = 3
    IDLE = 5
    RUNNING = 7


class SafetyMode(IntEnum):
    """Values of RTDE's ``safety_mode``."""

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
    """Values of RTDE's ``runtime_state``."""

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
