"""Formats with a grammar of their own: YAML, XML, Python and shell, each quoted by its library.

ROS 2's ``static_transform_publisher``: metres, quaternion xyzw. MoveIt's hand-eye panel saves a
launch file of one; ``sensors_3d.yaml`` holds topics and no pose, MoveIt takes the pose from tf.
easy_handeye2's ``.calib`` (``handeye_calibration.py``): metres, xyzw. OpenCV's FileStorage and
Zivid's ``Matrix4x4``: 4x4, row by row. RoboDK: a script that adds a frame, or a tool of the arm.

A URDF has the joints from what carries the camera to its mount and on to its optical frame.
Calibrations find the optical frame (z along the view); a camera's own URDF hangs by its mount link:
``base_T_mount = base_T_optical inv(mount_T_optical)``. Metres; rpy is Rz(y) Ry(p) Rx(r).
"""

from __future__ import annotations

import re
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from pydantic import Field

from flangeye import Params, StageError
from flangeye.files.paths import RecipeFile
from flangeye.models.urdf import end_of, origin_of, read_urdf
from flangeye.types import CAMERA, CalibratedPose, ExportedFile, Floats
from flangeye.types.geometry import rigid, rotation_from_rpy
from flangeye.units import Angle, Length, param
from flangeye_plugins.export.writing import (
    FRAME,
    FramesParams,
    LengthParams,
    NamedParams,
    fixed,
    numbers_of,
)


def ros2_command(pose: CalibratedPose, params: FramesParams) -> ExportedFile:
    """Write the command that publishes the pose as a ROS 2 static transform."""
    command = ("ros2", "run", "tf2_ros", "static_transform_publisher")
    lines = [shlex.join([*command, *_arguments(each, params)]) for each in pose.each]
    # A publisher runs until it is stopped, so all but the last go to the background
    text = pose.comment("#") + " &\n".join(lines) + "\n"
    if "\0" in text or not text.isascii():
        raise StageError("export.ros2_command: a frame name cannot be quoted for a shell")
    return ExportedFile(
        f"{params.name}.ros2.sh", text, "run it in a shell in which ROS 2 is sourced"
    )


def ros2_launch(pose: CalibratedPose, params: FramesParams) -> ExportedFile:
    """Write a ROS 2 launch file that publishes the pose as a static transform."""
    name = f"{params.name}.launch.py"
    return ExportedFile(name, _launch_file(pose, params), f"ros2 launch ./{name}")


def moveit(pose: CalibratedPose, params: FramesParams) -> ExportedFile:
    """Write the launch file that MoveIt's hand-eye calibration panel would save."""
    sort = "EYE-TO-HAND" if pose.stands else "EYE-IN-HAND"
    use = "include it in your MoveIt launch file; sensors_3d.yaml then needs the topic only"
    text = f"# Static transform publisher of the camera, {sort}.\n{_launch_file(pose, params)}"
    return ExportedFile(f"{params.name}_moveit.launch.py", text, use)


def _arguments(pose: CalibratedPose, params: FramesParams) -> list[str]:
    numbers = numbers_of("quaternion_xyzw", pose.transform.matrix)
    frames = ("--frame-id", params.carrier(pose), "--child-frame-id", params.carried(pose))
    # Options of static_transform_publisher in the order of the numbers: x, y, z, then xyzw
    flags = ("--x", "--y", "--z", "--qx", "--qy", "--qz", "--qw")
    return [word for pair in zip(flags, numbers, strict=True) for word in pair] + [*frames]


def _launch_file(pose: CalibratedPose, params: FramesParams) -> str:
    nodes = "".join(_node(each, params) for each in pose.each)
    return f"""{pose.comment("#")}
from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    return LaunchDescription([
{nodes}    ])
"""


def _node(pose: CalibratedPose, params: FramesParams) -> str:
    name = params.name if pose.transform.child == CAMERA else pose.transform.child
    return f"""        Node(
            package="tf2_ros",
            executable="static_transform_publisher",
            name={f"{name}_static_transform"!r},
            arguments={_arguments(pose, params)!r},
        ),
"""


