"""``robot.franky``: arms of Franka Robotics through franky and libfranka.

Tested with the library as far as possible without a controller: it loads, motions and poses can be
built, and refused and silent connections give errors in time. Moving, reading and stopping were
tested with a mock connection only; see the drivers' README.
"""

from __future__ import annotations

import contextlib
import math
import subprocess
import threading
import time
from typing import Any

import numpy as np

from flangeye.devices import (
    GRACE,
    SILENT,
    ArmMode,
    Device,
    DeviceError,
    Robot,
    RobotState,
    load_sdk,
)
from flangeye.files.processes import python_command
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import part
from flangeye.types import BASE, FLANGE, TOOL, Floats, Transform
from flangeye.types.pose_formats import CONVENTIONS
from flangeye_plugins.robot.tool_check import (
    ControllerParams,
    require_model,
    require_tool,
    twist_at_tool,
    wrench_at_flange,
)

MODES: dict[str, tuple[ArmMode, str]] = {
    "Idle": ("ready", ""),
    "Move": ("moving", ""),
    "Guiding": ("not ready", "the arm is being guided by hand: let go of it"),
    "Reflex": (
        "protective stop",
        "a limit or a collision stopped it: find the cause, recover in Desk",
    ),
    "UserStopped": ("emergency stop", "the stop button is pressed: release it"),
    "AutomaticErrorRecovery": ("not ready", "it recovers from an error"),
    "Other": ("not ready", "joints locked or FCI off: unlock and activate FCI in Desk"),
}
"""libfranka's RobotMode: what it means for motion, and its text."""


def require_answer(name: str, host: str, realtime: bool) -> None:
    """Check that the robot answers: connect once, then disconnect.

    Args:
        name: Name of the robot, for messages.
        host: Address of the controller.
        realtime: Whether to insist on a real-time kernel.

    Raises:
        DeviceError: The robot does not answer, or not in time.
    """
    # In a process that can be killed: where a host is silent, the library never returns
    program = """
import os, sys, franky
realtime = franky.RealtimeConfig.Enforce if sys.argv[2] == "True" else franky.RealtimeConfig.Ignore
try:
    franky.Robot(sys.argv[1], realtime_config=realtime)
except Exception as error:
    print(" ".join(str(error).split()), flush=True)
os._exit(0)
"""
    command = python_command("-c", program, host, str(realtime))
    patience = 2.5  # the library itself waits for ever [s]
    try:
        tried = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
            timeout=patience,
            check=False,
        )
    except subprocess.TimeoutExpired:
        raise cannot_connect(name, f"nothing within {patience:g} s") from None
    if tried.stdout:
        raise cannot_connect(name, tried.stdout)
    if tried.returncode:
        raise cannot_connect(name, f"the library ended with {tried.returncode}")


def cannot_connect(name: str, why: str) -> DeviceError:
    """Return the DeviceError for a failed connection."""
    return DeviceError(
        f"{name}: cannot connect ({one_line(why)}): is FCI active in Desk, is this its address, "
        "is this computer in its network?"
    )


def one_line(text: str) -> str:
    """Return the library's message as one line."""
    return " ".join(text.split())


class FrankyParams(ControllerParams):
    """Parameters of ``robot.franky``."""

    realtime: bool = True
    """Require a real-time kernel; without one, moves may be aborted."""


@part("robot.franky")
def robot_franky(model: RobotModel, params: FrankyParams) -> Robot:
    """An arm of Franka Robotics, through franky.

    Set in Desk: joints unlocked, FCI activated, the end effector and its load. The arm needs a
    dedicated wired network and a real-time kernel on this computer. The model's kinematics are
    compared with the controller's.

    Raises:
        DeviceError: The library is missing, or the arm cannot be driven; the message says what to
            do.
    """
    sdk = load_sdk("franky", "robot.franky", "pip install 'flangeye[franka]'")
    name = f"{model.model} at {params.host}"
    require_answer(name, params.host, params.realtime)
    config = sdk.RealtimeConfig.Enforce if params.realtime else sdk.RealtimeConfig.Ignore
    try:
        connection = sdk.Robot(params.host, realtime_config=config)
    except sdk.Exception as error:
        raise cannot_connect(name, str(error)) from None
    return opened(FrankyRobot(name, sdk, connection), model, params)


def opened(robot: FrankyRobot, model: RobotModel, params: FrankyParams) -> FrankyRobot:
    """Return a connected robot after checking its state.

    Raises:
        DeviceError: Tool or arm differ from the recipe's, or the arm is not ready.
    """
    shown = CONVENTIONS["rpy"].in_units("mm", "deg")
    expected = params.tool.flange_T_tool(shown)
    require_tool(robot.name, "franky", robot.offset, expected, shown)
    state = robot.state()
    require_model(robot.name, state, model)
    if state.message:
        raise DeviceError(f"{robot.name}: {state.message}")
    return robot


