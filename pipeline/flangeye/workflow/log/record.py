"""Log a run to MCAP while it runs; a hook implementation, so no stage can forget to log.

Channels (``N.stage`` is a step's label, such as ``2.fit.rim``):

============================  ==========================  ======================================
topic                         schema                      content
============================  ==========================  ======================================
/source                       flangeye.Source (JSON)      where captures come from, and notes
/capture                      flangeye.Capture (JSON)     id, pose, joints, time, role, grid shape
/capture/image                foxglove.CompressedImage    what a camera saw, lossless
/capture/scan                 flangeye.Scan               the whole scan, if asked for
/capture/cloud                foxglove.PointCloud         the scan, thinned
/pose                         foxglove.PoseInFrame        the flange as the controller reports it
/tf                           foxglove.FrameTransform     base -> flange, carrier -> camera, …
/step/N.stage                 flangeye.<type> (JSON)      what the step gave, lossless
/step/N.stage/cloud           foxglove.PointCloud         the points of that value, lossless
/note/N.stage/name            flangeye.<type> (JSON)      what a step wrote into its log
/note/N.stage/name            foxglove.CompressedImage    the same, for images
/scene                        foxglove.SceneUpdate        fitted circles; the seam and its tube
/circle                       foxglove.PointCloud         the fitted circles again, as points
/base/flanges                 foxglove.PointCloud         the flanges in base, once solved, thinned
/seam                         foxglove.PosesInFrame       the planned seam, z into the groove
/rejection                    flangeye.Rejection (JSON)   a capture set aside, and why
/capture/finished             flangeye.Finished (JSON)    nothing more will come of this capture
/log                          foxglove.Log                the same for people
/ended                        flangeye.Ended (JSON)       the run ended early, and why
============================  ==========================  ======================================

A ``flangeye.Scan`` is the scan's points, three little-endian float32 each, as
:mod:`flangeye.workflow.log.records` packs them; ``shape`` of its ``flangeye.Capture`` has rows and
columns. JSON messages of steps are ``{"capture": id or null, "seconds": s, "value": …, "shapes":
…}``; the shapes are those of the clouds' arrays, whose messages have no rows and columns.
Attachments: ``recipe.yaml``, ``recipe.resolved.yaml`` and, when the run ended, ``result.json``.
Every message is a chunk of its own and is handed to the operating system at once: a killed run
loses nothing that was finished.
"""

from __future__ import annotations

import dataclasses
import hashlib
import json
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import TypeAdapter

from flangeye import types as t
from flangeye.devices import RobotState
from flangeye.errors import FlangeyeError
from flangeye.files.paths import VERSION
from flangeye.plugin.hookspecs import hookimpl
from flangeye.workflow.log import foxglove
from flangeye.workflow.log.records import HASHES, pack

_ADAPTERS: dict[Any, TypeAdapter[Any]] = {}


class LogWriteError(FlangeyeError):
    """The log cannot be written any further, for example because the disk is full."""


def adapter(cls: Any) -> TypeAdapter[Any]:
    """Return the (cached) JSON reader and writer of a type."""
    if cls not in _ADAPTERS:
        _ADAPTERS[cls] = TypeAdapter(cls)
    return _ADAPTERS[cls]


def clouds_of(value: Any) -> dict[str, t.PointCloud]:
    """Return the point clouds among the fields of a step's result, by field name."""
    if not dataclasses.is_dataclass(value):
        return {}
    held = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    return {name: v for name, v in held.items() if isinstance(v, t.PointCloud)}


