"""A workpiece's scan in base coordinates: from a fixed scanner, or stitched from several poses.

Clouds of a scanner on the flange are stitched by the hand-eye pose and the reported flange poses.
Errors of the hand-eye pose and of the joint zeros affect every cloud, each in the orientation of
the arm at that pose. The error of a point seen in several clouds is the mean of their errors there.
Clouds that show the same face must agree.
"""

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
    """Interface: covariance of points mapped to the base, from calibration and arm."""

    def __call__(self, points_in_base: Floats) -> Floats:
        """Return the covariances (K, 3, 3) of points (K, 3) [m^2]."""


@dataclass(frozen=True, eq=False)
class PlacedScan:
    """A scan with its pose in the base and the covariance of mapped points.

    Attributes:
        base_T_camera: Pose of the camera; that of the middle scan if there are several.
        covariance: Covariance of points mapped to the base.
        eyes: (P, 3) positions of the camera for each cloud, in ``camera`` [m].
        clouds: P arrays (N, 3) of points, in ``camera`` [m].
        apart: Largest median distance between faces shared by neighbouring clouds [m]; None for one
            cloud.
    """

    base_T_camera: Transform
    covariance: OfPose
    eyes: Floats
    clouds: tuple[Floats, ...]
    apart: float | None = None

    @property
    def points(self) -> Floats:
        """Points (N, 3) of all clouds [m]."""
        return np.concatenate(self.clouds)

    def of_scanner(self, line: Floats, scanner: ScannerModel | None) -> Floats:
        """Return the covariances (K, 3, 3) of a line due to scanner distortion [m^2].

        The distortion translates and rotates each cloud as a whole: about the line's middle for one
        cloud, about the nearest scanner's optical axis for several.
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
        """Return points (K, 3) and covariances (K, 3, 3), mapped from ``camera`` to ``base``."""
        rotation = self.base_T_camera.rotation
        mapped = self.base_T_camera.apply(line)
        return mapped, rotation @ covariances @ rotation.T + self.covariance(mapped)


def seen_in_base(
    stage: str, scan: WorkpieceScan, answer: HandEye, robot: RobotModel | None
) -> PlacedScan:
    """Return a scan in the base, for a fixed scanner or one on the arm.

    Args:
        stage: Name of the stage for the error message.
        scan: Scan from a fixed scanner, or from several flange poses.
        answer: ``base_T_camera`` or ``flange_T_camera``.
        robot: Model of the arm with the standard deviation of its joint zeros (``joint_accuracy``).

    Raises:
        CalibrationRefused: Scan and calibration disagree about whether the scanner is on the
            flange.
    """
    camera = answer.camera
    of_flange = camera.transform.parent != BASE
    if of_flange != bool(scan.places):
        told = "rides on the flange" if of_flange else "stands beside the arm"
        use = "scan.along" if of_flange else "scan.live or scan.file"
        raise CalibrationRefused(f"{stage}: the scanner {told}", f"scan the workpiece with {use}")
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
    """Return ``base_T_camera`` of one cloud, by the corrected flange pose if it is known."""
    arm = Arm(robot) if robot else None
    flange = corrected_flange(place.base_T_flange, place.joints, answer.correction, arm)
    return Transform(BASE, CAMERA, flange @ answer.camera.transform.matrix)


@dataclass(frozen=True, eq=False)
class _AsOnePlace:
    """Covariance of points of a fixed scanner: that of the hand-eye pose alone.

    The arm's own error at the seam is not added, as it is similar to that at the nearby calibration
    poses, which the hand-eye pose contains.
    """

    answer: HandEye

    def __call__(self, points_in_base: Floats) -> Floats:
        pose = self.answer.base_T_camera
        return covariance_at(pose.covariance, pose.about, points_in_base)


@dataclass(frozen=True, eq=False)
class _AsSeveral:
    """Covariance of points of a scanner on the flange, from hand-eye pose and joint zeros.

    Both errors are common to all clouds.
    """

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
        """Return the weight (places, K) of each cloud at each point; a point's weights sum to 1."""
        from scipy.spatial import cKDTree

        trees = [cKDTree(cloud) for cloud in self.shown]
        # A cloud's weight at a point is the number of its points within this distance [m]
        cloud_within = 10e-3
        counts = np.array(
            [tree.query_ball_point(points, cloud_within, return_length=True) for tree in trees],
            float,
        )
        nearest = np.argmin([tree.query(points)[0] for tree in trees], axis=0)
        counts[nearest, np.arange(len(points))] += 1e-3  # the nearest alone, if none has points
        return np.asarray(counts / counts.sum(axis=0))


def _apart(clouds: Sequence[Floats]) -> float | None:
    """Return the largest median distance between faces shared by neighbouring clouds [m]."""
    from scipy.spatial import cKDTree

    found = []
    for first, second in pairwise(clouds):
        normals = normals_of(first)
        # Points within this distance may show the same face [m]
        away, at = cKDTree(first).query(second, distance_upper_bound=10e-3)
        both = np.isfinite(away)
        # Smallest number of shared points for a comparison
        fewest_shared = 200
        if both.sum() >= fewest_shared:
            at = at[both]
            across = np.einsum("ni,ni->n", second[both] - first[at], normals[at])
            found.append(float(np.median(np.abs(across))))
    return max(found, default=None)
