"""An emulated AUBO controller (ARCS) for the pyaubo-sdk client library (0.24).

It serves JSON-RPC on port 30004, with the methods that move the arm and read its state. Programs,
inputs and outputs are not emulated. Requests were recorded from the library; answers follow the
maker's interface documentation. Where that is silent, the drivers' README says so.
"""

import json
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from flangeye.models.graph import EmulatorOptions
from flangeye.models.robots import RobotModel
from flangeye.types import Floats
from flangeye.types.pose_formats import CONVENTIONS
from flangeye_emulators.controllers.arm import (
    ControlUnit,
    MotionFault,
    SimulatedArm,
    joint_zeros,
    starting_joints,
)
from flangeye_emulators.controllers.motion import joint_move, linear_move
from flangeye_emulators.controllers.mover import Mover
from flangeye_emulators.controllers.network import Connection, FaultInjector, Network
from flangeye_emulators.controllers.server import Server, run_server

OK = 0
"""Return value of commands: AUBO_OK."""


class AuboController(ControlUnit):
    """An emulated AUBO controller with its arm.

    Attributes:
        robot_mode: ``Running``, or ``PowerOff``.
        safety: ``Normal``, ``ProtectiveStop`` or ``RobotEmergencyStop``.
    """

    def __init__(self, robot: RobotModel, joints: Floats, zeros: Floats) -> None:
        """Start powered on, with the arm at rest at ``joints`` (n,) [rad]."""
        # `RobotConfig.getCycletime` of an i5 [s]
        cycle = 0.005
        # Data sheet of the i5 [rad/s]
        limits = np.resize(np.radians([150.0, 150.0, 150.0, 180.0, 180.0, 180.0]), len(joints))
        super().__init__(SimulatedArm(robot, limits, cycle, joints, zeros), cycle, 0.0)
        self.robot_mode, self.safety = "Running", "Normal"
        self._mover = Mover(self.arm)

    def _advance(self) -> None:
        try:
            self._mover.step()
        except MotionFault as fault:
            self.protective_stop(str(fault))

    # Motion

    def move_joint(self, q: Floats, a: float, v: float) -> int:
        """Append a move to joint angles (n,) [rad]; return 0, or an error code."""
        if not self._can(q, len(self.arm.speeds), a, v):
            return self._refusal()
        self.note("moveJoint")
        self._mover.append(lambda: joint_move(self.arm.stance.joints, q, v, a))
        return OK

    def move_line(self, pose: Floats, a: float, v: float) -> int:
        """Append a linear move of the tool to a pose (6,); return 0, or an error code."""
        if not self._can(pose, 6, a, v):
            return self._refusal()
        self.note("moveLine")
        target = CONVENTIONS["rpy"].matrix(pose)
        self._mover.append(lambda: linear_move(self.arm.stance.base_T_tcp, target, v, a))
        return OK

    def speed_line(self, xd: Floats, a: float, t: float) -> int:
        """Move at a twist (6,) for a time [s], then brake; return 0, or an error code."""
        if not self._can(xd, 6, a, 1.0):
            return self._refusal()
        self._mover.go_on(xd, a, t)
        return OK

    def speed_joint(self, qd: Floats, a: float, t: float) -> int:
        """Move at joint speeds (n,) for a time [s], then brake; return 0, or an error code."""
        if not self._can(qd, len(self.arm.speeds), a, 1.0):
            return self._refusal()
        self._mover.go_on(qd, a, t, in_space=False)
        return OK

    def halt(self, deceleration: float, in_space: bool) -> int:
        """Brake and drop the queued moves."""
        self.note("stop")
        self._mover.halt(deceleration, in_space)
        return OK

    @property
    def exec_id(self) -> int:
        """Number of the move in progress; -1 for none."""
        return self._mover.begun if self._mover.under_way else -1

    @property
    def queue_size(self) -> int:
        """Number of queued moves."""
        return self._mover.waiting

    def _can(self, numbers: Floats, count: int, a: float, v: float) -> bool:
        sound = numbers.shape == (count,) and np.isfinite(numbers).all() and a > 0 and v > 0
        return bool(sound) and not self._refusing

    @property
    def _refusing(self) -> bool:
        return self.robot_mode != "Running" or self.safety != "Normal"

    def _refusal(self) -> int:
        return 1 if self._refusing else 5  # AUBO_BAD_STATE, AUBO_INVL_ARGUMENT

    # Safety and power

    def protective_stop(self, why: str) -> None:
        """Brake, and refuse commands until unlocked."""
        if self.safety == "Normal":
            self.note(f"protective stop: {why}")
            self.safety, self._stopped_at = "ProtectiveStop", self._cycles
        self._mover.halt()

    def unlock(self) -> int:
        """Release a protective stop; return 0, or an error code."""
        if self.safety != "ProtectiveStop" or self.since_stop < self.unlock_after:
            return 1  # AUBO_BAD_STATE
        self.safety = "Normal"
        return OK

    def emergency_stop(self, why: str) -> None:
        """Cut the arm's power, as the emergency stop does."""
        self.note(f"emergency stop: {why}")
        self.safety = "RobotEmergencyStop"
        self.power_off()

    def power_off(self) -> int:
        """Cut the power; the arm brakes."""
        self.robot_mode = "PowerOff"
        self._mover.halt()
        return OK

    def reset(self, joints: Floats) -> None:
        """Return to the state after power-on."""
        self.safety, self.robot_mode = "Normal", "Running"
        self._mover.halt()
        self.arm.set_tool(np.eye(4))
        self.arm.put(joints)

    def modes(self) -> Mapping[str, Any]:
        """Return the controller's modes by name, for the control channel."""
        return {"robot_mode": self.robot_mode, "safety": self.safety}


