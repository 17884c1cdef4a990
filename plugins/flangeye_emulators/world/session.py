"""Poses of a simulated session in any configuration: reported, true and in view.

The kinematic loop is closed at a first pose: given the poses of camera and target in the recipe,
the remaining transform follows. Further joint angles are drawn around it at random, and those are
kept at which the camera sees the target.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.configuration import LINK, Configuration
from flangeye.types import BASE, FLANGE, FLANGE2, Floats
from flangeye.types.geometry import invert, rigid, rotation_exp, rotation_from_rpy
from flangeye_emulators.world.arm import ImperfectArm

DRAWS = 4000
"""Joint vectors tried, unless the view is a narrow one."""


@dataclass(frozen=True)
class CameraView:
    """The camera's field of view.

    Attributes:
        distance: Distance to the target at the first pose [m].
        near: Smallest distance [m].
        far: Largest distance [m].
        field: Full angles of view, horizontal and vertical [rad].
        facing: Largest angle between the target's z and the line to the camera [rad].
        draws: Number of random joint vectors to try.
    """

    distance: float
    near: float
    far: float
    field: tuple[float, float]
    facing: float
    draws: int = DRAWS

    def first(self) -> Floats:
        """Return ``camera_T_target`` (4, 4) at the first pose: straight ahead of the camera."""
        return rigid(rotation_from_rpy(np.pi, 0.0, 0.0), np.array([0.0, 0.0, self.distance]))

    def sees(self, poses: Floats) -> NDArray[np.bool_]:
        """Return the mask (N,) of poses ``camera_T_target`` (N, 4, 4) in view."""
        x, y, z = poses[:, :3, 3].T
        # Share of the field of view, to either side, in which the target's centre stays
        half = np.tan(np.asarray(self.field) / 2) * 0.75
        away = np.linalg.norm(poses[:, :3, 3], axis=1)
        cosine = -(poses[:, :3, 2] * poses[:, :3, 3]).sum(axis=1) / np.maximum(away, 1e-9)
        inside = (np.abs(x) < half[0] * z) & (np.abs(y) < half[1] * z)
        in_range = (z > self.near) & (z < self.far)
        return np.asarray(inside & in_range & (cosine > np.cos(self.facing)))


@dataclass(frozen=True, eq=False)
class Places:
    """True transforms X, Y and Z of the kinematic loop, each (4, 4)."""

    x: Floats
    y: Floats
    z: Floats


@dataclass(frozen=True, eq=False)
class ArmPoses:
    """Poses of the arms at N moments.

    Attributes:
        joints: (N, n) joint angles of the first arm [rad]; None for an arm without a model.
        second: (N, m) joint angles of the second arm [rad]; None without one.
        camera: (N, 4, 4) poses in ``base`` of the frame that carries the camera.
        flange: (N, 4, 4) ``base_T_flange``.
        target: (N, 4, 4) poses of the frame that carries the target, in its arm's base.
    """

    joints: Floats | None
    second: Floats | None
    camera: Floats
    flange: Floats
    target: Floats

    def where(self, chosen: NDArray[np.intp]) -> ArmPoses:
        """Return the chosen poses only."""
        joints = None if self.joints is None else self.joints[chosen]
        second = None if self.second is None else self.second[chosen]
        carried = (self.camera[chosen], self.flange[chosen], self.target[chosen])
        return ArmPoses(joints, second, *carried)


@dataclass(frozen=True, eq=False)
class Cast:
    """Arms and limits of a simulated session.

    Attributes:
        configuration: What carries camera and target.
        first: The first arm.
        second: The second arm; None without one.
        four_axes: Whether the first arm's flange only translates and rotates about the base's z.
        in_turns: Whether only one of two arms moves at a time, while the other rests at its first
            pose.
        draws: Number of random joint vectors to try.
    """

    configuration: Configuration
    first: Arm
    second: Arm | None
    four_axes: bool = False
    in_turns: bool = False
    draws: int = DRAWS


def draw_arm_poses(
    cast: Cast, home: tuple[Floats, Floats], spread: float, rng: np.random.Generator
) -> ArmPoses:
    """Return the first pose and random ones around it, whether in view or not.

    Args:
        cast: Arms and limits.
        home: Joint angles of the first and the second arm at the first pose [rad].
        spread: Largest change of any joint [rad].
        rng: Random generator of the joint angles.
    """
    joints = _around(home[0], spread, cast.draws, rng)
    if cast.in_turns:
        joints[::2] = home[0]
    frames, flange = cast.first.frames(joints), cast.first.flange(joints)
    if cast.four_axes:
        flange = _of_four_axes(flange[0], spread, cast.draws, rng)
    second = None if cast.second is None else _around(home[1], spread, cast.draws, rng)
    if cast.in_turns and second is not None:
        second[1::2] = home[1]
    carried: dict[str, Floats] = {BASE: np.tile(np.eye(4), (cast.draws, 1, 1)), FLANGE: flange}
    if cast.second is not None and second is not None:
        carried[FLANGE2] = cast.second.flange(second)
    camera = cast.configuration.camera
    if camera.startswith(LINK):
        carried[camera] = frames[:, int(camera.removeprefix(LINK))]
    known = None if cast.four_axes else joints
    return ArmPoses(known, second, carried[camera], flange, carried[cast.configuration.target])


def _around(home: Floats, spread: float, draws: int, rng: np.random.Generator) -> Floats:
    changes = rng.uniform(-spread, spread, (draws, len(home)))
    changes[0] = 0.0
    return np.asarray(home + changes)


def _of_four_axes(first: Floats, spread: float, draws: int, rng: np.random.Generator) -> Floats:
    """Return poses of an arm whose flange translates and rotates about the vertical only."""
    turns = rotation_exp(np.outer(rng.uniform(-spread, spread, draws), [0.0, 0.0, 1.0]))
    out = np.tile(first, (draws, 1, 1))
    out[1:, :3, :3] = turns[1:] @ first[:3, :3]
    out[1:, :3, 3] += rng.uniform(-0.15, 0.15, (draws - 1, 3))
    return out


def close_loop(
    poses: ArmPoses,
    view: CameraView,
    configuration: Configuration,
    camera: Floats | None,
    place: Floats,
) -> Places:
    """Return the loop's transforms such that the camera sees the target at the first pose.

    Args:
        poses: The arms' poses; only the first one is used.
        view: The camera's field of view.
        configuration: Determines which transform closes the loop.
        camera: (4, 4) pose of the camera in its carrier; None to compute it.
        place: (4, 4) pose of the target in its carrier, unless that closes the loop.
    """
    a, b, seen = poses.camera[0], poses.target[0], view.first()
    identity = np.eye(4)
    if camera is None:
        return Places(invert(a) @ b @ place @ invert(seen), identity, place)
    if configuration.other_base:
        return Places(camera, a @ camera @ seen @ invert(b @ place), place)
    return Places(camera, identity, invert(b) @ a @ camera @ seen)


def home_of(arm: Arm, base_T_flange: Floats) -> Floats:
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


def seen_from(poses: ArmPoses, places: Places) -> Floats:
    """Return ``camera_T_target`` at all poses (N, 4, 4)."""
    world = places.y @ poses.target @ places.z
    return np.asarray(invert(poses.camera @ places.x) @ world)


def visible(poses: ArmPoses, places: Places, view: CameraView, count: int) -> ArmPoses:
    """Return at least ``count`` poses at which the camera sees the target.

    Raises:
        StageError: There are too few such poses.
    """
    found = np.flatnonzero(view.sees(seen_from(poses, places)))
    if len(found) < count:
        raise StageError(
            f"the camera sees the target at {len(found)} of {view.draws} poses drawn, and {count} "
            "are needed; make spread smaller, or move home, camera or place"
        )
    return poses.where(found)


def disturbed(poses: Floats, noise: tuple[float, float], rng: np.random.Generator) -> Floats:
    """Return poses (N, 4, 4) disturbed in their own frames by noise [rad, m]."""
    out = poses.copy()
    turns, shifts = rng.standard_normal((2, len(poses), 3))
    out[:, :3, :3] = poses[:, :3, :3] @ rotation_exp(noise[0] * turns)
    out[:, :3, 3] += (poses[:, :3, :3] @ (noise[1] * shifts)[..., None])[..., 0]
    return out


def as_built(
    reported: ArmPoses, configuration: Configuration, arms: tuple[ImperfectArm, ImperfectArm | None]
) -> ArmPoses:
    """Return the true poses of imperfect arms that report ``reported``.

    Args:
        reported: Reported poses in the order of their visit.
        configuration: Who carries what.
        arms: The first arm, and the second one if there is one.

    Raises:
        StageError: The arm has no model in the catalogue.
    """
    if reported.joints is None:
        raise StageError("an arm of four axes has no joints to be wrong; leave 'arm' out")
    first, other = arms
    angles, carried = first.angles(reported.joints), {BASE: reported.camera * 0 + np.eye(4)}
    carried[FLANGE] = first.flange(angles)
    if configuration.camera.startswith(LINK):
        link = int(configuration.camera.removeprefix(LINK))
        carried[configuration.camera] = first.frames(angles)[:, link]
    if other is not None and reported.second is not None:
        carried[FLANGE2] = other.flange(other.angles(reported.second))
    camera, target = carried[configuration.camera], carried[configuration.target]
    return replace(reported, camera=camera, target=target, flange=carried[FLANGE])


def with_noise(
    reported: ArmPoses,
    configuration: Configuration,
    noise: tuple[float, float],
    rng: np.random.Generator,
) -> ArmPoses:
    """Return the true poses of arms that report ``reported``, with random noise.

    Frames fixed to a base have no noise.
    """
    carried = ((configuration.camera, reported.camera), (configuration.target, reported.target))
    camera, target = (m if frame == BASE else disturbed(m, noise, rng) for frame, m in carried)
    flange = camera if configuration.camera == FLANGE else reported.flange
    flange = target if configuration.target == FLANGE else flange
    return replace(reported, camera=camera, target=target, flange=flange)
