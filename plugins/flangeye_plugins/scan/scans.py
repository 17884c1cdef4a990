"""Scans of the workpiece: from files, or from the scanner itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from pydantic import Field

from flangeye import Params, RecipePath, StageError, stage
from flangeye.devices import ScannerDriver
from flangeye.files.clouds import CLOUD_SUFFIXES, LengthUnit, read_cloud
from flangeye.files.pairs import natural
from flangeye.types import CAMERA, PointCloud, WorkpieceScan


class FileScanParams(Params):
    """Parameters of ``scan.file``."""

    path: RecipePath = Field(
        description="A cloud (PCD, PLY, NPY, XYZ, CSV), or a folder of several, which are joined."
    )
    unit: LengthUnit = Field(description="Unit of the coordinates; files do not say.")


@stage("scan.file")
def scan_file(params: FileScanParams) -> WorkpieceScan:
    """Read a scan of the workpiece, taken by the calibrated scanner from where it stands.

    Raises:
        StageError: There is no cloud, or it cannot be read.
    """
    files = _files(params.path)
    clouds = [read_cloud(file, params.unit) for file in files]
    points = np.concatenate([cloud.points() for cloud in clouds])
    note = f"workpiece scan: {params.path}, {len(files)} files, {len(points)} points"
    return WorkpieceScan(PointCloud(CAMERA, points), params.path.name, (note,))


def _files(path: Path) -> list[Path]:
    if not path.exists():
        raise StageError(f"{path}: does not exist")
    if path.is_file():
        return [path]
    found = sorted(
        (p for p in path.iterdir() if p.suffix.lower() in CLOUD_SUFFIXES),
        key=lambda p: natural(p.name),
    )
    if not found:
        raise StageError(f"{path}: holds no cloud; known: {', '.join(CLOUD_SUFFIXES)}")
    return found


@stage("scan.live")
def scan_live(scanner: ScannerDriver) -> WorkpieceScan:
    """Take one exposure with the recipe's scanner; nothing moves.

    Raises:
        DeviceError: The scanner cannot be opened, or gave nothing in time.
    """
    with scanner.open() as device:
        scan = device.expose()()
        name = device.name
    return WorkpieceScan(scan.cloud, name, (f"workpiece scanned by {name}",))
