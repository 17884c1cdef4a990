"""Moments of a simulated cell: poses of its frames, reported and true, and who sees whom."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from pydantic import Field

from flangeye.maths.kinematics import Arm
from flangeye.models.cell import Cell, Frame, composed
from flangeye.plugin.stage import Params
from flangeye.types import (
    CAMERA,
    FLANGE,
    TARGET,
    Floats,
    Indices,
    Mask,
    Observation,
    PoseFeature,
    Source,
    Transform,
    Truth,
)
from flangeye.types.geometry import invert, rigid, rotation_exp, rotation_from_rpy
from flangeye_emulators.world.arm import ArmErrors, ImperfectArm

VERSION = 1
"""Raised whenever the same parameters would give other captures or sessions."""
UNSEEN = 60
"""Number of poses that are not used for calibration, at which the true error is measured."""
UPRIGHT = np.radians([0, -90, 90, -90, -90, 0])
"""Joints of an arm at its first pose."""
MOST_OBLIQUE = float(np.radians(50.0))
"""A camera sees a target whose z is this far from the view at most [rad]."""
FIELD = float(np.radians(50.0)), float(np.radians(40.0))
"""Horizontal and vertical field of view of a camera that is not a scanner [rad]."""
DRAWS = 4000
"""Joint vectors tried, unless the view is a narrow one."""


class ArmsParams(Params):
    """Common parameters of simulated arms."""

    arm: ArmErrors = Field(default_factory=ArmErrors)
    """Errors of the arms against their controllers' models; by default only the noise of a reported
    pose."""


@dataclass(frozen=True)
class CameraView:
    """The camera's field of view.

    Attributes:
        distance: Distance to the target at the first pose [m].
        near: Smallest distance [m].
        far: Largest distance [m].
        field: Full angles of view, horizontal and vertical [rad].
        max_incidence: Largest angle between the target's z and the line to the camera [rad].
        draws: Number of random joint vectors to try.
    """

    distance: float
    near: float
    far: float
    field: tuple[float, float]
    max_incidence: float
    draws: int = DRAWS

    def first(self) -> Floats:
        """Return ``camera_T_target`` (4, 4) at the first pose: straight ahead of the camera."""
        return rigid(rotation_from_rpy(np.pi, 0.0, 0.0), np.array([0.0, 0.0, self.distance]))

    def sees(self, poses: Floats) -> Mask:
        """Return the mask (N,) of poses ``camera_T_target`` (N, 4, 4) in view."""
        x, y, z = poses[:, :3, 3].T
        # Share of the field of view, to either side, in which the target's centre stays
        half = np.tan(np.asarray(self.field) / 2) * 0.75
        away = np.linalg.norm(poses[:, :3, 3], axis=1)
        cosine = -(poses[:, :3, 2] * poses[:, :3, 3]).sum(axis=1) / np.maximum(away, 1e-9)
        inside = (np.abs(x) < half[0] * z) & (np.abs(y) < half[1] * z)
        in_range = (z > self.near) & (z < self.far)
        return np.asarray(inside & in_range & (cosine > np.cos(self.max_incidence)))


Sighting = tuple[int, str, str]
"""Index of a sighting's moment, its camera and its target."""


def name_of(sighting: Sighting) -> str:
    """Return the name of a sighting; that of a configuration is its moment."""
    i, *ends = sighting
    return f"{i:04d}" if ends == [CAMERA, TARGET] else "-".join([f"{i:04d}", *ends])


def noise_free(camera_T_target: Floats) -> PoseFeature:
    """Return a target's pose (4, 4) as a camera without noise measures it."""
    return PoseFeature(Transform(CAMERA, TARGET, camera_T_target), np.zeros((6, 6)))


