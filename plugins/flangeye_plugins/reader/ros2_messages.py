"""Messages of ROS 2 bags, MCAP or SQLite, without ROS; clouds and images of them as files."""

import sqlite3
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, field
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np

from flangeye import StageError
from flangeye.files.recording import NotThisLayout
from flangeye.files.regular import open_regular
from flangeye.files.scans import natural
from flangeye.files.words import reason_of
from flangeye.maths.streams import interpolated
from flangeye.types import Floats
from flangeye.workflow.log.records import LogFile
from flangeye_plugins.reader.poses import pose_from_quaternion
from flangeye_plugins.ros2.messages import cloud_of, frame_of, pixels_of, stamp_of, types

Decoded = TypeVar("Decoded")


@dataclass(frozen=True)
class Raw:
    """A message, not yet decoded.

    Attributes:
        file: File of the bag.
        topic: Name of the topic.
        received: Time of recording [s].
        data: Serialised message (CDR).
        decode: Returns the decoded message.
    """

    file: Path
    topic: str
    received: float
    data: bytes
    decode: Callable[[], Any]

    def read(self, use: Callable[[Any], Decoded]) -> Decoded:
        """Return the result of a function on the message.

        Raises:
            StageError: The message is damaged, or not of its type.
        """
        try:
            return use(self.decode())
        except StageError as error:
            raise StageError(f"{self.file}: a message of {self.topic}: {error}") from None
        except Exception as error:  # a damaged schema makes messages without their fields
            reason = reason_of(error)
            raise StageError(
                f"{self.file}: a message of {self.topic} is damaged: {reason}"
            ) from None

    @property
    def stamp(self) -> float:
        """``header.stamp`` [s] of a message that begins with a header; else its time of receipt."""
        return stamp_of(self.data) * 1e-9 or self.received

    @property
    def frame(self) -> str:
        """``header.frame_id`` of a message that begins with a header."""
        return frame_of(self.data)


def bag_files(path: Path) -> list[Path]:
    """Return the files of a bag in the order of their numbers, or the file itself.

    Raises:
        NotThisLayout: There are none.
    """
    folder = [path] if path.is_file() else path.glob("*")
    candidates = sorted(folder, key=lambda p: natural(p.name))
    files = [p for p in candidates if p.suffix in (".mcap", ".db3")]
    if not files:
        raise NotThisLayout(f"{path}: holds no ROS 2 bag (.mcap or .db3)")
    return files


def topics_of(files: list[Path]) -> dict[str, str]:
    """Return topic -> message type, such as ``sensor_msgs/msg/PointCloud2``.

    Raises:
        StageError: A file cannot be read, or the extra ``ros`` is not installed.
    """
    found: dict[str, str] = {}
    for file in files:
        found |= _guarded(file, _mcap_topics if file.suffix == ".mcap" else _db3_topics)
    return found


def messages(files: list[Path], topics: Collection[str]) -> Iterator[Raw]:
    """Yield the messages of some topics, file by file in the order in which they were recorded.

    Raises:
        StageError: As :func:`topics_of`.
    """
    for file in files:
        read = _mcap_messages if file.suffix == ".mcap" else _db3_messages
        found = read(file, topics)
        while (raw := _guarded(file, lambda _: next(found, None))) is not None:  # noqa: B023
            yield raw


def _guarded(file: Path, read: Callable[[Path], Any]) -> Any:
    try:
        return read(file)
    except StageError:
        raise
    except Exception as error:  # damaged bytes can break the libraries in any way
        raise StageError(f"{file}: cannot be read as a ROS 2 bag: {reason_of(error)}") from None


def _mcap_topics(file: Path) -> dict[str, str]:
    from mcap.reader import make_reader

    with open_regular(file) as opened:
        summary = make_reader(opened).get_summary()
    if summary is None or not summary.channels:
        raise StageError(f"{file}: has no summary; was the recording stopped half way?")
    channels = summary.channels.values()
    ours = [c for c in channels if c.message_encoding == "cdr" and c.schema_id in summary.schemas]
    if not ours:
        raise NotThisLayout(f"{file}: is an MCAP file, but holds no ROS 2 messages")
    return {c.topic: summary.schemas[c.schema_id].name for c in ours}


def _mcap_messages(file: Path, topics: Collection[str]) -> Iterator[Raw]:
    def refuse(what: str) -> None:
        raise StageError(f"{file}: damaged: {what}")

    with open_regular(file) as opened:
        # The library's reader expands chunks before it looks at how large they become.
        for channel, time_ns, data, _ in LogFile(refuse).messages(opened, file.stat().st_size):
            if channel.topic in topics and channel.encoding == "cdr":
                decode = partial(types().deserialize_cdr, data, channel.schema)
                yield Raw(file, channel.topic, time_ns * 1e-9, data, decode)


@contextmanager
def _opened(file: Path) -> Iterator[sqlite3.Connection]:
    """Yield a bag's open database; views are refused, as their queries may never end.

    Raises:
        StageError: The database is not a ROS 2 bag.
    """
    # Read only: SQLite would otherwise create a missing file
    with closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True)) as database:
        tables = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
        if not {("topics",), ("messages",)} <= set(tables):
            raise StageError(f"{file}: is not a ROS 2 bag: it has no tables topics and messages")
        yield database


def _db3_topics(file: Path) -> dict[str, str]:
    with _opened(file) as database:
        return dict(database.execute("SELECT name, type FROM topics").fetchall())


