"""The plane of the work: two dimensions and a height; how the tool stands and leans in it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from flangeye.maths.geometry import rigid, rotation_from_rpy
from flangeye.models.finger import Finger, FingerGeometry
from flangeye.motion.seam_following import Command, ToolPose
from flangeye.types import BASE, FLANGE, Floats, Transform
from flangeye_plugins.weld.settings import Following


@dataclass(frozen=True, eq=False)
class LeaningTool:
    """A tool that leans by its work and travel angle.

    Attributes:
        level_R_tool: (3, 3) the tool's axes in level ones.
        torch: (3,) from the tip to the torch, in level axes [m]; its second number is zero.
    """

    level_R_tool: Floats
    torch: Floats

    @property
    def distance(self) -> float:
        """From the torch to the tip, seen from above [m]."""
        return -float(self.torch[0])


def leaning(work: float, travel: float) -> Floats:
    """Return the rotation (3, 3) of a tool that leans aside and forwards.

    Args:
        work: Its upper end leans to the right by this [rad].
        travel: Its upper end leans forwards by this [rad].
    """
    return np.asarray(rotation_from_rpy(work, 0.0, 0.0) @ rotation_from_rpy(0.0, travel, 0.0))


def body_of(finger: Finger, settings: Following) -> LeaningTool:
    """Return the finger's tool as it stands while the seam is followed."""
    work = settings.sign * settings.work_angle
    return body_from(finger.torch_from_tip, work, settings.travel_angle)


def body_from(torch: Floats, work: float, travel: float) -> LeaningTool:
    """Return a leaning tool whose torch is at (3,) from its tip, in the tool's axes [m]."""
    leans = leaning(work, travel)
    x, y, _ = (leans @ torch).tolist()
    turn = rotation_from_rpy(0.0, 0.0, -float(np.arctan2(-y, -x)))
    return LeaningTool(np.asarray(turn @ leans), np.asarray(turn @ leans @ torch))


class WorkPlane:
    """A frame on the work: x along the seam as a whole, z out of the work.

    Attributes:
        base_T_plane: Its pose.
    """

    def __init__(self, points: Floats, openings: Floats) -> None:
        """Lay the plane through (N, 3) points of a seam and across its openings (N, 3)."""
        z = openings.mean(axis=0)
        z /= np.linalg.norm(z)
        along = points[-1] - points[0]
        # Ends nearer than 1 mm to each other: the seam goes once around.
        if np.linalg.norm(along) < 1e-3:
            along = points[1] - points[0]
        x = along - (along @ z) * z
        x /= np.linalg.norm(x)
        rotation = np.column_stack([x, np.cross(z, x), z])
        self.base_T_plane = Transform(BASE, "plane", rigid(rotation, points.mean(axis=0)))
        self._inverse = self.base_T_plane.inverse()

    def points(self, in_base: Floats) -> Floats:
        """Return points (N, 3) in the plane's frame."""
        return self._inverse.apply(in_base)


class Tool:
    """Translates between the flange in the base and the tool in the plane."""

    def __init__(
        self, finger: FingerGeometry, plane: WorkPlane, body: LeaningTool | None = None
    ) -> None:
        """Take a tool that stands upright, or as its ``body`` does."""
        body = body or body_from(finger.torch_from_tip, 0.0, 0.0)
        self._plane = plane.base_T_plane
        self._tip = np.array(finger.tip)
        self._flange_R_tool = finger.flange_R_tool
        self._flange_R_level = finger.flange_R_tool @ body.level_R_tool.T
        self._torch = self._tip + self._flange_R_level @ body.torch
        self._angle: float | None = None

    def pose(self, base_T_flange: Transform, time: float) -> ToolPose:
        """Return the tool in the plane, its angle continuous with the last one."""
        plane = self._plane
        plane_R_base, rotation = plane.rotation.T, base_T_flange.rotation
        tip_in_base = rotation @ self._tip + base_T_flange.translation
        tip = plane_R_base @ (tip_in_base - plane.translation)
        ahead = plane_R_base @ (rotation @ self._flange_R_level[:, 0])
        angle = math.atan2(ahead[1], ahead[0])
        if self._angle is not None:
            angle += math.tau * round((self._angle - angle) / math.tau)
        self._angle = angle
        return ToolPose(time, tip, angle)

    @property
    def normal(self) -> Floats:
        """(3,) the plane's normal, out of the work, in base."""
        return self._plane.rotation[:, 2]

    def lowest(self, base_T_flange: Floats) -> float:
        """Return how high the lower one of tip and torch is above the plane [m].

        Args:
            base_T_flange: (4, 4) pose of the flange.
        """
        in_flange = np.stack([self._tip, self._torch])
        in_base = in_flange @ base_T_flange[:3, :3].T + base_T_flange[:3, 3]
        return float(((in_base - self._plane.translation) @ self.normal).min())

    def tilt(self, base_T_flange: Transform) -> float:
        """Return the angle between the tool's level z and the plane's [rad]."""
        up = base_T_flange.rotation @ self._flange_R_level[:, 2]
        return float(np.arccos(np.clip(up @ self._plane.rotation[:, 2], -1.0, 1.0)))

    def twist(self, command: Command, base_T_flange: Transform) -> Floats:
        """Return the flange's twist (6,), along the base's axes, that carries out a command."""
        plane, rotation = self._plane.rotation, base_T_flange.rotation
        normal, up = plane[:, 2], rotation @ self._flange_R_level[:, 2]
        # The tool is brought back to the plane's normal within a second.
        angular = command.turn * normal + _cross(up, normal)
        linear = plane @ command.velocity - _cross(angular, rotation @ self._tip)
        return np.concatenate([linear, angular])

    def base_T_flange(self, position: Floats, angle: float) -> Transform:
        """Return where the flange is with the tip at (3,) in the plane, the tool as it stands."""
        c, s = np.cos(angle), np.sin(angle)
        plane_R_level = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        rotation = self._plane.rotation @ plane_R_level @ self._flange_R_level.T
        tip = self._plane.apply(position)
        return Transform(BASE, FLANGE, rigid(rotation, tip - rotation @ self._tip))

    def base_R_tool(self, base_T_flange: Transform) -> Floats:
        """Return the tool's axes (3, 3) in the base's."""
        return np.asarray(base_T_flange.rotation @ self._flange_R_tool)


def _cross(first: Floats, second: Floats) -> Floats:
    """Return the cross product of two (3,), several times faster than NumPy's for any shape."""
    a, b, c = first.tolist()
    x, y, z = second.tolist()
    return np.array([b * z - c * y, c * x - a * z, a * y - b * x])
