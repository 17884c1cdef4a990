"""The ROS 2 graph: find arm and camera for a recipe, and publish a calibrated pose."""

from __future__ import annotations

import os
import re
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from flangeye.devices import Device, DeviceError
from flangeye.errors import StageError
from flangeye.files.regular import read_text
from flangeye.maths.kinematics import Arm
from flangeye.models.graph import Ask, Running, RunningCell, Topic
from flangeye.models.scanners import ScannerData, detect_unit, median_distance
from flangeye.models.urdf import LINKS_NAMED, URDF_BYTES, UrdfArm, arm_of, flange_links, parse_urdf
from flangeye.types import CAMERA, CalibratedPose, Floats, PointCloud
from flangeye.types.geometry import (
    invert,
    quaternion_from_rotation,
    rigid,
    rotation_from_quaternion,
)
from flangeye_plugins.ros2.client import MATCHING, Bridge, GraphMessage
from flangeye_plugins.ros2.messages import (
    DEPTH_UNITS,
    Type,
    cloud_of,
    decoded,
    encoded,
    frame_of,
    message,
    pixels_of,
    positions_of,
)


class StampedFrame(NamedTuple):
    """A tf frame: its parent, its pose in the parent (4, 4), and its time (None if static)."""

    parent: str
    pose: Floats
    received_ns: int | None


class Frames:
    """The tf frames of a graph, updated as transforms arrive.

    Attributes:
        frames: Frames by name.
    """

    def __init__(self, bridge: Bridge, moving: bool = True) -> None:
        """Subscribe to tf_static, if it is published, and to tf for moving frames.

        Raises:
            DeviceError: tf is needed but not published, or this ROS 2 has no tf2_msgs.
        """
        self.frames: dict[str, StampedFrame] = {}
        self._asker, self._bridge = bridge.asker, bridge
        bridge.wait_until_known()  # those that stand may be found after those that move
        if moving:
            bridge.follow("/tf", Type.TF, take=self._moving)
        if "/tf_static" in bridge.topics():
            bridge.follow("/tf_static", Type.TF, take=self._standing)

    def root(self, name: str) -> str:
        """Return the root frame of a frame's tree."""
        while name in self.frames:
            name = self.frames[name].parent
        return name

    def pose(self, parent: str, child: str) -> Floats:
        """Return ``parent_T_child`` (4, 4) now.

        Raises:
            DeviceError: The frames are not connected, or a frame between is no longer published.
        """
        up, down = self._chain(child), self._chain(parent)
        shared = next((name for name in up if name in down), None)
        if shared is None:
            known = ", ".join(sorted({*self.frames, *(f.parent for f in self.frames.values())}))
            raise DeviceError(
                f"{self._asker}: tf does not join {parent} and {child}; its frames: "
                f"{known or 'none'}"
            )
        return invert(self._from(parent, shared)) @ self._from(child, shared)

    def wait_for(self, parent: str, child: str) -> None:
        """Wait until a pose is available; raise as :meth:`pose` does after a timeout."""
        until = self._bridge.until_known()
        while time.monotonic() < until:
            try:
                self.pose(parent, child)
                return
            except DeviceError:
                time.sleep(0.05)
        self.pose(parent, child)

    def _chain(self, name: str) -> list[str]:
        found = [name]
        while found[-1] in self.frames and self.frames[found[-1]].parent not in found:
            found.append(self.frames[found[-1]].parent)
        return found

    def _from(self, name: str, ancestor: str) -> Floats:
        """Return the pose of a frame in one of its ancestors."""
        pose = np.eye(4)
        # A moving frame that was not published for so long is lost [s]: robot_state_publisher
        # publishes at 20 Hz unless configured otherwise.
        stale = 0.25
        while name != ancestor:
            frame = self.frames[name]
            age = (
                0.0
                if frame.received_ns is None
                else 1e-9 * (time.monotonic_ns() - frame.received_ns)
            )
            if age > stale:
                raise DeviceError(
                    f"{self._asker}: tf has not updated {name} for {age:.2f} s, at most {stale} s "
                    "are allowed"
                )
            pose, name = frame.pose @ pose, frame.parent
        return pose

    def _moving(self, message: GraphMessage) -> None:
        self._take(message, message.received_ns)

    def _standing(self, message: GraphMessage) -> None:
        self._take(message, None)

    def _take(self, message: GraphMessage, received_ns: int | None) -> None:
        for each in decoded(message.data, Type.TF).transforms:
            turn, move = each.transform.rotation, each.transform.translation
            xyzw, place = [turn.x, turn.y, turn.z, turn.w], [move.x, move.y, move.z]
            # A quaternion whose norm is off by more is none, and tf2 leaves such a transform out as
            # well
            if not (abs(np.linalg.norm(xyzw) - 1.0) < 0.01 and np.isfinite(place).all()):
                continue
            pose = rigid(rotation_from_quaternion(np.array(xyzw)), place)
            parent, child = (n.lstrip("/") for n in (each.header.frame_id, each.child_frame_id))
            self.frames[child] = StampedFrame(parent, pose, received_ns)


