"""The path to above the seam's start; before it, a check that the camera sees the finger."""

from __future__ import annotations

import numpy as np

from flangeye.errors import StageError
from flangeye.types import Floats
from flangeye_plugins.weld.execution import WeldCell
from flangeye_plugins.weld.reachability import SeamReach
from flangeye_plugins.weld.search import UNTOUCHED
from flangeye_plugins.weld.settings import Mode
from flangeye_plugins.weld.weld_log import WeldLog


def approach(cell: WeldCell, passage: SeamReach, weld_log: WeldLog, mode: Mode) -> None:
    """Bring the tip above the planned start, the tool along the seam.

    Raises:
        StageError: The finger is not seen, is deformed though nothing should touch it, or there is
            no free way.
        DeviceError: The arm was stopped on the way: the reason.
    """
    here = cell.drive.tick()
    route = passage.to_start(np.asarray(here.joints))
    if mode != "vision":
        _watch(cell, weld_log)
    cell.drive.follow(route)
    for sight in cell.eyes.seen():  # what was seen on the way is no news to the controller
        weld_log.before(sight)


def _watch(cell: WeldCell, weld_log: WeldLog) -> None:
    """Look at the finger for a while; nothing moves."""
    began = cell.drive.tick().time_ns
    felt: list[Floats] = []
    seen = 0
    # The finger is watched for at most two seconds before the arm moves.
    while cell.drive.tick().time_ns - began < 2e9 and len(felt) < 10:
        for sight in cell.eyes.seen():
            seen += 1
            weld_log.before(sight)
            if sight.feeling is not None:
                felt.append(np.asarray(sight.feeling.displacement))
    if not felt:
        what = "no tag is in view" if seen else "the camera gives no images"
        raise StageError(
            f"weld.tactile: {what}; is the finger's light on, the lens clean, and is the tag the "
            "one its file names?"
        )
    off = float(np.linalg.norm(np.median(felt, axis=0)))
    if off > UNTOUCHED:
        raise StageError(
            f"weld.tactile: the tip is displaced by {off * 1e3:.1f} mm though nothing should touch "
            "it; free it, or calibrate the finger again: flangeye tactile calibrate"
        )
