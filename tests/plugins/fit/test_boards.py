"""Printed targets in rendered images: perspective, lens, blur and noise, with known truth."""

import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from flangeye.models.boards import Board, charuco_of, print_of
from flangeye.models.corners import Corners, board_seen
from flangeye.types import CAMERA, Capture, Floats, Image, PointCloud, Rejected, Transform, by_frame
from flangeye.types.geometry import rigid, rotation_exp, rotation_log
from flangeye.units import SI
from flangeye_emulators.world.board_image import BoardCamera, Cover, render_board, scan_board
from flangeye_plugins.fit import boards
from flangeye_plugins.fit.boards import (
    CharucoParams,
    CheckerboardParams,
    CirclesParams,
    MarkerParams,
    fit_aruco,
    fit_charuco,
    fit_checkerboard,
    fit_circles,
)
from flangeye_plugins.fit.boards import _ambiguity as ambiguity
from flangeye_plugins.fit.planar import PlanarPose
from tests.plugins.bounds import check_bound
from tests.plugins.fixed import fixed

CAMERA_MATRIX = np.array([[1000.0, 0, 400], [0, 1000, 300], [0, 0, 1]])
LENS = np.array([-0.12, 0.05, 0.001, -0.0005, 0.0])
SMALL = BoardCamera(CAMERA_MATRIX, (800, 600))
BENT = BoardCamera(CAMERA_MATRIX, (800, 600), LENS)
POSE = Transform("base", "flange", np.eye(4))

CHARUCO = Board("charuco", 7, 5, 0.03, 0.022)
CHECKER = Board("checkerboard", 8, 5, 0.025)
MARKER = Board("marker", 1, 1, 0.08, 0.0, "APRILTAG_36h11", 3)
CIRCLES = Board("circles", 4, 11, 0.016, 0.014)
OF_CHARUCO = CharucoParams(columns=7, rows=5, square=SI(0.03), marker=SI(0.022))
OF_CHECKER = CheckerboardParams(columns=8, rows=5, square=SI(0.025))
OF_MARKER = MarkerParams(size=SI(0.08), dictionary="APRILTAG_36h11", id=3)
OF_CIRCLES = CirclesParams(columns=4, rows=11, spacing=SI(0.016), diameter=SI(0.014))
FITS = {
    "charuco": (CHARUCO, fit_charuco, OF_CHARUCO),
    "checkerboard": (CHECKER, fit_checkerboard, OF_CHECKER),
    "circles": (CIRCLES, fit_circles, OF_CIRCLES),
    "marker": (MARKER, fit_aruco, OF_MARKER),
}


def looking(tilt=0.4, about=(0.8, 0.6, 0.0), yaw=0.2, distance=0.5):
    """Return ``camera_T_target`` of a board that faces the camera, then tilted."""
    facing = np.diag([1.0, -1.0, -1.0]) @ rotation_exp(np.array([0, 0, yaw]))
    turned = facing @ rotation_exp(tilt * np.array(about))
    return rigid(turned, np.array([0.01, -0.006, distance]))


def capture(board, pose, camera=SMALL, depth=False, seed=0):
    rng = np.random.default_rng(seed)
    cloud = scan_board(board, pose, camera, rng) if depth else PointCloud(CAMERA, np.zeros((0, 3)))
    return Capture("0", cloud, by_frame(POSE), image=render_board(board, pose, camera, rng))


def error(feature, pose):
    found = feature.camera_T_target.matrix
    turn = rotation_log(found[:3, :3] @ pose[:3, :3].T)
    return np.concatenate([turn, found[:3, 3] - pose[:3, 3]])


@pytest.mark.parametrize("depth", [False, True])
@pytest.mark.parametrize("camera", [SMALL, BENT])
@pytest.mark.parametrize("kind", FITS)
def test_a_tilted_target_is_found_where_it_is(kind: str, camera: Any, depth: bool) -> None:
    board, fit, params = FITS[kind]
    pose = looking()
    feature = fit(capture(board, pose, camera, depth), params)
    off = error(feature, pose)
    assert np.degrees(np.linalg.norm(off[:3])) < 0.15
    assert np.linalg.norm(off[3:]) < 0.25e-3
    assert off @ np.linalg.solve(feature.covariance, off) < 22.5  # chi-square, 6, 99.9 %


