"""Calibrations of cameras, as programs write them."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from flangeye.errors import StageError
from flangeye.files.cameras import camera_in, cameras_in

K = np.array([[1201.5, 0, 639.25], [0, 1203.5, 363.75], [0, 0, 1.0]])
LENS = [-0.11, 0.07, 0.0011, -0.0012, 0.01]
ROWS = ", ".join(map(str, K.ravel()))
FOUR = "1201.5, 1203.5, 639.25, 363.75"


def text_of(rows):
    return "\n".join(" ".join(map(str, row)) for row in rows)


WRITTEN = {
    "camera_info.yaml": "image_width: 1280\nimage_height: 720\ncamera_name: a\ncamera_matrix:\n"
    f"  rows: 3\n  cols: 3\n  data: [{ROWS}]\ndistortion_model: plumb_bob\n"
    f"distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: {LENS}\nprojection_matrix:\n"
    f"  rows: 3\n  cols: 4\n  data: [{', '.join(['7'] * 12)}]\n",
    "camchain.yaml": "cam0:\n  camera_model: pinhole\n  distortion_model: radtan\n"
    f"  distortion_coeffs: {LENS}\n  intrinsics: [{FOUR}]\n  resolution: [1280, 720]\n",
    "zivid.yml": "CameraIntrinsics:\n  CameraMatrix:\n    CX: 639.25\n    CY: 363.75\n"
    "    FX: 1201.5\n    FY: 1203.5\n  Distortion:\n    K1: -0.11\n    K2: 0.07\n    K3: 0.01\n"
    "    P1: 0.0011\n    P2: -0.0012\n",
    "realsense.json": '{"color": {"width": 1280, "height": 720, "ppx": 639.25, "ppy": 363.75, "fx": '
    f'1201.5, "fy": 1203.5, "model": "distortion.brown_conrady", "coeffs": {LENS}}}}}',
    "plain.json": f'{{"K": {K.tolist()}, "dist": [{LENS}], "rms": 0.2}}',
    "echoed.yaml": f"header:\n  frame_id: a\nheight: 720\nwidth: 1280\ndistortion_model: plumb_bob\n"
    f"d: {LENS}\nk: [{ROWS}]\np: [{', '.join(['7'] * 12)}]\n---\n",
    "ost.txt": "# oST version 5.0 parameters\n\n\n[image]\n\nwidth\n1280\n\n[narrow_stereo]\n\ncamera "
    f"matrix\n{text_of(K)}\n\ndistortion\n{text_of([LENS])}\n\nrectification\n{text_of(np.eye(3))}\n",
    "left.ini": "[left]\nfx = 1201.5\nfy = 1203.5\ncx = 639.25\ncy = 363.75\nk1 = -.11\nk2 = 0.07\n"
    "p1 = 1.1e-3\np2 = -1.2e-3\nk3 = 0.01\n",
    "cam.toml": f"[camera]\nmatrix = {K.tolist()}\ndistortions = {LENS}\n",
    "printed.txt": f"camera matrix:\n{K}\ndistortion:\n[{LENS}]\n",
    "own.yaml": f"focal_length: [1201.5, 1203.5]\nprincipal_point: [639.25, 363.75]\ndist: {LENS}\n",
    "odd.json": f'{{"K": {K.tolist()}, "dist_coeff": [{LENS}]}}',
    "orbbec.json": '{"color_intrinsic": {"fx": 1201.5, "fy": 1203.5, "cx": 639.25, "cy": 363.75}, '
    '"color_distortion": {"k1": -0.11, "k2": 0.07, "k3": 0.01, "p1": 0.0011, "p2": -0.0012}}',
    "cameras.txt": "# Camera list\n# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    "1 FULL_OPENCV 1280 720 1201.5 1203.5 639.75 364.25 -0.11 0.07 0.0011 -0.0012 0.01 0 0 0\n",
}


@pytest.mark.parametrize("name", WRITTEN)
def test_each_kind_is_read_by_its_own_names(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text(WRITTEN[name])
    camera = camera_in(tmp_path / name)
    assert camera is not None
    assert np.allclose(camera.matrix, K)
    assert np.allclose(camera.distortion[:5], LENS)
    assert "focal length 1201.5, 1203.5 px, principal point 639.2, 363.8 px" in camera.note()


@pytest.mark.parametrize("suffix", [".yml", ".xml", ".json"])
@pytest.mark.parametrize("names", [("camera_matrix", "distortion_coefficients"), ("K", "D"),
                                   ("cameraMatrix", "distCoeffs")])  # fmt: skip
def test_opencvs_storage(tmp_path: Path, suffix: str, names: tuple[str, str]) -> None:
    path = tmp_path / f"intrinsics{suffix}"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    file.write("rms", 0.3)
    file.write(names[0], K)
    file.write(names[1], np.array([LENS]))
    file.release()
    (camera,) = cameras_in(tmp_path)
    assert np.allclose(camera.matrix, K)
    assert np.allclose(camera.distortion, LENS)


def test_arrays_and_nine_numbers(tmp_path: Path) -> None:
    np.savez(tmp_path / "calib.npz", mtx=K, dist=np.array([LENS]), rvecs=np.zeros((9, 3, 1)))
    np.savetxt(tmp_path / "K.txt", K)
    np.savetxt(tmp_path / "CameraMatrix.txt", K.reshape(1, 9))
    np.save(tmp_path / "K.npy", K)
    for k in range(5):  # poses, not cameras
        np.savetxt(tmp_path / f"pose_{k}.txt", np.eye(3))
    names = ["CameraMatrix.txt", "K.npy", "K.txt", "calib.npz"]
    assert [c.path.name for c in cameras_in(tmp_path)] == names
    assert all(np.allclose(c.matrix, K) for c in cameras_in(tmp_path))


@pytest.mark.parametrize("suffix", [".npy", ".txt"])
def test_a_distortion_beside_the_matrix_is_its_own(tmp_path: Path, suffix: str) -> None:
    for name, rows in (("camera_matrix", K), ("dist_coeffs", np.array([LENS]))):
        if suffix == ".npy":
            np.save(tmp_path / f"{name}.npy", rows)
        else:
            np.savetxt(tmp_path / f"{name}.txt", rows)
    (camera,) = cameras_in(tmp_path)
    assert np.allclose(camera.distortion, LENS)
    assert camera.note().endswith(f"5 coefficients of dist_coeffs{suffix}")


def test_a_rational_lens_keeps_all_its_coefficients(tmp_path: Path) -> None:
    names = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
    lens = {name: 0.1 + 0.01 * i for i, name in enumerate(names)}
    values = {"fx": 600.0, "fy": 600.0, "cx": 640.0, "cy": 360.0, **lens}
    (tmp_path / "kinect.json").write_text(json.dumps({"color": {"parameters": values}}))
    camera = camera_in(tmp_path / "kinect.json")
    assert camera is not None
    assert camera.distortion == pytest.approx(list(lens.values()))


def test_open3d_writes_the_matrix_column_by_column(tmp_path: Path) -> None:
    numbers = [*K.T.ravel()]
    (tmp_path / "camera_intrinsic.json").write_text(json.dumps({"intrinsic_matrix": numbers}))
    (camera,) = cameras_in(tmp_path)
    assert np.allclose(camera.matrix, K)


def test_nerfstudio_has_its_own_names(tmp_path: Path) -> None:
    names = ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3")
    values = (K[0, 0], K[1, 1], K[0, 2], K[1, 2], *LENS)
    (tmp_path / "transforms.json").write_text(json.dumps(dict(zip(names, values, strict=True))))
    (camera,) = cameras_in(tmp_path)
    assert np.allclose(camera.matrix, K)
    assert np.allclose(camera.distortion, LENS)


def test_several_cameras_in_a_file_are_said(tmp_path: Path) -> None:
    text = WRITTEN["camchain.yaml"]
    (tmp_path / "a.yaml").write_text(text + text.replace("cam0", "cam1").replace("1201.5", "900"))
    camera = camera_in(tmp_path / "a.yaml")
    assert camera is not None
    assert camera.note().endswith("5 coefficients; the first of 2 cameras in this file")


@pytest.mark.parametrize(
    ("first", "lens", "second"),
    [("M1", "D1", "M2"), ("cameraMatrix1", "distCoeffs1", "cameraMatrix2"),
     ("K_left", "D_left", "K_right")],
)  # fmt: skip
def test_a_stereo_pairs_first_camera_is_taken(
    tmp_path: Path, first: str, lens: str, second: str
) -> None:
    path = tmp_path / "stereo.yml"
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for name, value in ((second, 2 * K), (first, K), (lens, np.array([LENS])), ("R", np.eye(3))):
        file.write(name, value)
    file.release()
    camera = camera_in(path)
    assert camera is not None
    assert np.allclose(camera.matrix, K)
    assert np.allclose(camera.distortion, LENS)
    assert camera.note().endswith("5 coefficients; the first of 2 cameras in this file")


@pytest.mark.parametrize("named", ["K", "IntrinsicMatrix", "FocalLength"])
def test_matlabs_camera_counts_pixels_from_one(tmp_path: Path, named: str) -> None:
    own = K.copy()
    own[:2, 2] += 1.0
    values = {"IntrinsicMatrix": own.T, "K": own, "FocalLength": own[[0, 1], [0, 1]]}
    stated = {named: values[named], "ImageSize": [720.0, 1280.0], "RadialDistortion": LENS[:2]}
    stated |= {"PrincipalPoint": own[:2, 2]} if named == "FocalLength" else {}
    savemat(tmp_path / "cam.mat", {"params": {**stated, "TangentialDistortion": LENS[2:4]}})
    (camera,) = cameras_in(tmp_path)
    assert np.allclose(camera.matrix, K)
    assert np.allclose(camera.distortion, [*LENS[:4], 0.0])


def test_a_lens_of_another_model_is_refused(tmp_path: Path) -> None:
    text = WRITTEN["camchain.yaml"].replace("radtan", "equidistant")
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(StageError, match="model equidistant, whose coefficients are not OpenCV's"):
        camera_in(tmp_path / "a.yaml")


@pytest.mark.parametrize("text", ["k: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]", "robot: 3", "K: x", "["])
def test_what_is_no_camera_is_none(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    assert camera_in(tmp_path / "a.yaml") is None


@pytest.mark.parametrize(
    ("name", "raw"),
    [
        ("a.json", b'{"fx": 1' + 400 * b"0" + b', "fy": 600, "cx": 320, "cy": 240}'),
        ("a.json", b'{"k": [600, 0, 1' + 400 * b"0" + b", 0, 600, 240, 0, 0, 1]}"),
        ("cameras.txt", b"1 PINHOLE 640 480 600 many 320 240\n"),
        ("cameras.txt", b"1 PINHOLE 640 480 600 inf 320 240\n"),
        ("notes.txt", "Gr\xfc\xdfe".encode("latin-1")),
    ],
)
def test_numbers_that_are_none_and_texts_of_others_are_no_camera(
    tmp_path: Path, name: str, raw: bytes
) -> None:
    (tmp_path / name).write_bytes(raw)
    assert camera_in(tmp_path / name) is None
