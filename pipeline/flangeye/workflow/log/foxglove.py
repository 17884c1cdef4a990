"""Convert our values to Foxglove messages, so that any MCAP viewer shows a run.

The messages are protobuf with the published schemas; each function builds one.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import StageError
from flangeye.files.words import printable
from flangeye.maths.seam_geometry import seam_frames, tube_rings
from flangeye.types import CircleFeature, Floats, Image, PointCloud, Seam, Transform
from flangeye.types.geometry import basis_of_plane, quaternion_from_rotation, rigid


def point_cloud(cloud: PointCloud, xyz: NDArray[np.float32], time_ns: int) -> Any:
    """Return ``xyz`` (N, 3) float32, unchanged, as a foxglove.PointCloud in the cloud's frame."""
    from foxglove_schemas_protobuf.PackedElementField_pb2 import PackedElementField
    from foxglove_schemas_protobuf.PointCloud_pb2 import PointCloud as Message

    fields = [
        PackedElementField(name=name, offset=4 * i, type=PackedElementField.FLOAT32)
        for i, name in enumerate("xyz")
    ]
    data = np.ascontiguousarray(xyz, dtype="<f4").tobytes()
    message = Message(frame_id=cloud.frame, point_stride=12, fields=fields, data=data)
    # The identity; the default of all zeros is no rotation
    message.pose.orientation.w = 1.0
    message.timestamp.FromNanoseconds(time_ns)
    return message


def points_of(message: Any) -> NDArray[np.float32]:
    """Return the (N, 3) float32 points of a message made by :func:`point_cloud`."""
    return np.frombuffer(message.data, dtype="<f4").reshape(-1, 3)


def frame_transform(transform: Transform, time_ns: int) -> Any:
    """Return a foxglove.FrameTransform: the child's pose in the parent."""
    from foxglove_schemas_protobuf.FrameTransform_pb2 import FrameTransform

    message = FrameTransform(parent_frame_id=transform.parent, child_frame_id=transform.child)
    _set_pose(message.translation, message.rotation, transform)
    message.timestamp.FromNanoseconds(time_ns)
    return message


def pose_in_frame(transform: Transform, time_ns: int) -> Any:
    """Return a foxglove.PoseInFrame: the pose of the child in the parent."""
    from foxglove_schemas_protobuf.PoseInFrame_pb2 import PoseInFrame

    message = PoseInFrame(frame_id=transform.parent)
    _set_pose(message.pose.position, message.pose.orientation, transform)
    message.timestamp.FromNanoseconds(time_ns)
    return message


def compressed_image(image: Image, time_ns: int) -> Any:
    """Return the pixels as a foxglove.CompressedImage in PNG, lossless."""
    import cv2
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage

    # OpenCV encodes from blue, green, red
    colour = image.pixels[..., ::-1] if image.pixels.ndim == 3 else image.pixels
    _, data = cv2.imencode(".png", np.ascontiguousarray(colour))
    message = CompressedImage(frame_id="camera", format="png", data=data.tobytes())
    message.timestamp.FromNanoseconds(time_ns)
    return message


def circle_scene(capture: str, circle: CircleFeature, time_ns: int) -> Any:
    """Return a foxglove.SceneUpdate with the fitted circles and the normal, in ``camera``."""
    lines = [(points, 2.0) for points in circle_lines(circle)]
    return _scene("camera", f"circle/{capture}", lines, (0.9, 0.3, 0.1), time_ns)


def seam_scene(seam: Seam, time_ns: int) -> Any:
    """Return a foxglove.SceneUpdate with the planned seam and rings of its tube, in ``base``."""
    lines = [(seam.points_in_base, 3.0), *((ring, 1.0) for ring in tube_rings(seam))]
    return _scene("base", "seam", lines, (0.0, 0.45, 0.7), time_ns)


def _scene(
    frame: str,
    name: str,
    lines: Sequence[tuple[Floats, float]],
    colour: tuple[float, float, float],
    time_ns: int,
) -> Any:
    """Return a foxglove.SceneUpdate with lines (N, 3), each of a thickness."""
    from foxglove_schemas_protobuf.LinePrimitive_pb2 import LinePrimitive
    from foxglove_schemas_protobuf.SceneEntity_pb2 import SceneEntity
    from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate

    entity = SceneEntity(frame_id=frame, id=name)
    entity.timestamp.FromNanoseconds(time_ns)
    for points, thickness in lines:
        line = entity.lines.add(
            # Scale-invariant: the thickness is in pixels
            type=LinePrimitive.LINE_STRIP,
            thickness=thickness,
            scale_invariant=True,
        )
        line.pose.orientation.w = 1.0
        line.color.r, line.color.g, line.color.b = colour
        line.color.a = 1.0
        for x, y, z in points:
            line.points.add(x=x, y=y, z=z)
    return SceneUpdate(entities=[entity])


