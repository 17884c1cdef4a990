"""Arms: kinematics, flange, and roughly the space they fill."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import Any, Literal, Protocol

import numpy as np
from pydantic import Field, PrivateAttr, field_validator

from flangeye.errors import RecipeError, StageError
from flangeye.models.model import Model
from flangeye.types import Floats, Note
from flangeye.types.geometry import rigid, rotation_from_rpy
from flangeye.units import SI, Angle, AngularSpeed, JointPosition, Length, param

UR_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
"""Joints of Universal Robots from base to flange, as its ROS driver names them."""


class Recess(Model):
    """A slot milled into the face along a circle, with round ends, such as Franka's three."""

    angle: Angle
    """Angle about the flange's z to the middle of the recess."""
    radius: Length = param(gt=0)
    """Radius of the circle its centre line follows."""
    half_span: Angle
    """Half of the angle that the slot's centre line spans, without its rounded ends."""
    width: Length = param(gt=0)
    depth: Length = param(gt=0)


Finish = Literal["painted", "metal", "anodised"]


class FlangeDetails(Model):
    """Details of one robot's flange that its standard does not fix."""

    standard: str | None = None
    """Designation: ISO 9409-1-50-4-M6 or the like."""
    rim_chamfer: Length = param("0 mm")
    """Radial width of the chamfer at the rim."""
    bore_chamfer: Length = param("0 mm")
    """Radial width of the chamfer at the bore."""
    bore_depth: Length = param("6 mm")
    """Depth of the centring bore."""
    thickness: Length = param("6 mm")
    """Height of the plate above the wrist."""
    pin_angle: Angle | None = param(None)
    """Angle of the pin hole about the flange's z; without it the flange's roll is unknown."""
    wrist: Length = param("75 mm")
    """Diameter of the wrist's housing behind the plate."""
    wrist_length: Length = param("40 mm")
    """Length of that housing, from the face."""
    countersink: Length = param("0 mm")
    """Radial width of the chamfer at the holes."""
    hole_depth: Length = param("9 mm")
    """Depth of the threaded holes and the pin hole."""
    recesses: tuple[Recess, ...] = ()
    finish: Finish = "metal"
    """Surface of the face, as a scanner sees it."""
    source: str = ""


class Joint(Model):
    """One joint: its fixed transform, its axis, and its limits."""

    a: Length = param("0 mm")
    alpha: Angle = param("0 deg")
    d: Length = param("0 mm")
    theta: Angle = param("0 deg")
    """Offset added to the joint's angle."""
    xyz: tuple[Length, Length, Length] = param(("0 mm",) * 3)
    """Convention urdf: its frame's origin in the frame of the link before."""
    rpy: tuple[Angle, Angle, Angle] = param(("0 deg",) * 3)
    """Convention urdf: roll, pitch, yaw of its frame in that frame."""
    axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Convention urdf: the joint's axis, in its own frame."""
    slides: bool = False
    """Whether the joint slides, as a rail does, instead of turning."""
    lower: JointPosition = param("-360 deg")
    upper: JointPosition = param("360 deg")

    @field_validator("axis")
    @classmethod
    def _has_a_direction(cls, axis: tuple[float, float, float]) -> tuple[float, float, float]:
        # Squares of far smaller or larger numbers are 0 or infinite
        if not 1e-6 < math.hypot(*axis) < 1e6:
            raise ValueError("an axis needs a direction, for example [0, 0, 1]")
        return axis


class Placement(Model):
    """Where a frame is in another."""

    xyz: tuple[Length, Length, Length] = param(("0 mm",) * 3)
    rpy: tuple[Angle, Angle, Angle] = param(("0 deg",) * 3)
    """Roll, pitch, yaw."""


class Volume(Model):
    """A capsule that bounds a part of the arm, fixed to a link."""

    link: int = Field(ge=0)
    """0 is the base, n the last link."""
    start: tuple[Length, Length, Length]
    end: tuple[Length, Length, Length]
    radius: Length = param(gt=0)


class Bodies(Protocol):
    """The collision bodies of an arm's URDF, which are read when something moves."""

    @property
    def volumes(self) -> tuple[Volume, ...]:
        """Return a capsule for each body.

        Raises:
            RecipeError: A body is missing or wrong; names its link.
        """

    def meshes(self) -> Iterator[tuple[int, Any]]:
        """Yield each link's visible mesh (trimesh, in its moving frame) and its number."""


