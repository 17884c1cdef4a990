"""acquire.archive: what it gives, what it tells, and everything it refuses beforehand."""

import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flangeye import StageError
from flangeye.files.clouds import write_cloud
from flangeye.files.depth import read_scan
from flangeye.types import ArchivePath, Capture, PointCloud, Source, Transform
from flangeye.workflow.log.record import Recorder
from flangeye_plugins.acquire import archive as module
from flangeye_plugins.acquire.archive import ArchiveParams, acquire_archive
from flangeye_plugins.acquire.camera import CameraParams
from flangeye_plugins.reader.auto import auto
from tools.folder_archive import write_folder


@pytest.fixture
def acquire(scanner: Any, archive: Path) -> Callable[..., Any]:
    """Call the stage on the archive."""

    def call(path=archive, recipe_path=None, **params):
        chosen = ArchiveParams(**{"reader": auto.bind(), "path": recipe_path, **params})
        return acquire_archive(scanner, ArchivePath(path), chosen)

    return call


@pytest.fixture
def refused(acquire: Callable[..., Any]) -> Callable[..., Any]:
    """Call the stage, or run it to its end; return the one line it is refused with."""

    def call(to_the_end=False, **params):
        with pytest.raises(StageError) as error:
            stream = acquire(**params)
            if to_the_end:
                list(stream)
        assert "\n" not in str(error.value)
        return str(error.value)

    return call


def same(one: Capture, other: Capture) -> bool:
    return (
        (one.id, one.role, one.time_ns) == (other.id, other.role, other.time_ns)
        and np.array_equal(one.cloud.xyz, other.cloud.xyz)
        and np.allclose(one.base_T_flange.matrix, other.base_T_flange.matrix, atol=1e-14)
        and np.array_equal(np.asarray(one.joints), np.asarray(other.joints))
    )


# --- what it gives -----------------------------------------------------------------------------


def test_captures_come_back_as_they_were_verification_first(
    acquire: Callable[..., Any], captures: Any
) -> None:
    stream = acquire()
    read = list(stream)
    assert stream.total == 5
    assert [capture.id for capture in read] == ["check", "one", "two", "three", "four"]
    assert all(map(same, read, [captures[-1], *captures[:-1]]))


def test_clouds_are_read_one_at_a_time(
    acquire: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    read = []

    def noted(path, *unit, **options):
        read.append(path)
        return read_scan(path, *unit, **options)

    monkeypatch.setattr(module, "read_scan", noted)
    stream = iter(acquire())
    assert len(read) == 1, "one cloud, for its unit"
    next(stream)
    assert len(read) == 2


def test_it_tells_what_it_found(acquire: Callable[..., Any], archive: Path) -> None:
    assert acquire().source.notes == (
        f"archive: folder, poses.csv, {archive}",
        f"reader: folder, chosen by what {archive} holds",
        "clouds in m (detected): the first has its median point at 0.450 m; phoxi-s sees 0.384 to "
        "0.520 m",
    )


def test_the_fingerprint_follows_every_input_and_not_the_place(
    acquire: Callable[..., Any], archive: Path, tmp_path: Path, edit: Callable[..., Any]
) -> None:
    first = acquire().source.fingerprint
    moved = tmp_path / "elsewhere"
    shutil.copytree(archive, moved)
    assert acquire(moved).source.fingerprint == first
    cloud = archive / "two.pcd"
    content = bytearray(cloud.read_bytes())
    content[-2] ^= 1
    cloud.write_bytes(content)
    changed = acquire().source.fingerprint
    edit(",1002,", ",1003,")
    assert len({first, changed, acquire().source.fingerprint}) == 3


def test_poses_can_be_left_out(acquire: Callable[..., Any]) -> None:
    stream = acquire(leave_out=("two", "check"))
    assert [capture.id for capture in stream] == ["one", "three", "four"]
    assert "left out as the recipe states: two, check" in stream.source.notes


@pytest.mark.parametrize("named", [".", "run.mcap"])
def test_a_run_is_an_archive(
    acquire: Callable[..., Any], captures: Any, tmp_path: Path, named: str
) -> None:
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, {}, full_clouds=True)
    recorder.flangeye_run_started(source=Source("before", ("as it was told",)), total=5)
    for capture in captures:
        recorder.flangeye_captured(step="0.acquire.x", capture=capture, seconds=0.0)
    recorder.close()
    stream = acquire(tmp_path / named)
    assert all(map(same, stream, captures))
    assert stream.source.notes == (f"archive: {path}, a log of flangeye", "as it was told")
    assert stream.source.fingerprint != "before"


