"""What a plan of robot poses is asked with and what it gives: the contract of ``plan`` parts."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np

from flangeye.devices import DeviceError, RobotDriver, RobotState
from flangeye.errors import FlangeyeError
from flangeye.maths.geometry import rigid, rotation_from_rpy
from flangeye.types import Floats

POINT_WITHIN = 0.02
"""Poses near a point are this near to it, along each axis [m]."""

NEAR_TILT = 0.2
"""Their largest roll, pitch and yaw [rad]."""


@dataclass(frozen=True, eq=False)
class Site:
    """Arm, scanner and obstacles that a plan is made for.

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
    """Where to send the flange: (4, 4) ``base_T_flange``, and (n,) joint angles that do it.

    ``why`` tells people what it is expected to be good for, where the plan knows.
    """

    base_T_flange: Floats
    joints: Floats
    why: str = ""


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


class Planner(Protocol):
    """How a ``plan`` part is called."""

    def __call__(self, site: Site, rng: np.random.Generator) -> Plan:
        """Return the poses to visit; ``rng`` is the only randomness."""
        ...


def poses_near(
    place: Floats,
    count: int,
    site: Site,
    rng: np.random.Generator,
    spread: tuple[Any, float] = (POINT_WITHIN, NEAR_TILT),
) -> list[PlannedPose]:
    """Return poses drawn around a point (3,): as many as asked for, or as can be found.

    Args:
        place: (3,) in ``base`` [m].
        count: How many.
        site: What the arm can do there.
        rng: Draws them.
        spread: How near they are, (3,) or alike along each axis [m], and their largest roll,
            pitch and yaw [rad].
    """
    found: list[PlannedPose] = []
    facing, (near, tilt) = site.facing(place), spread
    # Poses tried for each of them
    for _ in range(50 * count):
        if facing is None or len(found) == count:
            break
        pose = tilted(place + rng.uniform(-near, near, 3), facing, tilt, rng)
        joints = site.joints(pose)
        found += [] if joints is None else [PlannedPose(pose, joints)]
    return found


def tilted(place: Floats, facing: Floats, tilt: float, rng: np.random.Generator) -> Floats:
    """Return a pose (4, 4) at a point whose roll, pitch and yaw from facing stay below ``tilt``."""
    roll, pitch, yaw = rng.uniform(-tilt, tilt, 3)
    return rigid(rotation_from_rpy(roll, pitch, yaw) @ facing, place)


def read_state(driver: RobotDriver) -> tuple[str, RobotState]:
    """Return an arm's name and its state; nothing is started on its controller, nothing commanded.

    Raises:
        DeviceError: The driver has no way to read alone, or the arm cannot be read: why.
    """
    if driver.read is None:
        raise DeviceError(f"{driver.name} has no way to read it without connecting to drive it")
    try:
        with driver.read() as robot:
            return robot.name, robot.state()
    except FlangeyeError:
        raise
    except Exception as error:  # a vendor's client may fail in any way
        raise DeviceError(
            f"{driver.name} failed with {type(error).__name__}: {' '.join(str(error).split())}"
        ) from error
