"""Small archives with poses and clouds that agree, made on the spot."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye.models.loading import load_model
from flangeye.types import CAMERA, Capture, PointCloud, Transform, by_frame
from flangeye.types.geometry import rigid, rotation_from_rpy
from tools.folder_archive import write_folder


@pytest.fixture
def scanner() -> Any:
    """A scanner that sees 0.384 to 0.520 m."""
    return load_model("scanners", "phoxi-s")


@pytest.fixture
def captures() -> Any:
    """One verification capture and four to calibrate with; the verification comes last."""
    rng = np.random.default_rng(3)
    made = []
    for i, name in enumerate(["one", "two", "three", "four", "check"]):
        rotation = rotation_from_rpy(*rng.uniform(-0.3, 0.3, 3))
        pose = rigid(rotation, [0.4 + 0.0625 * i, -0.3, 0.2 + 0.03 * (i % 2)])
        xyz = rng.uniform([-0.003, -0.003, 0.45], [0.003, 0.003, 0.45], (20, 3)).astype(np.float32)
        made.append(
            Capture(
                name,
                PointCloud(CAMERA, xyz),
                by_frame(Transform("base", "flange", pose)),
                joints=rng.uniform(-3, 3, 6),
                time_ns=1_000 + i,
                role="verification" if name == "check" else "calibration",
            )
        )
    return made


@pytest.fixture
def archive(tmp_path: Path, captures: Any) -> Path:
    """Those captures as a folder of clouds with poses.csv."""
    folder = tmp_path / "archive"
    write_folder(folder, captures)
    return folder


@pytest.fixture
def edit(archive: Path) -> Callable[..., Any]:
    """Replace text in one of the archive's files."""

    def replace(old: str, new: str, name: str = "poses.csv") -> None:
        text = (archive / name).read_text()
        assert old in text
        (archive / name).write_text(text.replace(old, new))

    return replace