MARK, _FRAME_HEADER = b"SOF\x01", struct.Struct(">4sI")
"""Header of a frame: the mark, and the length of the content."""


def serve(options: EmulatorOptions) -> None:
    """Run a controller until the process is told to stop.

    Raises:
        StageError: A port is taken, or an option is wrong.
    """
    zeros = joint_zeros(options.robot, options.seed)
    box = AuboController(options.robot, starting_joints(options.robot, options.joints), zeros)
    network = Network(options.host)
    port = 30004
    network.offer(port, lambda: RpcSession(network, box))
    run_server(Server(options, box, network, FaultInjector(box, network), {"JSON-RPC": port}))


class RpcSession(Connection):
    """Connection of one client of the RPC port."""

    def __init__(self, network: Network, box: AuboController) -> None:
        super().__init__(network)
        self._box = box
        self._buffer = b""

    def received(self, data: bytes) -> None:
        """Answer each complete frame."""
        self._buffer += data
        while len(self._buffer) >= _FRAME_HEADER.size:
            mark, length = _FRAME_HEADER.unpack_from(self._buffer)
            # Bytes of a body after which a client is cut off
            if mark != MARK or length > 1 << 20:
                self.abort()
                return
            end = _FRAME_HEADER.size + length
            if len(self._buffer) < end:
                return
            body, self._buffer = self._buffer[_FRAME_HEADER.size : end], self._buffer[end:]
            self.send(frame(answer(self._box, body)))


def frame(body: bytes) -> bytes:
    """Return a message body with its header: marker and length."""
    return _FRAME_HEADER.pack(MARK, len(body)) + body


def answer(box: AuboController, body: bytes) -> bytes:
    """Execute one request and return its answer."""
    if body.startswith(b"__login__"):
        # The client takes any answer.
        return b"OK"
    try:
        request = json.loads(body)
        said = {"id": request["id"], **_outcome(box, request)}
    except (ValueError, KeyError, TypeError):
        said = {"id": None, **_error(-32600, "not a request")}
    return json.dumps({"jsonrpc": "2.0", **said}).encode()


