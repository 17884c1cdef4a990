"""ROS 2 bags, MCAP or SQLite, read without ROS.

The arm's poses come from ``tf`` (``base`` and ``flange``), a ``PoseStamped`` topic, or joint angles
with the recipe's ``robot``. The camera's measurements come from ``PointCloud2``, ``Image`` with
``CameraInfo``, a ``PoseStamped`` of the target, or ``tf`` of the target's frame. Standstills are
detected in the arm's motion, and clouds and poses are paired by time.
"""

from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from flangeye import Params, StageError, part
from flangeye.files.recording import Archive, Recording
from flangeye.maths.kinematics import Arm
from flangeye.maths.pose_corrections import inverted
from flangeye.maths.streams import mean_pose, turning, with_joints
from flangeye.models.robots import RobotModel, joints_in_order
from flangeye.types import FLANGE, Floats
from flangeye.types.geometry import rows_at
from flangeye.units import param
from flangeye_plugins.reader.pairing import MatchedPose, PairingParams, Signal, pair
from flangeye_plugins.reader.ros2_messages import (
    BagFrames,
    PoseStream,
    Raw,
    bag_files,
    in_order,
    messages,
    pose_of,
    save_cloud,
    save_image,
    scratch,
    topics_of,
)
from flangeye_plugins.ros2.messages import Type, cloud_of, intrinsics_of, pixels_of

Value = TypeVar("Value")
ARM_HINT = "robot: NAME ('flangeye robots' lists them) or robot: {urdf: arm.urdf} in the recipe"
"""Remedy that states how a recipe names its arm."""


class BagParams(Params):
    """Topics and frames in the bag; each is found if it is the only one of its type."""

    clouds: str | None = None
    """Topic of the clouds (PointCloud2)."""
    images: str | None = None
    """Topic of the images (Image, CompressedImage)."""
    camera_info: str | None = None
    """Topic of the images' CameraInfo."""
    base: str | None = None
    """Frame of the arm's base, in which its poses are given."""
    flange: str | None = None
    """Frame of the flange, origin in its face."""
    robot: str | None = None
    """Topic of the arm, in place of tf: PoseStamped, or JointState, whose angles become poses by
    the kinematics of the recipe's robot."""
    joints: tuple[str, ...] = ()
    """Names of the joints from base to flange, where JointState mixes them."""
    target: str | None = None
    """Recorded poses of the target: a PoseStamped topic, or a frame of tf, together with camera."""
    camera: str | None = None
    """The camera's frame, for a target in tf."""
    join: PairingParams = param(PairingParams())
    """Pairing of poses and clouds by time."""


@dataclass
class Bag:
    """Contents of a bag from a first pass.

    Attributes:
        path: Path of the bag.
        files: Files of the bag.
        topics: Types of the topics with messages.
        frames: Transforms from tf.
        poses: Times and poses of PoseStamped, by topic.
        joints: Times and joint angles by name, by topic.
        stamps: Times of clouds and images, by topic.
        seen_from: Frames of images and cameras, by topic.
        cameras: Camera matrix (3, 3) [px] and distortion, by topic.
    """

    path: Path
    files: list[Path]
    topics: dict[str, str]
    frames: BagFrames = field(default_factory=BagFrames)
    poses: dict[str, tuple[list[float], list[Floats]]] = field(default_factory=dict)
    joints: dict[str, tuple[list[float], list[dict[str, float]]]] = field(default_factory=dict)
    stamps: dict[str, list[float]] = field(default_factory=dict)
    seen_from: dict[str, str] = field(default_factory=dict)
    cameras: dict[str, tuple[Floats, Floats]] = field(default_factory=dict)

    def of_type(self, *types: str) -> list[str]:
        """Return the topics of some types."""
        return [topic for topic, kind in self.topics.items() if kind in types]

    def only(self, what: str, given: str | None, *types: str) -> str | None:
        """Return the named topic, or the only one of its types; None without one.

        Raises:
            StageError: The topic does not exist, or there are several and none is named.
        """
        found = self.of_type(*types)
        if given is not None:
            if given not in found:
                known = ", ".join(found) or "none"
                raise StageError(f"{self.path}: {what}: no topic '{given}'; of this type: {known}")
            return given
        if len(found) > 1:
            raise StageError(
                f"{self.path}: {what}: name one of {', '.join(sorted(found))}, for example "
                f"reader: {{ros2_bag: {{{what}: {min(found)}}}}}"
            )
        return found[0] if found else None


