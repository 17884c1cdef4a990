"""``robot.aubo``: arms of AUBO with an ARCS controller, through the maker's library."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from flangeye.devices import GRACE, ArmMode, Device, DeviceError, Robot, RobotState, load_sdk
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import part
from flangeye.types import BASE, FLANGE, TOOL, Floats, Transform
from flangeye.types.geometry import rotation_log
from flangeye.types.pose_formats import CONVENTIONS
from flangeye_plugins.robot.aubo.client import STANDSTILL, AuboClient, VelocityMove
from flangeye_plugins.robot.tool_check import (
    ControllerParams,
    require_model,
    require_tool,
    twist_at_tool,
    wrench_at_flange,
)

POSE = CONVENTIONS["rpy"]
"""The interface's poses: (x, y, z, rx, ry, rz) [m, rad], turned about fixed axes."""


SAFETY: dict[str, tuple[ArmMode, str]] = {
    "Recovery": ("not ready", "the arm is outside its safety limits: move it back"),
    "Violation": ("not ready", "safety violation: look at the pendant"),
    "ProtectiveStop": (
        "protective stop",
        "protective stop: find the cause, then release it at the pendant",
    ),
    "SafeguardStop": ("protective stop", "safeguard stop: somebody is in the cell"),
    "SystemEmergencyStop": ("emergency stop", "emergency stop of the system: release it"),
    "RobotEmergencyStop": ("emergency stop", "emergency stop: release the button"),
    "Fault": ("not ready", "safety fault: restart the controller"),
    "Undefined": ("not ready", "the safety system does not answer"),
}
"""SafetyModeType: what it means for motion, and its text."""


class AuboParams(ControllerParams):
    """Parameters of ``robot.aubo``."""

    user: str = "aubo"
    """Account on the controller."""
    password: str = "123456"
    """Password of that account; the default is the factory's."""


@part("robot.aubo")
def robot_aubo(model: RobotModel, params: AuboParams, reads_only: bool = False) -> Robot:
    """An arm of AUBO with an ARCS controller, through its JSON-RPC interface.

    Set on the pendant: power on, brakes released, the mounted payload, no program running. The
    controller has no watchdog for this interface. Every motion is therefore commanded in pieces
    that expire after 0.1 s, and each reading of the arm's state commands the next one.

    Args:
        model: The arm; its kinematics are compared with what the controller reports.
        params: See :class:`AuboParams`.
        reads_only: Only read the state; closing does not stop the arm, which may be in any mode.

    Raises:
        DeviceError: The library is missing, or the arm cannot be driven; the message says what to
            do.
    """
    sdk = load_sdk("pyaubo_sdk", "robot.aubo", "pip install 'flangeye[aubo]'")
    name = f"{model.model} at {params.host}"
    client = AuboClient(sdk, name, params.host, params.user, params.password)
    try:
        robot = AuboRobot(name, client, reads_only)
        require_tool(
            name, "aubo", robot.offset, params.tool.flange_T_tool(POSE), POSE.in_units("mm", "deg")
        )
        state = robot.state()
        require_model(name, state, model)
        if state.message and not reads_only:
            raise DeviceError(f"{name}: {state.message}")
    except DeviceError:
        client.close()
        raise
    return robot


