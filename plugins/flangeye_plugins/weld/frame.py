"""The work surface along a seam, and the tool's orientation on it.

A seam may climb, bend and twist. The controller works in a plane into which the work surface is
flattened: arc length and geodesic curvature of the seam are kept, and its openings all point
upwards. Positions beside the seam agree to first order in their distance from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d

from flangeye.models.finger import FingerGeometry
from flangeye.motion.seam_following import Command, ToolPose
from flangeye.types import BASE, FLANGE, Floats, Transform
from flangeye.types.geometry import arc_lengths, rigid, rotation_from_rpy, rows_at
from flangeye_plugins.weld.path import CHORD, Path, PathPlace


@dataclass(frozen=True, eq=False)
class LeaningTool:
    """A tool in its orientation along the seam, given by work and travel angle.

    Attributes:
        level_R_tool: (3, 3) rotation from the tool's axes to level axes (x along the seam, z up).
        torch: (3,) vector from the tip to the torch in level axes [m]; its y is zero.
    """

    level_R_tool: Floats
    torch: Floats

    @property
    def distance(self) -> float:
        """Horizontal distance from the torch to the tip [m]."""
        return -float(self.torch[0])


def leaning(work: float, travel: float) -> Floats:
    """Return the rotation (3, 3) of a tool that leans by a work and a travel angle.

    Args:
        work: Lean of the tool's upper end to the right [rad].
        travel: Lean of the tool's upper end forwards [rad].
    """
    return np.asarray(rotation_from_rpy(work, 0.0, 0.0) @ rotation_from_rpy(0.0, travel, 0.0))


def body_from(torch: Floats, work: float, travel: float) -> LeaningTool:
    """Return a leaning tool, given the torch relative to the tip (3,) in the tool's axes [m]."""
    leans = leaning(work, travel)
    x, y, _ = (leans @ torch).tolist()
    turn = rotation_from_rpy(0.0, 0.0, -float(np.arctan2(-y, -x)))
    return LeaningTool(np.asarray(turn @ leans), np.asarray(turn @ leans @ torch))


TOGETHER = 1e-3
"""A seam whose ends are closer together than this is a closed one [m]."""


class SeamPlace(NamedTuple):
    """A place on the seam, in base and in the plane.

    Attributes:
        point: (3,) point of the seam in base [m].
        axes: (3, 3) axes in base, as columns: along the seam, to its left, out of the work.
        place: The same place in the plane.
    """

    point: Floats
    axes: Floats
    place: PathPlace

    def to_plane(self, vectors: Floats) -> Floats:
        """Convert a vector (3,) in base to the axes of the flattened plane."""
        along, left, up = (vectors @ self.axes).tolist()
        tx, ty = self.place.tangent.tolist()
        return np.array([along * tx - left * ty, along * ty + left * tx, up])

    def to_base(self, vector: Floats) -> Floats:
        """Convert a vector (3,) in the axes of the flattened plane to base."""
        x, y, z = vector.tolist()
        tx, ty = self.place.tangent.tolist()
        return np.asarray(self.axes @ np.array([x * tx + y * ty, y * tx - x * ty, z]))


