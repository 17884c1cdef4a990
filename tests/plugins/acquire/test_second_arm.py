"""Two arms in a folder: each pose names where the second one was, in its own base."""

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import StageError
from flangeye.types import (
    BASE,
    BASE2,
    CAMERA,
    FLANGE,
    FLANGE2,
    ArchivePath,
    Capture,
    PointCloud,
    Transform,
    by_frame,
)
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_plugins.acquire.archive import ArchiveParams, acquire_archive
from flangeye_plugins.reader.auto import auto
from flangeye_plugins.reader.folder import FolderParams, folder
from tools.folder_archive import write_folder

SECOND = {"position": [500.0, -20.0, 300.0], "rotation_vector_rad": [0.1, 0.0, 0.2]}


def as_json(archive, second):
    """Turn poses.csv into poses.json, with a second arm that moves along x."""
    with (archive / "poses.csv").open() as file:
        rows = list(csv.DictReader(file))
    poses = [
        {
            "cloud": row["cloud"],
            "position": [float(row[f"{axis}_m"]) * 1e3 for axis in "xyz"],
            "quaternion_xyzw": [float(row[f"q{axis}"]) for axis in "xyzw"],
            "second": {**second, "position": [500.0 + i, -20.0, 300.0]},
        }
        for i, row in enumerate(rows)
    ]
    (archive / "poses.csv").unlink()
    (archive / "poses.json").write_text(json.dumps({"unit": "mm", "poses": poses}))


def test_every_capture_says_where_the_second_arm_was(archive: Path, scanner: Any) -> None:
    as_json(archive, SECOND)
    params = ArchiveParams(reader=auto.bind())
    captures = list(acquire_archive(scanner, ArchivePath(archive), params))
    assert len(captures) == 5
    for capture in captures:
        assert capture.poses["flange2"].name == "base2_T_flange2"
    places = sorted(capture.poses["flange2"].translation[0] for capture in captures)
    assert np.allclose(places, [0.5, 0.501, 0.502, 0.503, 0.504])


def test_what_is_written_of_two_arms_is_read_again(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)

    def pose():
        return rigid(rotation_exp(rng.normal(0, 1, 3)), rng.uniform(-1, 1, 3))

    captures = [
        Capture(
            f"{i}",
            PointCloud(CAMERA, rng.random((5, 3))),
            by_frame(Transform(BASE, FLANGE, pose()), Transform(BASE2, FLANGE2, pose())),
        )
        for i in range(4)
    ]
    write_folder(tmp_path, captures)
    for capture, recording in zip(
        captures, folder(tmp_path, FolderParams()).recordings, strict=True
    ):
        second = capture.poses["flange2"].matrix
        assert np.allclose(recording.base_T_flange, capture.base_T_flange.matrix, atol=1e-12)
        assert np.allclose(recording.poses["flange2"], second, atol=1e-12)


HEADING = "cloud,x_mm,y_mm,z_mm,qx,qy,qz,qw"
ROW = "a.pcd,1,2,3,0,1,0,0"


@pytest.mark.parametrize(
    ("heading", "row", "line"),
    [
        ("second_x_m,second_y_m,second_z_m", "1,2,3",
         "poses.csv:1: the second arm's columns second_x_mm, second_y_mm, second_z_mm are missing; "
         "both arms have one unit"),
        ("second_x_mm,second_y_mm,second_z_mm", "1,2,3",
         "poses.csv:2: poses.0.second: needs a quaternion or a rotation vector, one of the two"),
        ("second_id", "7",
         "poses.csv:1: column 'second_id' is not known; known: cloud, image, id, role, time_ns, x_m, "
         "y_m, z_m, x_mm, y_mm, z_mm, x, y, z, qx, qy, qz, qw, rx_rad, ry_rad, rz_rad, j1_rad, …, "
         "second_x_m, …; 'flangeye init FOLDER' writes a recipe for other columns"),
    ],
)  # fmt: skip
def test_a_mistake_in_the_second_arms_columns_is_named(
    tmp_path: Path, heading: str, row: str, line: str
) -> None:
    (tmp_path / "poses.csv").write_text(f"{HEADING},{heading}\n{ROW},{row}\n")
    with pytest.raises(StageError) as error:
        folder(tmp_path, FolderParams())
    assert str(error.value).removeprefix(f"{tmp_path}/") == line