@pytest.mark.parametrize("yaw", np.arange(0, 360, 72.0))
@pytest.mark.parametrize("kind", FITS)
def test_no_target_is_taken_for_itself_upside_down(kind: str, yaw: Any) -> None:
    board, fit, params = FITS[kind]
    pose = looking(yaw=np.radians(yaw))
    feature = fit(capture(board, pose), params)
    assert np.degrees(np.linalg.norm(error(feature, pose)[:3])) < 0.3


def test_the_axes_are_right_up_and_towards_the_camera() -> None:
    feature = fit_charuco(capture(CHARUCO, looking(tilt=0.0, yaw=0.0)), OF_CHARUCO)
    assert np.allclose(feature.camera_T_target.rotation, np.diag([1, -1, -1]), atol=5e-3)


def test_a_markers_sides_are_not_taken_for_straight_where_the_lens_bends_them() -> None:
    camera = BoardCamera(CAMERA_MATRIX, (800, 600), np.array([-0.2, 0.0, 0.0, 0.0]), noise=0.5)
    pose = looking(0.5)
    pose[:3, 3] = [0.1, 0.07, 0.5]  # a side is bent by half a pixel out there
    off = error(fit_aruco(capture(MARKER, pose, camera), OF_MARKER), pose)
    assert np.linalg.norm(off[3:]) < 0.08e-3
    assert np.degrees(np.linalg.norm(off[:3])) < 0.1


def test_a_checkerboard_is_not_taken_one_square_beside_itself() -> None:
    """Where a side is covered, the sheet about the board can stand in for its outer squares."""
    matrix = np.array([[1400.0, 0, 639.5], [0, 1400, 511.5], [0, 0, 1]])
    lens = np.array([-0.12, 0.08, 0.0005, -0.0003, 0.0])
    camera = BoardCamera(matrix, (1280, 1024), lens, shade=0.4)
    turn = np.array(
        [[0.978590, 0.194829, -0.066359], [0.195266, -0.980750, 0.000093],
         [-0.065063, -0.013048, -0.997796]]
    )  # fmt: skip
    pose = rigid(turn, np.array([-0.06487, -0.097677, 0.674374]))
    cover = Cover(1.67357, 0.026487)
    for seed in range(3):
        image = render_board(CHECKER, pose, camera, np.random.default_rng(seed), cover)
        nothing = PointCloud(CAMERA, np.zeros((0, 3)))
        found = fit_checkerboard(Capture("0", nothing, by_frame(POSE), image=image), OF_CHECKER)
        assert isinstance(found, Rejected)


def test_the_corners_come_with_what_the_pose_misses() -> None:
    feature = fit_charuco(capture(CHARUCO, looking()), OF_CHARUCO)
    assert feature.corners.shape == (24, 4)
    assert np.sqrt((feature.corners[:, 2:] ** 2).mean()) == feature.figures["reprojection_px"]
    assert feature.figures["reprojection_px"] < 0.1


def test_a_small_marker_seen_frontally_has_two_poses_and_is_set_aside() -> None:
    small = Board("marker", 1, 1, 0.02, 0.0, "APRILTAG_36h11", 3)
    params = OF_MARKER.model_copy(update={"size": 0.02})
    rejected = [
        fit_aruco(capture(small, looking(tilt=0.12, distance=0.6), seed=seed), params)
        for seed in range(4)
    ]
    assert all(isinstance(each, Rejected) for each in rejected)
    assert "fit the corners alike" in rejected[0].reason
    assert "tilt it by 15 deg and more" in rejected[0].reason


def test_depth_decides_between_the_two_poses() -> None:
    small = Board("marker", 1, 1, 0.02, 0.0, "APRILTAG_36h11", 3)
    params = OF_MARKER.model_copy(update={"size": 0.02})
    pose = looking(tilt=0.12, distance=0.6)
    feature = fit_aruco(capture(small, pose, depth=True), params)
    assert np.degrees(np.linalg.norm(error(feature, pose)[:3])) < 1.0