class WorkSurface:
    """The surface along a seam, and the plane into which it is flattened.

    The plane's x points along the seam as a whole, its z out of the work. A closed seam is
    continued by one more turn beyond both ends.

    Attributes:
        points: (N, 3) points of the seam in the plane, all of height zero [m]; a closed seam has
            one more turn at each end.
        path: The seam in the plane.
    """

    def __init__(self, points: Floats, openings: Floats) -> None:
        """Construct the surface from a seam's points (N, 3) [m] and openings (N, 3) in base."""
        points, openings, wraps = _gone_around(points, openings)
        self.points = flattened(points, openings)
        self.path = Path(self.points, wraps)
        along = arc_lengths(self.points)
        ticks = self.path.step * np.arange(len(self.path.points), dtype=np.float64)
        line = rows_at(ticks, along, points)
        # Chords over two steps: between two points of a scan noise would turn the tangent.
        ahead = np.gradient(line, self.path.step, axis=0)
        # Scanned openings are noisy: they are averaged over a chord.
        width = max(1, round(CHORD / self.path.step))
        up = uniform_filter1d(rows_at(ticks, along, openings), width, 0, mode="nearest")
        self._rows: Floats = np.hstack([line, ahead, up])
        self._plain = self._rows.tolist()

    def line(self, s: Floats) -> tuple[Floats, Floats]:
        """Return points (K, 3) at arc lengths (K,), and axes (K, 3, 3) there, as columns.

        An open seam is continued straight beyond both ends.
        """
        path = self.path
        inside = np.clip(s, path.first, path.last)
        ticks = (inside - path.first) / path.step
        index = np.minimum(ticks.astype(int), len(self._rows) - 2)
        share = (ticks - index)[:, None]
        row = (1.0 - share) * self._rows[index] + share * self._rows[index + 1]
        ahead = row[:, 3:6] / np.linalg.norm(row[:, 3:6], axis=1)[:, None]
        # Openings need not be square to the seam: left is, and the upward axis follows from it.
        left = np.cross(row[:, 6:], ahead)
        left /= np.linalg.norm(left, axis=1)[:, None]
        beyond = (s - inside)[:, None]
        axes = np.stack([ahead, left, np.cross(ahead, left)], axis=2)
        return row[:, :3] + beyond * ahead, axes

    def at(self, s: float) -> SeamPlace:
        """Return the place on the seam at an arc length [m]."""
        x, y, z, tx, ty, tz, ux, uy, uz = self._at(s)
        # n = u x t, then u = t x n: the opening without its part along the seam
        nx, ny, nz = uy * tz - uz * ty, uz * tx - ux * tz, ux * ty - uy * tx
        norm = math.hypot(nx, ny, nz)
        nx, ny, nz = nx / norm, ny / norm, nz / norm
        ux, uy, uz = ty * nz - tz * ny, tz * nx - tx * nz, tx * ny - ty * nx
        axes = np.array([[tx, nx, ux], [ty, ny, uy], [tz, nz, uz]])
        return SeamPlace(np.array([x, y, z]), axes, self.path.at(s))

    def _at(self, s: float) -> list[float]:
        """Return point, unit tangent and opening (9,) in base at an arc length."""
        # Called several times a cycle: plain floats are ten times faster than small arrays.
        path = self.path
        inside = path.first if s < path.first else path.last if s > path.last else s
        share = (inside - path.first) / path.step
        index = min(int(share), len(self._plain) - 2)
        share -= index
        here, there = self._plain[index], self._plain[index + 1]
        row = [a + share * (b - a) for a, b in zip(here, there, strict=True)]
        x, y, z, ahead_x, ahead_y, ahead_z, *up = row
        norm, beyond = math.hypot(ahead_x, ahead_y, ahead_z), s - inside
        tx, ty, tz = ahead_x / norm, ahead_y / norm, ahead_z / norm
        return [x + beyond * tx, y + beyond * ty, z + beyond * tz, tx, ty, tz, *up]

    def foot(self, point: Floats, near: float | None = None) -> float:
        """Return the arc length of the seam's point closest to a point (3,) in base [m].

        The search starts at ``near`` if given; otherwise the whole seam is searched.
        """
        px, py, pz = point.tolist()
        # Beyond a curve's centre the iteration below diverges: search the whole seam instead.
        far = 30e-3
        if near is None or math.dist((px, py, pz), self._at(near)[:3]) > far:
            before = round(-self.path.first / self.path.step)
            away = np.linalg.norm(point - self._rows[before:, :3], axis=1)
            # argmax returns the first of several candidates: on a closed seam the one at its start
            near = float(np.argmax(away < away.min() + 1e-3)) * self.path.step
        for _ in range(3):
            x, y, z, tx, ty, tz, *_ = self._at(near)
            ahead = (px - x) * tx + (py - y) * ty + (pz - z) * tz
            # Newton's step for the foot: the distance ahead along the tangent; three rounds reach 1
            # nm near the seam.
            near += ahead
            if abs(ahead) < 1e-9:
                break
        return near

    def to_plane(self, point: Floats, s: float) -> Floats:
        """Convert a point (3,) in base, near an arc length, to the plane (3,)."""
        stand = self.at(s)
        off = stand.to_plane(point - stand.point)
        off[:2] += stand.place.point
        return off

    def height(self, point: Floats) -> float:
        """Return the height of a point (3,) in base above the closest point of the seam [m].

        It is measured along the opening there and along the mean opening; the larger value counts,
        because a leaning opening is misleading far from the seam.
        """
        stand = self.at(self.foot(point))
        off = point - stand.point
        # Far above the seam its closest point may be anywhere; the mean opening still says what is
        # up.
        whole = self._rows[:, 6:].mean(axis=0)
        return max(float(off @ stand.axes[:, 2]), float(off @ whole / math.sqrt(whole @ whole)))

    def to_base(self, points: Floats, near: Floats) -> Floats:
        """Convert points (K, 3) in the plane to base.

        Args:
            points: Points in the plane [m]; on a closed seam the plane may overlap itself.
            near: (K,) approximate arc lengths of the points [m].
        """
        each = [self._point_to_base(*place) for place in zip(points, near.tolist(), strict=True)]
        return np.array(each).reshape(-1, 3)

    def _point_to_base(self, point: Floats, s: float) -> Floats:
        for _ in range(2):
            s = self.path.foot(point[:2], s)
        stand = self.at(s)
        return stand.point + stand.to_base(point - [*stand.place.point, 0.0])

    def bending(self, distance: float) -> float:
        """Return the largest angle between the tool and the openings at its tip and torch [rad].

        Args:
            distance: Distance from the torch to the tip, both on the seam [m].
        """
        s = np.arange(distance, self.path.length, 1e-3)
        ups, behind = self.standing(s, distance)
        cosines = [np.einsum("ki,ki->k", ups, self.line(at)[1][:, :, 2]) for at in (s, behind)]
        return float(np.arccos(np.clip(np.concatenate(cosines), -1.0, 1.0)).max(initial=0.0))

    def standing(self, s: Floats, distance: float) -> tuple[Floats, Floats]:
        """Return the tool's upward axis (K, 3) in base and the torch's arc lengths (K,).

        The tip is on the seam at arc lengths ``s``, the torch on the seam ``distance`` behind it.
        Upwards is the opening at the tip, made perpendicular to the line from torch to tip.
        """
        tip, axes = self.line(s)
        behind = s - distance
        for _ in range(20):
            chord = tip - self.line(behind)[0]
            # Fixed point: the torch is one tool length behind, along the chord and not along the
            # arc.
            behind = behind + np.linalg.norm(chord, axis=1) - distance
        chord /= np.linalg.norm(chord, axis=1)[:, None]
        up = axes[:, :, 2] - np.einsum("ki,ki->k", axes[:, :, 2], chord)[:, None] * chord
        return np.asarray(up / np.linalg.norm(up, axis=1)[:, None]), behind


