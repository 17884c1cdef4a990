"""Depth images: as the clouds that they are, with the calibration beside them."""

import json
import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.files.clouds import read_cloud
from flangeye.files.depth import check_scan, read_scan
from flangeye.files.images import is_depth_image
from flangeye.files.paths import bundled

MATRIX = np.array([[310.0, 0, 163.5], [0, 305.0, 118.0], [0, 0, 1]])
LENS = np.array([-0.12, 0.05, 1e-3, -5e-4, 0.0])
SHAPE = (240, 320)


def camera_file(folder: Path, lens: Any = LENS, **more: Any) -> None:
    names = ["k1", "k2", "p1", "p2", "k3"]
    about = {"fx": 310.0, "fy": 305.0, "cx": 163.5, "cy": 118.0}
    lens_by_name = dict(zip(names, map(float, lens), strict=True))
    (folder / "camera.json").write_text(json.dumps({**about, **lens_by_name, **more}))


def slope() -> Any:
    """Depths [mm] of a plane, as whole numbers, with a hole in it."""
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    depths = np.round(800 + 0.5 * columns + 0.25 * rows).astype(np.uint16)
    depths[100:120, 50:90] = 0
    return depths


@pytest.mark.parametrize(
    ("name", "written", "more", "unit"),
    [
        ("depth/7.png", slope(), {}, "mm"),
        ("7_Depth.png", slope(), {"depth_scale": 0.001}, "m"),
        ("depth/7.tiff", (slope() / 1000).astype(np.float32), {}, "m"),
        ("frame_7.npy", slope(), {}, "mm"),
        ("depth/7.npy", slope() / 1000, {}, "m"),
    ],
)
def test_points_project_to_their_pixels(
    tmp_path: Path, name: str, written: Any, more: dict[str, float], unit: Any
) -> None:
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    if path.suffix == ".npy":
        np.save(path, written)
    else:
        cv2.imwrite(str(path), written)
    camera_file(tmp_path, **more)
    told: list[str] = []
    cloud = read_scan(path, unit, told.append)
    assert cloud.organised and check_scan(path) == np.prod(SHAPE)
    assert told[0].startswith(f"camera of {tmp_path}/camera.json: focal length 310.0, 305.0 px")
    seen = np.isfinite(cloud.xyz[..., 2])
    assert np.array_equal(seen, slope() > 0)
    points = cloud.xyz[seen].astype(np.float64)
    assert np.allclose(points[:, 2], slope()[seen] / 1000, rtol=1e-6)
    pixels = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, LENS)[0][:, 0]
    rows, columns = np.nonzero(seen)
    assert np.abs(pixels - np.column_stack([columns, rows])).max() < 0.02