@part("reader.ros2_bag")
def ros2_bag(path: Path, params: BagParams, kinematics: RobotModel | None = None) -> Archive:
    """Read the standstills with their clouds or images from a ROS 2 bag (MCAP or .db3)."""
    bag = _first_look(path)
    try:
        arm, arm_told, joints = _arm(bag, params, kinematics)
        seen, seen_told = _seen(bag, params)
        pairs, paired = pair(arm, seen.times, seen.signals(arm), params.join)
    except StageError as error:
        named = str(path) in str(error)
        raise StageError(str(error) if named else f"{path}: {error}") from None
    recordings = seen.recordings(pairs, joints)
    notes = [f"ROS 2 bag: {arm_told}; {seen_told}", *paired, *seen.notes]
    return Archive(f"ROS 2 bag, {path.name}", path, recordings, bag.files, "m", notes)


def _first_look(path: Path) -> Bag:
    """Read a bag's small messages, and only the times of its clouds and images."""
    files = bag_files(path)
    bag = Bag(path, files, topics_of(files))
    wanted = bag.of_type(
        Type.CLOUD, Type.POSE, Type.IMAGE, Type.COMPRESSED, Type.INFO, Type.JOINT_STATE, Type.TF
    )
    heard = set()
    for raw in messages(files, wanted):
        kind = bag.topics[raw.topic]
        heard.add(raw.topic)
        if kind == Type.TF:
            raw.read(partial(bag.frames.take, static=raw.topic.endswith("tf_static")))
        elif kind == Type.POSE:
            _append(bag.poses, raw, raw.read(_pose_stamped))
        elif kind == Type.JOINT_STATE:
            _append(bag.joints, raw, raw.read(_joint_angles))
        elif kind == Type.INFO:
            bag.cameras[raw.topic] = raw.read(intrinsics_of)
            bag.seen_from[raw.topic] = raw.frame
        else:
            # Clouds and images are large: they are decoded only after some of them are chosen
            bag.seen_from.setdefault(raw.topic, raw.frame)
            bag.stamps.setdefault(raw.topic, []).append(raw.stamp)
    # A topic that was recorded without a message is no source
    return replace(bag, topics={t: kind for t, kind in bag.topics.items() if t in heard})


def _append(into: dict[str, tuple[list[float], list[Any]]], raw: Raw, value: Any) -> None:
    times, values = into.setdefault(raw.topic, ([], []))
    times.append(raw.stamp)
    values.append(value)


def _pose_stamped(message: Any) -> Floats:
    return pose_of("its pose", message.pose.position, message.pose.orientation)


def _joint_angles(message: Any) -> dict[str, float]:
    angles = zip(message.name, message.position, strict=False)
    return {str(name): float(angle) for name, angle in angles}


# --- the arm


def _arm(
    bag: Bag, params: BagParams, robot: RobotModel | None
) -> tuple[PoseStream, str, PoseStream | None]:
    """Return the flange's poses, a text on their source, and the joints, if their order is known.

    Raises:
        StageError: The bag has no source of the flange's poses, or several.
    """
    joints = _joints(bag, params)
    if params.robot in bag.of_type(Type.JOINT_STATE):
        return *_by_kinematics(bag, joints, robot), joints
    if params.robot is not None:
        topic = bag.only("robot", params.robot, Type.POSE)
        return in_order(*bag.poses[str(topic)]), f"the flange's poses from {topic}", joints
    # Names under which ROS's drivers publish the two frames, the better one first
    base = _frame(bag, params.base, ("base", "base_link", "world"))
    flange = _frame(
        bag, params.flange,
        ("flange", "tool0", "tool_flange", "panda_link8", "fr3_link8", "lbr_link_ee", "link_eef"),
    )  # fmt: skip
    # tf before PoseStamped: its frames have names, a pose alone may be that of a tool
    if base and flange:
        told = f"the flange's poses from tf, {base} to {flange}"
        return bag.frames.between(base, flange), told, joints
    others = [topic for topic in bag.poses if topic != params.target]
    if len(others) == 1:
        return in_order(*bag.poses[others[0]]), f"the flange's poses from {others[0]}", joints
    if robot is not None and bag.joints:
        return *_by_kinematics(bag, joints, robot), joints
    raise StageError(f"{bag.path}: no topic gives the flange's pose; {_ways(bag)}")


def _by_kinematics(
    bag: Bag, joints: PoseStream | None, robot: RobotModel | None
) -> tuple[PoseStream, str]:
    """Return the flange's poses from recorded joint angles, and a text on their source."""
    if robot is None:
        raise StageError(
            f"{bag.path}: joint angles become poses by the arm's kinematics; write {ARM_HINT}"
        )
    if joints is None or joints[1].shape[1] != len(robot.joints):
        raise StageError(
            f"{bag.path}: which joint angles are the {len(robot.joints)} of {robot.model} is not "
            "known; write reader: {ros2_bag: {robot: TOPIC, joints: [NAME, …]}}, from base to "
            f"flange; there are {'; '.join(f'{t}: {_names(bag, t)}' for t in bag.joints)}"
        )
    return (
        joints[0],
        Arm(robot).flange(joints[1]),
    ), f"the flange's poses by the joints of {robot.model}"