def _gone_around(points: Floats, openings: Floats) -> tuple[Floats, Floats, float]:
    """Return a seam and its openings, extended by one turn at each end if the seam is closed.

    A weld on a closed seam may begin anywhere and continues over its start.

    Returns:
        The points and openings (M, 3), and the length of the extension at each end [m].
    """
    if np.linalg.norm(points[-1] - points[0]) >= TOGETHER:
        return points, openings, 0.0
    rows = np.hstack([points, openings])
    rows[-1] = rows[0]
    turn = float(arc_lengths(rows[:, :3])[-1])
    # Three turns, the true one in the middle, so that no lookup meets the closure.
    rows = np.vstack([rows[:-1], rows[:-1], rows])
    return rows[:, :3], rows[:, 3:], turn


def flattened(points: Floats, openings: Floats) -> Floats:
    """Return a seam's points in the plane (N, 3), with the distances and turns of the surface."""
    steps = np.diff(points, axis=0)
    lengths = np.linalg.norm(steps, axis=1)
    moves = np.flatnonzero(lengths > 0.0)
    before, after = steps[moves[:-1]], steps[moves[1:]]
    up = openings[moves[1:]] / np.linalg.norm(openings[moves[1:]], axis=1)[:, None]
    before, after = (v - np.einsum("ki,ki->k", v, up)[:, None] * up for v in (before, after))
    # Turns within the surface only (geodesic curvature): bending of the surface itself drops out.
    left = np.einsum("ki,ki->k", np.cross(before, after), up)
    turns = np.arctan2(left, np.einsum("ki,ki->k", before, after))
    headings = np.zeros(len(lengths))
    headings[moves[1:]] = np.cumsum(turns)
    way = lengths[:, None] * np.stack([np.cos(headings), np.sin(headings)], axis=1)
    planar = np.vstack([np.zeros(2), np.cumsum(way, axis=0)])
    whole = planar[-1]
    if np.linalg.norm(points[-1] - points[0]) < TOGETHER:
        # A closed seam has no far end: x follows its first step.
        whole = planar[moves[0] + 1]
    x, y = whole / np.linalg.norm(whole)
    planar = planar @ np.array([[x, -y], [y, x]])
    return np.column_stack([planar - planar.mean(axis=0), np.zeros(len(planar))])


