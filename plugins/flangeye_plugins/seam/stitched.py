"""A workpiece's scan in base coordinates: by a fixed scanner, or joined from several poses.

Clouds of a scanner on the flange are put together by the hand-eye pose and by where the controller
had the flange. Whatever is wrong with that pose or with the zeros of the joints is wrong in every
cloud, turned and shifted as the arm stood: a point that several clouds show is off by the mean of
what each is off there. Where two clouds show the same face they must agree.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Protocol

import numpy as np

from flangeye import CalibrationRefused
from flangeye.maths.arm_correction import corrected_flange
from flangeye.maths.kinematics import Arm
from flangeye.models.robots import RobotModel
from flangeye.models.scanners import ScannerModel
from flangeye.types import BASE, CAMERA, Floats, HandEye, ScanPlace, Transform, WorkpieceScan
from flangeye.types.geometry import covariance_at, levers
from flangeye_plugins.seam.planned import scanner_covariance
from flangeye_plugins.seam.points import normals_of, thinned


class OfPose(Protocol):
    """Covariance of points mapped to the base, from calibration and arm."""

    def __call__(self, points_in_base: Floats) -> Floats:
        """Return the (K, 3, 3) covariances [m^2] of (K, 3) points."""


@dataclass(frozen=True, eq=False)
class PlacedScan:
    """A scan with its pose and covariance.

    Attributes:
        base_T_camera: Pose of the camera; of the middle scan if there are several.
        covariance: Covariance of points mapped to the base.
        eyes: (P, 3) where the camera was at each place, in ``camera`` [m].
        clouds: P of (N, 3), what it saw there, in ``camera`` [m].
        apart: Median distance of one place's face from its neighbour's, the largest of all [m];
            None where there is one place.
    """

    base_T_camera: Transform
    covariance: OfPose
    eyes: Floats
    clouds: tuple[Floats, ...]
    apart: float | None = None

    @property
    def points(self) -> Floats:
        """(N, 3) of all clouds."""
        return np.concatenate(self.clouds)

    def of_scanner(self, line: Floats, scanner: ScannerModel | None) -> Floats:
        """Return the (K, 3, 3) covariances [m^2] of a line from the scanner's own distortion.

        It moves and turns what one place sees as a whole: about the line's middle, or, of several
        places, about what the nearest has straight ahead.
        """
        if len(self.eyes) == 1:
            levers, distance = line - line.mean(axis=0), np.linalg.norm(line.mean(axis=0))
        else:
            away = line[:, None] - self.eyes
            nearest = np.argmin(np.linalg.norm(away, axis=2), axis=1)
            levers = away[np.arange(len(line)), nearest]
            distance = np.median(levers[:, 2])
            levers[:, 2] = 0.0
        return covariance_at(scanner_covariance(scanner, float(distance)), np.zeros(3), levers)

    def in_base(self, line: Floats, covariances: Floats) -> tuple[Floats, Floats]:
        """Map (K, 3) points in ``camera`` and their covariances (K, 3, 3) to ``base``."""
        rotation = self.base_T_camera.rotation
        mapped = self.base_T_camera.apply(line)
        return mapped, rotation @ covariances @ rotation.T + self.covariance(mapped)


def seen_in_base(
    stage: str, scan: WorkpieceScan, answer: HandEye, robot: RobotModel | None
) -> PlacedScan:
    """Return a scan in the base, for a fixed scanner or one on the arm.

    Args:
        stage: Who asks, for the refusal.
        scan: From one place beside the arm, or from several places of the flange.
        answer: ``base_T_camera`` or ``flange_T_camera``.
        robot: The arm, whose joints' zeros are known to ``joint_accuracy`` alone.

    Raises:
        CalibrationRefused: The scan was not taken by the scanner that was calibrated.
    """
    camera = answer.camera
    of_flange = camera.transform.parent != BASE
    if of_flange != bool(scan.places):
        told = "rides on the flange" if of_flange else "stands beside the arm"
        use = "scan.along" if of_flange else "scan.live or scan.file"
        raise CalibrationRefused(f"{stage}: the scanner {told}; scan the workpiece with {use}")
    points = scan.cloud.points().astype(np.float64)
    if not scan.places:
        return PlacedScan(camera.transform, _AsOnePlace(answer), np.zeros((1, 3)), (points,))
    stands = [_stand(place, answer, robot) for place in scan.places]
    ends = np.cumsum([place.points for place in scan.places])
    split = np.split(points, ends[:-1])
    seen = [s.apply(cloud) for s, cloud in zip(stands, split, strict=True)]
    middle = stands[len(stands) // 2]
    # Clouds are thinned before they are compared with each other [m]
    shown = [thinned(cloud, 3e-3) for cloud in seen]
    of_pose = _AsSeveral(scan.places, answer, robot, shown)
    back = middle.inverse()
    eyes = back.apply(np.array([stand.translation for stand in stands]))
    clouds = tuple(back.apply(cloud) for cloud in seen)
    return PlacedScan(middle, of_pose, eyes, clouds, _apart(shown))


def _stand(place: ScanPlace, answer: HandEye, robot: RobotModel | None) -> Transform:
    """Return ``base_T_camera`` at a place, by the arm as reported or, where found, corrected."""
    arm = Arm(robot) if robot else None
    flange = corrected_flange(place.base_T_flange, place.joints, answer.correction, arm)
    return Transform(BASE, CAMERA, flange @ answer.camera.transform.matrix)


@dataclass(frozen=True, eq=False)
class _AsOnePlace:
    """The hand-eye pose alone: the scan of the workpiece took no part in the calibration.

    For the same arm, which errs at the seam much as it did at the poses nearby.
    """

    answer: HandEye

    def __call__(self, points_in_base: Floats) -> Floats:
        pose = self.answer.base_T_camera
        return covariance_at(pose.covariance, pose.about, points_in_base)


@dataclass(frozen=True, eq=False)
class _AsSeveral:
    """The hand-eye pose and the joints' zeros, both the same at every place."""

    places: Sequence[ScanPlace]
    answer: HandEye
    robot: RobotModel | None
    shown: Sequence[Floats]

    def __call__(self, points_in_base: Floats) -> Floats:
        camera, count = self.answer.camera, len(points_in_base)
        # An error of the hand-eye pose or of a joint's zero is one number for all places: how it
        # moves a point is averaged over the places that show the point, then squared
        of_camera = np.zeros((count, 3, 6))
        of_zeros = np.zeros((count, 3, 0 if self.robot is None else len(self.robot.joints)))
        for place, share in zip(self.places, self._shares(points_in_base), strict=True):
            flange = np.asarray(place.base_T_flange)
            inside = (points_in_base - flange[:3, 3]) @ flange[:3, :3]
            of_camera += share[:, None, None] * (flange[:3, :3] @ levers(inside - camera.about))
            if self.robot is not None:
                moved = levers(points_in_base - flange[:3, 3])
                turning = Arm(self.robot).jacobian(place.joints)
                of_zeros += share[:, None, None] * (moved @ turning)
        zeros = 0.0 if self.robot is None else self.robot.joint_accuracy**2
        out = of_camera @ camera.covariance @ of_camera.transpose(0, 2, 1)
        return np.asarray(out + zeros * of_zeros @ of_zeros.transpose(0, 2, 1))

    def _shares(self, points: Floats) -> Floats:
        """Return (places, K): how much of what is seen at each point each place shows."""
        from scipy.spatial import cKDTree

        trees = [cKDTree(cloud) for cloud in self.shown]
        # A cloud takes part in a point of the seam by how many of its points are so near [m]
        cloud_within = 10e-3
        counts = np.array(
            [tree.query_ball_point(points, cloud_within, return_length=True) for tree in trees],
            float,
        )
        nearest = np.argmin([tree.query(points)[0] for tree in trees], axis=0)
        counts[nearest, np.arange(len(points))] += 1e-3  # beyond what any shows: the nearest alone
        return np.asarray(counts / counts.sum(axis=0))


def _apart(clouds: Sequence[Floats]) -> float | None:
    """Return by how much neighbouring clouds are apart, across the faces that both show."""
    from scipy.spatial import cKDTree

    found = []
    for first, second in pairwise(clouds):
        normals = normals_of(first)
        # Points so near to each other may show the same face [m]
        away, at = cKDTree(first).query(second, distance_upper_bound=10e-3)
        both = np.isfinite(away)
        # Points that two clouds share, for their agreement to be known
        fewest_shared = 200
        if both.sum() >= fewest_shared:
            at = at[both]
            across = np.einsum("ni,ni->n", second[both] - first[at], normals[at])
            found.append(float(np.median(np.abs(across))))
    return max(found, default=None)
