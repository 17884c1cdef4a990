"""Where a scan of the workpiece comes from: the simulated cell, files, or the scanner itself."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from flangeye import Params, RecipePath, StageError, stage
from flangeye.cloudfile import CLOUD_SUFFIXES, LengthUnit, read_cloud
from flangeye.devices import ScannerDriver
from flangeye.geometry import rigid, rotation_from_rpy
from flangeye.types import CAMERA, Look, PointCloud, Seed, WorkpieceScan
from flangeye.units import Angle, Length, param
from flangeye.workpiece import Workpiece, WorkpiecePath, load_workpiece
from flangeye_plugins.simulation.bench import bench_with

BENCH = 7
"""Tells this use of the recipe's seed from others."""


class SimulatedScanParams(Params):
    """Parameters of ``scan.simulated``."""

    workpiece: WorkpiecePath = param(
        "v-straight", description="One of data/workpieces, or a .yaml file of one's own."
    )
    position: tuple[Length, Length, Length] = param(
        ("600 mm", "0 mm", "250 mm"), description="Of the origin of its CAD, in base."
    )
    rpy: tuple[Angle, Angle, Angle] = param(
        ("0 deg", "0 deg", "20 deg"), description="Roll, pitch, yaw of its CAD, in base."
    )
    clutter: int = Field(6, ge=0, description="Things that lie about on the bench.")
    covered: float = Field(0.0, ge=0, lt=1, description="Share of it under a sheet, at one end.")

    @property
    def base_T_part(self) -> Any:
        """(4, 4), translation in [m]."""
        return rigid(rotation_from_rpy(*self.rpy), np.asarray(self.position))


@stage("scan.simulated")
def scan_simulated(look: Look | None, seed: Seed, params: SimulatedScanParams) -> WorkpieceScan:
    """Scan a simulated workpiece on a bench, with the scanner of the simulated cell.

    Raises:
        StageError: The acquire step simulates no cell, or the workpiece cannot be read.
    """
    if look is None:
        raise StageError(
            "scan.simulated: looks with the scanner of a simulated cell, and the acquire step "
            "simulates none; use acquire.simulated, or scan.file"
        )
    workpiece = load_workpiece(params.workpiece)
    rng = np.random.default_rng([BENCH, seed])
    bodies = bench_with(workpiece, params.base_T_part, params.clutter, params.covered, rng)
    note = f"workpiece: {workpiece.title}, simulated, with {params.clutter} things about it"
    truth = _true_seams(workpiece, params)
    return WorkpieceScan(look(bodies), f"simulated {params.workpiece.stem}", (note,), truth)


def _true_seams(workpiece: Workpiece, params: SimulatedScanParams) -> dict[str, Any]:
    pose = params.base_T_part
    return {
        name: seam.points @ pose[:3, :3].T + pose[:3, 3] for name, seam in workpiece.seams.items()
    }


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
    found = sorted(p for p in path.iterdir() if p.suffix.lower() in CLOUD_SUFFIXES)
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