class RobotModel(Model):
    """An arm: its kinematics, its flange, and roughly the space it fills."""

    model: str
    maker: str
    convention: Literal["standard", "modified", "urdf"]
    """Denavit-Hartenberg, standard or modified (Craig); urdf: origins and axes."""
    joints: tuple[Joint, ...]
    flange_offset: Length = param("0 mm")
    """Last link to the flange's face, along z."""
    flange_frame: Placement = Placement()
    """The flange in the last link's frame, before flange_offset."""
    flange: FlangeDetails = FlangeDetails()
    volumes: tuple[Volume, ...] = ()
    volumes_missing: str = ""
    """Reason why there are no volumes, shown to a plan that needs them."""
    repeatability: Length = param("0.1 mm")
    joint_speed: AngularSpeed = param("180 deg/s", gt=0)
    """Speed limit of the slowest joint by the maker; no recipe may ask for more."""
    joint_accuracy: Angle = param("0.3 mrad")
    """Standard deviation of a joint's zero; makers do not publish it, so it is assumed."""
    source: str
    _bodies: Bodies | None = PrivateAttr(None)
    _notes: tuple[Note, ...] = PrivateAttr(())

    @property
    def notes(self) -> tuple[Note, ...]:
        """Notes on how the arm was derived from its file."""
        return self._notes

    def from_urdf(self, bodies: Bodies, notes: tuple[Note, ...]) -> RobotModel:
        """Return the arm with the bodies of its URDF, not read yet, and the notes about it."""
        arm = self.model_copy()
        arm._bodies, arm._notes = bodies, notes
        return arm

    def meshes(self) -> list[tuple[int, Any]]:
        """Return the arm's visible meshes: a trimesh [m] and the number of its moving frame.

        The list is empty for an arm without a URDF or whose mesh files are missing.
        """
        try:
            return list(self._bodies.meshes()) if self._bodies else []
        except RecipeError:
            return []

    def filled(self) -> RobotModel:
        """Return the arm with the space it fills, as its URDF's bodies have it."""
        if self._bodies is None:
            return self
        try:
            volumes = self._bodies.volumes
            return self.model_copy(update={"volumes": volumes, "volumes_missing": ""})
        # A missing mesh must not stop a run that moves nothing: the reason is kept for a plan.
        except RecipeError as error:
            return self.model_copy(update={"volumes_missing": str(error)})

    def known_volumes(self) -> tuple[Volume, ...]:
        """Return the capsules that bound the arm, without which no move is planned.

        Raises:
            StageError: The capsules are unknown; the message says why, and what to write in the
                file.
        """
        filled = self.filled()
        if filled.volumes_missing:
            raise StageError(
                f"the space the arm fills is needed to plan its moves: {filled.volumes_missing}"
            )
        return filled.volumes

    def carrying(self, start: Floats, end: Floats, radius: float) -> RobotModel:
        """Return the arm with a tool in the space it fills: a capsule, (3,) ends in ``flange`` [m].

        Raises:
            StageError: The space of the arm itself is not known.
        """
        placed = np.stack([start, end]) @ self.link_T_flange[:3, :3].T + self.link_T_flange[:3, 3]
        first, second = (tuple(map(SI, point)) for point in placed)
        tool = Volume(link=len(self.joints), start=first, end=second, radius=SI(radius))
        arm = self.model_copy(update={"volumes": (*self.known_volumes(), tool)})
        arm._bodies = None  # else `filled` would replace these volumes by the URDF's, without tool
        return arm

    @property
    def link_T_flange(self) -> Floats:
        """Pose (4, 4) of the flange in the frame of the last link."""
        frame = self.flange_frame
        placed = rigid(rotation_from_rpy(*frame.rpy), np.asarray(frame.xyz))
        return placed @ rigid(np.eye(3), np.array([0.0, 0.0, self.flange_offset]))

    @property
    def length(self) -> float:
        """Sum of all offsets from base to flange [m]: no point of it is farther from the base."""
        ends = [*(joint.xyz for joint in self.joints), self.flange_frame.xyz]
        offsets = [abs(joint.a) + abs(joint.d) for joint in self.joints]
        # The triangle inequality: links in line reach farthest.
        slides = [max(-j.lower, j.upper) for j in self.joints if j.slides]
        return float(np.linalg.norm(ends, axis=1).sum() + sum(offsets + slides)) + abs(
            self.flange_offset
        )


@dataclass(frozen=True)
class SecondRobot:
    """The arm of a recipe that carries the target before the camera on the first."""

    model: RobotModel


def joints_in_order(names: Iterable[str]) -> tuple[str, ...]:
    """Return joints in order from base to flange, by their names; drivers sort by alphabet."""
    named = list(names)
    ur = [next((n for n in named if joint in n), "") for joint in UR_JOINTS]
    if all(ur):
        return tuple(ur)
    # Names such as arm2_joint4: the joint's number is the last one
    numbers = {name: [int(n) for n in re.findall(r"\d+", name)] for name in named}
    # Other arms than six- and seven-joint ones have no common naming, so nothing is guessed.
    numbered = sorted((n for n in named if numbers[n]), key=lambda n: numbers[n][::-1])
    return tuple(numbered) if len(numbered) in (6, 7) else ()
