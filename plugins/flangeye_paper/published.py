"""``acquire.published_centres``: the authors' circle centres with what they verified on."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flangeye import StageError, stage
from flangeye.files.clouds import PER_METRE, read_cloud
from flangeye.files.recording import Archive, Recording
from flangeye.maths.geometry import rigid
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    ArchivePath,
    FlangeCloud,
    Floats,
    Observation,
    Observations,
    PointCloud,
    Seed,
    Transform,
    VerificationView,
    Views,
)
from flangeye_paper.open3d_0_7 import Normals, normals_of
from flangeye_plugins.acquire.centres import CentresParams, acquire_centres
from flangeye_plugins.acquire.opening import archive_path, open_archive


@dataclass(frozen=True)
class CadFile:
    """A published CAD cloud, and where it is in the flange's frame.

    Attributes:
        name: Below ``flange_ground_truth``.
        axes: Diagonal of the rotation.
        offset: Along z, in the file's unit.
    """

    name: str
    axes: tuple[float, float, float]
    offset: float


_CAD: Mapping[str, CadFile] = {
    "aubo": CadFile("flange_aubo_cropped.pcd", (-1, 1, -1), -0.006),
    # Their script of the Kinect takes the Aubo's flange for the UR10e's: ISO 9409-1-50-4-M6 both.
    "kinect": CadFile("flange_aubo_a.pcd", (-1, 1, -1), -6.0),
}


@dataclass(frozen=True, eq=False)
class PublishedView(VerificationView):
    """A published verification cloud with its CAD cloud, both in the unit of their files.

    Attributes:
        per_metre: The unit: 1 or 1000 to a metre.
        measured: (N, 3) in ``camera``.
        shape: (M, 3) in the CAD's own frame, where its face is exactly flat along an axis.
        flange_T_shape: (4, 4).
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

    shuffle: bool = Field(False, description="Shuffle the poses with the seed.")


@stage("acquire.published_centres")
def acquire_published_centres(
    archive: ArchivePath, views: Views | None, seed: Seed, params: PublishedParams
) -> Observations:
    """Take the authors' circle centres, and their verification cloud where it was published.

    What acquire.centres gives, and a view for ``error.icp_as_in_paper`` and
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
    cad = _CAD.get(archive.layout.removeprefix("ancorasir "))
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