def test_the_better_of_image_and_depth_is_taken() -> None:
    """A marker's tilt is known well from depth only; of a good board the image is as good."""
    assert fit_aruco(capture(MARKER, looking(0.05), depth=True), OF_MARKER).figures["by_depth"] == 1
    coarse = BoardCamera(CAMERA_MATRIX, (800, 600), depth_noise=3e-3)
    by_image = fit_charuco(capture(CHARUCO, looking(), coarse, depth=True), OF_CHARUCO)
    assert by_image.figures["by_depth"] == 0


@pytest.mark.parametrize("kind", FITS)
def test_a_print_in_another_size_is_named_by_depth(kind: str) -> None:
    board, fit, params = FITS[kind]
    field = {"marker": "size", "circles": "spacing"}.get(kind, "square")
    said = params.model_copy(update={field: getattr(params, field) / 1.03})
    rejected = fit(capture(board, looking(), depth=True), said)
    assert isinstance(rejected, Rejected)
    told = re.fullmatch(
        r"by the scanner's depth the target has ([\d.]+) times the recipe's size: "
        r"([\d.]+) mm is ([\d.]+) mm; measure the print",
        rejected.reason,
    )
    assert told
    scale, stated, measured = map(float, told.groups())
    assert scale == pytest.approx(1.03, abs=5e-3)
    assert stated == pytest.approx(1e3 * getattr(said, field), rel=1e-3)
    assert measured == pytest.approx(scale * stated, rel=1e-3)


def blank():
    image = Image(np.full((600, 800), 90, np.uint8), CAMERA_MATRIX)
    return Capture("0", PointCloud(CAMERA, np.zeros((0, 3))), by_frame(POSE), image=image)


@pytest.mark.parametrize(
    ("kind", "reason"),
    [
        ("charuco", "0 corners of the ChArUco board found, at least 6 are needed (0 of its "
         "markers were)"),
        ("checkerboard", "no checkerboard of 8 x 5 squares found"),
        ("marker", "marker 3 found 0 times, once is needed (found: none)"),
    ],
)  # fmt: skip
def test_nothing_to_be_seen_is_said(kind: str, reason: str) -> None:
    _, fit, params = FITS[kind]
    assert fit(blank(), params).reason == reason


@pytest.mark.parametrize(
    ("kind", "family", "told"),
    [
        ("charuco", "5X5_100", "(0 of its markers were; 17 of 5X5_250 are seen: write "
         "dictionary: 5X5_250)"),
        ("marker", "6X6_50", "(found: none; 1 of 6X6_250 are seen: write dictionary: 6X6_250)"),
    ],
)  # fmt: skip
def test_markers_of_another_family_are_named(kind: str, family: str, told: str) -> None:
    board, fit, params = FITS[kind]
    printed = capture(replace(board, dictionary=family), looking())
    assert fit(printed, params).reason.endswith(told)
    written = params.model_copy(update={"dictionary": told[-8:-1]})
    assert not isinstance(fit(printed, written), Rejected)


def test_a_charuco_board_of_another_size_is_told_by_its_markers() -> None:
    board, fit, params = FITS["charuco"]
    printed = capture(board, looking())
    larger = params.model_copy(update={"columns": board.columns + 3, "rows": board.rows + 2})
    last = (board.columns + 3) * (board.rows + 2) // 2 - 1
    assert (
        f"squares has 0 to {last}; count the squares of the print)" in fit(printed, larger).reason
    )


@pytest.mark.parametrize(
    ("board", "fit"),
    [
        (CHARUCO, "charuco: {columns: 7, rows: 5, dictionary: 4X4_250}"),
        (Board("charuco", 6, 8, 0.02, 0.014, "5X5_100"),
         "charuco: {columns: 6, rows: 8, dictionary: 5X5_250}"),
        (CHECKER, "checkerboard: {columns: 8, rows: 5}"),
        (MARKER, "aruco: {id: 3, dictionary: APRILTAG_36h11}"),
    ],
)  # fmt: skip
def test_an_image_shows_its_board_up_to_its_lengths(board: Board, fit: str) -> None:
    seen = board_seen(capture(board, looking()).image.pixels)
    assert seen is not None
    assert seen.fit == fit