def easy_handeye2(pose: CalibratedPose, params: FramesParams) -> ExportedFile:
    """Write a calibration that easy_handeye2's publisher loads."""
    numbers = [float(n) for n in numbers_of("quaternion_xyzw", pose.transform.matrix)]
    carrier = params.carrier(pose)
    document = {
        "parameters": {
            "name": params.name,
            # Frames that the other mounting does not use still need a name in the file
            "calibration_type": "eye_on_base" if pose.stands else "eye_in_hand",
            "robot_base_frame": carrier if pose.stands else "base",
            "robot_effector_frame": "flange" if pose.stands else carrier,
            "tracking_base_frame": params.carried(pose),
            "tracking_marker_frame": "target",
            "freehand_robot_movement": True,
            "move_group_namespace": "/",
            "move_group": "manipulator",
        },
        "transform": {
            "translation": dict(zip("xyz", numbers[:3], strict=True)),
            "rotation": dict(zip("xyzw", numbers[3:], strict=True)),
        },
    }
    use = "copy it to ~/.ros2/easy_handeye2/calibrations/, then publish it by its name"
    return ExportedFile(f"{params.name}.calib", pose.comment("#") + _yaml(document), use)


class _Matrix(dict[str, Any]):
    """A matrix of OpenCV's FileStorage."""


class _OpenCvDumper(yaml.SafeDumper):
    """PyYAML's safe writer, with OpenCV's tag."""


_OpenCvDumper.add_representer(
    # Written as !!opencv-matrix, by which FileStorage knows a matrix
    _Matrix,
    lambda dumper, data: dumper.represent_mapping("tag:yaml.org,2002:opencv-matrix", data),
)


def _yaml(document: Mapping[str, Any]) -> str:
    text: str = yaml.dump(document, Dumper=_OpenCvDumper, sort_keys=False, default_flow_style=None)
    return text


def opencv(pose: CalibratedPose, params: LengthParams) -> ExportedFile:
    """Write an OpenCV FileStorage (YAML) with the pose as a 4x4 matrix."""
    # FileStorage writes a matrix as a mapping of rows, cols, dt ("d": double) and data, row by row
    key = pose.transform.name
    numbers = [number for row in params.matrix(pose) for number in row]
    document = {key: _Matrix(rows=4, cols=4, dt="d", data=numbers)}
    text = f"%YAML:1.0\n---\n{pose.comment('#')}{_yaml(document)}"
    use = f"cv2.FileStorage(file, cv2.FILE_STORAGE_READ).getNode({key!r}).mat()"
    return ExportedFile(f"{params.name}.opencv.yml", text, use)


def zivid(pose: CalibratedPose, params: LengthParams) -> ExportedFile:
    """Write the pose as a Zivid Matrix4x4."""
    document = {
        "__version__": {"serializer": 1, "data": 1},
        "FloatMatrix": {"Data": params.matrix(pose)},
    }
    name = f"{params.name}.zivid.yaml"
    return ExportedFile(name, pose.comment("#") + _yaml(document), f"zivid.Matrix4x4({name!r})")


def robodk(pose: CalibratedPose, params: NamedParams) -> ExportedFile:
    """Write a Python script that adds the pose to the open RoboDK station."""
    rows = LengthParams(length="mm").matrix(pose)
    matrix = "".join(f"    {row!r},\n" for row in rows)
    name = params.name
    added = (
        # The parent of a robot in RoboDK is its base frame
        f"STATION.AddFrame({name!r}, ROBOT.Parent()).setPose(POSE)"
        if pose.stands
        else f"ROBOT.AddTool(POSE, {name!r})"
    )
    text = f"""{pose.comment("#")}from robodk import robolink, robomath

POSE = robomath.Mat([
{matrix}])  # millimetres

if __name__ == "__main__":
    STATION = robolink.Robolink()
    ROBOT = STATION.Item("", robolink.ITEM_TYPE_ROBOT)
    {added}
"""
    return ExportedFile(f"{params.name}_robodk.py", text, "run it beside the open station")


def matrix(pose: CalibratedPose, params: LengthParams) -> ExportedFile:
    """Write the plain 4x4 matrix as text, in metres or millimetres."""
    lines = "".join(" ".join(fixed(row)) + "\n" for row in params.matrix(pose))
    text = f"{pose.comment('#')}{lines}"
    return ExportedFile(f"{params.name}.txt", text, "numpy.loadtxt reads it")


class OpticalParams(Params):
    """Where the optical frame is in the mount link."""

    position: tuple[Length, Length, Length] = param(("0 mm", "0 mm", "0 mm"))
    """Position of the optical frame's origin in the mount link."""
    rpy: tuple[Angle, Angle, Angle] = param(("-90 deg", "0 deg", "-90 deg"))
    """Roll, pitch, yaw; by default z ahead along the mount's x, as in REP 103."""

    @property
    def matrix(self) -> Floats:
        """``mount_T_optical`` (4, 4) [m]."""
        return rigid(rotation_from_rpy(*self.rpy), np.array(self.position))


