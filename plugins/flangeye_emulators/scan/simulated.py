"""``scan.simulated``: a workpiece on a bench, before the scanner of a simulated cell."""

from __future__ import annotations

from typing import Any

import numpy as np
from pydantic import Field

from flangeye import Params, StageError, stage
from flangeye.maths.geometry import rigid, rotation_from_rpy
from flangeye.models.workpiece import Workpiece, WorkpiecePath, load_workpiece
from flangeye.types import Look, Seed, WorkpieceScan
from flangeye.units import Angle, Length, param
from flangeye_emulators.world.bench import bench_with

BENCH = 7
"""Tells this use of the recipe's seed from others."""


class SimulatedScanParams(Params):
    """Parameters of ``scan.simulated``."""

    workpiece: WorkpiecePath = param(
        "v-straight", description="One of data/workpieces, or a .yaml file of one's own."
    )
    position: tuple[Length, Length, Length] = param(
        ("600 mm", "0 mm", "250 mm"),
        description="Position of the workpiece's CAD origin in the base.",
    )
    rpy: tuple[Angle, Angle, Angle] = param(
        ("0 deg", "0 deg", "20 deg"), description="Roll, pitch, yaw of its CAD, in base."
    )
    clutter: int = Field(6, ge=0, description="Number of other objects on the bench.")
    covered: float = Field(
        0.0, ge=0, lt=1, description="Share of the workpiece covered by a sheet, at one end."
    )

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
