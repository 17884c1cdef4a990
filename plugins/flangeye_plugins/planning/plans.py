"""The poses an acquisition visits."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye.geometry import rigid, rotation_from_rpy
from flangeye.stage import Params, part
from flangeye.units import Angle, Length, param

Floats = NDArray[np.float64]

Point = tuple[Length, Length, Length]

NEAR = 0.02
"""Poses near a point are this near to it, along each axis [m]."""

NEAR_TILT = 0.2
"""Their largest roll, pitch and yaw [rad]."""

NEAR_ATTEMPTS = 50
"""Poses tried for each of them."""


@dataclass(frozen=True, eq=False)
class Site:
    """What a plan may know of the place.

    Attributes:
        centre: (3,) in ``base``, where to work when the recipe does not say [m].
        eye: (3,) in ``base``, where the scanner stands [m].
        facing: Gives the rotation (3, 3) of a flange at a point (3,) that faces the scanner, or
            None where the arm cannot show it.
        joints: Gives the joint angles for a flange pose (4, 4), or None where the arm cannot or
            must not go.
        lost: Gives the places, in order of their visit, of the poses that told nothing.
    """

    centre: Floats
    eye: Floats
    facing: Callable[[Floats], Floats | None]
    joints: Callable[[Floats], Floats | None]
    lost: Callable[[], Collection[int]] = frozenset


class PlannedPose(NamedTuple):
    """Where to send the flange: (4, 4) ``base_T_flange``, and (n,) joint angles that do it."""

    base_T_flange: Floats
    joints: Floats


class Plan(NamedTuple):
    """Poses to visit.

    Attributes:
        poses: In the order of their visit; a plan may choose each when it is asked for.
        wanted: How many there would be if the arm could go everywhere.
        centre: (3,) of the box they were wanted in, in ``base`` [m].
        size: (3,) edges of that box [m].
    """

    poses: Iterable[PlannedPose]
    wanted: int
    centre: Floats
    size: Floats


class GridParams(Params):
    """Parameters of ``plan.grid``."""

    centre: Point | None = Field(None, description="Of the grid; before the scanner if not given.")
    size: Point = param(
        ("300 mm", "300 mm", "200 mm"), description="Edges of the grid along the base's axes."
    )
    counts: tuple[int, int, int] = Field((3, 3, 2), description="Grid points along each edge.")
    tilt: Angle = param(
        "0.3 rad", ge=0, description="Largest roll, pitch and yaw away from facing the scanner."
    )
    facing: Angle = param(
        "35 deg", gt=0, description="Largest angle between the flange's normal and the view."
    )
    shuffled: bool = Field(True, description="Whether to visit the grid in random order.")
    attempts: int = Field(25, ge=1, description="Orientations tried at a grid point.")


@part("plan.grid")
def grid(site: Site, rng: np.random.Generator, params: GridParams) -> Plan:
    """Visit a grid, at each point in a random orientation that faces the scanner.

    The paper's plan (section 3.1: 5 x 5 x 3 points over 0.3 x 0.3 x 0.2 m; roll, pitch and yaw
    below 0.3 rad in 3.2.1). A grid point where no orientation is possible is left out.

    Args:
        site: The place.
        rng: Draws order and orientations.
        params: The grid.
    """
    centre = site.centre if params.centre is None else np.asarray(params.centre)
    size = np.asarray(params.size)
    nodes = centre + size * _unit_grid(params.counts)
    if params.shuffled:
        nodes = rng.permutation(nodes)
    facing = site.facing(centre)
    found = [] if facing is None else [_pose_at(n, facing, site, rng, params) for n in nodes]
    return Plan([pose for pose in found if pose is not None], len(nodes), centre, size)


def _unit_grid(counts: tuple[int, int, int]) -> Floats:
    ticks = [np.linspace(-0.5, 0.5, n) if n > 1 else np.zeros(1) for n in counts]
    return np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)


def _pose_at(
    place: Floats, facing: Floats, site: Site, rng: np.random.Generator, params: GridParams
) -> PlannedPose | None:
    for _ in range(params.attempts):
        pose = _tilted(place, facing, params.tilt, rng)
        if angle_between(pose[:3, 2], site.eye - place) > params.facing:
            continue
        joints = site.joints(pose)
        if joints is not None:
            return PlannedPose(pose, joints)
    return None


def poses_near(
    place: Floats, count: int, site: Site, rng: np.random.Generator
) -> list[PlannedPose]:
    """Return poses drawn around a point (3,): as many as asked for, or as can be found."""
    found: list[PlannedPose] = []
    facing = site.facing(place)
    for _ in range(NEAR_ATTEMPTS * count):
        if facing is None or len(found) == count:
            break
        pose = _tilted(place + rng.uniform(-NEAR, NEAR, 3), facing, NEAR_TILT, rng)
        joints = site.joints(pose)
        found += [] if joints is None else [PlannedPose(pose, joints)]
    return found


def _tilted(place: Floats, facing: Floats, tilt: float, rng: np.random.Generator) -> Floats:
    """Return a pose (4, 4) at a point whose roll, pitch and yaw from facing stay below ``tilt``."""
    roll, pitch, yaw = rng.uniform(-tilt, tilt, 3)
    return rigid(rotation_from_rpy(roll, pitch, yaw) @ facing, place)


def angle_between(first: Floats, second: Floats) -> float:
    """Return the angle of two vectors (3,) [rad]."""
    return float(np.arctan2(np.linalg.norm(np.cross(first, second)), first @ second))
