"""How poses are written, and who carries the camera, as the poses of arm and target show together.

Between two captures arm and target turn by the same angle, whatever the frames: a convention in
which they do not is the wrong one. A camera in the hand and one beside the robot, and a target's
pose either way round, leave different residuals of A X = X B.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

from flangeye.errors import CalibrationRefused
from flangeye.handeye.closed.motions import motions_of, place_of, translation_of
from flangeye.handeye.closed.separable import park_martin
from flangeye.maths.geometry import rigid
from flangeye.maths.pose_corrections import inverted
from flangeye.maths.pose_formats import AngleUnit, LengthUnit, pose_of_numbers
from flangeye.types import Floats

FEWEST = 5
"""Poses; fewer fit several conventions."""
MOST = 60
"""Poses whose pairs are looked at: enough to tell frames apart."""
ALIKE = np.radians(3.0)
"""Largest median difference of the angles [rad] at which a convention is taken to fit."""
CLEARER = 3.0
"""By what factor the next best has to be worse, beyond 0.2 deg or 2 mm."""
LOOSE_ANGLE, LOOSE_PLACE = np.radians(0.2), 2e-3
"""Differences [rad, m] below which two hypotheses are both good."""


class Writing(NamedTuple):
    """One way in which a row of numbers may be a pose."""

    rotation: str
    length: LengthUnit
    angle: AngleUnit

    def poses(self, numbers: Floats) -> Floats | None:
        """Return (N, 4, 4) poses [m]; None where a row is none in this convention."""
        try:
            rows = [pose_of_numbers(row, self.rotation, self.length, self.angle) for row in numbers]
        except ValueError:
            return None
        return np.array(rows)


@dataclass(frozen=True)
class Choice:
    """What fits best, and how much better than the next.

    Attributes:
        arm: How the arm's poses are written.
        target: How the target's are.
        told: With what the choice was made, for people.
    """

    arm: Writing
    target: Writing
    told: str


def writing_of(
    arm: Floats, arms: Sequence[Writing], target: Floats, targets: Sequence[Writing]
) -> Choice | None:
    """Return how both are written; None where nothing fits, or several things do.

    Args:
        arm: (N, k) numbers of the arm's poses.
        arms: What they may mean.
        target: (N, m) numbers of the target's.
        targets: What those may mean.
    """
    if len(arm) != len(target) or len(arm) < FEWEST:
        return None
    tried = []
    angles = {id(w): _turned(w.poses(arm)) for w in arms}
    seen = {id(w): _turned(w.poses(target)) for w in targets}
    for a, b in product(arms, targets):
        one, other = angles[id(a)], seen[id(b)]
        if one is not None and other is not None:
            tried.append((float(np.median(np.abs(one - other))), a, b))
    tried.sort(key=lambda each: each[0])
    if not tried or tried[0][0] > ALIKE:
        return None
    best, a, b = tried[0]
    if len(tried) > 1 and tried[1][0] < CLEARER * max(best, LOOSE_ANGLE):
        return None
    beyond = f", the next {np.degrees(tried[1][0]):.1f} deg" if len(tried) > 1 else ""
    return Choice(a, b, f"arm and target turn alike to {np.degrees(best):.2g} deg{beyond}")


def turn_alike(arm: Floats, target: Floats) -> bool:
    """Return whether poses (N, 4, 4) of arm and target turn by the same angles."""
    one, other = _turned(arm), _turned(target)
    if one is None or other is None or len(arm) < FEWEST or len(arm) != len(target):
        return False
    return bool(np.median(np.abs(one - other)) < ALIKE)


def _turned(poses: Floats | None) -> Floats | None:
    """Return the angles [rad] between poses one and two apart."""
    if poses is None or len(poses) < 3:
        return None
    turns = poses[:, :3, :3]
    pairs = [np.swapaxes(turns[:-k], 1, 2) @ turns[k:] for k in (1, 2)]
    traces = np.trace(np.concatenate(pairs), axis1=1, axis2=2)
    return np.asarray(np.arccos(np.clip((traces - 1) / 2, -1, 1)))


class Mounting(NamedTuple):
    """Who carries the camera, and which way round the target's poses are."""

    camera: str
    target: str
    told: str


def mounting_of(
    arm: Floats, seen: Floats, cameras: Sequence[str], targets: Sequence[str]
) -> Mounting | None:
    """Return the mounting that fits; None where none does, or several do.

    Args:
        arm: (N, 4, 4) base_T_flange [m].
        seen: (N, 4, 4) poses of the target as they stand in the file [m].
        cameras: What may carry the camera: base, flange.
        targets: What the target's poses may be: camera_T_target, target_T_camera.
    """
    if len(arm) < FEWEST:
        return None
    some = np.linspace(0, len(arm) - 1, min(len(arm), MOST)).astype(int)
    arm, seen = arm[some], seen[some]
    tried = []
    for camera, way in product(cameras, targets):
        carried = arm if camera == "flange" else inverted(arm)
        found = _residual(carried, seen if way == "camera_T_target" else inverted(seen))
        if found is not None:
            tried.append((found, camera, way))
    tried.sort()
    if not tried or (len(tried) > 1 and tried[1][0] < CLEARER * max(tried[0][0], LOOSE_PLACE)):
        return None
    best, camera, way = tried[0]
    beyond = f", the next to {1e3 * tried[1][0]:.0f} mm" if len(tried) > 1 else ""
    return Mounting(camera, way, f"fits to {1e3 * best:.1f} mm{beyond}")


def _residual(carried: Floats, seen: Floats) -> float | None:
    """Return the median distance [m] of the target's places from one another; None where the
    motions tell nothing.
    """  # noqa: D205
    try:
        motions = motions_of(carried, seen)
        turn = park_martin(motions)[:3, :3]
        x = rigid(turn, translation_of(turn, motions))
        places = (carried @ x @ seen)[:, :3, 3]
        place = place_of(carried, x, seen)[:3, 3]
    except (CalibrationRefused, ValueError, np.linalg.LinAlgError):
        return None
    return float(np.median(np.linalg.norm(places - place, axis=1)))
