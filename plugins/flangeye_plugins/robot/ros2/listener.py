"""Pose of an arm from ROS 2: from joint states and the arm's model, or from tf."""

from __future__ import annotations

import time
from collections import deque
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from flangeye.devices import ArmMode, Device, DeviceError, RobotState
from flangeye.errors import StageError
from flangeye.files.processes import busy
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.plugin.stage import Params
from flangeye.types import BASE, FLANGE, Floats, Transform
from flangeye_plugins.robot.tool_check import require_model
from flangeye_plugins.ros2.client import Bridge, GraphMessage
from flangeye_plugins.ros2.graph import Frames
from flangeye_plugins.ros2.messages import Type, decoded, positions_of


class TfParams(Params):
    """Frames of the flange's pose in tf."""

    base: str = "base_link"
    """Frame of the arm's base."""
    flange: str = "tool0"
    """Frame of the flange, origin in its face, z outwards."""


class ListenParams(Params):
    """Source of the arm's pose in ROS 2."""

    joints: tuple[str, ...] = Field(min_length=1)
    """Names of the joints from base to flange, prefix included; the messages may hold others and
    any order."""
    joint_states: str = "/joint_states"
    """Topic of the joint states."""
    tf: TfParams | None = None
    """Take the flange's pose from tf instead of the model's kinematics; needs tf2_msgs, which every
    ROS 2 distribution has."""
    sim_time: bool = False
    """Stamps are simulated time, of the topic /clock."""


class JointSample(NamedTuple):
    """Joint angles (n,) [rad] with the times of measurement and receipt [ns]."""

    joints: Floats
    time_ns: int
    received_ns: int


