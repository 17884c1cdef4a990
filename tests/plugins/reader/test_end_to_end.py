"""From what other tools saved, and from images on disk, to a calibration with known truth."""

import json
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from flangeye import cli
from flangeye.models.boards import Board
from flangeye.types import Capture, Transform, by_frame
from flangeye.types.geometry import quaternion_from_rotation, rigid, rotation_exp, rotation_log
from flangeye.types.pose_formats import PoseConvention
from flangeye_emulators.world.board_image import BoardCamera, render_board, scan_board
from tools.folder_archive import write_folder

CAMERA = BoardCamera(np.array([[700.0, 0, 320], [0, 700, 240], [0, 0, 1]]), (640, 480))
FLANGE_T_CAMERA = rigid(rotation_exp(np.array([0.02, -0.03, 0.5])), np.array([0.06, 0.01, 0.04]))
BASE_T_TARGET = rigid(rotation_exp(np.array([0.01, 0.02, -0.3])), np.array([0.5, 0.05, 0.02]))
BOARD = Board("charuco", 7, 5, 0.03, 0.022)


def poses(count, seed=3):
    """Return base_T_flange of poses from which the camera in the hand sees the board."""
    rng = np.random.default_rng(seed)
    facing = np.diag([1.0, -1.0, -1.0, 1.0])
    out = []
    for _ in range(count):
        turned = rigid(rotation_exp(rng.uniform(-0.4, 0.4, 3)), np.zeros(3))
        back = rigid(np.eye(3), np.array([*rng.uniform(-0.03, 0.03, 2), -rng.uniform(0.4, 0.55)]))
        base_T_camera = BASE_T_TARGET @ facing @ turned @ back
        out.append(base_T_camera @ np.linalg.inv(FLANGE_T_CAMERA))
    return np.array(out)


def targets(robot):
    return np.linalg.inv(robot @ FLANGE_T_CAMERA) @ BASE_T_TARGET


def flangeye(monkeypatch, *words):
    monkeypatch.setattr(sys, "argv", ["flangeye", *map(str, words)])
    with pytest.raises(SystemExit) as ended:
        cli.main()
        raise SystemExit(0)
    return ended.value.code


def transforms(folder):
    return json.loads((folder / "result.json").read_text())["transforms"]


def check_result(folder, turn, shift):
    found = np.array(transforms(folder)["flange_T_camera"]["matrix"])
    off = rotation_log(found[:3, :3].T @ FLANGE_T_CAMERA[:3, :3])
    assert np.degrees(np.linalg.norm(off)) < turn
    assert np.linalg.norm(found[:3, 3] - FLANGE_T_CAMERA[:3, 3]) < shift


HEADER = (
    "title: T\nrobot: {model: ur5e}\nconfiguration: {name: eye-in-hand, place: unknown}\nsteps:\n"
)


def transform(pose):
    q = quaternion_from_rotation(pose[:3, :3]).tolist()
    return {
        "translation": dict(zip("xyz", pose[:3, 3].tolist(), strict=True)),
        "rotation": dict(zip("xyzw", q, strict=True)),
    }


@pytest.fixture
def samples(tmp_path: Path) -> Path:
    """Fifteen samples of easy_handeye2, eye-in-hand, with noise."""
    rng = np.random.default_rng(1)
    robot = poses(15)
    noise = [rigid(rotation_exp(rng.normal(0, 5e-4, 3)), rng.normal(0, 1e-4, 3)) for _ in robot]
    pairs = zip(robot, targets(robot) @ noise, strict=True)
    data = {"samples": [{"robot": transform(r), "tracking": transform(s)} for r, s in pairs]}
    folder = tmp_path / "archive"
    folder.mkdir()
    (folder / "cell.samples").write_text(json.dumps(data))
    return folder


def recipe(tmp_path, kind):
    path = tmp_path / "recipe.yaml"
    path.write_text(
        f"{HEADER}  - acquire.samples: {{reader: {{easy_handeye: {{calibration: {kind}}}}}}}\n"
        "  - solve.robust\n"
    )
    return path


