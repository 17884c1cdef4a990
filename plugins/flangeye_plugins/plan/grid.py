"""``plan.grid``: the corners of a box, in random orientations that face the scanner."""

from __future__ import annotations

import numpy as np
from pydantic import Field

from flangeye.maths.geometry import angle_between
from flangeye.motion.planning import Plan, PlannedPose, Site, tilted
from flangeye.plugin.stage import Params, part
from flangeye.types import Floats
from flangeye.units import Angle, Length, param

Point = tuple[Length, Length, Length]


class PlanParams(Params):
    """Where plans look for poses."""

    centre: Point | None = Field(
        None, description="Centre of the work; before the scanner if not given."
    )
    size: Point = param(
        ("300 mm", "300 mm", "200 mm"),
        description="Edges of the work along the base's axes: where the matrix has to be right.",
    )
    tilt: Angle = param(
        "0.3 rad", ge=0, description="Largest roll, pitch and yaw away from facing the scanner."
    )
    facing: Angle = param(
        "35 deg", gt=0, description="Largest angle between the flange's normal and the view."
    )


class GridParams(PlanParams):
    """Parameters of ``plan.grid``."""

    counts: tuple[int, int, int] = Field((3, 3, 2), description="Grid points along each edge.")


@part("plan.grid")
def grid(site: Site, rng: np.random.Generator, params: GridParams) -> Plan:
    """Visit a grid of points in random order, each in a random orientation facing the scanner.

    The paper's plan (section 3.1: 5 x 5 x 3 points over 0.3 x 0.3 x 0.2 m; roll, pitch and yaw
    below 0.3 rad in 3.2.1). A grid point where no orientation is possible is left out.

    Args:
        site: The place.
        rng: Draws order and orientations.
        params: The grid.
    """
    centre = site.centre if params.centre is None else np.asarray(params.centre)
    size = np.asarray(params.size)
    nodes = rng.permutation(centre + size * _unit_grid(params.counts))
    facing = site.facing(centre)
    found = [] if facing is None else [_pose_at(n, facing, site, rng, params) for n in nodes]
    return Plan([pose for pose in found if pose is not None], len(nodes), centre, size)


def _unit_grid(counts: tuple[int, int, int]) -> Floats:
    ticks = [np.linspace(-0.5, 0.5, n) if n > 1 else np.zeros(1) for n in counts]
    return np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1).reshape(-1, 3)


def _pose_at(
    place: Floats, facing: Floats, site: Site, rng: np.random.Generator, params: GridParams
) -> PlannedPose | None:
    for _ in range(25):
        pose = tilted(place, facing, params.tilt, rng)
        if angle_between(pose[:3, 2], site.eye - place) > params.facing:
            continue
        joints = site.joints(pose)
        if joints is not None:
            return PlannedPose(pose, joints)
    return None
