"""Read a run's MCAP log, complete or not, to show it or to rerun from it.

The file is read sequentially, so an unfinished one is read up to its last complete message. Damaged
or foreign parts are named in ``RunLog.damage`` and left out; the rest is read
(:mod:`flangeye.workflow.log.records`).
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, NotRequired, TypeVar, cast

import numpy as np
from pydantic import Field
from typing_extensions import TypedDict

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.files.images import decode_image
from flangeye.files.regular import open_regular
from flangeye.workflow.log import foxglove
from flangeye.workflow.log.record import adapter
from flangeye.workflow.log.records import (
    DamageError,
    LogFile,
    LogMessage,
    NotMcapError,
    reason_of,
    unpack,
)

_TYPES: dict[str, type] = {
    cls.__name__: cls
    for cls in (
        t.FlangeCloud, t.CircleFeature, t.PoseFeature, t.HandEye, t.VerifiedHandEye, t.Verification,
        t.Observation, t.WorkpieceScan, t.Seam, t.WeldReport,
    )
}  # fmt: skip

Value = TypeVar("Value")


class _CaptureFacts(TypedDict):
    """Content of a ``/capture`` message."""

    id: str
    poses: dict[str, t.Transform]
    joints: list[float] | None
    time_ns: int
    role: t.Role
    shape: list[Annotated[int, Field(ge=0)]]
    full: bool
    step: str
    seconds: float
    image: NotRequired[dict[str, Any] | None]
    camera: NotRequired[str]
    target: NotRequired[str]
    motion: NotRequired[t.Motion | None]
    arm_joints: NotRequired[dict[str, list[float]]]


class _StepFacts(TypedDict):
    """Facts about a step from its message."""

    capture: str | None
    seconds: float


@dataclass(frozen=True)
class Entry:
    """One value a step gave.

    Attributes:
        step: Label of the step, such as ``2.fit.rim``.
        capture: The capture's id, for steps that run once per capture.
        seconds: Duration [s].
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
class JournalEntry:
    """One line of a step's log.

    Attributes:
        step: Label of the step, such as ``7.weld.tactile``.
        name: Name of the entry.
        value: Plain data; pixels (H, W) or (H, W, 3) for an image.
    """

    step: str
    name: str
    value: Any