def test_samples_of_easy_handeye_are_calibrated(
    tmp_path: Path, samples: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = recipe(tmp_path, "eye_in_hand")
    assert flangeye(monkeypatch, "run", path, "--archive", samples, "--out", tmp_path / "o") == 0
    check_result(tmp_path / "o", 0.1, 1e-3)


def test_the_doctor_tells_the_wrong_type_of_samples(
    tmp_path: Path,
    samples: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert (
        flangeye(monkeypatch, "doctor", samples, "--recipe", recipe(tmp_path, "eye_in_hand")) == 0
    )
    capsys.readouterr()
    assert (
        flangeye(monkeypatch, "doctor", samples, "--recipe", recipe(tmp_path, "eye_on_base")) == 1
    )
    told = capsys.readouterr().out
    assert "1. pose direction: the poses are flange_T_base" in told  # the reader turned them round
    assert told.rstrip().endswith("robot: {inverted: true}}}}")
    assert "configuration:" not in told  # the distances tell that the camera is in the hand
    assert "reader: {easy_handeye: {calibration: eye_on_base}}, robot: {inverted: true" in told


def test_a_folder_of_images_with_kuka_poses_is_calibrated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(2)
    folder = tmp_path / "archive"
    folder.mkdir()
    robot = poses(10)
    kuka = PoseConvention("kuka", tuple("abcdef"), "ZYX", "mm", "deg")
    rows = []
    for i, (pose, target) in enumerate(zip(robot, targets(robot), strict=True)):
        cv2.imwrite(str(folder / f"{i:02}.png"), render_board(BOARD, target, CAMERA, rng).pixels)
        rows.append(f"{i:02}.png," + ",".join(f"{x:.4f}" for x in kuka.numbers(pose)))
    (folder / "poses.csv").write_text("image,X,Y,Z,A,B,C\n" + "\n".join(rows) + "\n")
    path = tmp_path / "recipe.yaml"
    path.write_text(
        f"{HEADER}  - acquire.images:\n"
        "      reader: {table: {rotation: kuka, length: mm, angle: deg, pose: base_T_flange}}\n"
        "      focal_length: [700, 700]\n      principal_point: [320, 240]\n"
        "  - fit.charuco: {columns: 7, rows: 5, square: 30 mm, marker: 22 mm}\n"
        "  - solve.robust\n"
    )
    assert flangeye(monkeypatch, "run", path, "--archive", folder, "--out", tmp_path / "o") == 0
    check_result(tmp_path / "o", 0.1, 0.6e-3)
    again = ("--from", tmp_path / "o" / "run.mcap", "--at", "fit.charuco", "--out", tmp_path / "p")
    assert flangeye(monkeypatch, "run", path, *again) == 0
    assert transforms(tmp_path / "p") == transforms(tmp_path / "o")
    assert flangeye(monkeypatch, "doctor", folder, "--recipe", path) == 0
    wrong = path.read_text().replace("rotation: kuka", "rotation: fanuc")
    path.write_text(wrong)
    assert flangeye(monkeypatch, "doctor", folder, "--recipe", path) == 1


def test_organised_clouds_with_images_beside_them_need_no_camera_matrix(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rng = np.random.default_rng(4)
    folder, robot, captures = tmp_path / "archive", poses(8), []
    for i, (pose, target) in enumerate(zip(robot, targets(robot), strict=True)):
        cloud = scan_board(BOARD, target, CAMERA, rng)
        captures.append(Capture(f"{i}", cloud, by_frame(Transform("base", "flange", pose))))
    write_folder(folder, captures)
    for i, target in enumerate(targets(robot)):
        cv2.imwrite(str(folder / f"{i}.png"), render_board(BOARD, target, CAMERA, rng).pixels)
    path = tmp_path / "recipe.yaml"
    path.write_text(
        HEADER.replace("configuration", "scanner: {model: phoxi-m}\nconfiguration")
        + "  - acquire.archive\n"
        "  - fit.charuco: {columns: 7, rows: 5, square: 30 mm, marker: 22 mm}\n"
        "  - solve.robust\n"
    )
    assert flangeye(monkeypatch, "run", path, "--archive", folder, "--out", tmp_path / "o") == 0
    check_result(tmp_path / "o", 0.1, 0.6e-3)
    result = json.loads((tmp_path / "o" / "result.json").read_text())
    (told,) = [n for n in result["provenance"]["notes"] if n.startswith("camera of the images")]
    assert "focal length 700.0, 700.0 px, principal point 320.0, 240.0 px" in told
