"""A seam with a chosen planning error, for studies of how touch corrects it."""

import numpy as np

from flangeye import stage
from flangeye.models.workpiece import load_workpiece
from flangeye.types import CAMERA, Floats, PointCloud, Seam, Seed, VerifiedHandEye, WorkpieceScan
from flangeye.types.geometry import arc_lengths, rotation_exp, rows_at
from flangeye_emulators.world.bench import LaidParams


class AsLaidParams(LaidParams):
    """Parameters of ``scan.as_laid`` and ``seam.misplanned``."""

    def seam(self) -> tuple[Floats, Floats, float | None]:
        """Return the true seam (N, 3) and its opening (3,) in base, and its half angle."""
        (seam,) = load_workpiece(self.workpiece).seams.values()
        pose = self.base_T_part
        points = _dense(seam.points) @ pose[:3, :3].T + pose[:3, 3]
        return points, pose[:3, :3] @ seam.openings[0], seam.half_angle


@stage("scan.as_laid")
def scan_as_laid(params: AsLaidParams) -> WorkpieceScan:
    """Return the workpiece at its known pose without scanning, for a study of the weld alone."""
    points, _, _ = params.seam()
    cloud = PointCloud(CAMERA, points.astype(np.float32))
    return WorkpieceScan(cloud, f"{params.workpiece.stem}, as laid", (), {"groove": points})


@stage("seam.misplanned")
def seam_misplanned(hand_eye: VerifiedHandEye, seed: Seed, params: AsLaidParams) -> Seam:
    """Plan the true seam, but off by 3 mm in a random direction of its plane and by 1 deg."""
    points, opening, half_angle = params.seam()
    rng = np.random.default_rng([seed, 13])
    along = points[-1] - points[0]
    along /= np.linalg.norm(along)
    way = rng.uniform(0.0, 2.0 * np.pi)
    shift = np.cos(way) * along + np.sin(way) * np.cross(opening, along)
    turn = rotation_exp(rng.choice([-1.0, 1.0]) * np.radians(1.0) * opening)
    middle = points.mean(axis=0)
    planned = (points - middle) @ turn.T + middle + 3e-3 * shift
    each = np.tile(np.eye(3) * 1.5e-3**2, (len(points), 1, 1))
    openings = np.tile(opening, (len(points), 1))
    return Seam(planned, openings, each, half_angle, source="misplanned on purpose")


def _dense(points: Floats) -> Floats:
    along = arc_lengths(points)
    # Between two points of a seam [m]
    ticks = np.linspace(0.0, along[-1], round(along[-1] / 1e-3) + 1)
    return rows_at(ticks, along, points)
