"""Layouts of folders with images of a board, or scans of the flange: verified without an edit."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from flangeye.cli import commands
from flangeye.maths.kinematics import Arm
from flangeye.models.boards import Board, print_of
from flangeye.models.loading import load_model
from flangeye.models.robots import FlangeDetails
from flangeye.models.targets import flange_of, load_standard
from flangeye.testing.percapture import _on_face
from flangeye.types import Floats
from flangeye.types.geometry import rigid, rotation_exp
from tests.plugins.ros2.urdf import urdf_of
from tests.workflow.recipe.test_layouts import PAGE, euler, quaternion, storage, text, vector

COUNT = 12
MATRIX = np.array([[700.0, 0, 322], [0, 701, 238], [0, 0, 1]])
BOARD = Board("charuco", 6, 5, 0.03, 0.022)
PRINT = "charuco: {columns: 6, rows: 5, square: 30 mm, marker: 22 mm, dictionary: 4X4_50}"
FLANGE_T_CAMERA = rigid(rotation_exp(np.array([0.1, -0.2, 1.1])), np.array([0.05, 0.02, 0.09]))
BASE_T_BOARD = rigid(rotation_exp(np.array([0.02, 0.05, 2.0])), np.array([-0.45, -0.1, 0.05]))
BASE_T_CAMERA = rigid(rotation_exp(np.array([-1.5, 0.1, -0.2])), np.array([-0.4, -1.0, 0.5]))
PLATE = flange_of(FlangeDetails(), load_standard("ISO 9409-1-50-4-M6"))
UR5E = load_model("robots", "ur5e")


def seen(seed: int, far: float, least: float) -> Floats:
    """Return camera_T_target of things that face the camera, at least so much aslant [rad]."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(8 * COUNT):
        way, tilt = rng.uniform(-np.pi, np.pi), rng.uniform(least, 0.5)
        lean = rotation_exp(tilt * np.array([np.cos(way), np.sin(way), 0]))
        turn = lean @ rotation_exp([np.pi, 0, 0]) @ rotation_exp([0, 0, rng.uniform(-1.5, 1.5)])
        place = far * np.array([*rng.uniform(-0.08, 0.08, 2), rng.uniform(0.9, 1.1)])
        found.append(rigid(turn, place))
    return np.array(found)


def photographed() -> tuple[Floats, Floats, Floats]:
    """Return joints, base_T_flange and camera_T_board of a camera in a UR5e's hand."""
    arm, sets = Arm(UR5E), []
    for pose in seen(4, 0.45, 0.1):
        flange = BASE_T_BOARD @ np.linalg.inv(FLANGE_T_CAMERA @ pose)
        joints = arm.inverse(flange)
        sets += [(joints[0], flange, pose)] if len(joints) else []
    joints, flanges, poses = (np.array(each[:COUNT]) for each in zip(*sets, strict=True))
    assert len(poses) == COUNT
    return joints, flanges, poses


def photographs(folder: Path, poses: Floats, name: str = "{:03d}.png") -> list[str]:
    folder.mkdir(exist_ok=True)
    page = np.pad(print_of(BOARD, 60), 30, constant_values=255)
    width, height = BOARD.size
    step = BOARD.square / 60  # of a pixel of the print [m]
    place = np.array([[step, 0, -width / 2 - 29.5 * step], [0, -step, height / 2 + 29.5 * step],
                      [0, 0, 1]])  # fmt: skip
    names = [name.format(k) for k in range(len(poses))]
    for each, pose in zip(names, poses, strict=True):
        view = MATRIX @ pose[:3, [0, 1, 3]] @ place
        cv2.imwrite(str(folder / each), cv2.warpPerspective(page, view, (640, 480), borderValue=99))
    return names


def scanned(missing: float) -> tuple[Floats, list[Floats]]:
    """Return base_T_flange, and organised scans [m] from beside the robot of its flange."""
    rng, scans = np.random.default_rng(6), []
    poses = seen(5, 0.7, 0.15)[:COUNT]
    x, y = np.meshgrid(np.arange(-140, 140) / 700, np.arange(-120, 120) / 700)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    for pose in poses:
        far = (pose[:3, 3] @ pose[:3, 2]) / (rays @ pose[:3, 2])
        face = _on_face(PLATE, (rays * far[..., None] - pose[:3, 3]) @ pose[:3, :3])
        depth = np.where(face, far, 1.3) + rng.normal(0, 5e-5, far.shape)
        xyz = rays * depth[..., None]
        # The wall is hardly seen: over half of the points are missing
        xyz[~face & (rng.random(far.shape) < 0.6)] = missing
        scans.append(xyz)
    return BASE_T_CAMERA @ poses, scans


def images_and_poses(f):
    _, flanges, poses = photographed()
    photographs(f / "images", poses, "img_{}.png")
    (f / "poses").mkdir()
    for k, pose in enumerate(flanges):
        np.savetxt(f / "poses" / f"pose_{k}.txt", pose)
    storage(f, "calib.yml", [("camera_matrix", MATRIX), ("dist_coeffs", np.zeros((1, 5)))])


def json_each(f):
    _, flanges, poses = photographed()
    for name, pose in zip(photographs(f, poses), flanges, strict=True):
        told = {"robot_pose": pose.tolist(), "image": name}
        (f / name).with_suffix(".json").write_text(json.dumps(told))
    np.save(f / "camera_matrix.npy", MATRIX)
    np.save(f / "dist_coeffs.npy", np.zeros(5))