class UrdfParams(FramesParams):
    """The frames, and the pose of the camera's optical frame in its mount link."""

    mount: str | None = Field(None, pattern=FRAME)
    """The camera's mount link; camera_link if not given."""
    child: str | None = Field(None, pattern=FRAME)
    """The camera's optical frame; camera_optical_frame if not given, and in a cell the frame's own
    name."""
    mount_T_optical: OpticalParams | None = None
    """Where the optical frame is in the mount link, if that is known."""
    camera_urdf: RecipeFile | None = None
    """The camera's URDF (xacro already run); gives the same transform."""


def urdf(pose: CalibratedPose, params: UrdfParams) -> ExportedFile:
    """Write URDF joints for the camera's mount link and its optical frame."""
    robot = ElementTree.Element("robot", name=params.name)
    for line in pose.remarks:
        # No "--" may stand in a comment, nor "-" at its end (XML 1.0, 2.5).
        # XML forbids two hyphens in a comment
        robot.append(ElementTree.Comment(f" {re.sub('-(?=-)', '- ', line)} "))
    for each in pose.each:
        robot.extend(_joints(each, params))
    ElementTree.indent(robot)
    text = ElementTree.tostring(robot, "unicode")
    try:
        ElementTree.fromstring(text)
    except (ElementTree.ParseError, UnicodeError) as error:  # a character that XML cannot hold
        raise StageError(f"export.urdf: a name cannot be written as XML: {error}") from None
    file = f'<?xml version="1.0"?>\n{text}\n'
    return ExportedFile(f"{params.name}.urdf", file, "copy the joints, or include the file")


def _joints(pose: CalibratedPose, params: UrdfParams) -> list[ElementTree.Element]:
    alone = pose.transform.child == CAMERA
    optical = params.child or (f"{CAMERA}_optical_frame" if alone else pose.transform.child)
    mount = params.mount or f"{pose.transform.child}_link"
    mount_T_optical = _mount_T_optical(params, mount, optical)
    carrier, found = params.carrier(pose), pose.transform.matrix
    if mount_T_optical is None:
        return _joint(carrier, optical, found)
    # base_T_mount = base_T_optical inv(mount_T_optical), as a URDF attaches the mount link
    joints = _joint(carrier, mount, found @ np.linalg.inv(mount_T_optical))
    if params.camera_urdf is None:  # else the camera's own URDF has the second joint
        joints += _joint(mount, optical, mount_T_optical)
    return joints


def _joint(parent: str, child: str, matrix: Floats) -> list[ElementTree.Element]:
    numbers = numbers_of("rpy", matrix)
    joint = ElementTree.Element("joint", name=f"{child}_joint", type="fixed")
    ElementTree.SubElement(joint, "parent", link=parent)
    ElementTree.SubElement(joint, "child", link=child)
    ElementTree.SubElement(joint, "origin", xyz=" ".join(numbers[:3]), rpy=" ".join(numbers[3:]))
    return [ElementTree.Element("link", name=child), joint]


def _mount_T_optical(params: UrdfParams, mount: str, optical: str) -> Floats | None:
    if params.camera_urdf is not None:
        return _chain(params.camera_urdf, mount, optical)
    return params.mount_T_optical.matrix if params.mount_T_optical else None


def _chain(file: Path, mount: str, optical: str) -> Floats:
    """Return ``mount_T_optical`` (4, 4) along the fixed joints of a URDF.

    Raises:
        FlangeyeError: The file is not a URDF, or no fixed joints lead from one link to the other.
    """
    above = {
        child: joint
        for child, joint in read_urdf(file).above.items()
        if joint.get("type") == "fixed"
    }
    pose, link = np.eye(4), optical
    while link != mount:
        if link not in above:
            known = ", ".join(sorted(above)) or "none"
            raise StageError(
                f"{file}: no fixed joints lead from '{mount}' to '{optical}'; links with a fixed "
                f"joint: {known}"
            )
        # Popped, so that joints in a circle end in the error above
        joint = above.pop(link)
        pose, link = origin_of(file, joint) @ pose, end_of(joint, "parent")
    return pose
