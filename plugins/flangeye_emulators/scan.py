"""``scan.simulated``: a workpiece on a bench, before the scanner of a simulated cell."""

import numpy as np

from flangeye import StageError, stage
from flangeye.models.workpiece import load_workpiece
from flangeye.types import Look, Seed, WorkpieceScan
from flangeye_emulators.world.bench import CLUTTER, BenchParams, bench_with


class SimulatedScanParams(BenchParams):
    """Parameters of ``scan.simulated``."""


@stage("scan.simulated")
def scan_simulated(look: Look | None, seed: Seed, params: SimulatedScanParams) -> WorkpieceScan:
    """Scan a simulated workpiece on a bench, with the scanner of the simulated cell.

    Raises:
        StageError: The acquire step simulates no cell, or the workpiece cannot be read.
    """
    if look is None:
        raise StageError(
            "scan.simulated: needs the scanner of a simulated cell, but the acquire step "
            "simulates none; use acquire.simulated, or scan.file"
        )
    workpiece = load_workpiece(params.workpiece)
    # Gives this use of the recipe's seed a stream of its own
    rng = np.random.default_rng([7, seed])
    bodies = bench_with(workpiece, params.base_T_part, params.covered, rng)
    note = f"workpiece: {workpiece.title}, simulated, with {CLUTTER} other objects around it"
    truth = params.true_seams(workpiece)
    return WorkpieceScan(look(bodies), f"simulated {params.workpiece.stem}", (note,), truth)