def test_a_log_of_thinned_scans_is_refused(
    refused: Callable[..., Any], captures: Any, tmp_path: Path
) -> None:
    path = tmp_path / "run.mcap"
    recorder = Recorder(path, {}, full_clouds=False)
    recorder.flangeye_run_started(source=Source("x"), total=5)
    recorder.flangeye_captured(step="0.acquire.x", capture=captures[0], seconds=0.0)
    recorder.close()
    assert refused(path=path) == (
        f"{path}: holds no whole scans; record with log: {{clouds: full}}, or use flangeye run "
        "--from to start at a later step"
    )


# --- images ------------------------------------------------------------------------------------

FOCAL, MIDDLE = 40.0, (9.5, 7.0)


def add_image(archive, name, bend=0.0):
    """Put an organised cloud and the image of its grid in the place of a cloud."""
    v, u = np.indices((15, 20), dtype=float)
    rays = np.stack([(u - MIDDLE[0]) / FOCAL, (v - MIDDLE[1]) / FOCAL, np.ones_like(u)], axis=-1)
    rays[..., 0] += bend * rays[..., 0] ** 3
    cloud = PointCloud("camera", (0.45 + 1e-3 * len(name)) * rays)
    write_cloud(archive / f"{name}.pcd", cloud)
    pixels = np.full((15, 20), len(name), np.uint8)
    (archive / f"{name}.png").write_bytes(cv2.imencode(".png", pixels)[1].tobytes())


def test_an_image_beside_a_cloud_comes_with_the_camera_that_the_cloud_implies(
    acquire: Callable[..., Any], archive: Path
) -> None:
    add_image(archive, "two")
    add_image(archive, "three")
    stream = acquire()
    images = {capture.id: capture.image for capture in stream}
    assert {name for name, image in images.items() if image} == {"two", "three"}
    assert np.allclose(
        images["two"].camera_matrix, [[FOCAL, 0, 9.5], [0, FOCAL, 7], [0.0, 0, 1]], atol=1e-3
    )
    assert images["three"].pixels[0, 0] == len("three")
    assert (
        "camera of the images: focal length 40.0, 40.0 px, principal point 9.5, 7.0 px, "
        "estimated from their organised clouds"
    ) in stream.source.notes


def test_the_stated_camera_goes_before_what_the_clouds_imply(
    acquire: Callable[..., Any], archive: Path
) -> None:
    add_image(archive, "two", bend=30.0)
    stated = CameraParams(focal_length=(41, 42), principal_point=(9, 8), distortion=(0.1, 0.2))
    (image,) = [c.image for c in acquire(camera=stated) if c.image]
    assert np.allclose(np.diag(image.camera_matrix), [41, 42, 1])
    assert np.allclose(image.distortion, [0.1, 0.2])


def test_images_of_no_known_camera_are_left_out_and_that_is_told(
    acquire: Callable[..., Any], archive: Path
) -> None:
    add_image(archive, "two", bend=30.0)
    stream = acquire()
    assert all(capture.image is None for capture in stream)
    assert stream.source.notes[-1] == (
        "left out the images, such as two.png: no pinhole camera fits the clouds under them; write "
        "camera: {focal_length: [fx, fy], principal_point: [cx, cy]}"
    )


def test_two_images_of_one_cloud_are_refused(refused: Callable[..., Any], archive: Path) -> None:
    add_image(archive, "two")
    shutil.copy(archive / "two.png", archive / "two.bmp")
    assert refused() == f"{archive}: two.bmp and two.png both belong to two.pcd; keep one of them"


# --- units -------------------------------------------------------------------------------------


@pytest.fixture
def in_millimetres(archive: Path, captures: Any) -> None:
    """The clouds in millimetres, as many scanners write them."""
    for capture in captures:
        write_cloud(archive / f"{capture.id}.pcd", capture.cloud, unit="mm")


