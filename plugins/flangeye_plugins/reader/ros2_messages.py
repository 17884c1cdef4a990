"""Messages of ROS 2 bags, MCAP or SQLite, without ROS; clouds and images of them as files."""

from __future__ import annotations

import sqlite3
import struct
from collections.abc import Callable, Collection, Iterator
from contextlib import AbstractContextManager, closing
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np

from flangeye import StageError
from flangeye.files.images import decode_image
from flangeye.files.pairs import natural
from flangeye.files.printable import reason_of
from flangeye.files.recording import NotThisLayout
from flangeye.files.regular import open_regular
from flangeye.log.records import Channel, LogFile
from flangeye.types import Singles

T = TypeVar("T")

SHORTEST = 12
"""A message with a time has four bytes of encapsulation, seconds and nanoseconds."""
MISSING = "{}: reading ROS 2 bags needs the extra 'ros': pip install 'flangeye[ros]'"
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""``sensor_msgs/PointField``: datatype -> NumPy's."""
GREY = {"mono8": (np.uint8, 1), "8UC1": (np.uint8, 1), "mono16": (np.uint16, 1),
        "16UC1": (np.uint16, 1), "rgb8": (np.uint8, 3), "bgr8": (np.uint8, 3),
        "8UC3": (np.uint8, 3), "rgba8": (np.uint8, 4), "bgra8": (np.uint8, 4)}  # fmt: skip
"""Encodings of ``sensor_msgs/Image`` that are read: type and channels."""


@dataclass(frozen=True)
class Raw:
    """A message, not yet decoded.

    Attributes:
        file: The bag's file.
        topic: Its topic.
        received: When it was recorded [s].
        data: CDR.
        decode: Gives the message.
    """

    file: Path
    topic: str
    received: float
    data: bytes
    decode: Callable[[], Any]

    def read(self, use: Callable[[Any], T]) -> T:
        """Return what a function makes of the message.

        Raises:
            StageError: It is damaged, or not what its type says.
        """
        try:
            return use(self.decode())
        except StageError:
            raise
        except Exception as error:  # a damaged schema makes messages without their fields
            reason = reason_of(error)
            raise StageError(
                f"{self.file}: a message of {self.topic} is damaged: {reason}"
            ) from None

    @property
    def stamp(self) -> float:
        """``header.stamp`` [s] of a message that begins with a header; else when received."""
        if len(self.data) < SHORTEST:
            return self.received
        order = "<" if self.data[1] & 1 else ">"
        seconds, nanoseconds = struct.unpack_from(f"{order}iI", self.data, 4)
        return seconds + nanoseconds * 1e-9 if seconds or nanoseconds else self.received

    @property
    def frame(self) -> str:
        """``header.frame_id`` of a message that begins with a header."""
        if len(self.data) < SHORTEST + 4:
            return ""
        order = "<" if self.data[1] & 1 else ">"
        (length,) = struct.unpack_from(f"{order}I", self.data, SHORTEST)
        text = self.data[SHORTEST + 4 : SHORTEST + 4 + length]
        return text.rstrip(b"\0").decode("utf-8", "replace").lstrip("/")


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
    except ModuleNotFoundError:
        raise StageError(MISSING.format(file)) from None
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
    from mcap.records import Schema
    from mcap_ros2.decoder import DecoderFactory

    def refuse(what: str) -> None:
        raise StageError(f"{file}: damaged: {what}")

    factory, decoders = DecoderFactory(), dict[Channel, Callable[[bytes], Any] | None]()
    with open_regular(file) as opened:
        # The library's reader expands chunks before it looks at how large they become.
        for channel, time_ns, data, _ in LogFile(refuse).messages(opened, file.stat().st_size):
            if channel.topic not in topics:
                continue
            if channel not in decoders:
                described = channel.schema_data, channel.schema_encoding, channel.schema
                schema = Schema(len(decoders) + 1, *described)
                decoders[channel] = factory.decoder_for(channel.encoding, schema)
            if (decode := decoders[channel]) is not None:
                yield Raw(file, channel.topic, time_ns * 1e-9, data, partial(decode, data))