@dataclass(frozen=True, eq=False)
class Moments:
    """The poses of a cell at N moments, as reported by controllers and true.

    Attributes:
        cell: Graph of the cell's frames.
        reported: (N, 4, 4) reported poses, by name of the moving frame.
        actual: All frames with their true poses.
        joints: (N, n) reported joint angles, by arm [rad]; empty if not reported.
        angles: (N, n) true joint angles, by arm [rad].
        unseen: Noise-free observations that take no part in the session.
    """

    cell: Cell
    reported: Mapping[str, Floats]
    actual: Mapping[str, Frame]
    joints: Mapping[str, Floats]
    angles: Mapping[str, Floats]
    unseen: tuple[Observation, ...] = ()

    def __len__(self) -> int:
        return len(next(iter(self.reported.values())))

    def where(self, chosen: Indices) -> Moments:
        """Return the chosen moments only."""
        reported, joints, angles = (
            {name: values[chosen] for name, values in each.items()}
            for each in (self.reported, self.joints, self.angles)
        )
        actual = {name: frame.at(chosen) for name, frame in self.actual.items()}
        return replace(self, reported=reported, actual=actual, joints=joints, angles=angles)

    def placed(self, places: Mapping[str, Floats | None]) -> Moments:
        """Return the moments with other true poses of some frames, (4, 4) or (N, 4, 4)."""
        actual = {n: replace(f, place=places.get(n, f.place)) for n, f in self.actual.items()}
        return replace(self, actual=actual)

    def disturbed(
        self, names: Iterable[str], noise: tuple[float, float], rng: np.random.Generator
    ) -> Moments:
        """Return the moments with moving frames disturbed in themselves by noise [rad, m]."""
        exact = {name: np.asarray(self.actual[name].place) for name in names}
        return self.placed({n: _disturbed(poses, noise, rng) for n, poses in exact.items()})

    def as_built(self, errors: ArmErrors, rng: np.random.Generator) -> Moments:
        """Return the moments with the true poses of imperfect arms that visit them in order."""
        scale, cell = 0.0 if errors.is_default else 1.0, self.cell
        arms = {n: ImperfectArm(m, scale, rng.spawn(1)[0], errors) for n, m in cell.arms.items()}
        angles = {name: arms[name].angles(joints) for name, joints in self.angles.items()}
        return replace(self.placed(carried(cell, arms, angles)), angles=angles)

    def seen(self, camera: str = CAMERA, target: str = TARGET) -> Floats:
        """Return ``camera_T_target`` at all moments (N, 4, 4)."""
        return np.asarray(invert(self.each(camera)) @ self.each(target))

    def each(self, name: str) -> Floats:
        """Return a frame's pose in the root frame at all moments (N, 4, 4)."""
        return np.broadcast_to(composed(self.actual, name), (len(self), 4, 4))

    def place(self, i: int, name: str) -> Floats:
        """Return a frame's pose (4, 4) in the root frame at one moment."""
        return composed({each: frame.at(i) for each, frame in self.actual.items()}, name)

    def pose(self, i: int, camera: str = CAMERA, target: str = TARGET) -> Floats:
        """Return ``camera_T_target`` (4, 4) at one moment."""
        return np.asarray(invert(self.place(i, camera)) @ self.place(i, target))

    def recorded(self, i: int) -> dict[str, Any]:
        """Return the poses and joints reported at one moment, as a capture or observation has."""
        parent = {name: self.cell.frames[name].parent for name in self.cell.movers}
        joints = {name: joints[i] for name, joints in self.joints.items()}
        return {
            "poses": {n: Transform(parent[n], n, self.reported[n][i]) for n in parent},
            "joints": joints.pop(FLANGE, None),
            "arm_joints": joints,
        }

    def exact(self, i: int, camera: str = CAMERA, target: str = TARGET) -> Observation:
        """Return a noise-free observation of a target by a camera."""
        seen = noise_free(self.pose(i, camera, target))
        name = name_of((i, camera, target))
        return Observation(name, seen, camera=camera, target=target, **self.recorded(i))

    def source(self, seed: int, note: str, made_of: Sequence[Any]) -> Source:
        """Return the provenance of a session, with the truth, from its models' plain data."""
        cell = self.cell
        camera, *others = (
            Transform.named(cell.name_of(name), np.asarray(self.actual[name].place))
            for name in cell.unknown_frames
        )
        truth = Truth(camera, tuple(others), unseen=self.unseen)
        return Source(fingerprint_of(seed, made_of), (note,), truth=truth, simulated=True)


def carried(
    cell: Cell, arms: Mapping[str, Arm | ImperfectArm], angles: Mapping[str, Floats]
) -> dict[str, Floats]:
    """Return the poses (N, 4, 4) of flanges and links in their arms' bases, by name.

    Args:
        cell: Graph of the cell's frames.
        arms: Kinematics by name of the arm.
        angles: (N, n) joint angles by name of the arm [rad].
    """
    places = {name: arms[name].flange(joints) for name, joints in angles.items()}
    for name, link in cell.links.items():
        places[name] = arms[link.arm].frames(angles[link.arm])[:, link.number]
    return places


def _disturbed(poses: Floats, noise: tuple[float, float], rng: np.random.Generator) -> Floats:
    out = poses.copy()
    turns, shifts = rng.standard_normal((2, len(poses), 3))
    out[:, :3, :3] = poses[:, :3, :3] @ rotation_exp(noise[0] * turns)
    out[:, :3, 3] += (poses[:, :3, :3] @ (noise[1] * shifts)[..., None])[..., 0]
    return out


def fingerprint_of(seed: int, made_of: Sequence[Any]) -> str:
    """Return the hash of a simulation, computed from its seed and its models' plain data."""
    text = json.dumps([VERSION, seed, made_of], sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
