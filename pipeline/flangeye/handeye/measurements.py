"""What a solver of any configuration knows: N measurements of the target, as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np
from numpy.typing import NDArray

from flangeye.errors import StageError
from flangeye.maths.geometry import basis_of_plane, hat
from flangeye.maths.kinematics import Arm
from flangeye.models.configuration import Configuration, carriers_of
from flangeye.types import BASE, Feature, Floats, Mask, Observation, PoseFeature


@dataclass(frozen=True, eq=False)
class Loop:
    """Which parts of the loop A X M = Y B Z are unknown, and which carriers are moved.

    Attributes:
        y: Whether there is a second base to find.
        z: Whether the target's place is to be found.
        place: (4, 4) of it, or a first guess.
        camera_moves: Whether an arm moves the camera, and so has noise there.
        target_moves: Whether an arm moves the target.
    """

    y: bool
    z: bool
    place: Floats
    camera_moves: bool
    target_moves: bool


def loop_of(configuration: Configuration) -> Loop:
    """Return what a configuration leaves unknown."""
    known = configuration.place
    return Loop(
        y=configuration.other_base is not None,
        z=known is None,
        place=np.eye(4) if known is None else np.asarray(known),
        camera_moves=configuration.camera != BASE,
        target_moves=configuration.target != BASE,
    )


@dataclass(frozen=True, eq=False)
class Seen:
    """What cameras saw of targets, N times.

    Attributes:
        rotations: (N, 3, 3) camera_R_target; the turn about z means nothing for circles, and all
            of it nothing for centres.
        centres: (N, 3) in ``camera`` [m].
        covariances: (N, 6, 6) own noise, order (rotation, translation), in ``camera``.
        projectors: (N, 6, 6) onto what was measured.
        freedoms: (N,) how many numbers that is: 6 for a pose, 5 with a normal, 3 for a centre.
    """

    rotations: Floats
    centres: Floats
    covariances: Floats
    projectors: Floats
    freedoms: Floats

    def __len__(self) -> int:
        return len(self.centres)

    @property
    def poses(self) -> Floats:
        """(N, 4, 4) camera_T_target."""
        out = np.zeros((len(self), 4, 4))
        out[:, :3, :3], out[:, :3, 3], out[:, 3, 3] = self.rotations, self.centres, 1.0
        return out

    @property
    def are_poses(self) -> bool:
        """Whether every measurement is a whole pose."""
        return bool((self.freedoms == 6).all())

    @property
    def have_normals(self) -> bool:
        """Whether every measurement has a normal at least."""
        return bool((self.freedoms >= 5).all())

    def where(self, chosen: Mask | NDArray[np.intp]) -> Self:
        """Return some of it."""
        return type(self)(**{each.name: getattr(self, each.name)[chosen] for each in fields(self)})


@dataclass(frozen=True, eq=False)
class Measurements(Seen):
    """N measurements of one target by one camera.

    Attributes:
        a: (N, 4, 4) where the camera was carried, in ``base``.
        b: (N, 4, 4) where the target was carried, in its own arm's base.
        offsets: (N, 3) what was seen, in the target's frame [m].
    """

    a: Floats
    b: Floats
    offsets: Floats

    @property
    def has_normal(self) -> Mask:
        """(N,) where a normal was measured, and no whole pose."""
        return np.asarray(self.freedoms == 5)

    def without_normals(self, mask: Mask) -> Measurements:
        """Return the same measurements, the normals of a mask left out."""
        out = mask & self.has_normal
        projectors = self.projectors.copy()
        projectors[out, :3, :3] = 0.0
        return replace(self, projectors=projectors, freedoms=np.where(out, 3.0, self.freedoms))

    def mirrored(self) -> Measurements:
        """Return what a scanner of the other handedness would have seen."""
        flip = np.array([1.0, 1.0, -1.0])
        return replace(
            self, centres=self.centres * flip, rotations=self.rotations * np.outer(flip, flip)
        )


def measurements_of(
    observations: Sequence[Observation],
    configuration: Configuration,
    arm: Arm | None,
    normals: bool = True,
) -> Measurements:
    """Collect observations into arrays.

    Args:
        observations: N of them.
        configuration: Says who carries what.
        arm: Kinematics, where a link carries the camera.
        normals: Whether circles' normals count.

    Raises:
        StageError: There are no observations, or a carrier's pose is missing.
    """
    if not observations:
        raise StageError("no pose to solve with: every capture was set aside, each for its reason")
    carriers = carriers_of(configuration, observations, arm)
    each = [measured(o, normals) for o in observations]
    rotations, covariances, projectors = (np.array(column) for column in zip(*each, strict=True))
    return Measurements(
        a=carriers.camera,
        b=carriers.target,
        offsets=np.array([o.centre_in_mount for o in observations]),
        rotations=rotations,
        centres=np.array([o.feature.centre for o in observations]),
        covariances=covariances,
        projectors=projectors,
        freedoms=np.trace(projectors, axis1=1, axis2=2).round(),
    )


def shared_errors(observations: Sequence[Observation]) -> Floats:
    """Return (N, 6, k) how each of k errors that all share moves what was seen, in ``camera``."""
    each = [o.feature.shared if isinstance(o.feature, PoseFeature) else np.zeros((6, 0))
            for o in observations]  # fmt: skip
    most = max(moved.shape[1] for moved in each)
    if not most:
        return np.zeros((len(each), 6, 0))
    return np.array([np.pad(moved, ((0, 0), (0, most - moved.shape[1]))) for moved in each])


def measured(observation: Observation, normals: bool) -> tuple[Floats, Floats, Floats]:
    """Return (3, 3) rotation, (6, 6) covariance and (6, 6) projector of one feature."""
    feature = observation.feature
    if isinstance(feature, PoseFeature):
        return feature.camera_T_target.rotation, feature.covariance, np.eye(6)
    covariance, projector = np.zeros((6, 6)), np.zeros((6, 6))
    covariance[3:, 3:], projector[3:, 3:] = feature.covariance, np.eye(3)
    if feature.normal is None or feature.normal_covariance is None or not normals:
        return np.eye(3), covariance, projector
    turn = hat(feature.normal)
    covariance[:3, :3] = turn @ feature.normal_covariance @ turn.T
    projector[:3, :3] = np.eye(3) - np.outer(feature.normal, feature.normal)
    return basis_of_plane(feature.normal).T, covariance, projector


def by_depth(feature: Feature) -> bool:
    """Whether a feature was measured in a cloud, and not in the pixels of an image."""
    return not (isinstance(feature, PoseFeature) and len(feature.corners))