@dataclass
class RunLog:
    """The content of a log, except its raw clouds (see :meth:`captures`).

    Attributes:
        path: Path of the file.
        complete: Whether the run finished.
        attachments: Attached files (recipe, result) by name, as bytes.
        source: Provenance of the captures; None if the run died before it was known.
        total: Expected number of captures, if known.
        poses: Metadata of the captures by id, in order of arrival.
        entries: All values, in order.
        rejections: Rejected captures.
        finished: Ids of completely processed captures.
        messages: Log lines as text.
        noted: Labels of the steps that logged notes; see :func:`read_notes`.
        damage: Unreadable parts with reasons, one sentence each.
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
    noted: set[str] = field(default_factory=set)
    damage: list[str] = field(default_factory=list)

    @property
    def gathered(self) -> bool:
        """Whether anything was recorded before the log ended."""
        return bool(self.poses or self.entries or self.rejections)

    @property
    def notes(self) -> list[str]:
        """The log's damage in a few lines, as notes for a result."""
        kept = f"kept: {len(self.poses)} captures, {len(self.entries)} values of steps"
        told_at_most = 10
        told = [f"{self.path}: damaged: {what}; {kept}" for what in self.damage[:told_at_most]]
        more = len(self.damage) - told_at_most
        return told + ([f"{self.path}: damaged: and {more} more"] if more > 0 else [])

    def require_sound(self) -> None:
        """Refuse a damaged log.

        Raises:
            StageError: The message gives the first damage, their number, and what is readable.
        """
        if self.damage:
            more = f" (and {len(self.damage) - 1} more)" if len(self.damage) > 1 else ""
            raise StageError(f"{self.notes[0]}{more}")

    def require_gathered(self) -> None:
        """Refuse a log without captures or results.

        Raises:
            StageError: It is damaged, or the run ended early.
        """
        if not self.gathered:
            self.require_sound()
            raise StageError(f"{self.path}: the run ended early; no capture was recorded")

    def text(self, name: str) -> str | None:
        """Return an attached text, such as ``recipe.yaml``; None if it is not attached."""
        raw = self.attachments.get(name)
        return None if raw is None else raw.decode()

    @property
    def has_recipe(self) -> bool:
        """Whether the log has the recipe of its run."""
        return not {"recipe.yaml", "recipe.resolved.yaml"}.isdisjoint(self.attachments)

    @property
    def models(self) -> dict[str, bytes]:
        """The recipe's own models attached to the log, by the name the recipe gives them."""
        return {k: v for k, v in self.attachments.items() if k.startswith("models/")}

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
            t.Observation(
                str(e.capture),
                e.value,
                *self._pose(str(e.capture)),
                *self._ends(str(e.capture)),
                self._motion(str(e.capture)),
                self._arm_joints(str(e.capture)),
            )
            for e in self.of_kind("fit")
            if e.capture in self.poses
        ]
        return given + fitted

    def flange_clouds(self) -> Iterator[tuple[t.Capture, t.FlangeCloud]]:
        """Yield each segmented flange as a cloud, with its capture."""
        for entry in self.of_kind("segment"):
            if str(entry.capture) not in self.poses:
                continue  # its pose is in the damaged part
            yield self._capture(str(entry.capture), entry.value.cloud), entry.value

    def views(self) -> t.Views:
        """Return the verification views."""
        return t.Views(
            t.VerificationView(capture.id, flange, capture.base_T_flange)
            for capture, flange in self.flange_clouds()
            if capture.role == "verification"
        )

    def calibration(self) -> t.HandEye | None:
        """Return the last calibration of any stage; None without one."""
        return self.last(t.HandEye)

    def given(self, stage: str) -> Any:
        """Return the last output of ``stage``; None if the run ended before it."""
        return next((e.value for e in reversed(self.entries) if e.stage == stage), None)

    def last(self, kind: type[Value]) -> Value | None:
        """Return the last value of a type that any step gave."""
        return next((e.value for e in reversed(self.entries) if isinstance(e.value, kind)), None)

    def captures(self) -> Iterator[t.Capture]:
        """Yield the captures with their images, and their clouds as logged, thinned or whole."""
        yield from (reading for reading in self.readings() if isinstance(reading, t.Capture))

    def readings(self) -> Iterator[t.Capture | t.Rejection]:
        """Yield the captures; a capture that cannot be read is yielded as its rejection."""
        capture, parts = "", dict[str, Any]()
        # Many thousands of poses without a scan are not read once more
        for message in _messages(self.path) if self.poses else ():
            topic = message.channel.topic
            try:
                if topic == "/capture":
                    capture, parts = str(decode_json(message.data)["id"]), {}
                elif topic == "/capture/scan" and capture in self.poses:
                    parts["scan"] = unpack(message.data, self.poses[capture]["shape"])
                elif topic == "/capture/image":
                    parts["pixels"] = logged_image(message.data)
                # The last message of a capture, after its scan and its image
                elif topic == "/capture/cloud" and capture in self.poses:
                    yield self._logged_capture(capture, message.data, **parts)
            except Exception as error:  # what a foreign log holds can be wrong in any way
                if capture in self.poses:
                    step = self.poses[capture]["step"].partition(".")[2]
                    yield t.Rejection(capture, step, _error_line(message, error))

    def _logged_capture(
        self, capture: str, data: bytes, scan: t.Singles | None = None, pixels: Any = None
    ) -> t.Capture:
        meta, xyz = self.poses[capture], _decode_cloud(data).xyz if scan is None else scan
        if meta["full"]:
            xyz = xyz.reshape(meta["shape"])
        return self._capture(capture, t.PointCloud(t.CAMERA, xyz), pixels)

    @property
    def has_full_clouds(self) -> bool:
        """Whether the raw scans were logged whole."""
        return bool(self.poses) and all(meta["full"] for meta in self.poses.values())

    @property
    def last_joints(self) -> Any:
        """Joint angles (n,) at the last capture [rad]; None if unknown."""
        return self._pose(next(reversed(self.poses)))[1] if self.poses else None

    def _pose(self, capture: str) -> tuple[t.Poses, Any]:
        """Return the controllers' poses by frame, and the joint angles."""
        meta = self.poses[capture]
        poses = adapter(dict[str, t.Transform]).validate_python(meta["poses"])
        return poses, None if meta["joints"] is None else np.array(meta["joints"])

    def _capture(self, capture: str, cloud: t.PointCloud, pixels: Any = None) -> t.Capture:
        meta = self.poses[capture]
        poses, joints = self._pose(capture)
        image = None if pixels is None else t.Image(pixels, **meta["image"])
        ends = self._ends(capture)
        when = meta["time_ns"], meta["role"]
        moved = self._motion(capture), self._arm_joints(capture)
        return t.Capture(capture, cloud, poses, joints, *when, image, *ends, *moved)

    def _motion(self, capture: str) -> t.Motion | None:
        """Return the flange's motion at a capture; None for an arm at rest."""
        motion = adapter(t.Motion | None).validate_python(self.poses[capture].get("motion"))
        return cast("t.Motion | None", motion)

    def _arm_joints(self, capture: str) -> dict[str, t.Floats]:
        """Return the joint angles of a cell's arms, by their frames."""
        given = self.poses[capture].get("arm_joints", {})
        return {name: np.array(joints) for name, joints in given.items()}

    def _ends(self, capture: str) -> tuple[str, str]:
        """Return camera and target of a capture; defaults for logs of one camera."""
        meta = self.poses[capture]
        return meta.get("camera", t.CAMERA), meta.get("target", t.TARGET)