def _outcome(box: AuboController, request: dict[str, Any]) -> dict[str, Any]:
    name = str(request["method"]).removeprefix("rob1.")
    method = RPC_METHODS.get(name)
    if method is None:
        # JSON-RPC 2.0, section 5.1
        return _error(-32601, f"{name} is not simulated")
    try:
        return {"result": method(box, request.get("params", {}))}
    except (KeyError, TypeError, ValueError) as error:
        return _error(-32602, f"{name}: {type(error).__name__}: {error}")


def _error(code: int, message: str) -> dict[str, Any]:
    return {"error": {"code": code, "message": message}}


Method = Callable[[AuboController, Mapping[str, Any]], Any]


def _numbers(values: Any) -> Floats:
    return np.array(values, dtype=np.float64)


def _method(value: Callable[[AuboController], Any]) -> Method:
    return lambda box, params: value(box)


def _flange(box: AuboController) -> Floats:
    return box.arm.chain.flange(box.arm.stance.joints)


def _pose(matrix: Floats) -> list[float]:
    return [float(number) for number in CONVENTIONS["rpy"].numbers(matrix)]


def _set_tool(box: AuboController, params: Mapping[str, Any]) -> int:
    box.arm.set_tool(CONVENTIONS["rpy"].matrix(params["offset"]))
    return OK


RPC_METHODS: dict[str, Method] = {
    "getRobotNames": _method(lambda box: ["rob1"]),
    "getAxisNames": _method(lambda box: []),
    "SystemInfo.getInterfaceVersionCode": _method(lambda box: 24001),
    "SystemInfo.getControlSoftwareFullVersion": _method(lambda box: "0.24.1 (loopback)"),
    "RobotConfig.getCycletime": _method(lambda box: box.cycle),
    "RobotConfig.getDof": _method(lambda box: len(box.arm.speeds)),
    "RobotConfig.getTcpOffset": _method(lambda box: _pose(box.arm.chain.flange_T_tcp)),
    "RobotConfig.setTcpOffset": _set_tool,
    "RobotState.getActualTcpOffset": _method(lambda box: _pose(box.arm.chain.flange_T_tcp)),
    "RobotState.getRobotModeType": _method(lambda box: box.robot_mode),
    "RobotState.getSafetyModeType": _method(lambda box: box.safety),
    "RobotState.isPowerOn": _method(lambda box: box.robot_mode == "Running"),
    "RobotState.isSteady": _method(lambda box: box.arm.standing),
    "RobotState.getJointPositions": _method(lambda box: box.arm.stance.joints.tolist()),
    "RobotState.getJointSpeeds": _method(lambda box: box.arm.speeds.tolist()),
    "RobotState.getTcpPose": _method(lambda box: _pose(box.arm.stance.base_T_tcp)),
    "RobotState.getToolPose": _method(lambda box: _pose(_flange(box))),
    "RobotState.getTcpSpeed": _method(lambda box: box.arm.twist.tolist()),
    "RobotState.getTcpForce": _method(lambda box: box.arm.felt.tolist()),
    "MotionControl.moveJoint": lambda box, p: box.move_joint(_numbers(p["q"]), p["a"], p["v"]),
    "MotionControl.moveLine": lambda box, p: box.move_line(_numbers(p["pose"]), p["a"], p["v"]),
    "MotionControl.speedLine": lambda box, p: box.speed_line(_numbers(p["xd"]), p["a"], p["t"]),
    "MotionControl.speedJoint": lambda box, p: box.speed_joint(_numbers(p["qd"]), p["a"], p["t"]),
    "MotionControl.stopLine": lambda box, p: box.halt(p["acc"], in_space=True),
    "MotionControl.stopJoint": lambda box, p: box.halt(p["acc"], in_space=False),
    "MotionControl.getExecId": _method(lambda box: box.exec_id),
    "MotionControl.getQueueSize": _method(lambda box: box.queue_size),
    "RobotManage.poweroff": _method(AuboController.power_off),
    "RobotManage.setUnlockProtectiveStop": _method(AuboController.unlock),
}
"""Methods by name; those of a robot are without the robot's name in front."""
