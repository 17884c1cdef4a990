"""``verify.stored_results_as_in_paper``: compares a calibration with the authors' own results.

For three recordings they stored the 50 matrices that Algorithm 1 ended with, and what ICP gave
for each. The verification clouds of two of them were never published; but a matrix H and its ICP
motion T belong together so that H T is where ICP would like the camera to be, whatever H was. From
H T follows what ICP gives for any other matrix, as far as it converges.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from flangeye import Params, StageError, stage
from flangeye.files.arrays import read_npz
from flangeye.maths.geometry import rigid, rotation_from_rpy, rpy_from_rotation
from flangeye.types import ArchivePath, Floats, HandEye, Verification


class StoredParams(Params):
    """Parameters of ``verify.stored_results_as_in_paper``."""

    robot: Literal["aubo", "ur5", "franka"] = Field(description="Whose results.")


@stage("verify.stored_results_as_in_paper")
def verify_stored_results(
    calibration: HandEye, archive: ArchivePath, params: StoredParams
) -> Verification:
    """Say what the authors' ICP would have given for this calibration, by their 50 stored results.

    It measures and does not judge: every run passes.

    Figures [m, rad], in ``camera`` at its origin: ``x, y, z, roll, pitch, yaw``, the mean of what
    the 50 imply, and ``x_std``, ...: how far the 50 disagree, for their ICP had not converged.

    Raises:
        StageError: The stored results are not where the published folder has them.
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