def log_of(path: Path) -> Path:
    """Return the log of a run, given as its folder or any file in it."""
    if path.is_dir():
        return path / "run.mcap"
    beside = path.parent / "run.mcap"
    of_a_run = path.name in ("calibration.yaml", "result.json", "report.html")
    return beside if of_a_run and beside.is_file() else path


def is_log(path: Path) -> bool:
    """Return whether a file may be a flangeye log; other programs write MCAP too."""
    if path.suffix != ".mcap" or not path.is_file():
        return False
    with path.open("rb") as file:
        head = file.read(64)
    # How every MCAP file begins; the name of the program that wrote it follows
    return not head.startswith(b"\x89MCAP0\r\n") or b"flangeye" in head


def read_run(path: Path) -> RunLog:
    """Read the log of a run, given as a file or folder, up to its first damage.

    Raises:
        StageError: The file is missing, empty, or not an MCAP file of ours.
    """
    log = RunLog(log_of(path))
    clouds: dict[str, t.PointCloud] = {}
    for message in _messages(log.path, log):
        take(log, message, clouds)
    _check_texts(log)
    return log


def read_notes(path: Path, steps: Set[str] | None = None) -> Iterator[JournalEntry]:
    """Yield the notes that steps logged, in order, up to the first damage.

    Args:
        path: The log.
        steps: Labels of the steps to read; None for all.

    Raises:
        StageError: The file is missing, no MCAP file, or damaged; missing notes would change the
            repeated decisions.
    """
    for message in _messages(path, strict=True):
        topic = message.channel.topic
        of = topic.removeprefix("/note/").rpartition("/")[0]
        if topic.startswith("/note/") and (steps is None or of in steps):
            try:
                yield _note(message)
            except Exception as error:  # what a foreign log holds can be wrong in any way
                raise StageError(f"{path}: {_error_line(message, error)}") from None


def _note(message: LogMessage) -> JournalEntry:
    step, _, name = message.channel.topic.removeprefix("/note/").rpartition("/")
    if message.channel.schema == "foxglove.CompressedImage":
        return JournalEntry(step, name, logged_image(message.data))
    return JournalEntry(step, name, decode_json(message.data)["value"])


def take(log: RunLog, message: LogMessage, clouds: dict[str, t.PointCloud]) -> None:
    """Add one message to a run's log; an unreadable one is recorded as damage.

    Args:
        log: The log so far, which is changed.
        message: The next message.
        clouds: Clouds read so far that later values refer to, by topic.
    """
    try:
        _take(log, message, clouds)
    except Exception as error:  # what a foreign log holds can be wrong in any way
        log.damage.append(_error_line(message, error))


def _take(log: RunLog, message: LogMessage, clouds: dict[str, t.PointCloud]) -> None:
    topic, schema = message.channel.topic, message.channel.schema
    if topic.startswith("/note/"):
        log.noted.add(topic.removeprefix("/note/").rpartition("/")[0])
    elif schema == "foxglove.PointCloud" and topic.startswith("/step/"):
        # A value's clouds are logged before it, on topics of their own
        clouds[topic] = _decode_cloud(message.data)
    elif topic == "/log":
        log.messages.append(_decode_log(message.data))
    # A whole scan is packed and large: only `readings` unpacks it
    elif schema.startswith("flangeye.") and schema != "flangeye.Scan":
        _take_json(log, topic, schema.removeprefix("flangeye."), message.data, clouds)


