"""A URDF: the joints from what carries the camera to its mount and on to its optical frame.

Calibrations find the optical frame (z along the view); a camera's own URDF hangs by its mount link:
``base_T_mount = base_T_optical inv(mount_T_optical)``. Metres; rpy is Rz(y) Ry(p) Rx(r).
"""

from __future__ import annotations

import re
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from pydantic import Field

from flangeye import Params, StageError
from flangeye.files.paths import RecipePath
from flangeye.maths.geometry import rigid, rotation_from_rpy
from flangeye.models.urdf import end_of, origin_of, read_urdf
from flangeye.types import CAMERA, CalibratedPose, ExportedFile, Floats
from flangeye.units import Angle, Length, param
from flangeye_plugins.export.writing import FRAME, FramesParams, numbers_of


class OpticalParams(Params):
    """Where the optical frame is in the mount link."""

    position: tuple[Length, Length, Length] = param(
        ("0 mm", "0 mm", "0 mm"),
        description="Position of the optical frame's origin in the mount link.",
    )
    rpy: tuple[Angle, Angle, Angle] = param(
        ("-90 deg", "0 deg", "-90 deg"),
        description="Roll, pitch, yaw; by default z ahead along the mount's x, as in REP 103.",
    )

    @property
    def matrix(self) -> Floats:
        """``mount_T_optical`` (4, 4) [m]."""
        return rigid(rotation_from_rpy(*self.rpy), np.array(self.position))


class UrdfParams(FramesParams):
    """The frames, and how the camera's mount link and its optical frame lie to each other."""

    mount: str | None = Field(
        None, pattern=FRAME, description="The camera's mount link; camera_link if not given."
    )
    child: str | None = Field(
        None,
        pattern=FRAME,
        description="The camera's optical frame; camera_optical_frame if not given, and in a cell "
        "the frame's own name.",
    )
    mount_T_optical: OpticalParams | None = Field(
        None, description="Where the optical frame is in the mount link, if that is known."
    )
    camera_urdf: RecipePath | None = Field(
        None, description="The camera's own URDF (xacro already run), which tells the same."
    )


def urdf(pose: CalibratedPose, params: UrdfParams) -> ExportedFile:
    """Write URDF joints: the mount link's, where the camera's URDF is known, and the optical's."""
    robot = ElementTree.Element("robot", name=params.name)
    for line in pose.remarks:
        # No "--" may stand in a comment, nor "-" at its end (XML 1.0, 2.5).
        robot.append(ElementTree.Comment(f" {re.sub('-(?=-)', '- ', line)} "))
    for each in pose.each:
        robot.extend(_joints(each, params))
    ElementTree.indent(robot)
    text = ElementTree.tostring(robot, "unicode")
    try:
        ElementTree.fromstring(text)
    except ElementTree.ParseError as error:  # a control character, which XML cannot hold
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
    joints = _joint(carrier, mount, found @ np.linalg.inv(mount_T_optical))
    if params.camera_urdf is None:  # which has the second joint itself
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
        FlangeyeError: The file is no URDF, or no fixed joints lead from one link to the other.
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
        joint = above.pop(link)
        pose, link = origin_of(file, joint) @ pose, end_of(joint, "parent")
    return pose
