"""A camera nobody calibrated: found by the views of the board, or refined, with how well."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from flangeye import StageError
from flangeye.models.boards import Board
from flangeye.models.corners import find_corners
from flangeye.types import ArchivePath, Image, warnings_of
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.units import SI
from flangeye_emulators.world.board_image import BoardCamera, render_board
from flangeye_plugins.acquire.images import ImagesParams, SeenBoardParams, acquire_images, lens_of
from flangeye_plugins.fit.boards import CheckerboardParams

MATRIX = np.array([[1000.0, 0, 407], [0, 1003, 295], [0, 0, 1]])
LENS = np.array([-0.12, 0.05, 0.001, -0.0005, 0.0])
CAMERA = BoardCamera(MATRIX, (800, 600), LENS)
HALF = BoardCamera(np.array([[500.0, 0, 203.25], [0, 501.5, 147.25], [0, 0, 1]]), (400, 300), LENS)
"""The same camera with pixels of twice the width: where a board is not found, time goes by pixels."""
BOARD = Board("charuco", 7, 5, 0.03, 0.022)
OF_BOARD = SeenBoardParams(columns=7, rows=5, square=SI(0.03), marker=SI(0.022))
CIRCLES = Board("circles", 4, 11, 0.016, 0.014)


def poses(count, tilt=0.45):
    for k in range(count):
        about = np.array([np.cos(1.9 * k), np.sin(1.9 * k), 0.0])
        turned = np.diag([1.0, -1.0, -1.0]) @ rotation_exp(tilt * about)
        yield rigid(
            turned, np.array([0.05 * np.cos(k), 0.03 * np.sin(2 * k), 0.46 + 0.02 * (k % 4)])
        )


def images(board, count, tilt=0.45, camera=CAMERA):
    rng = np.random.default_rng(1)
    return {
        str(k): np.asarray(render_board(board, pose, camera, rng).pixels)
        for k, pose in enumerate(poses(count, tilt))
    }


@pytest.fixture(scope="module")
def views() -> Any:
    return images(BOARD, 12)


def misses(lens):
    """Return how far the camera is from the true one, in its own standard deviations."""
    k, true = lens.matrix, MATRIX
    of_matrix = [
        k[0, 0] - true[0, 0],
        k[1, 1] - true[1, 1],
        k[0, 2] - true[0, 2],
        k[1, 2] - true[1, 2],
    ]
    return np.array([*of_matrix, *(lens.distortion - LENS[:4])]) / lens.deviations


@pytest.mark.parametrize("board", [BOARD, CIRCLES])
def test_the_camera_is_found_as_well_as_it_says(board: Any, views: Any) -> None:
    lens = lens_of(views if board is BOARD else images(board, 12), board)
    assert lens.deviations[0] < 5
    assert np.abs(misses(lens)).max() < 6  # what detection moves all corners by is not in it
    assert abs(lens.matrix[0, 0] - 1000) < 5
    assert lens.error < 0.15


def test_a_camera_that_is_nearly_known_is_refined(views: Any) -> None:
    rough = MATRIX + np.diag([30.0, 30.0, 0.0])
    known = Image(views["0"], rough, np.zeros(0))
    refined = lens_of(views, BOARD, known)
    np.testing.assert_allclose(refined.matrix, lens_of(views, BOARD).matrix, atol=0.05)


def test_a_calibration_that_the_images_contradict_is_said(views: Any) -> None:
    wrong = MATRIX * [[1.4, 1, 1], [1, 1.4, 1], [1, 1, 1]]
    found = lens_of(views, BOARD, Image(views["0"], wrong, np.zeros(0)))
    said = found.against(wrong)
    assert said is not None
    assert said.startswith("the camera's calibration states a focal length of 1400 px; 12 views of")
    assert found.against(MATRIX) is None


OTHER = Board("checkerboard", 9, 6, 0.02)


@pytest.mark.parametrize(
    ("shown", "said"),
    [
        (BOARD, "it shows a ChArUco board of 7 x 5 squares, markers of 4X4_250: write "
         "fit.charuco: {columns: 7, rows: 5, dictionary: 4X4_250}"),
        (OTHER, "it shows a checkerboard of 9 x 6 squares: write fit.checkerboard: {columns: 9, "),
        (None, "0: no checkerboard of 10 x 7 squares found"),
    ],
)  # fmt: skip
def test_a_board_that_is_in_no_image_ends_early_and_the_one_that_is_seen_is_named(
    shown: Board | None, said: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    pixels = np.random.default_rng(0).integers(0, 255, (240, 320), dtype=np.uint8)
    seen = images(shown, 12, 0.2, HALF) if shown else {str(k): pixels for k in range(12)}
    looked = []

    def counted(board, image, thorough=True):
        looked.append(thorough)
        return find_corners(board, image, thorough)

    monkeypatch.setattr("flangeye_plugins.acquire.images.find_corners", counted)
    with pytest.raises(StageError, match="none of 8 of the 12 images, taken evenly") as refused:
        lens_of(seen, Board("checkerboard", 10, 7, 0.02))
    assert said in str(refused.value)
    assert (len(looked), sum(looked)) == (10, 2)


def test_a_board_in_a_mirror_is_named_as_that() -> None:
    board = Board("charuco", 7, 5, 0.03, 0.022)
    seen = {name: pixels[:, ::-1] for name, pixels in images(board, 9, 0.2, HALF).items()}
    with pytest.raises(StageError, match="0: it shows the board mirrored: switch off image"):
        lens_of(seen, board)


def test_images_without_a_board_are_left_out_and_named(views: Any) -> None:
    blank = np.full_like(views["0"], 90)
    lens = lens_of({**views, "blank": blank}, BOARD)
    assert lens.left_out == ("blank",)
    assert lens.note().startswith("camera by 12 views of the board: focal length ")
    assert lens.note().endswith("px; without blank")


def test_too_few_or_too_equal_views_are_refused(views: Any) -> None:
    few = {name: views[name] for name in "0123"}
    with pytest.raises(
        StageError, match="^4 of 4 images show the board, 6 are needed to calibrate"
    ):
        lens_of(few, BOARD)
    other = replace(BOARD, dictionary="6X6_250")
    with pytest.raises(StageError, match=r"^0 of 4 .*; 0: 0 corners of .*: write dictionary: "):
        lens_of(few, other)
    with pytest.raises(StageError, match="tilt the board by 20 deg and more to both sides"):
        lens_of(images(BOARD, 7, tilt=0.02), BOARD)
    with pytest.raises(StageError, match="^images of 2 sizes are not one camera's"):
        lens_of({**few, "small": views["0"][:100]}, BOARD)


def test_a_folder_of_images_needs_no_calibrated_camera(views: Any, tmp_path: Path) -> None:
    reader = written_with_poses(tmp_path, views)
    known = ImagesParams(path=tmp_path, reader=reader, board=OF_BOARD)
    taken = acquire_images(ArchivePath(None), known)
    first = next(iter(taken))
    assert abs(first.image.camera_matrix[0, 0] - 1000) < 5
    assert any(note.startswith("camera by 12 views") for note in taken.source.notes)
    with pytest.raises(StageError, match=r"or board: \{kind: charuco, …\} to find it"):
        acquire_images(ArchivePath(None), ImagesParams(path=tmp_path, reader=reader))


@pytest.mark.parametrize(("scale", "warned"), [(1.0, False), (1.5, True), (0.5, True)])
def test_a_calibration_of_another_image_size_is_said(
    views: Any, tmp_path: Path, scale: float, warned: bool
) -> None:
    reader = written_with_poses(tmp_path, views)
    np.savetxt(tmp_path / "K.txt", MATRIX * [[scale], [scale], [1]])
    taken = acquire_images(ArchivePath(None), ImagesParams(path=tmp_path, reader=reader))
    said = [note for note in warnings_of(taken.source.notes) if "principal point" in note]
    assert bool(said) is warned
    assert (
        all(note.fix.endswith(f"scale its matrix by {1 / scale:.2g}") for note in said) or scale > 1
    )


def test_images_of_a_known_camera_without_the_board_that_is_fitted_end_early(
    tmp_path: Path,
) -> None:
    reader = written_with_poses(tmp_path, images(BOARD, 12, camera=HALF))
    lens = {"focal_length": (500.0, 501.5), "principal_point": (203.25, 147.25)}
    params = ImagesParams(path=tmp_path, reader=reader, **lens)
    fitted = CheckerboardParams(columns=10, rows=7, square=SI(0.02)).board
    with pytest.raises(StageError, match=r"none of 8 of the 12 images.*\(checkerboard, 10 x 7\)"):
        acquire_images(ArchivePath(None), params, fitted)
    assert acquire_images(ArchivePath(None), params, BOARD).total == 12


def written_with_poses(folder, views):
    """Write images with poses beside them; return how the poses are read."""
    rows = ["x,y,z,a,b,c"]
    for k, (name, pixels) in enumerate(views.items()):
        cv2.imwrite(str(folder / f"{name}.png"), pixels)
        rows.append(f"{0.1 * k},0.1,0.2,{0.1 * k},0,0")
    (folder / "poses.csv").write_text("\n".join(rows))
    return table_reader()


def table_reader():
    from flangeye.plugin.stage import BoundPart
    from flangeye_plugins.reader.table import TableParams, table

    params = TableParams(rotation="vector", length="m", angle="rad", pose="base_T_flange")
    return BoundPart(table, params)


@pytest.mark.parametrize(
    ("given", "line"),
    [
        (
            {"kind": "marker", "columns": 3, "rows": 3},
            "the four corners of a marker do not determine a camera",
        ),
        (
            {"kind": "charuco", "columns": 7, "rows": 5},
            "marker: a ChArUco board's markers are smaller",
        ),
        (
            {"kind": "checkerboard", "columns": 6, "rows": 3},
            "OpenCV finds checkerboards of at least 4 x 4 squares",
        ),
    ],
)
def test_a_board_that_tells_no_camera_is_refused(given: dict[str, Any], line: str) -> None:
    with pytest.raises(ValueError, match=line):
        SeenBoardParams(square=SI(0.03), **given)