def _names(bag: Bag, topic: str) -> str:
    """Return a text with the names of a topic's joints."""
    return ", ".join(bag.joints[topic][1][0])


def _ways(bag: Bag) -> str:
    """Return a text on the parameters that select the flange's poses in the bag."""
    ways = {
        "base: …, flange: …": bag.frames.names and f"frames of tf: {', '.join(bag.frames.names)}",
        "robot: …": bag.poses and f"PoseStamped topics: {', '.join(bag.poses)}",
    }
    found = [f"reader: {{ros2_bag: {{{way}}}}} ({told})" for way, told in ways.items() if told]
    if bag.joints:
        found.append(f"{ARM_HINT} (for the angles of {', '.join(bag.joints)})")
    if not found:
        return "it has neither tf nor PoseStamped nor JointState"
    return f"write {' or '.join(found)}"


def _frame(bag: Bag, given: str | None, usual: Sequence[str]) -> str | None:
    if given is not None:
        return given
    return next((name for name in usual if name in bag.frames.names), None)


def _joints(bag: Bag, params: BagParams) -> PoseStream | None:
    given = params.robot if params.robot in bag.joints else None
    topics = [given] if given else list(bag.joints)
    if len(topics) != 1:
        return None
    times, values = bag.joints[str(topics[0])]
    # Drivers sort joints by name, and other devices share the topic: the order is by the names
    names = params.joints or joints_in_order(values[0])
    usable = [(t, v) for t, v in zip(times, values, strict=True) if set(names) <= set(v)]
    if not names or not usable:
        return None
    angles = [np.array([value[name] for name in names]) for _, value in usable]
    return in_order([t for t, _ in usable], angles)


# --- what the camera saw


@dataclass
class Target:
    """The target's poses in the camera with their times, from another program."""

    times: Floats
    poses: Floats
    notes: tuple[str, ...] = ()

    def signals(self, arm: PoseStream) -> tuple[Signal, Signal] | None:
        """Angular speeds of arm and target, which are the same in every frame."""
        enough = len(self.times) > 2 and len(arm[0]) > 2
        return (turning(*arm), turning(self.times, self.poses)) if enough else None

    def recordings(
        self, pairs: Sequence[MatchedPose], joints: PoseStream | None
    ) -> list[Recording]:
        """Return one recording for each pair."""
        return [
            replace(
                _recording(i, found, joints),
                camera_T_target=mean_pose(self.poses[list(found.events)]),
            )
            for i, found in enumerate(pairs)
        ]