@pytest.mark.parametrize(("unit", "how"), [("auto", "detected"), ("mm", "as stated")])
def test_millimetres_are_found_or_believed_and_reported(
    acquire: Callable[..., Any], captures: Any, in_millimetres: None, unit: str, how: str
) -> None:
    stream = acquire(unit=unit)
    assert stream.source.notes[-1] == (
        f"clouds in mm ({how}): the first has its median point at 0.450 m; phoxi-s sees "
        "0.384 to 0.520 m"
    )
    assert np.allclose(next(iter(stream)).cloud.xyz, captures[-1].cloud.xyz, rtol=1e-6)


def test_millimetres_declared_as_metres_are_refused(
    refused: Callable[..., Any], archive: Path, in_millimetres: None
) -> None:
    assert refused(unit="m") == (
        f"{archive}/check.pcd: median distance 450 m with unit m, but phoxi-s sees 0.384 to "
        "0.520 m; these look like millimetres: set unit: mm"
    )


def test_metres_declared_as_millimetres_are_refused(
    refused: Callable[..., Any], archive: Path
) -> None:
    assert refused(unit="mm") == (
        f"{archive}/check.pcd: median distance 0.00045 m with unit mm, but phoxi-s sees 0.384 to "
        "0.520 m; these look like metres: set unit: m"
    )


def _scale(archive, name, factor):
    points = np.random.default_rng(0).uniform(0.4, 0.5, (20, 3)) * factor
    write_cloud(archive / f"{name}.pcd", PointCloud("camera", points))


def test_a_distance_that_fits_neither_unit_is_refused(
    refused: Callable[..., Any], archive: Path
) -> None:
    _scale(archive, "check", 20.0)
    assert re.fullmatch(
        re.escape(f"{archive}/check.pcd: median distance 15.")
        + r"\d fits neither m nor mm: phoxi-s sees 0\.384 to 0\.520 m; state unit: in, which fits, "
        "or the right scanner",
        refused(),
    )
    assert refused(unit="m").endswith("these look like inches: set unit: in")
    _scale(archive, "check", 2e4)
    assert "unit m, but phoxi-s sees 0.384 to 0.520 m; and 15." in refused(unit="m")
    assert refused(unit="m").endswith("m with unit mm does not fit either; is it this scanner?")


def test_one_cloud_in_another_unit_stops_the_run_when_it_comes(
    refused: Callable[..., Any], archive: Path
) -> None:
    _scale(archive, "three", 1000.0)
    assert refused(to_the_end=True).startswith(f"{archive}/three.pcd: median distance 7")


def test_a_scan_of_a_far_wall_is_no_reason_to_refuse(
    acquire: Callable[..., Any], archive: Path
) -> None:
    _scale(archive, "one", 10.0)
    assert len(list(acquire())) == 5


# --- files -------------------------------------------------------------------------------------


def test_an_unreadable_cloud_stops_the_run_before_it_starts(
    refused: Callable[..., Any], archive: Path
) -> None:
    (archive / "three.pcd").write_bytes(b"")
    assert refused() == f"{archive}/three.pcd: is empty (0 bytes)"


def test_an_unreadable_cloud_can_be_set_aside_and_is_reported(
    acquire: Callable[..., Any], archive: Path
) -> None:
    (archive / "three.pcd").unlink()
    stream = acquire(unreadable="reject")
    assert [capture.id for capture in stream] == ["check", "one", "two", "four"]
    assert f"set aside 'three': {archive}/three.pcd: does not exist" in stream.source.notes


def test_what_is_set_aside_counts_damage_inside_the_data_too(
    acquire: Callable[..., Any], archive: Path
) -> None:
    text = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nWIDTH 1\nHEIGHT 1\nDATA ascii\n1 2 x"
    (archive / "two.pcd").write_text(text)
    assert len(list(acquire(unreadable="reject"))) == 4


def test_nan_everywhere_is_refused_but_one_empty_scan_is_not(
    acquire: Callable[..., Any], refused: Callable[..., Any], archive: Path, captures: Any
) -> None:
    nothing = PointCloud("camera", np.full((4, 3), np.nan))
    write_cloud(archive / "check.pcd", nothing)
    assert len(next(iter(acquire())).cloud.points()) == 0
    for i, capture in enumerate(captures, 1):
        nothing = PointCloud("camera", np.full((i, 3), np.nan))
        write_cloud(archive / f"{capture.id}.pcd", nothing)
    assert refused() == f"{archive}: none of its 5 clouds has a finite point (all NaN)"


