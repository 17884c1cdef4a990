"""Read a run's MCAP back, finished or killed half way: for people, and to run again.

Read from front to back with the streaming reader: a file without its end is read as far as its
last whole message, and there is one way for both.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from flangeye import foxglove
from flangeye import types as t
from flangeye.errors import StageError
from flangeye.record import adapter

_TYPES: dict[str, type] = {
    cls.__name__: cls
    for cls in (
        t.FlangeCloud, t.CircleFeature, t.PoseFeature, t.HandEye, t.VerifiedHandEye, t.Verification,
        t.Observation, t.WorkpieceScan, t.Seam, t.WeldReport,
    )
}  # fmt: skip

Value = TypeVar("Value")


@dataclass(frozen=True)
class Entry:
    """One value a step gave.

    Attributes:
        step: Its label, such as ``2.fit.rim``.
        capture: The capture's id, for steps that run once per capture.
        seconds: What it took.
        type: Name of the value's type.
        value: The value, or plain data when its type is not ours.
    """

    step: str
    capture: str | None
    seconds: float
    type: str
    value: Any

    @property
    def stage(self) -> str:
        """Name of the stage, such as ``fit.rim``."""
        return self.step.partition(".")[2]

    @property
    def kind(self) -> str:
        """Kind of the stage, such as ``fit``."""
        return self.stage.partition(".")[0]


@dataclass(frozen=True)
class Note:
    """One line of a step's journal.

    Attributes:
        step: Its label, such as ``7.weld.tactile``.
        name: Under which it was written.
        value: Plain data; pixels (H, W) or (H, W, 3) for an image.
    """

    step: str
    name: str
    value: Any


@dataclass
class RunLog:
    """What a log holds, its raw clouds aside (see :meth:`captures`).

    Attributes:
        path: The file.
        complete: Whether the run came to its end.
        attachments: Name -> bytes: the recipe, the result.
        source: Where the captures came from; None when the run died before.
        total: How many captures were expected, when known.
        poses: Capture id -> its metadata, in order of arrival.
        entries: Every value, in order.
        rejections: Captures set aside.
        finished: Ids of the captures that went through.
        messages: Log lines for people.
    """

    path: Path
    complete: bool = False
    attachments: dict[str, bytes] = field(default_factory=dict)
    source: t.Source | None = None
    total: int | None = None
    poses: dict[str, dict[str, Any]] = field(default_factory=dict)
    entries: list[Entry] = field(default_factory=list)
    rejections: list[t.Rejection] = field(default_factory=list)
    finished: list[str] = field(default_factory=list)
    messages: list[str] = field(default_factory=list)

    @property
    def result(self) -> dict[str, Any] | None:
        """The content of ``result.json``, when the run came to its end."""
        raw = self.attachments.get("result.json")
        return None if raw is None else json.loads(raw)

    def of_kind(self, kind: str) -> list[Entry]:
        """Return the values of every step of one kind, in order."""
        return [entry for entry in self.entries if entry.kind == kind]

    def observations(self) -> list[t.Observation]:
        """Return one observation for each feature that was fitted, in order."""
        given = [e.value for e in self.of_kind("acquire") if isinstance(e.value, t.Observation)]
        fitted = [
            t.Observation(str(e.capture), e.value, *self._pose(str(e.capture)))
            for e in self.of_kind("fit")
            if e.capture in self.poses
        ]
        return given + fitted

    def flange_clouds(self) -> Iterator[tuple[t.Capture, t.FlangeCloud]]:
        """Yield each segmented flange with its capture, whose own cloud is the flange's."""
        for entry in self.of_kind("segment"):
            yield self._capture(str(entry.capture), entry.value.cloud), entry.value

    def views(self) -> t.Views:
        """Return the verification views."""
        return t.Views(
            t.VerificationView(capture.id, flange, capture.base_T_flange)
            for capture, flange in self.flange_clouds()
            if capture.role == "verification"
        )

    def calibration(self, stage: str | None = None) -> t.HandEye | None:
        """Return what ``stage`` gave, or the last calibration of any, if it came so far."""
        if stage is not None:
            found: t.HandEye | None = self.given(stage)
            return found
        return self.last(t.HandEye)

    def given(self, stage: str) -> Any:
        """Return the last value that ``stage`` gave, None when the run did not come so far."""
        return next((e.value for e in reversed(self.entries) if e.stage == stage), None)

    def last(self, kind: type[Value]) -> Value | None:
        """Return the last value of a type that any step gave."""
        return next((e.value for e in reversed(self.entries) if isinstance(e.value, kind)), None)

    def captures(self) -> Iterator[t.Capture]:
        """Yield the captures with their images, and their clouds as logged, thinned or whole."""
        meta: dict[str, Any] = {}
        pixels = None
        for topic, _, data in _messages(self.path):
            if topic == "/capture":
                meta, pixels = json.loads(data), None
            elif topic == "/capture/image":
                pixels = _decode_image(data)
            elif topic == "/capture/cloud":
                xyz = _decode_cloud(data).xyz
                if meta["full"]:
                    xyz = xyz.reshape(meta["shape"])
                yield self._capture(meta["id"], t.PointCloud(t.CAMERA, xyz), pixels)

    @property
    def has_full_clouds(self) -> bool:
        """Whether the raw scans were logged whole."""
        return bool(self.poses) and all(meta["full"] for meta in self.poses.values())

    def _pose(self, capture: str) -> tuple[t.Transform, Any, t.Transform | None]:
        """Return base_T_flange, the joint angles and base2_T_flange2."""
        meta, read = self.poses[capture], adapter(t.Transform).validate_python
        joints, second = meta["joints"], meta.get("base2_T_flange2")
        return (
            read(meta["base_T_flange"]),
            None if joints is None else np.array(joints),
            None if second is None else read(second),
        )

    def _capture(self, capture: str, cloud: t.PointCloud, pixels: Any = None) -> t.Capture:
        meta = self.poses[capture]
        pose, joints, second = self._pose(capture)
        image = None if pixels is None else t.Image(pixels, **meta["image"])
        return t.Capture(capture, cloud, pose, joints, meta["time_ns"], meta["role"], image, second)