class Recorder:
    """Writes one run to one MCAP file.

    Attributes:
        gathered: Whether the log contains scans or results worth keeping.
    """

    def __init__(self, path: Path, recipe: dict[str, str], full_clouds: bool) -> None:
        """Create the log file.

        Args:
            path: File to create.
            recipe: Attachment name -> YAML text.
            full_clouds: Log raw scans whole instead of thinned.

        Raises:
            LogWriteError: The file cannot be written.
        """
        from mcap.writer import CompressionType, Writer

        self.gathered = False
        self._path = path
        self._full = full_clouds
        self._channels: dict[str, int] = {}
        self._poses: dict[str, t.Transform] = {}
        self._cameras: dict[str, str] = {}
        self._flanges: dict[str, t.PointCloud] = {}
        try:
            self._file = path.open("wb")
            # One message, one chunk: what was written survives the death of the process. Scans and
            # images come packed, and the other points are noise to a codec: LZ4 won 0.3 % of a
            # calibration's log, 7 % of a weld's, and cost a fifth of writing a whole scan.
            self._writer = Writer(
                self._file, chunk_size=1, compression=CompressionType.NONE, enable_data_crcs=True
            )
            self._writer.start(profile="", library=f"flangeye {VERSION}")
            for name, text in recipe.items():
                self._attach(name, "application/yaml", text.encode("utf-8", "replace"))
        except OSError as error:
            raise self._unwritable(error) from None

    @hookimpl
    def flangeye_run_started(self, source: t.Source, total: int | None) -> None:
        """Log where the captures come from."""
        self._json("/source", "Source", {"total": total, **_plain(source)})
        for note in source.notes:
            self._log(note, "INFO")

    @hookimpl
    def flangeye_captured(self, step: str, capture: t.Capture, seconds: float) -> None:
        """Log the scan, the image and the pose."""
        self.gathered = True
        cloud, now = capture.cloud, time.time_ns()
        meta = _plain(capture) | {
            "shape": list(cloud.xyz.shape),
            # A capture without points, such as an image, lacks nothing
            "full": self._full or not cloud.xyz.size,
            "step": step,
            "seconds": seconds,
        }
        self._json("/capture", "Capture", meta)
        if capture.image is not None:  # before the cloud, with which a capture is whole
            self._proto("/capture/image", foxglove.compressed_image(capture.image, now))
        if self._full and cloud.xyz.size:
            self._write("/capture/scan", "Scan", "application/x-flangeye-scan", pack(cloud.xyz))
        self._proto("/capture/cloud", foxglove.point_cloud(cloud, _thinned(cloud), now))
        self._cameras[capture.id] = capture.camera
        if t.FLANGE in capture.poses:
            self._poses[capture.id] = capture.base_T_flange
            self._proto("/pose", foxglove.pose_in_frame(capture.base_T_flange, now))
        for pose in capture.poses.values():
            self._proto("/tf", foxglove.frame_transform(pose, now))

    @hookimpl
    def flangeye_stage_finished(
        self, step: str, capture: str | None, value: Any, seconds: float
    ) -> None:
        """Log a step's result, and a copy of it for viewers."""
        self.gathered = True
        topic, clouds = f"/step/{step}", clouds_of(value)
        for name, cloud in clouds.items():
            xyz = cloud.xyz.reshape(-1, 3)
            self._proto(f"{topic}/{name}", foxglove.point_cloud(cloud, xyz, time.time_ns()))
        payload = {
            "capture": capture,
            "seconds": seconds,
            "value": _plain(value),
            "shapes": {name: list(cloud.xyz.shape) for name, cloud in clouds.items()},
        }
        self._json(topic, type(value).__name__, payload)
        self._mirror(capture, value)

    @hookimpl
    def flangeye_noted(self, step: str, name: str, value: Any) -> None:
        """Log a line of a step's log."""
        topic = f"/note/{step}/{name}"
        if isinstance(value, t.Image):
            self._proto(topic, foxglove.compressed_image(value, time.time_ns()))
        else:
            self._json(topic, type(value).__name__, {"value": _plain(value)})
        if isinstance(value, RobotState):
            self._proto("/tf", foxglove.frame_transform(value.base_T_flange, time.time_ns()))

    @hookimpl
    def flangeye_capture_rejected(self, rejection: t.Rejection) -> None:
        """Log a rejected capture."""
        self._json("/rejection", "Rejection", _plain(rejection))
        self._log(f"{rejection.id} set aside by {rejection}", "WARNING")

    @hookimpl
    def flangeye_capture_finished(self, capture: str) -> None:
        """Log that a capture is finished."""
        self._json("/capture/finished", "Finished", {"capture": capture})

    @hookimpl
    def flangeye_run_finished(self, result: dict[str, Any]) -> None:
        """Attach the result and close the file."""
        try:
            told = dump_result(result).encode("utf-8", "replace")
            self._attach("result.json", "application/json", told)
            self._writer.finish()  # type: ignore[no-untyped-call]
        except OSError as error:
            raise self._unwritable(error) from None
        self.close()

    def ended(self, reason: str) -> None:
        """Log that the run ended early, and why; a viewer that follows it stops waiting."""
        with suppress(LogWriteError):  # a full disk has been reported already
            if not self._file.closed:
                self._log(reason, "ERROR")
                self._json("/ended", "Ended", {"reason": reason})

    def close(self) -> None:
        """Close the file; a log without an end can still be read."""
        try:
            self._file.close()
        except OSError as error:
            raise self._unwritable(error) from None

    def _mirror(self, capture: str | None, value: Any) -> None:
        now = time.time_ns()
        if isinstance(value, t.FlangeCloud) and capture is not None:
            self._flanges[capture] = t.PointCloud(t.CAMERA, _thinned(value.cloud, 4_000))
        if isinstance(value, t.CircleFeature) and capture is not None:
            self._proto("/scene", foxglove.circle_scene(capture, value, now))
            self._proto("/circle", foxglove.circle_points(value, now))
        if isinstance(value, t.PoseFeature) and capture is not None:
            self._proto("/tf", foxglove.frame_transform(value.camera_T_target, now))
        if isinstance(value, t.HandEye):
            for estimate in value.transforms.values():
                self._proto("/tf", foxglove.frame_transform(estimate.transform, now))
            self._in_base(value, now)
        if isinstance(value, t.Seam):
            self._proto("/scene", foxglove.seam_scene(value, now))
            self._proto("/seam", foxglove.seam_poses(value, now))
        if isinstance(value, t.Verification):
            level = "INFO" if value.passed else "WARNING"
            self._log(value.reason, level)

    def _in_base(self, calibration: t.HandEye, now: int) -> None:
        """Log every flange mapped to the base by the calibration; they disagree if it is wrong."""
        found = {x.transform.child: x.transform for x in calibration.transforms.values()}
        for capture, cloud in self._flanges.items():
            place, pose = found[self._cameras.get(capture, t.CAMERA)], self._poses.get(capture)
            camera = t.Transform(place.parent, t.CAMERA, place.matrix)
            # The pose of a camera in the hand is known in the flange, whose pose changes with the
            # capture
            moved = pose @ camera if pose is not None and camera.parent == t.FLANGE else camera
            if moved.parent == t.BASE:
                flange = moved.apply_cloud(cloud)
                self._proto("/base/flanges", foxglove.point_cloud(flange, flange.xyz, now))

    def _log(self, line: str, level: str) -> None:
        self._proto("/log", foxglove.log(line, level, time.time_ns()))

    def _json(self, topic: str, schema: str, payload: dict[str, Any]) -> None:
        self._write(topic, schema, "json", json.dumps(payload, allow_nan=False).encode())

    def _write(self, topic: str, schema: str, encoding: str, data: bytes) -> None:
        if topic not in self._channels:
            described = json.dumps({"title": f"flangeye.{schema}", "type": "object"}).encode()
            of_schema = ("jsonschema", described) if encoding == "json" else ("", b"")
            schema_id = self._writer.register_schema(f"flangeye.{schema}", *of_schema)
            self._channels[topic] = self._writer.register_channel(topic, encoding, schema_id)
        self._add(topic, data)

    def _proto(self, topic: str, message: Any) -> None:
        from mcap_protobuf.schema import register_schema

        if topic not in self._channels:
            schema_id = register_schema(self._writer, type(message))
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", schema_id)
        self._add(topic, message.SerializeToString())

    def _add(self, topic: str, data: bytes) -> None:
        now = time.time_ns()
        try:
            self._writer.add_message(self._channels[topic], now, data, now)
            # Flushed each time: a viewer follows the file, and a killed run keeps its captures
            self._file.flush()
        except OSError as error:
            raise self._unwritable(error) from None

    def _attach(self, name: str, media_type: str, data: bytes) -> None:
        now = time.time_ns()
        self._writer.add_attachment(now, now, name, media_type, data)
        self._writer.add_metadata(HASHES, {name: hashlib.sha256(data).hexdigest()})
        self._file.flush()

    def _unwritable(self, error: OSError) -> LogWriteError:
        return LogWriteError(
            f"{self._path}: cannot be written: {error.strerror or error}; what was written so far "
            "can be read with 'flangeye show'"
        )


def dump_result(result: dict[str, Any]) -> str:
    """Return the text of ``result.json``."""
    return json.dumps(result, indent=2, allow_nan=False, ensure_ascii=False) + "\n"


def _plain(value: Any) -> Any:
    """Return a stage's value as plain JSON data, without parts that have their own channel."""
    left_out: dict[str, Any] = dict.fromkeys(clouds_of(value), True)
    if isinstance(value, t.Capture):
        left_out["image"] = {"pixels"}
    return adapter(type(value)).dump_python(value, mode="json", exclude=left_out)


def _thinned(cloud: t.PointCloud, most: int = 40_000) -> NDArray[np.float32]:
    """Return at most a given number of finite points, evenly thinned."""
    flat = cloud.xyz.reshape(-1, 3)
    if cloud.organised:
        # The same step along rows and columns keeps the scan's proportions
        step = max(1, int(np.ceil(np.sqrt(len(flat) / most))))
        flat = cloud.xyz[::step, ::step].reshape(-1, 3)
    else:
        flat = flat[:: max(1, -(-len(flat) // most))]
    return flat[np.isfinite(flat).all(axis=1)]
