"""ViSP's pose files, as its hand-eye tutorial and ``visp-compute-hand-eye-calibration`` use them.

``pose_rPe_1.yaml`` holds the flange in the arm's base, ``pose_cPo_1.yaml`` the object in the
camera: three metres and a rotation vector in radians each (``vpPoseVector``).
"""

from __future__ import annotations

from pathlib import Path

from flangeye import part
from flangeye.files.recording import Archive
from flangeye_plugins.reader.matrices import MatricesParams, TargetArrays, matrices

VECTOR = {"rotation": "vector", "length": "m", "angle": "rad"}


@part("reader.visp")
def visp(path: Path) -> Archive:
    """Read ViSP's pose_rPe_N.yaml and pose_cPo_N.yaml."""
    target = TargetArrays.model_validate({"at": "*cPo*.yaml", **VECTOR})
    params = MatricesParams.model_validate({"robot": "*rPe*.yaml", "target": target, **VECTOR})
    archive: Archive = matrices(path, params)
    return archive