def read_run(path: Path) -> RunLog:
    """Read a log, as far as it goes.

    Raises:
        StageError: The file is missing, empty, or not an MCAP file of ours.
    """
    log = RunLog(path)
    clouds: dict[str, t.PointCloud] = {}
    for topic, schema, data in _messages(path, log):
        if schema == "foxglove.PointCloud" and topic.startswith("/step/"):
            clouds[topic] = _decode_cloud(data)
        elif topic == "/log":
            log.messages.append(_decode_log(data))
        elif schema.startswith("flangeye."):
            _take(log, topic, schema.removeprefix("flangeye."), json.loads(data), clouds)
    if log.source is None and not log.attachments:
        raise StageError(f"{path}: is an MCAP file, but not a log of flangeye")
    return log


def read_notes(path: Path) -> Iterator[Note]:
    """Yield what steps wrote into their journals, in order, as far as the log goes.

    Raises:
        StageError: The file is missing, or not an MCAP file.
    """
    for topic, schema, data in _messages(path):
        if topic.startswith("/note/"):
            step, _, name = topic.removeprefix("/note/").rpartition("/")
            image = schema == "foxglove.CompressedImage"
            yield Note(step, name, _decode_image(data) if image else json.loads(data)["value"])


def _take(
    log: RunLog, topic: str, schema: str, data: dict[str, Any], clouds: dict[str, t.PointCloud]
) -> None:
    if topic == "/source":
        log.total = data.pop("total")
        log.source = adapter(t.Source).validate_python(data)
    elif topic == "/capture":
        log.poses[data["id"]] = data
    elif topic == "/capture/finished":
        log.finished.append(data["capture"])
    elif topic == "/rejection":
        log.rejections.append(t.Rejection(**data))
    elif topic.startswith("/step/"):
        held = _held(topic, data.get("shapes", {}), clouds)
        value = _decode_value(schema, data["value"], held)
        step = topic.removeprefix("/step/")
        log.entries.append(Entry(step, data["capture"], data["seconds"], schema, value))


def _held(
    topic: str, shapes: Mapping[str, list[int]], clouds: Mapping[str, t.PointCloud]
) -> dict[str, t.PointCloud]:
    """Return the clouds of a step's value by field name, in rows and columns as they were."""
    found = {at.rpartition("/")[2]: c for at, c in clouds.items() if at.rpartition("/")[0] == topic}
    return {
        name: t.PointCloud(cloud.frame, cloud.xyz.reshape(shapes.get(name, cloud.xyz.shape)))
        for name, cloud in found.items()
    }


def _decode_value(schema: str, data: Any, held: Mapping[str, t.PointCloud]) -> Any:
    cls = _TYPES.get(schema)
    return data if cls is None else adapter(cls).validate_python({**data, **held})


def _decode_cloud(data: bytes) -> t.PointCloud:
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud

    message = PointCloud.FromString(data)
    return t.PointCloud(message.frame_id, foxglove.points_of(message))


def _decode_image(data: bytes) -> Any:
    import cv2
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    raw = np.frombuffer(CompressedImage.FromString(data).data, dtype=np.uint8)
    pixels = np.asarray(cv2.imdecode(raw, cv2.IMREAD_UNCHANGED))
    return pixels if pixels.ndim == 2 else pixels[..., ::-1]


def _decode_log(data: bytes) -> str:
    from foxglove_schemas_protobuf.Log_pb2 import Log

    return str(Log.FromString(data).message)


def _messages(path: Path, log: RunLog | None = None) -> Iterator[tuple[str, str, bytes]]:
    """Yield (topic, schema name, data) until the end or the first damage; fill ``log``."""
    from mcap.records import Attachment, Channel, Footer, Message, Schema
    from mcap.stream_reader import StreamReader

    schemas: dict[int, str] = {}
    channels: dict[int, tuple[str, str]] = {}
    try:
        size = path.stat().st_size
        with path.open("rb") as file:
            for record in StreamReader(file, validate_crcs=True, record_size_limit=size).records:
                if isinstance(record, Schema):
                    schemas[record.id] = record.name
                elif isinstance(record, Channel):
                    channels[record.id] = (record.topic, schemas.get(record.schema_id, ""))
                elif isinstance(record, Message):
                    yield (*channels[record.channel_id], record.data)
                elif log is not None and isinstance(record, Attachment):
                    log.attachments[record.name] = record.data
                elif log is not None and isinstance(record, Footer):
                    log.complete = True
    except OSError as error:
        raise StageError(f"{path}: cannot be read: {error.strerror or error}") from None
    except Exception as error:  # damaged bytes can break the parser in any way
        if not channels:
            raise StageError(f"{path}: is not an MCAP file") from error