def circle_points(circle: CircleFeature, time_ns: int) -> Any:
    """Return the fitted circles and the normal as a foxglove.PointCloud, in ``camera``.

    Viewers that know no SceneUpdate, such as Rerun, show them so.
    """
    lines = circle_lines(circle, 360) or [circle.centre[None]]
    xyz = np.vstack(lines).astype(np.float32)
    return point_cloud(PointCloud("camera", xyz), xyz, time_ns)


def seam_poses(seam: Seam, time_ns: int) -> Any:
    """Return foxglove.PosesInFrame: along the seam, x in its direction and z into the groove."""
    from foxglove_schemas_protobuf.PosesInFrame_pb2 import PosesInFrame

    message = PosesInFrame(frame_id="base")
    message.timestamp.FromNanoseconds(time_ns)
    for point, rotation in zip(seam.points_in_base, seam_frames(seam), strict=True):
        pose = message.poses.add()
        _set_pose(
            pose.position, pose.orientation, Transform("base", "seam", rigid(rotation, point))
        )
    return message


def circle_lines(circle: CircleFeature, segments: int = 72) -> list[NDArray[np.float64]]:
    """Return polylines (N, 3) [m] in ``camera``: one ring a radius, and the normal as 30 mm."""
    if circle.normal is None:
        return []
    u, v, n = basis_of_plane(circle.normal)
    angle = np.linspace(0, 2 * np.pi, segments + 1)[:, None]
    ring = np.cos(angle) * u + np.sin(angle) * v
    rings = [circle.centre + radius * ring for radius in circle.radii.values()]
    return [*rings, np.stack([circle.centre, circle.centre + 0.03 * n])]


def log(message: str, level: str, time_ns: int) -> Any:
    """Return a foxglove.Log line; the level is one of its enumeration, such as ``INFO``."""
    from foxglove_schemas_protobuf.Log_pb2 import Log

    line = Log(level=Log.Level.Value(level), message=printable(message), name="flangeye")
    line.timestamp.FromNanoseconds(time_ns)
    return line


def _set_pose(position: Any, orientation: Any, transform: Transform) -> None:
    position.x, position.y, position.z = transform.translation
    x, y, z, w = quaternion_from_rotation(transform.rotation)
    orientation.x, orientation.y, orientation.z, orientation.w = x, y, z, w


CLOUD_TOPICS = ("/capture/cloud", "/circle", "/base/flanges")


def foxglove_layout() -> str:
    """Return a layout for Foxglove or Lichtblick, as ``Import from file`` reads it."""
    panels: dict[str, Any] = {
        "3D!cell": {
            "followTf": "base",
            "topics": {topic: {"visible": True, "pointSize": 2} for topic in CLOUD_TOPICS}
            | {"/scene": {"visible": True}, "/seam": {"visible": True}, "/pose": {"visible": True}},
        },
        "Image!camera": {"imageMode": {"imageTopic": "/capture/image"}},
        # From INFO on
        "RosOut!log": {"minLogLevel": 2},
        "RawMessages!rejected": {"topicPath": "/rejection"},
    }
    right = {
        "direction": "column",
        "first": "Image!camera",
        "second": {
            "direction": "column", "first": "RosOut!log", "second": "RawMessages!rejected",
        },
        "splitPercentage": 45,
    }  # fmt: skip
    layout = {"direction": "row", "first": "3D!cell", "second": right, "splitPercentage": 65}
    document = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": layout,
    }
    return json.dumps(document, indent=2) + "\n"


def write_rerun_blueprint(path: Path) -> None:
    """Write a blueprint for Rerun: ``rerun run.mcap layout.rbl`` opens a run with it.

    Raises:
        StageError: The extra ``rerun`` is not installed, or the file cannot be written.
    """
    try:
        import rerun.blueprint as rrb
    except ModuleNotFoundError:
        raise StageError(
            "a blueprint is written by Rerun itself: pip install 'flangeye[rerun]'"
        ) from None
    cell = rrb.Spatial3DView(name="Cell", origin="/", contents=["+ /**", "- /capture/image/**"])
    image = rrb.Spatial2DView(name="Camera", origin="/capture/image")
    log = rrb.TextLogView(name="Log", origin="/log")
    columns = rrb.Horizontal(cell, rrb.Vertical(image, log), column_shares=[2, 1])
    # Rerun keeps one layout for each application; that of a log is its file's name,
    # ``run.mcap``.
    try:
        rrb.Blueprint(columns, collapse_panels=True).save("run", str(path))
    except RuntimeError as error:
        raise StageError(f"{path}: cannot be written: {error}") from None