def named_in_a_folder(f):
    _, flanges, poses = photographed()
    names = photographs(f / "rgb", poses, "frame{:06d}.jpg")
    rows = [f"{n},{text([row])}" for n, row in zip(names, quaternion(flanges), strict=True)]
    (f / "poses.csv").write_text("image,x_m,y_m,z_m,qx,qy,qz,qw\n" + "".join(rows))
    fx, fy, cx, cy = MATRIX[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    chain = {"intrinsics": [fx, fy, cx, cy], "distortion_coeffs": [0.0] * 4,
             "camera_model": "pinhole", "distortion_model": "radtan"}  # fmt: skip
    (f / "camchain.yaml").write_text(yaml.safe_dump({"cam0": chain}))


def joints_and_urdf(f):
    joints, _, poses = photographed()
    photographs(f / "color", poses, "{}_Color.png")
    (f / "ur5e.urdf").write_text(urdf_of(UR5E))
    (f / "joints.csv").write_text(",".join(f"joint_{k}" for k in range(1, 7)) + "\n" + text(joints))
    fx, fy, ppx, ppy = MATRIX[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    (f / "intrinsics.json").write_text(json.dumps(
        {"fx": fx, "fy": fy, "ppx": ppx, "ppy": ppy, "coeffs": [0] * 5, "width": 640}
    ))  # fmt: skip


def six_numbers(f):
    _, flanges, poses = photographed()
    photographs(f / "images", poses, "{}.png")
    (f / "robot_poses.csv").write_text(text(euler(flanges, "xyz")))
    fx, fy, cx, cy = MATRIX[[0, 1, 0, 1], [0, 1, 2, 2]]
    (f / "cameras.txt").write_text(f"1 PINHOLE 640 480 {fx} {fy} {cx + 0.5} {cy + 0.5}\n")


def zeros_in_ply(f):
    flanges, scans = scanned(0.0)
    for k, xyz in enumerate(scans):
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {xyz[..., 0].size}\n"
        head += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
        (f / f"scan{k}.ply").write_bytes(head.encode() + (1e3 * xyz).astype("<f4").tobytes())
    (f / "arm.csv").write_text("X,Y,Z,A,B,C\n" + text(euler(flanges, "ZYX")))


def text_with_units(f):
    flanges, scans = scanned(np.nan)
    (f / "clouds").mkdir()
    for k, xyz in enumerate(scans):
        points = 1e3 * xyz[np.isfinite(xyz[..., 2])]
        rows = text(points, ";").replace(".", ",")
        (f / "clouds" / f"{k}.csv").write_text(f"X [mm];Y [mm];Z [mm]\n{rows}")
    np.savez(f / "robot.npz", R_gripper2base=flanges[:, :3, :3], t_gripper2base=flanges[:, :3, 3])


def array_and_vectors(f):
    flanges, scans = scanned(-10.0)
    for k, xyz in enumerate(scans):
        points = xyz.reshape(-1, 3)
        np.save(f / f"{k}.npy", np.hstack([points, np.full_like(points, 128)]))
    (f / "tcp.txt").write_text(text(np.column_stack([np.arange(1, COUNT + 1), vector(flanges)])))


LAYOUTS: dict[str, Callable[[Path], None]] = {
    "`images/`, `poses/` of 4×4 texts by number, `calib.yml` of OpenCV": images_and_poses,
    "a JSON for each image, `camera_matrix.npy` and `dist_coeffs.npy`": json_each,
    "`poses.csv` that names images of `rgb/`, kalibr's camchain": named_in_a_folder,
    "joint angles, the arm's `.urdf`, images and RealSense's intrinsics": joints_and_urdf,
    "position and three angles without names, images, COLMAP's `cameras.txt`": six_numbers,
    "scans as `.ply`, zeros for missing points, in mm; X, Y, Z, A, B, C": zeros_in_ply,
    "scans as `.csv`, X [mm] and decimal commas; `.npz` of `R_gripper2base`": text_with_units,
    "scans as `.npy` (N, 6), −10 m for missing points; an index and six numbers": array_and_vectors,
}
"""What is in the folder, and how it is written; those with images come first."""


@pytest.mark.parametrize("name", LAYOUTS)
def test_images_and_scans_are_verified_without_an_edit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rec").mkdir()
    LAYOUTS[name](tmp_path / "rec")
    target = ["--target", PRINT] if "scans" not in name else []
    told = CliRunner().invoke(commands(), ["init", "rec", "--yes", *target])
    assert told.exit_code == 0, f"{told.output}{told.exception}"
    done = CliRunner().invoke(commands(), ["run", "recipe.yaml", "--out", "out"])
    assert done.exit_code == 0, f"{told.output}{done.output}{done.exception}"
    assert "\nVERIFIED " in done.output
    answer = json.loads((tmp_path / "out" / "result.json").read_text("utf-8"))["transforms"]
    key, truth = (
        ("flange_T_camera", FLANGE_T_CAMERA) if target else ("base_T_camera", BASE_T_CAMERA)
    )
    off = np.linalg.inv(truth) @ np.array(answer[key]["matrix"])
    assert np.linalg.norm(off[:3, 3]) < 1e-3
    assert Rotation.from_matrix(off[:3, :3]).magnitude() < 2e-3


def test_the_page_lists_these_layouts() -> None:
    shelf = PAGE.read_text("utf-8").partition("## Images and scans that")[2].partition("\n## ")[0]
    rows = [line.split("|") for line in shelf.splitlines() if line[:1] == "|"]
    assert [row[1].strip() for row in rows[2:]] == list(LAYOUTS)