def test_a_board_as_opencv_printed_it_before_4_6_is_found() -> None:
    import cv2

    old = charuco_of(Board("charuco", 8, 6, 0.03, 0.022))
    old.setLegacyPattern(True)
    page = np.full((800, 1000), 255, np.uint8)
    page[100:700, 100:900] = old.generateImage((800, 600), marginSize=0)
    seen = Capture("0", PointCloud(CAMERA, np.zeros((0, 3))), by_frame(POSE), image=Image(
        np.asarray(cv2.GaussianBlur(page, (5, 5), 0), np.uint8), np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]])
    ))  # fmt: skip
    found = fit_charuco(seen, OF_CHARUCO.model_copy(update={"columns": 8, "rows": 6}))
    assert np.allclose(found.camera_T_target.translation, [0, 0, 0.3], atol=1e-3)


def test_a_family_may_be_written_in_small_letters() -> None:
    assert MarkerParams(size=SI(0.02), dictionary="5x5_100").dictionary == "5X5_100"
    assert MarkerParams(size=SI(0.02), dictionary="apriltag_36H11").dictionary == "APRILTAG_36h11"


def test_a_capture_without_an_image_is_set_aside() -> None:
    nothing = Capture("0", PointCloud(CAMERA, np.zeros((0, 3))), by_frame(POSE))
    assert fit_charuco(nothing, OF_CHARUCO).reason.startswith("there is no image")


def test_depth_only_needs_depth() -> None:
    params = OF_CHARUCO.model_copy(update={"depth": "only"})
    reason = fit_charuco(capture(CHARUCO, looking()), params).reason
    assert reason == "the cloud has no depth at the corners; it must be organised as the image"


def test_a_wrong_camera_matrix_is_told_by_the_corners() -> None:
    seen = capture(CHARUCO, looking(0.7, distance=0.35))
    wrong = CAMERA_MATRIX * [[1.5, 1, 1], [1, 0.7, 1], [1, 1, 1]]
    rejected = fit_charuco(
        Capture("0", seen.cloud, by_frame(POSE), image=Image(seen.image.pixels, wrong)), OF_CHARUCO
    )
    assert "is the camera's matrix right" in rejected.reason