class AuboRobot(Device):
    """An arm of AUBO; see :class:`flangeye.devices.Robot`.

    A state is read by several queries, which take 1 ms together. An arm at 0.1 m/s moves 0.1 mm in
    that time; an arm at rest is read exactly.

    Attributes:
        offset: (4, 4) ``flange_T_tool`` set in the controller.
    """

    def __init__(self, name: str, client: AuboClient, reads_only: bool = False) -> None:
        """Read tool offset and cycle time of a connected controller.

        Raises:
            DeviceError: The controller does not answer.
        """
        self.name, self._client, self._reads_only = name, client, reads_only
        self.period = float(client.ask("cycle time", client.config.getCycletime))
        self.offset = POSE.matrix(client.ask("tool", client.state.getActualTcpOffset))
        self.flange_T_tool: Transform | None = Transform(FLANGE, TOOL, self.offset)
        self._tool_T_flange = np.linalg.inv(self.offset)
        self._begins = self._velocity_until = -np.inf
        self._ride: VelocityMove | None = None
        self._rest = _in_joints(np.zeros(0))
        self._in_joints = False
        self._closed = False

    def state(self) -> RobotState:
        """Return the arm's state, and continue a move in progress.

        The state is read again if the queries took too long on a busy computer.
        """
        state, took = self._read()
        # Reading the arm takes a millisecond; where it takes longer than this [s], the
        # network is lost
        stale = 0.1
        if took > stale:
            state, took = self._read()
        if took > stale:
            raise DeviceError(
                f"{self.name}: reading it took {took:.2f} s, at most {stale} s are allowed: the "
                "network is slow"
            )
        if self._ride is None:
            return state
        try:
            self._go_on(self._ride, state)
        except DeviceError:
            # The arm may have stopped after it was read: that is its state then, not an error.
            self._ride = None
            state, _ = self._read()
            if not state.message:
                raise
        return state

    def _read(self) -> tuple[RobotState, float]:
        """Return the arm's state, and the time it took to read [s]."""
        began = time.monotonic_ns()
        tell = self._client.state
        # The mode is read before the pose: an arm that is reported to stand stood at that pose.
        speeds = np.array(self._ask("joint speeds", tell.getJointSpeeds))
        mode, message = self._condition(speeds)
        joints, pose, force = (
            np.array(self._ask(what, question))
            for what, question in (
                ("joints", tell.getJointPositions),
                ("pose", tell.getTcpPose),
                ("force", tell.getTcpForce),
            )
        )
        ended = time.monotonic_ns()
        base_T_tool = POSE.matrix(pose)
        base_T_flange = base_T_tool @ self._tool_T_flange
        state = RobotState(
            base_T_flange=Transform(BASE, FLANGE, base_T_flange),
            joints=joints,
            joint_speeds=speeds,
            # The pose was asked for about half way
            time_ns=(began + ended) // 2,
            mode=mode,
            force=wrench_at_flange(force, base_T_flange, base_T_tool),
            message=message,
        )
        return state, 1e-9 * (ended - began)

    def move_joints(self, joints: Floats, speed: float, acceleration: float) -> None:
        """Start a move to joint angles (n,) [rad]; a moving arm is stopped first."""
        target = [float(angle) for angle in joints]
        motion = self._client.motion
        self._begin(in_joints=True)
        self._rest = _in_joints(np.asarray(joints))
        self._ride_to(target, motion.speedJoint, motion.moveJoint, speed, acceleration)

    def move_linear(self, base_T_flange: Transform, speed: float, acceleration: float) -> None:
        """Start a linear move of the flange; a moving arm is stopped first."""
        base_T_goal = base_T_flange.matrix @ self.offset
        target = POSE.numbers(base_T_goal).tolist()
        motion = self._client.motion
        self._begin(in_joints=False)
        self._rest = self._in_space(base_T_goal)
        self._ride_to(target, motion.speedLine, motion.moveLine, speed, acceleration)

    def _ride_to(
        self, target: list[float], go: Any, end: Any, speed: float, acceleration: float
    ) -> None:
        """Start a move by speed commands that ends with the controller's own move, in one space."""
        self._ride = VelocityMove(
            speed, acceleration,
            lambda speeds: self._client.command(
                "speed", lambda: go(speeds.tolist(), acceleration, GRACE)
            ),
            self._brake,
            lambda: self._arrive(lambda: end(target, acceleration, speed, 0.0, 0.0)),
        )  # fmt: skip

    def move_velocity(self, twist: Floats, acceleration: float) -> None:
        """Move the flange at a twist (6,); the arm stops if it is not renewed within GRACE."""
        base_T_tool = POSE.matrix(self._ask("pose", self._client.state.getTcpPose))
        self._require_able()
        at_tool = twist_at_tool(twist, base_T_tool @ self._tool_T_flange, base_T_tool)
        go = self._client.motion.speedLine
        self._in_joints, self._ride = False, None
        self._client.command("velocity", lambda: go(at_tool, acceleration, GRACE))
        self._velocity_until = time.monotonic() + GRACE

    def wait_cycle(self) -> None:
        """Wait for one controller cycle; the controller sends no events of its own."""
        # To the next multiple of the period: sleeping for a whole one would drift
        time.sleep(self.period - time.monotonic() % self.period)

    def stop(self) -> None:
        """Brake in the space of the present motion, joint or Cartesian."""
        self._begins = self._velocity_until = -np.inf
        self._ride = None
        self._brake()

    def _brake(self) -> None:
        motion = self._client.motion
        stop = 4.0  # deceleration [m/s^2, rad/s^2]
        if self._in_joints:
            self._client.command("stop", lambda: motion.stopJoint(stop))
        else:
            self._client.command("stop", lambda: motion.stopLine(stop, stop))

    def close(self) -> None:
        """Stop the arm and disconnect."""
        if self._closed:
            return
        if not self._reads_only:
            with contextlib.suppress(DeviceError):
                self.stop()
        self._closed = True
        self._client.close()

    def _ask(self, what: str, question: Any) -> Any:
        if self._closed:
            raise DeviceError(f"{self.name} is closed")
        return self._client.ask(what, question)

    def _begin(self, in_joints: bool) -> None:
        """Brake a moving arm, and prepare for the next move."""
        self._require_able()
        self.stop()
        self._in_joints = in_joints

    def _go_on(self, ride: VelocityMove, state: RobotState) -> None:
        """Command the next piece of a move, unless it is over or a stop is active."""
        if state.message or ride.over:
            self._ride = None
            return
        rest, left = self._rest(state)
        ride.renew(rest, left, float(np.abs(state.joint_speeds).max()))

    def _arrive(self, move: Callable[[], int]) -> None:
        """Command the controller's own move over the remaining distance."""
        # A move that has not begun after this has ended already [s]
        self._begins = time.monotonic() + 0.3
        self._client.command("move", move)

    def _in_space(self, base_T_goal: Floats) -> Callable[[RobotState], tuple[Floats, float]]:
        def rest(state: RobotState) -> tuple[Floats, float]:
            base_T_tool = state.base_T_flange.matrix @ self.offset
            turn = rotation_log(base_T_goal[:3, :3] @ base_T_tool[:3, :3].T)
            way = base_T_goal[:3, 3] - base_T_tool[:3, 3]
            return np.concatenate([way, turn]), float(
                max(np.linalg.norm(way), np.linalg.norm(turn))
            )

        return rest

    def _require_able(self) -> None:
        """Raise DeviceError if the arm cannot move."""
        _, message = self._condition(np.zeros(1))
        if message:
            raise DeviceError(f"{self.name}: {message}")

    def _condition(self, speeds: Floats) -> tuple[ArmMode, str]:
        """Return the mode, and a message with the remedy."""
        tell = self._client.state
        safety = self._ask("safety mode", tell.getSafetyModeType).name
        if safety in SAFETY:
            return SAFETY[safety]
        power = self._ask("robot mode", tell.getRobotModeType).name
        if power != "Running":
            return "not ready", f"the arm is in mode {power}: switch it on at the pendant"
        moves = self._under_way() or bool(np.abs(speeds).max() > STANDSTILL)
        return ("moving" if moves else "ready"), ""

    def _under_way(self) -> bool:
        """Return whether a command is in progress or queued."""
        motion = self._client.motion
        if self._ride is not None and not self._ride.over:
            return True
        if self._ask("move", motion.getExecId) != -1:
            self._begins = -np.inf
            return True
        now = time.monotonic()
        # Between a command and its execution the controller reports neither: the time decides then
        waits = self._ask("queue", motion.getQueueSize) > 0
        return bool(waits or now < self._begins or now < self._velocity_until)


def _in_joints(goal: Floats) -> Callable[[RobotState], tuple[Floats, float]]:
    """Return a function from joint angles to the remaining path (n,), and its length [rad]."""

    def rest(state: RobotState) -> tuple[Floats, float]:
        way = goal - state.joints
        return way, float(np.abs(way).max())

    return rest