class FrankyRobot(Device):
    """An arm of Franka Robotics; see :class:`flangeye.devices.Robot`.

    Attributes:
        offset: (4, 4) ``flange_T_tool`` set in the controller.
    """

    period = 0.001

    def __init__(self, name: str, sdk: Any, connection: Any) -> None:
        """Use an open connection.

        Args:
            name: Name in messages and reports.
            sdk: The module ``franky``.
            connection: The library's ``Robot``.

        Raises:
            DeviceError: The connection is lost.
        """
        self.name, self._sdk, self._robot = name, sdk, connection
        self._stopping: Any = None
        # Reentrant: a stop is commanded while a new motion holds the lock
        self._looked, self._commands = time.monotonic(), threading.RLock()
        self.offset = np.array(self._ask(lambda: connection.state.F_T_EE).matrix)
        self.flange_T_tool: Transform | None = Transform(FLANGE, TOOL, self.offset)
        self._tool_T_flange = np.linalg.inv(self.offset)
        self._closed = False
        threading.Thread(target=self._end_unwatched, daemon=True).start()

    def state(self) -> RobotState:
        """Return the newest state, converted from tool to flange."""
        self._looked = time.monotonic()
        sample = self._ask(lambda: self._robot.state)
        under_way, trouble = self._motion()
        mode, message = MODES[sample.robot_mode.name]
        if trouble:
            mode, message = "protective stop", trouble
        elif mode == "ready" and under_way:
            mode = "moving"
        base_T_tool = np.array(sample.O_T_EE.matrix)
        base_T_flange = base_T_tool @ self._tool_T_flange
        # libfranka reports what the arm does to its surroundings.
        felt = -np.array(sample.O_F_ext_hat_K)
        return RobotState(
            base_T_flange=Transform(BASE, FLANGE, base_T_flange),
            joints=np.array(sample.q),
            joint_speeds=np.array(sample.dq),
            time_ns=time.monotonic_ns(),
            mode=mode,
            force=wrench_at_flange(felt, base_T_flange, base_T_tool),
            message=message,
        )

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Start a move to joint angles (7,) [rad]."""
        sdk, robot = self._sdk, self._robot
        factor = self._factor(
            speed / float(np.max(robot.joint_velocity_limit.get())),
            acceleration / float(np.max(robot.joint_acceleration_limit.get())),
        )
        target = sdk.JointState([float(angle) for angle in joints])
        motion = sdk.JointMotion(target, relative_dynamics_factor=factor)
        self._start(motion, sdk.JointStopMotion)

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Start a linear move of the flange."""
        sdk = self._sdk
        pose = sdk.RobotPose(sdk.Affine(base_T_flange.matrix @ self.offset))
        target = sdk.CartesianState(pose)
        motion = sdk.CartesianMotion(
            target, relative_dynamics_factor=self._linear_factor(speed, acceleration)
        )
        self._start(motion, sdk.CartesianStopMotion)

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Move the flange at a twist (6,); the arm stops if it is not renewed within GRACE."""
        sdk = self._sdk
        base_T_tool = np.array(self._ask(lambda: self._robot.state).O_T_EE.matrix)
        at_tool = twist_at_tool(twist, base_T_tool @ self._tool_T_flange, base_T_tool)
        velocity = sdk.RobotVelocity(sdk.Twist(at_tool[:3], at_tool[3:]))
        motion = sdk.CartesianVelocityMotion(
            velocity,
            duration=sdk.Duration(round(GRACE * 1e3)),
            relative_dynamics_factor=self._linear_factor(float("inf"), acceleration),
        )
        self._start(motion, sdk.CartesianVelocityStopMotion)

    def wait_cycle(self) -> None:
        """Wait for the duration of one controller cycle."""
        time.sleep(self.period - time.monotonic() % self.period)

    def stop(self) -> None:
        """Brake in the space of the present motion, joint or Cartesian."""
        with self._commands:
            if self._stopping is not None and self._motion()[0]:
                stopping = self._stopping
                self._ask(lambda: self._robot.move(stopping(), asynchronous=True))

    def close(self) -> None:
        """Stop the arm; the library disconnects when the object is deleted."""
        if self._closed:
            return
        with self._commands:
            try:
                self.stop()
            finally:
                self._closed, self._robot = True, None

    def _end_unwatched(self) -> None:
        """Stop a motion, once, if its state was not read for SILENT.

        The library drives the arm from a thread of this process. If the whole process hangs, that
        thread does too, and the controller stops by itself after 20 lost cycles.
        """
        while not self._closed:
            time.sleep(0.1 * SILENT)
            with self._commands, contextlib.suppress(DeviceError):
                if not self._closed and time.monotonic() - self._looked > SILENT:
                    self.stop()
                    self._looked = math.inf  # not again until the state is read

    def _start(self, motion: Any, stopping: Any) -> None:
        state = self.state()
        if state.message:
            raise DeviceError(f"{self.name}: {state.message}")
        with self._commands:
            # A motion of another kind is refused by the library while one goes on.
            if self._stopping not in (None, stopping):
                self.stop()
                self._ask(lambda: self._robot.join_motion(timeout=1.0))
            self._stopping = stopping
            self._ask(lambda: self._robot.move(motion, asynchronous=True))

    def _motion(self) -> tuple[bool, str]:
        """Return whether a motion is in progress, and the last one's error ("" if none)."""
        try:
            return bool(self._robot.poll_motion()), ""
        except self._sdk.ControlException as error:
            return False, one_line(str(error))
        except self._sdk.Exception as error:
            raise self._lost(error) from None

    def _linear_factor(self, speed: float, acceleration: float) -> Any:
        robot = self._robot
        return self._factor(
            speed / float(robot.translation_velocity_limit.get()),
            acceleration / float(robot.translation_acceleration_limit.get()),
        )

    def _factor(self, speed: float, acceleration: float) -> Any:
        """Return speed, acceleration and jerk as shares of the arm's limits."""
        # Smallest share of the arm's limits that the library is asked for
        shares = np.clip([speed, acceleration, acceleration], 1e-3, 1.0)
        return self._sdk.RelativeDynamicsFactor(*(float(share) for share in shares))

    def _ask(self, question: Any) -> Any:
        if self._robot is None:
            raise DeviceError(f"{self.name} is closed")
        try:
            return question()
        except self._sdk.Exception as error:
            raise self._lost(error) from None

    def _lost(self, error: Exception) -> DeviceError:
        return DeviceError(
            f"{self.name}: {one_line(str(error))}: look at Desk and the network, then open it again"
        )