def test_only_what_is_called_depth_and_has_16_bits_is_one(tmp_path: Path) -> None:
    for name, pixels in (
        ("depth_1.png", slope()), ("mono_1.png", slope()),
        ("depth_view_1.png", (slope() // 8).astype(np.uint8)),
    ):  # fmt: skip
        cv2.imwrite(str(tmp_path / name), pixels)
    assert [p.name for p in sorted(tmp_path.iterdir()) if is_depth_image(p)] == ["depth_1.png"]
    assert not is_depth_image(tmp_path / "depth_none.png")


def test_a_calibration_that_is_missing_or_of_another_size_is_named(tmp_path: Path) -> None:
    path = tmp_path / "depth_1.png"
    cv2.imwrite(str(path), slope())
    with pytest.raises(StageError, match=r"needs the calibration of its camera: put its file"):
        read_scan(path)
    camera_file(tmp_path)  # put there once it was asked for
    assert read_scan(path).organised
    other = tmp_path / "half"
    other.mkdir()
    cv2.imwrite(str(other / "depth_1.png"), slope()[::2, ::2])
    camera_file(other)
    with pytest.raises(
        StageError, match="has 160 x 120 px, but camera.json has its principal point"
    ):
        read_scan(other / "depth_1.png")


def test_damage_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "depth_1.png"
    cv2.imwrite(str(path), slope())
    path.write_bytes(path.read_bytes()[:200])
    camera_file(tmp_path)
    with pytest.raises(StageError, match=r"depth_1.png: is a damaged image"):
        read_scan(path)


def test_a_folder_of_depth_images_is_calibrated(tmp_path: Path, command: Any) -> None:
    """The sample's clouds, as a depth camera would have stored them, every assumption taken."""
    folder = tmp_path / "session"
    (folder / "depth").mkdir(parents=True)
    size, focal = (600, 800), 780.0
    for cloud in (bundled("data") / "samples/ur5_phoxi-m").glob("*.pcd"):
        points = read_cloud(cloud).points()
        points = points[np.isfinite(points[:, 2])]
        x, y, z = points.T
        columns, rows = np.round(focal * np.array([x, y]) / z + [[400], [300]]).astype(int)
        inside = (columns >= 0) & (columns < size[1]) & (rows >= 0) & (rows < size[0])
        depths = np.zeros(size, np.uint16)
        depths[rows[inside], columns[inside]] = np.round(z[inside] * 1e4)
        cv2.imwrite(str(folder / "depth" / f"{cloud.stem}.png"), depths)
    text = (bundled("data") / "samples/ur5_phoxi-m/poses.csv").read_text()
    (folder / "poses.csv").write_text(re.sub(r"(\d+)\.pcd", r"depth/\1.png", text))
    about = {"fx": focal, "fy": focal, "ppx": 400, "ppy": 300, "depth_scale": 1e-4}
    (folder / "intrinsics.json").write_text(json.dumps(about))
    recipe = tmp_path / "recipe.yaml"
    code, out, err = command("init", folder, "--yes", "--out", recipe)
    assert code == 0, err
    assert "clouds: 8 .png" in out
    code, out, err = command("run", recipe, "--out", tmp_path / "run")
    assert code == 0 and "VERIFIED" in out, out + err


def test_a_tiff_of_three_floats_is_a_cloud_whatever_its_name(tmp_path: Path) -> None:
    points = np.zeros((*SHAPE, 3), np.float32)
    points[..., :2] = np.mgrid[: SHAPE[0], : SHAPE[1]].transpose(1, 2, 0)
    points[..., 2] = np.where(slope() > 0, slope(), 0)
    points[slope() == 0] = points[:20] = 0
    path, photograph = tmp_path / "img_7.tiff", tmp_path / "img_8.tiff"
    cv2.imwrite(str(path), np.ascontiguousarray(points[..., ::-1]))
    cv2.imwrite(str(photograph), (points / 8).astype(np.uint8))
    assert is_depth_image(path) and not is_depth_image(photograph)
    told: list[str] = []
    cloud = read_scan(path, "mm", told.append)
    assert told == ["img_7.tiff: 7200 of 76800 points have (0, 0, 0): taken as missing"]
    assert check_scan(path) == np.prod(SHAPE)
    seen = points[..., 2] > 0
    assert np.array_equal(np.isfinite(cloud.xyz[..., 2]), seen)
    assert np.array_equal(cloud.xyz[seen], points[seen] / np.float32(1000))


def test_of_several_cameras_that_of_the_images_size_is_taken(tmp_path: Path) -> None:
    folder = tmp_path / "depth"
    folder.mkdir()
    cv2.imwrite(str(folder / "7.png"), slope())
    camera_file(tmp_path)
    other = {"fx": 620.0, "fy": 620.0, "cx": 640.0, "cy": 360.0}
    (tmp_path / "depth_camera.json").write_text(json.dumps(other))
    told: list[str] = []
    read_scan(folder / "7.png", "mm", told.append)
    assert told[0].startswith(f"camera of {tmp_path}/camera.json: focal length 310.0")


@pytest.mark.parametrize(("name", "taken"), [("depth", "depth.json"), ("aligned_depth", "a.json")])
def test_aligned_depths_are_the_colour_cameras(tmp_path: Path, name: str, taken: str) -> None:
    folder = tmp_path / name
    folder.mkdir()
    cv2.imwrite(str(folder / "7.png"), slope())
    for file, focal in (("a.json", 300.0), ("depth.json", 290.0)):
        about = {"fx": focal, "fy": focal, "cx": 163.5, "cy": 118.0}
        (tmp_path / file).write_text(json.dumps(about))
    told: list[str] = []
    read_scan(folder / "7.png", "mm", told.append)
    assert told[0].startswith(f"camera of {tmp_path}/{taken}: ")
