"""Plan of a simulated session in any configuration, simulated as the cell that it is.

The kinematic loop is closed at a first pose: given the poses of camera and target in the recipe,
the remaining transform follows. Further joint angles are drawn around it at random, and those are
kept at which the camera sees the target.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from pydantic import Field

from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import Cell, cell_of
from flangeye.models.configuration import Configuration
from flangeye.models.robots import RobotModel, SecondRobot
from flangeye.models.targets import Flange
from flangeye.plugin.stage import Params, PlaceParams
from flangeye.types import BASE, BASE2, CAMERA, FLANGE, TARGET, Floats, Source
from flangeye.types.geometry import invert, rotation_exp
from flangeye.units import Angle, Length, param
from flangeye_emulators.acquire.moments import (
    UNSEEN,
    UPRIGHT,
    ArmsParams,
    CameraView,
    Moments,
    carried,
)

REPORTED = float(np.radians(0.0115)), 0.05e-3
"""Standard deviation of a reported pose about and along each axis [rad, m]: half of what the data
sheet of a UR5 gives for repeatability, 0.1 mm."""


class SessionParams(ArmsParams):
    """Common parameters of simulated sessions."""

    poses: int = Field(20, ge=3, le=100_000)
    """Number of captures."""
    spread: Angle = param("17 deg", gt=0)
    """Largest change of a joint from the middle of the poses."""
    camera: PlaceParams | None = None
    """True pose of the camera in the frame that carries it; by default, such that it sees the
    target at the first pose."""
    place: PlaceParams = Field(default_factory=PlaceParams)
    """True pose of the target in the frame that carries it, where the recipe does not know it; if
    camera is given, it follows from the first pose."""
    motion: Literal["together", "in_turns", "four_axes"] = "together"
    """together: two arms move at once; in_turns: only one of them moves at a time, and the other
    rests at its first pose; four_axes: the first arm is a SCARA, whose flange turns about the
    vertical."""


class ViewParams(SessionParams):
    """Common parameters of simulated sessions with area cameras."""

    distance: Length = param("650 mm", gt=0)
    """Distance from camera to target at the first pose."""


def plan_session(
    robot: RobotModel,
    second: SecondRobot | None,
    configuration: Configuration,
    given: tuple[SessionParams, CameraView],
    rng: np.random.Generator,
) -> Moments:
    """Return a session with random arm poses, and camera and target placed to close the loop.

    Args:
        robot: The first arm.
        second: The second arm; None for a configuration with one.
        configuration: What carries camera and target.
        given: Parameters of the recipe, and the camera's field of view.
        rng: Random generator of poses and noise.

    Raises:
        StageError: A second arm is missing, the target is in view at too few poses, or an arm of
            four axes is to have errors.
    """
    params, view = given
    four_axes, exact = params.motion == "four_axes", params.arm.is_default
    if configuration.other_base and second is None:
        raise StageError("two arms need the recipe's 'second_robot' section: {model: …}")
    if four_axes and not exact:
        raise StageError(
            "joint errors cannot be simulated for an arm of four axes; leave 'arm' out"
        )
    cell = cell_of(configuration, robot, second.model if second else None)
    arms = {name: Arm(model) for name, model in cell.arms.items()}
    known = configuration.place
    place = params.place.matrix if known is None else np.asarray(known)
    camera = params.camera.matrix if params.camera else None
    home = UPRIGHT
    if camera is not None and known is not None and not configuration.other_base:
        home = _home_of(arms[FLANGE], place @ invert(camera @ view.first()))
    angles = _drawn(cell, home, params, view.draws, rng)
    reported = carried(cell, arms, angles)
    if four_axes:
        reported[FLANGE] = _of_four_axes(reported[FLANGE], params.spread, rng)
    places = _closed(configuration, reported, view, camera, place)
    joints = {} if four_axes else {FLANGE: angles[FLANGE]}
    moments = Moments(cell, reported, cell.frames, joints, {} if four_axes else angles)
    moments = _in_view(moments.placed(places | reported), params.poses, view)
    if not exact:
        moments = moments.as_built(params.arm, rng)
        rest = range(params.poses, len(moments))
        moments = replace(moments, unseen=tuple(map(moments.exact, rest)))
    moments = moments.where(np.arange(params.poses))
    carriers = [name for name in (configuration.camera, configuration.target) if name != BASE]
    return moments.disturbed(carriers, REPORTED, rng)


def _drawn(
    cell: Cell, home: Floats, params: SessionParams, draws: int, rng: np.random.Generator
) -> dict[str, Floats]:
    """Return joint angles (draws, n) of the arms: the first pose and random ones around it."""
    angles = {}
    for k, name in enumerate(cell.arms):
        first = home if name == FLANGE else UPRIGHT
        changes = rng.uniform(-params.spread, params.spread, (draws, len(first)))
        changes[0] = 0.0
        if params.motion == "in_turns":
            changes[k::2] = 0.0
        angles[name] = np.asarray(first + changes)
    return angles


def _of_four_axes(flange: Floats, spread: float, rng: np.random.Generator) -> Floats:
    """Return poses of an arm whose flange translates and rotates about the vertical only."""
    first, draws = flange[0], len(flange)
    turns = rotation_exp(np.outer(rng.uniform(-spread, spread, draws), [0.0, 0.0, 1.0]))
    out = np.tile(first, (draws, 1, 1))
    out[1:, :3, :3] = turns[1:] @ first[:3, :3]
    out[1:, :3, 3] += rng.uniform(-0.15, 0.15, (draws - 1, 3))
    return out


def _closed(
    configuration: Configuration,
    reported: Mapping[str, Floats],
    view: CameraView,
    camera: Floats | None,
    place: Floats,
) -> dict[str, Floats | None]:
    """Return the places of what stands still, so that the target is in view at the first pose.

    Args:
        configuration: Determines which transform closes the loop.
        reported: The arms' poses by frame; only the first one is used.
        view: The camera's field of view.
        camera: (4, 4) pose of the camera in its carrier; None to compute it.
        place: (4, 4) pose of the target in its carrier, unless that closes the loop.
    """
    first = {BASE: np.eye(4), **{name: poses[0] for name, poses in reported.items()}}
    a, b, seen = first[configuration.camera], first[configuration.target], view.first()
    places = {CAMERA: camera, BASE2: np.eye(4), TARGET: place}
    if camera is None:
        places[CAMERA] = invert(a) @ b @ place @ invert(seen)
    elif configuration.other_base:
        places[BASE2] = a @ camera @ seen @ invert(b @ place)
    elif configuration.place is None:
        places[TARGET] = invert(b) @ a @ camera @ seen
    return places


def _home_of(arm: Arm, base_T_flange: Floats) -> Floats:
    """Return joint angles (n,) that reach a pose [rad].

    Raises:
        StageError: The pose is out of reach.
    """
    found = arm.inverse(base_T_flange)
    if not len(found):
        raise StageError(
            "the arm cannot reach a pose at which the camera sees the target; change camera:, "
            "place: or distance:"
        )
    return np.asarray(found[0])


def _in_view(moments: Moments, count: int, view: CameraView) -> Moments:
    """Return the first moments at which the camera sees the target, and some more if possible.

    Raises:
        StageError: There are too few such poses.
    """
    found = np.flatnonzero(view.sees(moments.seen()))
    if len(found) < count:
        raise StageError(
            f"the camera sees the target at {len(found)} of {view.draws} poses drawn, and {count} "
            "are needed; make spread smaller, or move home, camera or place"
        )
    return moments.where(found[: count + UNSEEN])


def source_of(
    moments: Moments, given: tuple[RobotModel, Configuration], seed: int, *models: Params | Flange
) -> Source:
    """Return the provenance of a session's captures, from its models and parameters."""
    robot, configuration = given
    dumped: list[Any] = [model.model_dump(mode="json") for model in models]
    note = f"simulated: {configuration.name}, {len(moments)} poses"
    return moments.source(seed, note, [robot.model, configuration.describe(), *dumped])
