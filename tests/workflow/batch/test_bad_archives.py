"""Archives that cannot be used: one line and exit code 2."""

from collections.abc import Callable
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye.files.clouds import write_cloud
from flangeye.types import CAMERA, PointCloud

RECIPE = """\
title: Bad archives
robot: {model: ur5}
scanner: {model: phoxi-m}
steps:
  - acquire.archive
  - segment.flange
  - fit.rim
  - solve.svd
"""
HEADER = "cloud,x_m,y_m,z_m,qx,qy,qz,qw,role\n"


def pose(i, place=None, quaternion="0,0,0,1", role="calibration"):
    at = i if place is None else place
    return f"{i:02d}.pcd,{0.05 * at:.3f},{0.03 * at * at:.3f},0.3,{quaternion},{role}\n"


def write_poses(folder, *rows):
    (folder / "poses.csv").write_text(HEADER + "".join(rows))


def clouds_without_poses(folder):
    (folder / "poses.csv").unlink()


def an_empty_list_of_poses(folder):
    write_poses(folder)


def poses_without_clouds(folder):
    for path in folder.glob("*.pcd"):
        path.unlink()


def counts_that_differ(folder):
    for path in folder.iterdir():
        path.unlink()
    poses = "".join(f"{100 * i} {90 * i * i} 300 0 0 {0.1 * i}\n" for i in range(5))
    (folder / "readRobot.txt").write_text(poses)
    (folder / "measureRobot.txt").write_text("".join(f"{i} {i} 700\n" for i in range(4)))


def a_cloud_without_a_pose(folder):
    write_poses(folder, *(pose(i) for i in range(4)))


def a_quaternion_of_another_norm(folder):
    write_poses(folder, *(pose(i) for i in range(4)), pose(4, quaternion="0,0,1,1"))


def duplicated_poses(folder):
    write_poses(folder, *(pose(i) for i in range(4)), pose(4, place=1))


def a_verification_cloud_that_is_trained_on(folder):
    write_poses(folder, *(pose(i) for i in range(4)), pose(4, role="verification"))
    (folder / "04.pcd").write_bytes((folder / "02.pcd").read_bytes())


CASES = {
    clouds_without_poses:
        ": no reader knows this layout; 'flangeye init *' writes a recipe for other layouts; tried: "
        "ancorasir (holds none of calib_data.json, "
        "calibration_robot_pose_data.npy, calibration_robot_pose_data.npz, data.txt, "
        "readRobot.txt);* folder (holds clouds (5), but none of poses.csv, poses.yaml, poses.yml, "
        "poses.json);* not tried, because a recipe must give their parameters: *",
    an_empty_list_of_poses: ": holds no poses",
    poses_without_clouds: "/00.pcd: does not exist",
    counts_that_differ:
        "/readRobot.txt: counts differ: readRobot.txt has 5, measureRobot.txt has 4",
    a_cloud_without_a_pose:
        "/04.pcd: poses.csv has no pose for it; add it, or move the cloud away",
    a_quaternion_of_another_norm:
        "/poses.csv:6: pose '04': the quaternion's norm is 1.414; it must be 1 (within 0.001)",
    duplicated_poses:
        ": poses '01' and '04' are the same; every capture needs a pose of its own; 'flangeye doctor' names those to leave out",
    a_verification_cloud_that_is_trained_on:
        "/02.pcd: is the verification cloud 04.pcd again; a verification cloud must not be "
        "used to calibrate",
}  # fmt: skip
"""What is said of each; ``*`` stands for readers that are not named here."""


@pytest.fixture
def bad(tmp_path: Path) -> Callable[..., Any]:
    """Make one spoilt archive after the other, and a recipe to run on them."""
    (tmp_path / "bad.yaml").write_text(RECIPE)

    def make(spoil):
        folder = tmp_path / spoil.__name__
        folder.mkdir()
        rng = np.random.default_rng(0)
        for i in range(5):
            xyz = rng.uniform([-0.1, -0.1, 0.6], [0.1, 0.1, 0.8], (300, 3)).astype(np.float32)
            write_cloud(folder / f"{i:02d}.pcd", PointCloud(CAMERA, xyz))
        write_poses(folder, *(pose(i) for i in range(5)))
        spoil(folder)
        return folder

    return make


@pytest.mark.parametrize("spoil", CASES, ids=lambda spoil: spoil.__name__)
def test_run_says_one_line(
    spoil: Any, bad: Callable[..., Any], flangeye: Callable[..., Any], tmp_path: Path
) -> None:
    folder = bad(spoil)
    code, _, err = flangeye("run", "bad.yaml", "--archive", folder)
    assert code == 2
    assert fnmatchcase(err, f"error: {folder}{CASES[spoil]}\n")
    assert err.count("\n") == 1
    assert not (tmp_path / "runs").exists()