def _opened(file: Path) -> AbstractContextManager[sqlite3.Connection]:
    return closing(sqlite3.connect(f"file:{file}?mode=ro", uri=True))


def _db3_topics(file: Path) -> dict[str, str]:
    with _opened(file) as database:
        return dict(database.execute("SELECT name, type FROM topics").fetchall())


def _db3_messages(file: Path, topics: Collection[str]) -> Iterator[Raw]:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)
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
    """Clouds and images taken out of bags, until the program ends."""
    return TemporaryDirectory(prefix="flangeye-bag-")


def scratch(bag: Path) -> Path:
    """Return a folder for what is taken out of one bag."""
    folder = Path(_scratch().name) / f"{abs(hash(bag.resolve())):x}"
    folder.mkdir(exist_ok=True)
    return folder


def cloud_of(message: Any) -> Singles:
    """Return the points of a ``sensor_msgs/PointCloud2``, (H, W, 3) if organised, else (N, 3) [m].

    Raises:
        StageError: It has no x, y and z.
    """
    fields = {f.name: f for f in message.fields}
    if not {"x", "y", "z"} <= set(fields):
        raise StageError(f"a PointCloud2 without x, y, z: it has {', '.join(fields) or 'nothing'}")
    order = ">" if message.is_bigendian else "<"
    kind = np.dtype(
        {
            "names": list("xyz"),
            "formats": [order + NUMBERS[fields[axis].datatype] for axis in "xyz"],
            "offsets": [fields[axis].offset for axis in "xyz"],
            "itemsize": message.point_step,
        }
    )
    row = message.width * message.point_step  # some drivers leave row_step at 0
    data = np.frombuffer(bytes(message.data), np.uint8)
    rows = data.reshape(message.height, message.row_step or row)
    used = np.ascontiguousarray(rows[:, :row])
    points = used.reshape(-1).view(kind)
    xyz = np.stack([points[axis].astype(np.float32) for axis in "xyz"], axis=-1)
    return xyz.reshape(message.height, message.width, 3) if message.height > 1 else xyz


def save_cloud(path: Path, message: Any) -> Path:
    """Write a cloud as .npy and return the file."""
    file = path.with_suffix(".npy")
    np.save(file, cloud_of(message))
    return file


def save_image(path: Path, message: Any) -> Path:
    """Write a ``sensor_msgs/Image`` or ``CompressedImage`` as a file and return it.

    Raises:
        StageError: Its encoding is not known.
        ImageError: It is compressed, and damaged.
    """
    import cv2

    if hasattr(message, "format"):
        pixels_of(message)  # a damaged one is found here, where it can still be set aside
        suffix = ".png" if "png" in message.format else ".jpg"
        path.with_suffix(suffix).write_bytes(bytes(message.data))
        return path.with_suffix(suffix)
    cv2.imwrite(str(path.with_suffix(".png")), pixels_of(message))
    return path.with_suffix(".png")


def pixels_of(message: Any) -> Any:
    """Return the pixels of a ``sensor_msgs/Image`` as 8 bits, blue first where coloured.

    Those of a ``CompressedImage`` are grey.

    Raises:
        StageError: Its encoding is not known.
        ImageError: It is compressed, and damaged.
    """
    import cv2

    if hasattr(message, "format"):
        return decode_image(bytes(message.data), cv2.IMREAD_GRAYSCALE)
    if message.encoding not in GREY:
        known = ", ".join(GREY)
        raise StageError(f"an image of encoding '{message.encoding}'; known: {known}")
    kind, channels = GREY[message.encoding]
    order = np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<")
    rows = np.frombuffer(bytes(message.data), np.uint8).reshape(message.height, message.step)
    width = message.width * channels * order.itemsize
    pixels = np.ascontiguousarray(rows[:, :width]).view(order)
    pixels = pixels.reshape(message.height, message.width, channels)[:, :, :3].squeeze()
    if kind is np.uint16:
        pixels = (pixels / max(int(pixels.max()), 1) * 255).astype(np.uint8)
    return pixels[..., ::-1] if message.encoding.startswith("rgb") else pixels