def _take_json(
    log: RunLog, topic: str, schema: str, raw: bytes, clouds: dict[str, t.PointCloud]
) -> None:
    data = decode_json(raw)
    if topic == "/source":
        total = adapter(int | None).validate_python(data.pop("total"), strict=True)
        log.source, log.total = adapter(t.Source).validate_python(data), total
    elif topic == "/capture":
        adapter(_CaptureFacts).validate_python(data)
        log.poses[data["id"]] = data
    elif topic == "/capture/finished":
        log.finished.append(adapter(str).validate_python(data["capture"]))
    elif topic == "/rejection":
        log.rejections.append(adapter(t.Rejection).validate_python(data))
    elif topic.startswith("/step/"):
        facts = adapter(_StepFacts).validate_python(data)
        held = _held(topic, data.get("shapes", {}), clouds)
        value = _decode_value(schema, data["value"], held)
        step = topic.removeprefix("/step/")
        entry = Entry(step, facts["capture"], facts["seconds"], schema, value)
        _check_kind(entry)
        log.entries.append(entry)


def _check_kind(entry: Entry) -> None:
    """Refuse a value of a type that no stage of its kind returns."""
    # What the steps of a kind give, where others rely on it
    expected: tuple[type, ...] | None = {
        "segment": (t.FlangeCloud,),
        "fit": (t.CircleFeature, t.PoseFeature),
        "verify": (t.Verification,),
    }.get(entry.kind)
    if expected and not isinstance(entry.value, expected):
        names = " or ".join(kind.__name__ for kind in expected)
        raise DamageError(f"a step of {entry.kind} gives {names}, not {entry.type}")


def _check_texts(log: RunLog) -> None:
    """Record attachments whose content does not match their name as damaged."""
    for name, raw in list(log.attachments.items()):
        try:
            if name.endswith(".yaml"):
                raw.decode()
            elif name == "result.json":
                decode_json(raw)
        except Exception as error:  # what a foreign log holds can be wrong in any way
            del log.attachments[name]
            log.damage.append(f"the attached {name}: {reason_of(error)}")


def decode_json(raw: bytes) -> dict[str, Any]:
    """Return a JSON object of a log.

    Raises:
        ValueError: The text is too long, no JSON, or no object.
    """
    most = 1 << 24  # decoded, a message takes forty times as much [bytes]
    if len(raw) > most:
        raise DamageError(f"it has {len(raw)} bytes; at most {most} are read")
    # Python's parser would accept NaN and Infinity, which are not JSON
    data = json.loads(raw, parse_constant=_no_number)
    if not isinstance(data, dict):
        raise DamageError(f"it is not an object but of type {type(data).__name__}")
    return data


def _no_number(text: str) -> None:
    raise DamageError(f"it holds {text}, which is not a number")


def _error_line(message: LogMessage, error: Exception) -> str:
    return f"message {message.number} on {message.channel.topic}: {reason_of(error)}"


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


def logged_image(data: bytes) -> Any:
    """Return the pixels of a logged image, (H, W) grey or (H, W, 3) as red, green, blue."""
    import cv2
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    pixels = decode_image(CompressedImage.FromString(data).data, cv2.IMREAD_UNCHANGED)
    # OpenCV decodes to blue, green, red
    return pixels if pixels.ndim == 2 else pixels[..., ::-1]


def _decode_log(data: bytes) -> str:
    from foxglove_schemas_protobuf.Log_pb2 import Log

    return str(Log.FromString(data).message)


def _messages(path: Path, log: RunLog | None = None, strict: bool = False) -> Iterator[LogMessage]:
    """Yield the messages up to the log's end or its first unreadable part; fill ``log``."""

    def damaged(what: str) -> None:
        if strict:
            raise StageError(f"{path}: damaged: {what}")
        if log is not None:
            log.damage.append(what)

    reading = LogFile(damaged)
    with open_regular(path) as file:
        try:
            yield from reading.messages(file, path.stat().st_size)
        except NotMcapError:
            raise StageError(f"{path}: is not an MCAP file") from None
        except OSError as error:
            raise StageError(f"{path}: cannot be read: {error.strerror or error}") from None
    if log is not None:
        log.attachments, log.complete = reading.attachments, reading.ended
        if log.source is None and not log.attachments and not reading.may_be_ours:
            raise StageError(f"{path}: is an MCAP file, but not a log of flangeye")