def test_a_verification_cloud_that_is_also_trained_with_is_refused(
    refused: Callable[..., Any], archive: Path
) -> None:
    shutil.copy(archive / "check.pcd", archive / "two.pcd")
    assert refused() == (
        f"{archive}/two.pcd: is the verification cloud check.pcd again; a verification cloud "
        "must not be used to calibrate"
    )


def test_one_cloud_at_two_poses_is_refused(refused: Callable[..., Any], archive: Path) -> None:
    shutil.copy(archive / "one.pcd", archive / "two.pcd")
    assert refused() == f"{archive}/two.pcd: has the same content as one.pcd"


# --- poses -------------------------------------------------------------------------------------


def test_no_archive_given_is_refused(refused: Callable[..., Any], tmp_path: Path) -> None:
    assert refused(path=None) == (
        "acquire.archive: no archive given; add --archive PATH, or path: in the recipe"
    )
    assert refused(path=tmp_path / "no") == f"{tmp_path}/no: does not exist"


def test_the_recipe_may_name_the_archive_and_the_command_line_comes_first(
    acquire: Callable[..., Any], archive: Path
) -> None:
    with pytest.raises(StageError, match="does not exist"):
        acquire(archive / "no", recipe_path=archive)
    assert acquire(None, recipe_path=archive).total == 5


def rewrite(archive, captures):
    shutil.rmtree(archive)
    write_folder(archive, captures)


def moved(capture, matrix):
    return replace(capture, poses={"flange": Transform("base", "flange", matrix)})


def test_fewer_than_three_captures_are_refused(
    refused: Callable[..., Any], archive: Path, captures: Any
) -> None:
    rewrite(archive, [captures[0], captures[1], captures[4]])
    assert refused() == (
        f"{archive}: 2 captures to calibrate with; at least 3 are needed, at different places"
    )


def test_all_poses_at_one_place_are_refused(
    refused: Callable[..., Any], archive: Path, captures: Any
) -> None:
    turned = []
    for i, capture in enumerate(captures):
        matrix = capture.base_T_flange.matrix.copy()
        matrix[:3, 3] = 0.4, -0.3, 0.2 + 1e-4 * i
        turned.append(moved(capture, matrix))
    rewrite(archive, turned)
    assert refused() == (
        f"{archive}: all 4 poses have the flange within 0.15 mm of one place; move it through the "
        "workspace"
    )


def test_a_pose_given_twice_is_refused(
    refused: Callable[..., Any], archive: Path, captures: Any
) -> None:
    captures[2] = moved(captures[2], captures[0].base_T_flange.matrix)
    rewrite(archive, captures)
    assert refused() == (
        f"{archive}: poses 'one' and 'three' are the same; every capture needs a pose of its own; 'flangeye doctor' names those to leave out"
    )


def test_poses_that_a_driver_made_up_are_refused_as_such(
    refused: Callable[..., Any], archive: Path, captures: Any
) -> None:
    told = "the driver did not read them from the robot; record again"
    rewrite(archive, [moved(capture, np.eye(4)) for capture in captures])
    assert refused() == f"{archive}: 5 of 5 robot poses are the identity: {told}"
    stale = captures[0].base_T_flange.matrix
    rewrite(archive, [*(moved(capture, stale) for capture in captures[:4]), captures[4]])
    assert refused() == f"{archive}: 4 of 5 robot poses are the same: {told}"


def test_two_poses_of_one_name_are_refused(
    refused: Callable[..., Any], archive: Path, edit: Callable[..., Any]
) -> None:
    edit("two.pcd,two,", "two.pcd,one,")
    assert refused() == f"{archive}: pose 'one' is given twice"


def test_positions_in_millimetres_declared_as_metres_are_refused(
    refused: Callable[..., Any], archive: Path, edit: Callable[..., Any]
) -> None:
    edit(",0.4625,", ",462.5,")
    assert refused() == (
        f"{archive}: pose 'two' is 462.5 m from the base, beyond any arm; are the positions in "
        "millimetres?"
    )


def test_leaving_out_a_pose_that_is_not_there_is_refused(
    refused: Callable[..., Any], archive: Path
) -> None:
    assert refused(leave_out=("nine",)) == f"{archive}: leave_out: there is no pose 'nine'"