class Listener(Device):
    """The reading part of an arm under ROS 2; see :class:`flangeye.devices.Robot`.

    Attributes:
        name: Name in messages and reports.
        period: Time between two joint states [s].
        flange_T_tool: None, as joint states contain no tool.
    """

    nothing: ClassVar[str] = "nothing came on it"

    # A sample older than this is no news of the arm [s].
    stale: ClassVar[float] = 0.1

    flange_T_tool: Transform | None = None

    def __init__(self, asker: str, model: RobotModel, params: ListenParams, bridge: Bridge) -> None:
        """Subscribe to the arm's joint states and wait for the first.

        Raises:
            DeviceError: No joint states arrive, or they are not this arm's.
        """
        self.name = f"{model.model} on {params.joint_states}"
        self.arm, self._params, self._bridge = Arm(model), params, bridge
        self._asker, self._model = asker, model
        self._seen = self._kept = 0
        self._samples: deque[JointSample] = deque()
        # What came and was not taken in yet: not more than a moment of a fast driver's
        self._arrived: deque[GraphMessage] = deque(maxlen=32)
        self._heard: set[str] = set()
        self._angles: dict[str, float] = {}
        self._begun_ns = self._followed_since_ns = 0
        if len(params.joints) != self.arm.n:
            raise DeviceError(
                f"{asker}: joints names {len(params.joints)}, but a {model.model} has {self.arm.n}"
            )
        bridge.follow(params.joint_states, Type.JOINT_STATE, take=self._arrived.append)
        self._frames = Frames(bridge) if params.tf else None
        if self._frames and params.tf:
            self._frames.wait_for(params.tf.base, params.tf.flange)
        self.period = self._measured_period()
        require_model(self.name, self.state(), model)

    def state(self) -> RobotState:
        """Return the newest state of the arm."""
        self._take(0.0)
        newest = self._fresh()
        pose = self._flange(newest)
        speeds = self.speeds()
        # No joint turns faster on an arm that stands [rad/s]
        return RobotState(
            base_T_flange=Transform(BASE, FLANGE, pose),
            joints=newest.joints,
            joint_speeds=speeds,
            time_ns=newest.time_ns,
            mode=self._mode(bool(np.abs(speeds).max() > 1e-3)),
        )

    def wait_cycle(self) -> None:
        """Wait for the next joint state."""
        if not self._take(self.stale):
            self._fresh()

    def close(self) -> None:
        """Disconnect from ROS 2."""
        self._bridge.close()

    @property
    def patience(self) -> float:
        """Longest wait for a new joint state [s]; not critical for an arm moved by others."""
        return 0.5

    def speeds(self) -> Floats:
        """Return the joint speeds (n,) over the last 50 ms [rad/s]."""
        first, last = self._samples[0], self._samples[-1]
        seconds = 1e-9 * (last.time_ns - first.time_ns)
        return (last.joints - first.joints) / seconds if seconds > 0 else np.zeros(self.arm.n)

    def _flange(self, sample: JointSample) -> Floats:
        if self._frames and (tf := self._params.tf):
            return self._frames.pose(tf.base, tf.flange)
        return self.arm.flange(sample.joints)

    def _mode(self, moves: bool) -> ArmMode:
        return "moving" if moves else "ready"

    def _measured_period(self) -> float:
        """Return the time between two joint states [s]."""
        # For how long joint states are counted when an arm is opened [s].
        listening = 1.0
        until = self._bridge.until_known() + listening
        while not self._take(listening / 2) and time.monotonic() < until:
            pass
        kept, first = self._kept, self._samples[-1].received_ns if self._samples else 0
        while 0 < self._kept < kept + 10 and time.monotonic() < until:
            self._take(listening / 2)
        if self._kept == kept:
            topic = self._params.joint_states
            raise DeviceError(f"{self._asker}: {topic}: {self._missing() or self.nothing}")
        period = 1e-9 * (self._samples[-1].received_ns - first) / (self._kept - kept)
        # Longest time between joint states with which an arm can be watched [s].
        slowest = 0.05
        if period > slowest:
            raise DeviceError(
                f"{self._asker}: {self._params.joint_states} comes {1 / period:.0f} times a "
                f"second, at least {1 / slowest:.0f} are needed: raise the rate of its publisher"
            )
        return max(period, 1e-3)

    # --- samples

    def _take(self, patience: float) -> bool:
        """Process the messages about this arm; return whether there is a new sample."""
        until, new = time.monotonic() + patience, False
        while not new:
            left = max(until - time.monotonic(), 0.0)
            message = self._bridge.wait(self._params.joint_states, self._seen, left)
            if message is None:
                return False
            self._seen = message.number
            while self._arrived:
                new |= self._keep(self._arrived.popleft())
        return True

    def _keep(self, message: GraphMessage) -> bool:
        """Store a message's joint angles; return whether every joint has a new one.

        The joints may be split over several messages that arrive shortly after each other.
        """
        try:
            told = decoded(message.data, Type.JOINT_STATE, positions_of)
        except StageError as error:
            raise DeviceError(f"{self.name}: {error}") from None
        self._heard.update(told)
        mine = {joint: told[joint] for joint in self._params.joints if joint in told}
        if not self._angles or message.received_ns - self._begun_ns > 1e9 * self.stale:
            self._angles, self._begun_ns = {}, message.received_ns
        self._angles.update(mine)
        if len(self._angles) < self.arm.n:
            return False
        joints = np.array([self._angles[joint] for joint in self._params.joints])
        self._angles = {}
        if not np.isfinite(joints).all():
            raise DeviceError(
                f"{self.name}: a joint's position is not a number: is the arm's hardware active?"
            )
        time_ns = self._bridge.local_ns(self._params.joint_states, message)
        sample = JointSample(joints, time_ns, message.received_ns)
        self._require_forwards(sample)
        if self._samples and sample.time_ns - self._samples[-1].time_ns > 1e9 * self.stale:
            self._followed_since_ns = sample.received_ns
        self._samples.append(sample)
        self._kept += 1
        # Over which speeds are taken [ns]: what some drivers publish as velocity is noise, or empty
        while len(self._samples) > 2 and sample.time_ns - self._samples[1].time_ns > 50_000_000:
            self._samples.popleft()
        return True

    def _require_forwards(self, sample: JointSample) -> None:
        newest = self._samples[-1] if self._samples else sample
        back = 1e-9 * (newest.time_ns - sample.time_ns)
        if back > self.stale:
            self._samples.clear()
            raise DeviceError(
                f"{self.name}: its stamps jumped back by {back:.2f} s: a clock was set, or the "
                "simulation was started again; start the run again"
            )

    def _fresh(self) -> JointSample:
        """Return the newest sample after waiting for it; raise DeviceError if none is recent."""
        if not self._samples:
            raise DeviceError(f"{self.name}: {self._missing() or self.nothing}")
        until = time.monotonic() + self.patience
        while (fault := self._fault(self._samples[-1])) and (left := until - time.monotonic()) > 0:
            self._take(left)
        if fault:
            raise DeviceError(f"{self.name}: {fault}")
        return self._samples[-1]

    def _fault(self, newest: JointSample) -> str:
        """Return why a sample is not a current state of the arm; "" if it is."""
        age = 1e-9 * (time.monotonic_ns() - newest.received_ns)
        if age > self.stale:
            allowed = self.patience or self.stale
            return f"silent for {age:.2f} s, at most {allowed} s are allowed{busy()}"
        off = 1e-9 * (newest.received_ns - newest.time_ns)
        if abs(off) > self.stale:
            when = "before" if off > 0 else "after"
            return (
                f"stamped {abs(off):.2f} s {when} it came, at most {self.stale} s are allowed: set "
                "the clocks of both computers (NTP), or sim_time: true where stamps are of /clock"
            )
        return ""

    def _missing(self) -> str:
        """Return a text that names the joints missing from the received messages."""
        lost = [joint for joint in self._params.joints if joint not in self._heard]
        if not self._heard or not lost:
            return ""
        return f"it has no joint {', '.join(lost)}; it has {', '.join(sorted(self._heard))}"