@dataclass
class Scans:
    """Recorded clouds, images, or clouds with their nearest images."""

    bag: Bag
    clouds: str | None
    images: str | None
    camera: tuple[Floats, Floats] | None
    damaged: dict[str, dict[int, StageError]] = field(default_factory=dict)

    @property
    def notes(self) -> tuple[str, ...]:
        """Notes on damaged messages: their number and the first one, for each topic."""
        return tuple(
            f"set aside {len(errors)} of {len(self.bag.stamps[topic])} messages of {topic}, the "
            f"first of them number {min(errors)}: {errors[min(errors)]}"
            for topic, errors in self.damaged.items()
        )

    @property
    def first(self) -> str:
        """The topic that is paired with the arm."""
        return str(self.clouds or self.images)

    @property
    def times(self) -> Floats:
        """Times of its messages [s]."""
        return np.array(self.bag.stamps[self.first])

    def signals(self, arm: PoseStream) -> tuple[Signal, Signal] | None:
        """Difference of each value from the one before, if they are frequent enough to compare."""
        # From so many measurements a second on, their own change shows when something moved
        if len(self.times) < 20 or len(arm[0]) < 20 or np.median(np.diff(self.times)) > 1 / 3.0:
            return None
        looks = self._sound(self.first, range(len(self.times)), lambda _, message: _look(message))
        if len({look.shape for look in looks.values()}) != 1:  # clouds of changing size
            return None
        # The correlation needs the course in time only, so any measure of change will do
        changes = [float(np.abs(b - a).mean()) for a, b in pairwise(looks.values())]
        times = self.times[list(looks)]
        return turning(*arm), ((times[1:] + times[:-1]) / 2, np.array(changes))

    def _sound(
        self, topic: str, wanted: Container[int], use: Callable[[int, Any], Value]
    ) -> dict[int, Value]:
        """Return a function's results on some messages, by number, without damaged ones.

        Raises:
            StageError: All of them are damaged.
        """
        found = {}
        for number, raw in enumerate(messages(self.bag.files, [topic])):
            if number in wanted:
                try:
                    found[number] = raw.read(partial(use, number))
                except StageError as error:
                    self.damaged.setdefault(topic, {})[number] = error
        if not found and topic in self.damaged:
            raise next(iter(self.damaged[topic].values()))
        return found

    def recordings(
        self, pairs: Sequence[MatchedPose], joints: PoseStream | None
    ) -> list[Recording]:
        """Return one recording for each pair, with cloud and image written as files."""
        chosen = [self._middle(found.events) for found in pairs]
        files = self._files(self.first, chosen)
        images = files if self.clouds is None else self._beside(chosen)
        return [
            replace(
                _recording(i, found, joints),
                cloud=files[event] if self.clouds else None,
                image=images.get(event),
                camera=self.camera,
            )
            for i, (found, event) in enumerate(zip(pairs, chosen, strict=True))
            if event in files
        ]

    def _middle(self, events: Sequence[int]) -> int:
        """Return the middle one of a standstill's undamaged messages."""
        # Farthest from the motions before and after, whose vibration fades during a standstill
        damaged = self.damaged.get(self.first, {})
        sound = [event for event in events if event not in damaged] or events
        return sound[len(sound) // 2]

    def _beside(self, chosen: Sequence[int]) -> dict[int, Path]:
        """Return the image taken nearest to each chosen cloud."""
        if self.images is None:
            return {}
        taken = np.array(self.bag.stamps[self.images])
        nearest = {event: int(np.argmin(np.abs(taken - self.times[event]))) for event in chosen}
        files = self._files(self.images, list(nearest.values()))
        return {event: files[image] for event, image in nearest.items() if image in files}

    def _files(self, topic: str, wanted: Sequence[int]) -> dict[int, Path]:
        """Write some messages of a topic as files; return the paths by the message's number."""
        save = save_cloud if self.bag.topics[topic] == Type.CLOUD else save_image
        name = scratch(self.bag.path) / topic.strip("/").replace("/", "_")
        return self._sound(topic, wanted, lambda i, told: save(Path(f"{name}-{i:05}"), told))


def _look(message: Any) -> Floats:
    """Return a coarse sample of a cloud's depths or an image's pixels."""
    if hasattr(message, "fields"):
        # A prime step crosses all columns of an organised cloud, whatever its width
        return np.asarray(np.nan_to_num(cloud_of(message)[..., 2].ravel()[::97]), dtype=float)
    return np.asarray(pixels_of(message)[::16, ::16], dtype=float)


def _seen(bag: Bag, params: BagParams) -> tuple[Target | Scans, str]:
    """Return the camera's measurements, and a text on their source."""
    if params.target is not None:
        return _target(bag, params), f"the target from {params.target}"
    clouds = bag.only("clouds", params.clouds, Type.CLOUD)
    images = bag.only("images", params.images, Type.IMAGE, Type.COMPRESSED)
    if clouds is None and images is None:
        raise StageError(
            f"{bag.path}: holds neither clouds nor images; name the recorded poses of the "
            "target (a PoseStamped topic, or a frame of tf)"
        )
    info = _info(bag, params, images) if images else None
    told = " and ".join(topic for topic in (clouds, images) if topic)
    return Scans(bag, clouds, images, bag.cameras.get(str(info))), told


def _info(bag: Bag, params: BagParams, images: str) -> str | None:
    """Return the CameraInfo topic: the named one, or that of the images by name or frame."""
    # By ROS convention a camera's CameraInfo is published beside its image
    beside = f"{images.removesuffix('/compressed').rpartition('/')[0]}/camera_info"
    frame = bag.seen_from[images]
    same = [topic for topic in bag.cameras if frame and bag.seen_from[topic] == frame]
    found = [beside] if beside in bag.cameras else same
    given = params.camera_info or (found[0] if len(found) == 1 else None)
    return bag.only("camera_info", given, Type.INFO)


def _target(bag: Bag, params: BagParams) -> Target:
    name = str(params.target)
    if name in bag.poses:
        return Target(*in_order(*bag.poses[name]))
    if params.camera is None:
        raise StageError(f"{bag.path}: target: '{name}' is not a PoseStamped topic; as a frame of "
                         "tf it needs the camera's frame, camera: NAME")  # fmt: skip
    # Seen from the target the chain is the same, and its times are those of the target's own tf.
    times, poses = bag.frames.between(name, params.camera)
    return Target(times, np.array([inverted(pose) for pose in poses]))


def _recording(number: int, found: MatchedPose, joints: PoseStream | None) -> Recording:
    """Return a recording of the arm's pose, at rest or moving, with its joints if recorded."""
    angles, motion = None, found.motion
    if joints is not None:
        angles = rows_at(found.time, *joints)
        motion = motion and with_joints(motion, found.time, FLANGE, joints)
    pose, time_ns = {FLANGE: found.pose}, round(found.time * 1e9)
    return Recording(f"{number:03}", pose, joints=angles, time_ns=time_ns, motion=motion)