SCANS = (Type.CLOUD, Type.IMAGE, Type.COMPRESSED)
"""The types in which cameras publish."""


class Ros2Graph(Device):
    """The running ROS 2 graph; see :class:`flangeye.models.graph.Graph`."""

    # For how long messages are counted [s]; a camera that runs by itself gives one in that
    # time.
    counted: ClassVar[float] = 1.5

    def __init__(self) -> None:
        """Join the graph.

        Raises:
            DeviceError: ROS 2 is not sourced in this terminal.
        """
        self._bridge = Bridge("ROS 2")

    def close(self) -> None:
        """Leave the graph."""
        self._bridge.close()

    def topics(self) -> list[Topic]:
        """Return all topics, sorted by name, once discovery has finished (2 s after joining)."""
        self._bridge.wait_until_known()
        known = self._bridge.topics()
        return [known[n] for n in sorted(known) if known[n].publishers or known[n].subscribers]

    def running(self) -> list[Running]:
        """Return the running arms and cameras; see :class:`flangeye.models.graph.Graph`."""
        topics = self.topics()
        found = [Running(name, f"{name}: String", "robot") for name in descriptions_in(topics)]
        found += [
            Running(each.topic.name, each.line, "scans" if each.scans else "")
            for each in self._listen(topics)
        ]
        found += [
            Running(name, f"{name}: JointTrajectory, a controller listens", "trajectory")
            for name in controllers_in(topics)
        ]
        return found + [
            Running(name, f"{name}: Trigger, a service", "trigger") for name in self._triggers()
        ]

    def cell(self, ask: Ask, name: str) -> RunningCell:
        """Return the running arm and camera; publish nothing and call no service.

        Raises:
            DeviceError: There is no running arm or no running camera.
            RecipeError: The URDF has no arm, or its links are ambiguous.
        """
        topics = self.topics()
        if not any(
            t.publishers and t.type in (Type.TEXT, Type.JOINT_STATE, *SCANS) for t in topics
        ):
            raise DeviceError(
                f"ROS 2: no arm and no camera runs {self._bridge.place}: start their drivers, or "
                "set both variables here as in their terminals"
            )
        path = Path(f"{name}.urdf")
        text = self._description(topics, ask)
        found, section = described_arm(text, path, ask)
        heard = self._listen(topics)
        states, angles = states_of(heard, found.joints)
        scans = scans_of(heard, ask)
        driver = arm_driver(topics, found.joints, states, ask)
        camera = scanner_driver(scans, self._triggers(), ask)
        if any(topic.name == "/clock" and topic.publishers for topic in topics):
            for params in (camera, *driver.values()):
                params["sim_time"] = True
        base, frame = found.base, scans.frame or CAMERA
        return RunningCell(
            robot=section | {"driver": driver},
            scanner={"driver": {"ros2": camera}},
            flange=Arm(found.robot).flange(angles),
            camera=self._place(base, frame),
            pixels=seen_by(scans) if scans.scans == "image" else None,
            files={path.name: text},
            steps=[{"export.ros2_launch": {"parent": base, "child": frame}}],
            steps_in_hand=[{"export.ros2_launch": {"parent": found.flange, "child": frame}}],
            seen=[
                f"{found.robot.model}: {base} to {found.flange}, {len(found.joints)} joints",
                *(each.line for each in heard),
                *unit_of(scans),
            ],
        )

    def publish(self, pose: CalibratedPose, frames: Mapping[str, str]) -> list[str]:
        """Publish a pose on ``/tf_static``; see :class:`flangeye.models.graph.Graph`.

        If the camera's driver publishes its own tree of frames, the root of that tree is connected,
        because a frame has only one parent.

        Raises:
            DeviceError: The camera is connected to its carrier already, or this ROS 2 has no
                ``tf2_msgs``.
        """
        tree = self._tree()
        self._bridge.offer("/tf_static", Type.TF, latched=True)
        told, transforms = [], []
        for each in (pose.transform, *pose.others):
            parent, child = (frames.get(n, n) for n in (each.parent, each.child))
            root, above = tree.root(child), tree.root(parent)
            if root == above:
                raise DeviceError(
                    f"ROS 2: /tf_static joins {child} to {parent} already: end what publishes "
                    "that, or choose another frame, --child NAME"
                )
            matrix = each.matrix @ invert(tree.pose(root, child))
            transforms.append(self._stamped(parent, root, matrix))
            told.append(f"{parent} to {root}" + (f", which carries {child}" * (root != child)))
        self._bridge.publish("/tf_static", encoded(message(Type.TF, transforms=transforms)))
        return told

    def stay(self) -> None:
        """Keep publishing until interrupted; see :class:`flangeye.models.graph.Graph`."""
        while True:
            # [s]
            self._bridge.wait("", 0, 86400.0)

    # --- what runs

    def _triggers(self) -> list[str]:
        """Return the services that may trigger a scan, chosen by type and name.

        Services that could switch an arm are left out.
        """
        words = r"capture|trigger|acquire|scan|grab|snap|frame"
        services = self._bridge.services().items()
        return [
            s for s, kind in services if kind == Type.TRIGGER and re.search(words, s, re.IGNORECASE)
        ]

    def _description(self, topics: Sequence[Topic], ask: Ask) -> str:
        """Return the URDF published by a node, or that of a file."""
        known = descriptions_in(topics)
        question = f"which robot_description ({', '.join(known) or 'none runs'}), or a .urdf file"
        chosen = ask("robot", question, known[0] if len(known) == 1 else None, "arm.urdf")
        if chosen not in known:
            return read_text(Path(chosen), URDF_BYTES, DeviceError)
        self._bridge.follow(chosen, Type.TEXT)
        latched = self._bridge.wait(chosen, 0, self.counted)
        if latched is None:
            raise DeviceError(
                f"{chosen}: nothing came within {self.counted:g} s; --robot takes a file"
            )
        return str(decoded(latched.data, Type.TEXT).data)

    def _listen(self, topics: Sequence[Topic]) -> list[ReceivedTopic]:
        """Return the samples that all topics of arms and cameras sent in a short time."""
        some = [t for t in topics if t.publishers and t.type in (Type.JOINT_STATE, *SCANS)]
        joints: dict[str, dict[str, float]] = {topic.name: {} for topic in some}

        def take(name: str, message: GraphMessage) -> None:
            joints[name].update(decoded(message.data, Type.JOINT_STATE, positions_of))

        for topic in some:
            moves = topic.type == Type.JOINT_STATE
            hears = partial(take, topic.name) if moves else None
            self._bridge.follow(topic.name, topic.type, always=moves, take=hears)
            self._bridge.want(topic.name)
        time.sleep(MATCHING)
        before = {topic.name: self._bridge.heard(topic.name) for topic in some}
        time.sleep(self.counted)
        return [
            ReceivedTopic(
                topic,
                (self._bridge.heard(topic.name) - before[topic.name]) / self.counted,
                self._bridge.newest(topic.name),
                dict(joints[topic.name]),
            )
            for topic in some
        ]

    def _place(self, base: str, frame: str) -> Floats | None:
        """Return the camera's pose by tf (4, 4); None if tf does not connect it."""
        with suppress(DeviceError):
            return self._tree().pose(base, frame)
        return None

    def _tree(self) -> Frames:
        """Return the frames of tf once the static ones have arrived."""
        moving = any(t.name == "/tf" and t.publishers for t in self.topics())
        frames = Frames(self._bridge, moving)
        time.sleep(MATCHING)
        return frames

    def _stamped(self, parent: str, child: str, matrix: Floats) -> Any:
        """Return a pose (4, 4) as a TransformStamped."""
        now = time.time_ns()
        stamp = message("builtin_interfaces/msg/Time", sec=now // 10**9, nanosec=now % 10**9)
        move, turn = matrix[:3, 3].tolist(), quaternion_from_rotation(matrix[:3, :3]).tolist()
        return message(
            "geometry_msgs/msg/TransformStamped",
            header=message("std_msgs/msg/Header", stamp=stamp, frame_id=parent),
            child_frame_id=child,
            transform=message(
                "geometry_msgs/msg/Transform",
                translation=message(
                    "geometry_msgs/msg/Vector3", **dict(zip("xyz", move, strict=True))
                ),
                rotation=message(
                    "geometry_msgs/msg/Quaternion", **dict(zip("xyzw", turn, strict=True))
                ),
            ),
        )


class ReceivedTopic(NamedTuple):
    """What was received on a topic: rate [Hz], newest message, and joint angles by name."""

    topic: Topic
    rate: float
    newest: GraphMessage | None
    joints: Mapping[str, float]

    @property
    def frame(self) -> str:
        """Frame of the topic's messages; empty without a message."""
        return frame_of(self.newest.data) if self.newest else ""

    @property
    def scans(self) -> str:
        """Parameter of ``scanner.ros2`` for this topic; empty if it has no scans.

        Depth images are recognised by their encoding, or by the topic's name without a message.
        """
        kind, name = self.topic.type, self.topic.name
        if kind not in SCANS or name.endswith("/compressedDepth"):
            return ""
        if kind != Type.IMAGE:
            return "cloud" if kind == Type.CLOUD else "image"
        if self.newest is None:
            return "depth" if "depth" in name else "image"
        encoding = decoded(self.newest.data, Type.IMAGE).encoding
        return "depth" if encoding in DEPTH_UNITS else "image"

    @property
    def line(self) -> str:
        """One line of text that describes the topic."""
        name, kind = self.topic.name, self.topic.type.rpartition("/")[2]
        often = f"{self.rate:.3g} Hz" if self.newest else "silent"
        frame = f", frame {self.frame}" if self.frame else ""
        return f"{name}: {kind}, {often}{frame}, by {' and '.join(self.topic.publishers)}"


def descriptions_in(topics: Iterable[Topic]) -> list[str]:
    """Return the topics with an arm's URDF."""
    texts = (t.name for t in topics if t.type == Type.TEXT and t.publishers)
    return [name for name in texts if name.endswith("robot_description")]


def controllers_in(topics: Iterable[Topic]) -> list[str]:
    """Return the topics on which a controller accepts joint trajectories."""
    return [t.name for t in topics if t.type == Type.TRAJECTORY and t.subscribers]


def described_arm(text: str, path: Path, ask: Ask) -> tuple[UrdfArm, dict[str, Any]]:
    """Return the arm of a URDF to be saved at ``path``, and the recipe's section for it.

    Raises:
        RecipeError: The text is no URDF, or its base link is ambiguous.
    """
    packages, urdf, flange = packages_of(text), parse_urdf(text, path), None
    links = flange_links(urdf)
    if len(links) > 1:  # of a gripper, or of a camera that the arm carries
        question = f"which link is the flange, z outwards ({', '.join(links[:LINKS_NAMED])})"
        flange = ask("flange", question, None, links[0])
    found = arm_of(urdf, flange=flange, packages=packages)
    section: dict[str, Any] = {"urdf": path.name, "base": found.base, "flange": found.flange}
    if packages:
        section["packages"] = {name: str(folder) for name, folder in packages.items()}
    return found, section


def packages_of(text: str) -> dict[str, Path]:
    """Return the folders of the packages named by a URDF's meshes, in the sourced environment."""
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    found = {}
    for name in dict.fromkeys(re.findall(r"package://([^/\"]+)/", text)):
        folders = (Path(prefix) / "share" / name for prefix in prefixes if prefix)
        if folder := next((each for each in folders if each.is_dir()), None):
            found[name] = folder
    return found


def states_of(heard: Sequence[ReceivedTopic], joints: Sequence[str]) -> tuple[str, Floats]:
    """Return the topic with all joints of an arm, and their present angles (n,) [rad].

    Among several a topic named joint_states is preferred, as others may contain commands.

    Raises:
        DeviceError: No topic has all joints; the message names the joints of each.
    """
    states = [each for each in heard if each.topic.type == Type.JOINT_STATE and each.newest]
    for each in sorted(states, key=lambda each: not each.topic.name.endswith("joint_states")):
        if set(joints) <= set(each.joints):
            return each.topic.name, np.array([each.joints[joint] for joint in joints])
    told = [f"{each.topic.name} has {', '.join(each.joints) or 'none'}" for each in states]
    raise DeviceError(
        f"no JointState topic has the joints of the robot_description, {', '.join(joints)}: "
        f"{'; '.join(told) or 'none was heard'}"
    )


def arm_driver(
    topics: Iterable[Topic], joints: Sequence[str], states: str, ask: Ask
) -> dict[str, Any]:
    """Return the recipe's entry for an arm's driver with its parameters."""
    listening = controllers_in(topics)
    question = "which controller moves the arm (none: it is moved by hand or by another program)"
    told = f" ({', '.join(listening)})" if len(listening) > 1 else ""
    chosen = ask("trajectory", question + told, _only(listening, "none"))
    params: dict[str, Any] = {"joints": list(joints)}
    if states != "/joint_states":
        params["joint_states"] = states
    if chosen == "none":
        return {"ros2_freedrive": params}
    return {"ros2": params | {"trajectory": chosen}}


def scans_of(heard: Sequence[ReceivedTopic], ask: Ask) -> ReceivedTopic:
    """Return the topic of the scans: clouds, else depth images, else images of a printed target.

    Raises:
        DeviceError: There is none, or not the requested one.
    """
    every = {each.topic.name: each for each in heard if each.scans}
    # An image that is published compressed besides is taken as it is
    plain = [n for n in every if n.removesuffix("/compressed") not in every.keys() - {n}]
    kinds = ([n for n in plain if every[n].scans == kind] for kind in ("cloud", "depth", "image"))
    found = next((names for names in kinds if names), [])
    question = f"which topic has the scans ({', '.join(found) or 'none runs'})"
    chosen = ask("scans", question, _only(found, None))
    if chosen not in every:
        raise DeviceError(
            f"nobody publishes clouds, depth images or images on {chosen}; there are: "
            f"{', '.join(every) or 'none'}"
        )
    return every[chosen]


def unit_of(scans: ReceivedTopic) -> list[str]:
    """Return a warning if the newest cloud of a topic is not in metres, the unit of ROS 2."""
    if scans.topic.type != Type.CLOUD or scans.newest is None:
        return []
    xyz = decoded(scans.newest.data, Type.CLOUD, cloud_of)
    there = xyz[(xyz != 0).any(axis=-1)]  # many drivers write zeros for missing points
    far = median_distance(PointCloud(CAMERA, there))
    try:
        unit = detect_unit(Path(scans.topic.name), far, ScannerData(model="a work cell's scanner"))
    except StageError as error:
        return [f"warning: {error}"]
    if unit == "m":
        return []
    return [
        f"warning: {scans.topic.name}: its points are {far:.4g} away (median), which are "
        "millimetres; ROS 2 has metres (REP 103), and a run would refuse the scans: set the "
        "camera's driver to metres, then flangeye init --ros2 again"
    ]


def seen_by(scans: ReceivedTopic) -> Any:
    """Return the newest image of a topic, (H, W) or (H, W, 3); empty without one."""
    if scans.newest is None:
        return np.zeros((0, 0), np.uint8)
    return np.ascontiguousarray(decoded(scans.newest.data, scans.topic.type, pixels_of))


def scanner_driver(scans: ReceivedTopic, triggers: Iterable[str], ask: Ask) -> dict[str, Any]:
    """Return the parameters of ``scanner.ros2``; a silent topic needs a trigger.

    Args:
        scans: Topic of the scans.
        triggers: Services that may trigger a scan.
        ask: Asks the user which one does.
    """
    params: dict[str, Any] = {scans.scans: scans.topic.name}
    if scans.newest is None:
        namespace = f"/{scans.topic.name.split('/')[1]}/"
        likely = [t for t in triggers if t.startswith(namespace)] or [*triggers]
        told = f" ({', '.join(likely)})" if len(likely) > 1 else ""
        question = f"{scans.topic.name} is silent: which service (std_srvs/Trigger) takes a scan"
        trigger = ask("trigger", question + told, _only(likely, None), "/camera/capture")
        if trigger != "none":
            params["trigger"] = trigger
    return params


def _only(names: Sequence[str], otherwise: str | None) -> str | None:
    return names[0] if len(names) == 1 else otherwise if not names else None