@pytest.mark.parametrize(
    ("model", "values", "message"),
    [
        (CheckerboardParams, {"columns": 8, "rows": 6, "square": SI(0.02)},
         "a board of 8 x 6 squares looks the same after half a turn; use one with an odd and an "
         "even number of squares, or a ChArUco board"),
        (CharucoParams, {"columns": 7, "rows": 5, "square": SI(0.02), "marker": SI(0.02)},
         "the markers of a ChArUco board are smaller than its squares"),
        (MarkerParams, {"size": SI(0.02), "dictionary": "4X4_51"}, "no dictionary '4X4_51'; known:"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_with_the_recipe(
    model: Any, values: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValidationError) as error:
        model.model_validate(values)
    assert message in str(error.value)


def test_the_first_square_of_a_checkerboard_is_black() -> None:
    printed = print_of(CHECKER, 10)
    assert printed.shape == (50, 80)
    assert (printed[:10, :10] == 0).all()
    assert (printed[:10, 10:20] == 255).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", FITS)
def test_the_stated_covariance_holds_its_share(kind: str) -> None:
    board, fit, params = FITS[kind]
    rng = np.random.default_rng(7)
    inside = []
    for seed in range(30):
        angle = rng.uniform(0, 2 * np.pi)
        pose = looking(rng.uniform(0.3, 0.7), (np.cos(angle), np.sin(angle), 0), rng.uniform(-3, 3))
        feature = fit(capture(board, pose, seed=seed), params)
        off = error(feature, pose)
        inside.append(off @ np.linalg.solve(feature.covariance, off) < 12.6)  # 95 %
    assert np.mean(inside) > 0.8


def test_a_grid_of_circles_that_is_symmetric_or_partly_seen_is_refused() -> None:
    with pytest.raises(ValidationError, match="10 rows looks the same after half a turn"):
        CirclesParams(columns=4, rows=10, spacing=SI(0.016), diameter=SI(0.014))
    pose = looking()
    pose[0, 3] += 0.2
    told = fit_circles(capture(CIRCLES, pose), OF_CIRCLES)
    assert told.reason == "no grid of 11 rows of 4 circles found; all of it must be seen"


def test_a_depth_that_has_too_few_corners_is_as_none() -> None:
    seen = capture(MARKER, looking(), depth=True)
    holes = seen.cloud.xyz.copy()
    holes[:, :400] = np.nan  # two of the four corners
    params = OF_MARKER.model_copy(update={"depth": "only"})
    half = Capture("0", PointCloud(CAMERA, holes), by_frame(POSE), image=seen.image)
    assert fit_aruco(half, params).reason.startswith("the cloud has no depth at the corners")
    assert fit_aruco(seen, params).figures["by_depth"] == 1


def test_a_scanners_distortion_turns_a_small_target_more() -> None:
    """What is added by depth: the error in each direction, and over the target's size as a turn."""
    seen = capture(CHARUCO, looking(), depth=True)
    plain, more = (
        fit_charuco(
            seen, OF_CHARUCO.model_copy(update={"depth": "only", "scanner_error": error})
        ).covariance
        for error in (0.0, 1e-3)
    )
    size = np.hypot(5 * 0.03, 3 * 0.03)  # of the corners inside
    expected = 1e-6 * np.diag([size**-2] * 3 + [1.0] * 3)
    assert more - plain == pytest.approx(expected, rel=1e-6, abs=1e-12)


@pytest.mark.parametrize(
    ("model", "given", "name", "refused", "taken"),
    [
        (CharucoParams, {"rows": 5, "square": "30 mm", "marker": "20 mm"}, "columns", 2, 3),
        (CharucoParams, {"columns": 5, "square": "30 mm", "marker": "20 mm"}, "rows", 2, 3),
        (CharucoParams, {"columns": 5, "rows": 5, "square": "9 mm"}, "marker", "0 mm", "1 um"),
        (CharucoParams, {"columns": 5, "rows": 5, "marker": "9 mm"}, "square", "0 mm", "9.1 mm"),
        (CheckerboardParams, {"rows": 5, "square": "30 mm"}, "columns", 3, 4),
        (CheckerboardParams, {"columns": 5, "square": "30 mm"}, "rows", 3, 4),
        (CheckerboardParams, {"columns": 6, "rows": 5}, "square", "0 mm", "1 um"),
        (CirclesParams, {"rows": 5, "spacing": "9 mm", "diameter": "9 mm"}, "columns", 1, 2),
        (CirclesParams, {"columns": 5, "spacing": "9 mm", "diameter": "9 mm"}, "rows", 1, 3),
        (CirclesParams, {"columns": 5, "rows": 5, "diameter": "9 mm"}, "spacing", "0 mm", "1 um"),
        (CirclesParams, {"columns": 5, "rows": 5, "spacing": "9 mm"}, "diameter", "0 mm", "1 um"),
        (MarkerParams, {"size": "9 mm"}, "id", -1, 0),
        (MarkerParams, {}, "size", "0 mm", "1 um"),
        (MarkerParams, {"size": "9 mm"}, "scanner_error", "-1 um", "0 mm"),
    ],
)  # fmt: skip
def test_a_parameter_has_its_bounds(
    model: Any, given: dict[str, Any], name: str, refused: Any, taken: Any
) -> None:
    check_bound(model, name, refused, taken, given)


def pose_of(tilt: float, misfit: float) -> PlanarPose:
    return PlanarPose(looking(tilt), np.eye(6), 0.1, misfit)


@pytest.mark.parametrize(
    ("tilt", "misfit", "said"),
    [
        (0.2, 0.02, "two poses 11.5 deg apart fit the corners alike (likelihoods 1 : 2.72): "),
        (0.2, 0.135, "two poses 11.5 deg apart fit the corners alike (likelihoods 1 : 854): "),
        (0.2, 0.14, None),  # 1,097 times likelier
        (1e-3, 0.0, None),  # the same pose
    ],
)
def test_two_poses_are_told_apart_if_one_is_a_thousand_times_likelier(
    tilt: float, misfit: float, said: str | None
) -> None:
    told = ambiguity([pose_of(0.0, 0.0), pose_of(tilt, misfit)])
    assert (told and told.reason[: len(said or "")]) == said
    assert ambiguity([pose_of(0.0, 0.0)]) is None


def test_a_thousand_times_likelier_is_not_yet_certain() -> None:
    best = pose_of(0.0, 0.0)._replace(noise=1.0)
    other = pose_of(0.2, 2 * float(np.log(1000)))
    assert ambiguity([best, other]) is not None
    assert ambiguity([best, other._replace(misfit=2.001 * float(np.log(1000)))]) is None


GRID = np.stack([*np.meshgrid(np.arange(6.0), np.arange(4.0)), np.zeros((4, 6))], -1)
POINTS: Floats = 0.03 * (GRID.reshape(-1, 3) - GRID.mean(axis=(0, 1)))


def project(points, pose):
    seen = (points @ pose[:3, :3].T + pose[:3, 3]) @ CAMERA_MATRIX.T
    return seen[:, :2] / seen[:, 2:]


def known_corners(monkeypatch, pixels, pose, *, larger=1.0, rough=0.0):
    """Return a capture in which such corners are found, on a sheet scanned by depth.

    The scanner has it larger than it is, and so rough [m].
    """
    monkeypatch.setattr(boards, "find_corners", lambda board, image: Corners(pixels, POINTS))
    v, u = np.indices((600, 800))
    rays = np.stack([u, v, np.ones(u.shape)], -1) @ np.linalg.inv(CAMERA_MATRIX).T
    depth = (pose[:3, 2] @ pose[:3, 3]) / (rays @ pose[:3, 2])
    depth = larger * (depth + rough * np.random.default_rng(0).standard_normal(depth.shape))
    image = Image(np.zeros((600, 800), np.uint8), CAMERA_MATRIX)
    return Capture("0", PointCloud(CAMERA, rays * depth[..., None]), by_frame(POSE), image=image)


def test_large_discs_seen_from_near_are_found_at_their_centres(monkeypatch: Any) -> None:
    """The middles of their images lie up to half a pixel beside those of their centres."""
    radius, angle = 0.013, np.linspace(0, 2 * np.pi, 2000, endpoint=False)
    rim = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    pose, middles = looking(0.6, distance=0.25), []
    for point in POINTS:
        x, y = project(point + rim, pose).T
        area = x * np.roll(y, -1) - np.roll(x, -1) * y  # the centroid of a polygon
        middles.append([((c + np.roll(c, -1)) * area).sum() / (3 * area.sum()) for c in (x, y)])
    assert np.abs(middles - project(POINTS, pose)).max() > 0.5
    seen = known_corners(monkeypatch, np.array(middles), pose)
    params = OF_CIRCLES.model_copy(update={"diameter": 2 * radius, "depth": "off"})
    assert np.abs(error(fit_circles(seen, params), pose)).max() < 2e-5


@pytest.mark.parametrize(
    ("depth", "pixels", "rough", "by_depth"),
    [
        ("auto", 0.5, 1e-5, 1), ("auto", 0.01, 3e-3, 0), ("off", 0.5, 1e-5, 0),
        ("only", 0.01, 3e-3, 1),
    ],
)  # fmt: skip
def test_depth_is_taken_where_it_is_better_never_or_always(
    monkeypatch: Any, depth: str, pixels: float, rough: float, by_depth: float
) -> None:
    pose = looking()
    noise = pixels * np.random.default_rng(1).standard_normal((len(POINTS), 2))
    seen = known_corners(monkeypatch, project(POINTS, pose) + noise, pose, rough=rough)
    update = {"depth": depth, "corner_noise": pixels, "scanner_error": SI(0)}
    found = fit_charuco(
        seen, fixed(CharucoParams, **{**OF_CHARUCO.model_dump(mode="json"), **update})
    )
    assert found.figures["by_depth"] == by_depth
    assert found.figures["corners"] == len(POINTS)


@pytest.mark.parametrize(
    ("larger", "rough", "refused"),
    [
        (1.0048, 0.0, False), (1.0052, 0.0, True), (0.9948, 0.0, True),
        (1.006, 8e-3, False), (1.015, 8e-3, True),
    ],
)  # fmt: skip
def test_a_size_is_wrong_by_more_than_half_a_percent_and_more_than_it_scatters(
    monkeypatch: Any, larger: float, rough: float, refused: bool
) -> None:
    pose = looking()
    seen = known_corners(monkeypatch, project(POINTS, pose), pose, larger=larger, rough=rough)
    found = fit_charuco(seen, OF_CHARUCO.model_copy(update={"depth": "only"}))
    assert isinstance(found, Rejected) == refused