class Tool:
    """Converts between the flange's pose in base and the tool's pose in the plane."""

    def __init__(
        self, finger: FingerGeometry, surface: WorkSurface, body: LeaningTool | None = None
    ) -> None:
        """Construct the conversion for a leaning ``body``; None is an upright tool."""
        body = body or body_from(finger.torch_from_tip, 0.0, 0.0)
        self._surface, self._distance = surface, body.distance
        self._tip = np.array(finger.tip)
        self._flange_R_tool = finger.flange_R_tool
        self._flange_R_level = finger.flange_R_tool @ body.level_R_tool.T
        self._torch = self._tip + self._flange_R_level @ body.torch
        self._angle: float | None = None
        self._s: float | None = None
        # The tip runs on beyond the seam's end, until the torch reaches it.
        self._ticks = np.arange(-CHORD, surface.path.last + body.distance + CHORD, CHORD / 4)
        self._ups, _ = surface.standing(self._ticks, body.distance)
        self._tilts = np.gradient(self._ups, CHORD / 4, axis=0)

    def pose(self, base_T_flange: Transform, time: float) -> ToolPose:
        """Return the tool's pose in the plane; its angle is continuous with the last call's."""
        rotation, surface = base_T_flange.rotation, self._surface
        tip = rotation @ self._tip + base_T_flange.translation
        self._s = surface.foot(tip, self._s)
        position = surface.to_plane(tip, self._s)
        torch = rotation @ self._torch + base_T_flange.translation
        behind = surface.to_plane(torch, surface.foot(torch, self._s - self._distance))
        ahead_x, ahead_y, _ = (position - behind).tolist()
        angle = math.atan2(ahead_y, ahead_x)
        if self._angle is not None:
            # The arctangent jumps at half a turn, which a controller would answer with a full turn
            # of the tool.
            angle += math.tau * round((self._angle - angle) / math.tau)
        self._angle = angle
        return ToolPose(time, position, angle)

    def up(self, base_R_flange: Floats) -> Floats:
        """Return the tool's upward axis (3,) in base, given the flange's rotation (3, 3)."""
        return np.asarray(base_R_flange @ self._flange_R_level[:, 2])

    @property
    def tilting(self) -> float:
        """Largest tilt of the tool per distance along the seam [rad/m]."""
        return float(np.linalg.norm(self._tilts, axis=1).max())

    def lowest(self, base_T_flange: Floats) -> float:
        """Return the smaller height of tip and torch above the seam [m].

        Args:
            base_T_flange: (4, 4) pose of the flange.
        """
        in_flange = np.stack([self._tip, self._torch])
        in_base = in_flange @ base_T_flange[:3, :3].T + base_T_flange[:3, 3]
        return min(self._surface.height(point) for point in in_base)

    def twist(self, command: Command, base_T_flange: Transform) -> Floats:
        """Return the flange's twist (6,) in base axes that carries out a command [m/s, rad/s]."""
        rotation, surface = base_T_flange.rotation, self._surface
        tip = rotation @ self._tip
        s = surface.foot(tip + base_T_flange.translation, self._s)
        stand = surface.at(s)
        # Velocities in the plane are velocities on the surface: rolling out keeps lengths along the
        # seam.
        velocity = stand.to_base(command.velocity)
        up, tilt = self._standing(s)
        going = float(velocity @ stand.axes[:, 0])
        # Sum of the commanded turn about the surface's normal, a correction of the tool's tilt with
        # gain 1/s, and the feed-forward of the surface's tilt. The flange's origin moves with v - w
        # x r, where r is the vector from there to the tip
        angular = command.turn * up + _cross(self.up(rotation), up) + going * _cross(up, tilt)
        return np.concatenate([velocity - _cross(angular, tip), angular])

    def base_T_flange(self, position: Floats, angle: float, near: float) -> Transform:
        """Return the flange's pose in base for a pose of the tool in the plane.

        Args:
            position: (3,) position of the tip in the plane [m].
            angle: Angle of the tool in the plane [rad].
            near: Approximate arc length of the tip [m].
        """
        surface = self._surface
        tip = surface.to_base(position[None], np.array([near]))[0]
        s = surface.foot(tip, near)
        stand, (up, _) = surface.at(s), self._standing(s)
        c, sine = math.cos(angle), math.sin(angle)
        x = stand.to_base(np.array([c, sine, 0.0]))
        # The tool's x in the surface, made square to its own upward axis
        x = x - (x @ up) * up
        x /= np.linalg.norm(x)
        base_R_level = np.column_stack([x, np.cross(up, x), up])
        rotation = base_R_level @ self._flange_R_level.T
        return Transform(BASE, FLANGE, rigid(rotation, tip - rotation @ self._tip))

    def in_plane(self, base_T_flange: Transform) -> Floats:
        """Return the tool's axes in the plane, as columns (3, 3)."""
        rotation = base_T_flange.rotation
        tip = rotation @ self._tip + base_T_flange.translation
        stand = self._surface.at(self._surface.foot(tip, self._s))
        return np.stack(
            [stand.to_plane(axis) for axis in (rotation @ self._flange_R_tool).T], axis=1
        )

    def _standing(self, s: float) -> tuple[Floats, Floats]:
        """Return the tool's nominal upward axis (3,) at an arc length, and its derivative [1/m]."""
        share = (s - self._ticks[0]) / (self._ticks[1] - self._ticks[0])
        share = min(max(share, 0.0), len(self._ticks) - 1.001)
        index = int(share)
        share -= index
        up = (1.0 - share) * self._ups[index] + share * self._ups[index + 1]
        return up / math.sqrt(up @ up), self._tilts[index]


def _cross(first: Floats, second: Floats) -> Floats:
    """Return the cross product of two vectors (3,); several times faster than NumPy's."""
    (a, b, c), (x, y, z) = first.tolist(), second.tolist()
    return np.array([b * z - c * y, c * x - a * z, a * y - b * x])
