"""``acquire.published_centres``: the authors' circle centres, with their verification clouds.

``verify.stored_results_as_in_paper``: compares a calibration with the authors' own results.

For three recordings they stored the 50 matrices that Algorithm 1 ended with, and the result of ICP
for each. The verification clouds of two of them were never published. But the product H T of a
stored matrix H and its ICP motion T is the camera pose to which ICP converges, whatever H was. From
H T follows the result of ICP for any other matrix, as far as ICP converges.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from flangeye import Params, StageError, stage
from flangeye.files.arrays import read_npz
from flangeye.files.clouds import PER_METRE, read_cloud
from flangeye.files.recording import Archive, Recording
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    ArchivePath,
    FlangeCloud,
    Floats,
    HandEye,
    Observation,
    Observations,
    PointCloud,
    Seed,
    Transform,
    Verification,
    VerificationView,
    Views,
)
from flangeye.types.geometry import rigid, rotation_from_rpy, rpy_from_rotation
from flangeye_paper.open3d_0_7 import Normals, normals_of
from flangeye_plugins.acquire.centres import CentresParams, acquire_centres
from flangeye_plugins.acquire.opening import archive_path, open_archive


@dataclass(frozen=True)
class CadFile:
    """A published CAD cloud and its pose in the flange's frame.

    Attributes:
        name: Path in the folder ``flange_ground_truth``.
        axes: Diagonal of the rotation matrix flange_R_CAD.
        offset: Position of the CAD's origin along the flange's z, in the file's unit.
    """

    name: str
    axes: tuple[float, float, float]
    offset: float


@dataclass(frozen=True, eq=False)
class PublishedView(VerificationView):
    """A published verification cloud with its CAD cloud, both in the unit of their files.

    Attributes:
        per_metre: Units per metre: 1 or 1000.
        measured: (N, 3) points in ``camera``.
        shape: (M, 3) points in the CAD's frame, in which its face is exactly flat along an axis.
        flange_T_shape: (4, 4) pose of the CAD's frame.
    """

    per_metre: float
    measured: Floats
    shape: Floats
    flange_T_shape: Floats

    def normals(self, kind: Normals) -> Floats:
        """Return the (M, 3) normals of the shape, computed once."""
        if kind not in self.__dict__:
            self.__dict__[kind] = normals_of(self.shape, 1.0, kind)
        found: Floats = self.__dict__[kind]
        return found


class PublishedParams(CentresParams):
    """Parameters of ``acquire.published_centres``."""

    shuffle: bool = False
    """Shuffle the poses with the seed."""


@stage("acquire.published_centres")
def acquire_published_centres(
    archive: ArchivePath, views: Views | None, seed: Seed, params: PublishedParams
) -> Observations:
    """Read the authors' circle centres, and their verification cloud if it was published.

    The result is that of acquire.centres, with a view for ``error.icp_as_in_paper`` and
    ``verify.icp_as_in_paper``. The archive is the whole published folder.
    """
    centres: Observations = acquire_centres(archive, params)
    if views is not None:
        path = archive_path("acquire.published_centres", archive, params)
        views.extend(_views(open_archive(path, params)))
    if not params.shuffle:
        return centres
    order = np.random.default_rng(seed).permutation(centres.total or 0)
    return Observations(_reordered(centres, order), centres.source, centres.total)


def _reordered(centres: Observations, order: NDArray[np.intp]) -> Iterator[Observation]:
    given = list(centres)
    for index in order:
        yield given[index]


def _views(archive: Archive) -> Iterator[PublishedView]:
    cad = {
        "aubo": CadFile("flange_aubo_cropped.pcd", (-1, 1, -1), -0.006),
        # Their script of the Kinect takes the Aubo's flange for the UR10e's: ISO 9409-1-50-4-M6
        # both.
        "kinect": CadFile("flange_aubo_a.pcd", (-1, 1, -1), -6.0),
    }.get(archive.layout.removeprefix("ancorasir "))
    for recording in archive.recordings:
        if cad and recording.cloud and recording.role == "verification":
            shape = read_cloud(_truth_folder(archive.root) / cad.name).points().astype(np.float64)
            yield _view(
                recording, recording.cloud, PER_METRE[archive.cloud_unit or "m"], cad, shape
            )


def _view(
    recording: Recording, cloud: Path, per_metre: float, cad: CadFile, shape: Floats
) -> PublishedView:
    measured = read_cloud(cloud).points().astype(np.float64)
    centre = measured.mean(axis=0) / per_metre
    points = PointCloud(CAMERA, (measured / per_metre).astype(np.float32))
    return PublishedView(
        id=recording.id,
        flange=FlangeCloud(points, centre, -centre / np.linalg.norm(centre)),
        base_T_flange=Transform(BASE, FLANGE, recording.base_T_flange),
        per_metre=per_metre,
        measured=measured,
        shape=shape,
        flange_T_shape=rigid(np.diag(cad.axes), np.array([0.0, 0.0, cad.offset])),
    )


def _truth_folder(root: Path) -> Path:
    """Return the repository's folder of CAD clouds, from a recording's folder.

    Raises:
        StageError: It is not there.
    """
    for above in root.resolve().parents:
        if (above / "flange_ground_truth").is_dir():
            return above / "flange_ground_truth"
    raise StageError(
        f"{root}: flange_ground_truth, which the published verification needs, is not beside it; "
        "give the whole published folder"
    )


class StoredParams(Params):
    """Parameters of ``verify.stored_results_as_in_paper``."""

    robot: Literal["aubo", "ur5", "franka"]
    """Robot whose stored results are used."""


@stage("verify.stored_results_as_in_paper")
def verify_stored_results(
    calibration: HandEye, archive: ArchivePath, params: StoredParams
) -> Verification:
    """Predict what the authors' ICP would give for this calibration, from their 50 stored results.

    It measures and does not judge: every run passes.

    Figures [m, rad], in ``camera`` at its origin: ``x, y, z, roll, pitch, yaw``, the mean of what
    the 50 imply, and ``x_std``, ...: how far the 50 disagree, for their ICP had not converged.

    Raises:
        StageError: The stored results are not in the published folder.
    """
    matrices, motions = stored_results(archive.path or Path(), params.robot)
    transform = calibration.base_T_camera.transform
    implied = transform.inverse().matrix @ matrices @ motions
    turns = np.array([rpy_from_rotation(m[:3, :3]) for m in implied])
    errors = np.hstack([implied[:, :3, 3], turns])
    names = ("x", "y", "z", "roll", "pitch", "yaw")
    figures = {
        **dict(zip(names, errors.mean(axis=0).tolist(), strict=True)),
        **{f"{n}_std": float(s) for n, s in zip(names, errors.std(axis=0), strict=True)},
    }
    shift = ", ".join(f"{figures[axis] * 1e3:+.2f}" for axis in "xyz")
    return Verification(True, f"by their stored results ICP would give ({shift}) mm", figures)


def stored_results(root: Path, robot: str) -> tuple[Floats, Floats]:
    """Return the (50, 4, 4) stored base_T_camera [m] and the (50, 4, 4) ICP motions [m]."""
    file = stored_file(root, robot)
    shifts = read_npz(file, "arr_1", (None, None, 3))[:, -1] * 1e-3
    # As the authors' scripts have it
    angles = read_npz(file, "arr_2", (None, None, 3))[:, -1] * (3.14 / 180)
    matrices = read_npz(file, "arr_3", (None, 4, 4))
    # The stored translations are all in millimetres
    matrices[:, :3, 3] /= {"aubo": 1.0, "ur5": 1e3, "franka": 1e3}[robot]
    motions = [
        rigid(rotation_from_rpy(*angle), shift) for angle, shift in zip(angles, shifts, strict=True)
    ]
    return matrices, np.array(motions)


def stored_file(root: Path, robot: str) -> Path:
    """Return the file of stored results of a robot below the published folder, or in it.

    Raises:
        StageError: It is not there.
    """
    for folder in (root / "data" / robot, root / robot, root):
        if (folder / "results_photoneo.npz").is_file():
            return folder / "results_photoneo.npz"
    raise StageError(f"{root}: no data/{robot}/results_photoneo.npz; give the published folder")
