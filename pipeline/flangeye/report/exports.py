"""The matrix in other programs' words, to copy from the page."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress

from flangeye import result as r
from flangeye.errors import FlangeyeError
from flangeye.models.configuration import CELL
from flangeye.plugin.stage import Stage
from flangeye.types import ExportedFile


def exported(result: r.Result, exports: Sequence[Stage]) -> dict[str, ExportedFile]:
    """Return the files of a calibration by format, with default parameters.

    Nothing of one that was refused or not finished; formats whose parameters have no defaults, or
    that cannot write this pose, or of a cell carry one transform alone, are left out.
    """
    if result.status not in ("verified", "unverified") or not result.transforms:
        return {}
    pose = r.calibrated_pose(result)
    files: dict[str, ExportedFile] = {}
    for stage in exports:
        if pose.others and CELL not in stage.serves:
            continue
        with suppress(FlangeyeError, ValueError):
            params = {} if stage.params is None else {"params": stage.params()}
            files[stage.name.partition(".")[2]] = stage.function(pose=pose, **params)
    return files