def _db3_messages(file: Path, topics: Collection[str]) -> Iterator[Raw]:
    store = types()
    marks = ",".join("?" * len(topics))
    with _opened(file) as database:
        rows = database.execute(
            "SELECT topics.name, topics.type, timestamp, data FROM messages JOIN topics "
            f"ON messages.topic_id = topics.id WHERE topics.name IN ({marks}) ORDER BY timestamp",
            list(topics),
        )
        for topic, kind, stamp, data in rows:
            yield Raw(file, topic, stamp * 1e-9, data, partial(store.deserialize_cdr, data, kind))


@cache
def _scratch() -> TemporaryDirectory[str]:
    """Return the temporary folder for files extracted from bags, deleted at exit."""
    return TemporaryDirectory(prefix="flangeye-bag-")


def scratch(bag: Path) -> Path:
    """Return a temporary folder for files unpacked from a bag."""
    folder = Path(_scratch().name) / f"{abs(hash(bag.resolve())):x}"
    folder.mkdir(exist_ok=True)
    return folder


def save_cloud(path: Path, message: Any) -> Path:
    """Write a cloud as .npy and return the file."""
    file = path.with_suffix(".npy")
    np.save(file, cloud_of(message))
    return file


def save_image(path: Path, message: Any) -> Path:
    """Write a ``sensor_msgs/Image`` or ``CompressedImage`` as a file and return it.

    Raises:
        StageError: The image's encoding is not known.
        ImageError: The compressed image is damaged.
    """
    import cv2

    if hasattr(message, "format"):
        pixels_of(message)  # a damaged one is found here, where it can still be set aside
        suffix = ".png" if "png" in message.format else ".jpg"
        path.with_suffix(suffix).write_bytes(bytes(message.data))
        return path.with_suffix(suffix)
    cv2.imwrite(str(path.with_suffix(".png")), pixels_of(message))
    return path.with_suffix(".png")


PoseStream = tuple[Floats, Floats]
"""Times (N,) [s], ascending, and poses (N, 4, 4) [m] or joint angles (N, n) [rad]."""


def pose_of(where: str, position: Any, turn: Any) -> Floats:
    """Return the pose (4, 4) [m] of a ROS position and orientation."""
    return pose_from_quaternion(
        where, [position.x, position.y, position.z], [turn.x, turn.y, turn.z, turn.w]
    )


def in_order(times: Sequence[float], values: Sequence[Floats]) -> PoseStream:
    """Return a stream sorted by time, with one value for each time."""
    # Interpolation needs ascending times, each once; several publishers may repeat one
    moments, first = np.unique(np.array(times), return_index=True)
    return moments, np.array(values)[first]


@dataclass
class BagFrames:
    """The transforms of a bag's ``/tf`` and ``/tf_static``.

    Attributes:
        parents: Parent frame of each frame.
        samples: Times and poses in the parent, by frame.
        static: Frames that never move.
    """

    parents: dict[str, str] = field(default_factory=dict)
    samples: dict[str, tuple[list[float], list[Floats]]] = field(default_factory=dict)
    static: set[str] = field(default_factory=set)

    def take(self, message: Any, static: bool) -> None:
        """Add the transforms of a ``tf2_msgs/TFMessage``."""
        for each in message.transforms:
            # ROS 1 began names with a slash, and bags converted from it still do
            child = each.child_frame_id.lstrip("/")
            stamp = each.header.stamp
            times, poses = self.samples.setdefault(child, ([], []))
            move = each.transform
            poses.append(pose_of(f"tf of {child}", move.translation, move.rotation))
            times.append(stamp.sec + getattr(stamp, "nanosec", 0) * 1e-9)
            self.parents[child] = each.header.frame_id.lstrip("/")
            if static:
                self.static.add(child)

    @property
    def names(self) -> list[str]:
        """Names of all frames."""
        return sorted({*self.parents, *self.parents.values()})

    def chain(self, frame: str) -> list[str]:
        """Return a frame and its ancestors, up to the root."""
        found = [frame]
        while found[-1] in self.parents and self.parents[found[-1]] not in found:
            found.append(self.parents[found[-1]])
        return found

    def between(self, parent: str, child: str) -> PoseStream:
        """Return ``parent_T_child`` over time.

        Raises:
            StageError: A frame does not exist, or the two are not connected.
        """
        for name in (parent, child):
            if name not in self.names:
                raise StageError(f"tf has no frame '{name}'; it has {', '.join(self.names)}")
        up, down = self.chain(child), self.chain(parent)
        common = next((name for name in up if name in down), None)
        if common is None:
            raise StageError(f"tf: no chain of transforms leads from '{parent}' to '{child}'")
        legs = up[: up.index(common)], down[: down.index(common)]
        times = self._times([*legs[0], *legs[1]])
        # parent_T_child = inv(common_T_parent) common_T_child
        return times, np.linalg.inv(self._at(legs[1], times)) @ self._at(legs[0], times)

    def _times(self, frames: Sequence[str]) -> Floats:
        """Return the times of the frame that moves most often."""
        moving = [np.unique(self.samples[f][0]) for f in frames if f not in self.static]
        return max(moving, key=len) if moving else np.zeros(1)

    def _at(self, leg: Sequence[str], times: Floats) -> Floats:
        """Return the poses of a chain's first frame in the parent of its last."""
        pose = np.tile(np.eye(4), (len(times), 1, 1))
        for frame in leg:
            own, poses = in_order(*self.samples[frame])
            alone = len(own) == 1 or frame in self.static
            step = np.tile(poses[-1], (len(times), 1, 1)) if alone else None
            pose = (interpolated(own, poses, times) if step is None else step) @ pose
        return pose
