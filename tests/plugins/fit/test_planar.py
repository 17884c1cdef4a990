"""The pose of a flat target from its corners: exact corners, and draws whose scatter is counted."""

import cv2
import numpy as np
import pytest

from flangeye.models.corners import Corners
from flangeye.types import CAMERA, Image, PointCloud
from flangeye.types.geometry import rigid, rotation_exp, rotation_log
from flangeye_plugins.fit.planar import (
    PlanarPose,
    middles_beside_centres,
    moved_by_camera,
    points_of,
    pose_from_points,
    poses_from_pixels,
    reprojection,
    scale_of,
)

MATRIX = np.array([[1000.0, 0, 400], [0, 1050, 300], [0, 0, 1]])
LENS = np.array([-0.12, 0.05, 0.001, -0.0005, 0.0])
KNOWN = np.zeros((0, 0))
POSE = rigid(np.diag([1.0, -1.0, -1.0]) @ rotation_exp([0.4, 0.3, 0.2]), [0.01, -0.006, 0.5])
GRID = np.stack([*np.meshgrid(np.arange(6), np.arange(4)), np.zeros((4, 6))], axis=-1).reshape(
    -1, 3
)
POINTS = 0.03 * (GRID - GRID.mean(axis=0))


def image(matrix=MATRIX, lens=LENS, covariance=KNOWN):
    return Image(np.zeros((600, 800), np.uint8), matrix, lens, covariance)


def project(points, pose=POSE, matrix=MATRIX, lens=LENS):
    turn = cv2.Rodrigues(pose[:3, :3])[0]
    return cv2.projectPoints(points, turn, pose[:3, 3], matrix, lens)[0].reshape(-1, 2)


def corners(pixels=None):
    return Corners(project(POINTS) if pixels is None else pixels, POINTS)


def between(found, pose=POSE):
    """Return the turn and the shift from one pose to another."""
    turn = rotation_log(found[:3, :3] @ pose[:3, :3].T)
    return np.concatenate([turn, found[:3, 3] - pose[:3, 3]])


def moved(pose, step):
    return rigid(rotation_exp(step[:3]) @ pose[:3, :3], pose[:3, 3] + step[3:])


def test_the_reprojections_derivative_is_its_slope() -> None:
    errors, jacobian = reprojection(corners(), image(), POSE)
    assert np.abs(errors).max() < 1e-9
    for k, step in enumerate(1e-7 * np.eye(6)):
        ahead, behind = (
            reprojection(corners(), image(), moved(POSE, s * step))[0] for s in (1, -1)
        )
        assert jacobian[:, k] == pytest.approx((ahead - behind) / 2e-7, rel=1e-4, abs=1e-2)


def test_exact_corners_give_the_exact_pose_and_the_noise_that_was_expected() -> None:
    best, *_ = poses_from_pixels(corners(), image(), 0.1)
    assert np.abs(between(best.matrix)).max() < 1e-9
    # Of 48 coordinates 6 are fitted; what is expected counts as 8 more.
    assert best.noise == pytest.approx(0.1 * np.sqrt(8 / (48 - 6 + 8)))


def test_two_poses_are_ordered_by_how_they_fit() -> None:
    rng = np.random.default_rng(0)
    flat = rigid(np.diag([1.0, -1.0, -1.0]) @ rotation_exp([0.1, 0.0, 0.0]), [0.0, 0.0, 2.0])
    seen = Corners(project(POINTS, flat) + 0.1 * rng.standard_normal((24, 2)), POINTS)
    poses = poses_from_pixels(seen, image(), 0.1)
    assert [p.misfit for p in poses] == sorted(p.misfit for p in poses)
    for pose in poses:
        errors = reprojection(seen, image(), pose.matrix)[0]
        assert pose.misfit == pytest.approx(errors @ errors)


def test_the_stated_covariance_is_that_of_the_poses() -> None:
    rng = np.random.default_rng(1)
    found, stated, noise = [], [], []
    for _ in range(150):
        seen = corners(project(POINTS) + 0.3 * rng.standard_normal((24, 2)))
        pose = poses_from_pixels(seen, image(), 0.3)[0]
        found.append(between(pose.matrix))
        stated.append(pose.covariance)
        noise.append(pose.noise)
    mean = np.mean(stated, axis=0)
    assert np.sqrt(np.diag(mean)) == pytest.approx(np.std(found, axis=0), rel=0.2)
    assert np.mean(noise) == pytest.approx(0.3, rel=0.05)


def test_what_shifts_all_corners_alike_shifts_the_pose_across_the_view() -> None:
    """However little corners scatter, 0.02 px of bias are left, and more of them far away."""
    for distance in (0.5, 1.0):
        pose = POSE.copy()
        pose[2, 3] = distance
        best, *_ = poses_from_pixels(corners(project(POINTS, pose)), image(), 1e-6)
        bias = (0.02 * distance / 1000) ** 2
        expected = np.diag([0, 0, 0, bias, bias, 0])
        assert best.covariance == pytest.approx(expected, abs=1e-3 * bias)


def test_the_error_at_a_point_is_of_shift_and_turn() -> None:
    exact = PlanarPose(POSE, np.zeros((6, 6)), 0.0, 0.0)
    blurred = exact.blurred(position=1e-4, angle=1e-3)
    there = np.array([[0.3, 0, 0], [0, -0.3, 0]])  # as far from the origin, whatever the turn
    shift, turn = 3 * 1e-4**2, 2 * (1e-3 * 0.3) ** 2
    assert blurred.error_at(np.zeros((1, 3))) == pytest.approx(np.sqrt(shift))
    assert blurred.error_at(there) == pytest.approx(np.sqrt(shift + turn))
    both = np.vstack([there[:1], np.zeros((1, 3))])
    assert blurred.error_at(both) == pytest.approx(np.sqrt(shift + turn / 2))


def test_a_cameras_error_moves_the_pose_as_another_camera_would() -> None:
    # fx, cx and cy [px]; fy and the lens are known exactly.
    sigma = np.array([2.0, 0.0, 1.5, 1.0, 0.0, 0.0, 0.0, 0.0])
    covariance = np.diag(sigma**2)
    columns = moved_by_camera(corners(), image(covariance=covariance), POSE)
    assert columns.shape == (6, 3)
    for entry, size in (((0, 0), 2.0), ((0, 2), 1.5), ((1, 2), 1.0)):
        other = MATRIX.copy()
        other[entry] += 1e-3 * size
        best, *_ = poses_from_pixels(corners(), image(other), 0.1)
        step = 1e3 * between(best.matrix)
        nearest = min(np.abs(columns * sign - step[:, None]).max(axis=0).min() for sign in (1, -1))
        assert nearest < 0.01 * np.abs(step).max()
    for exact in (KNOWN, np.zeros((8, 8))):
        assert moved_by_camera(corners(), image(covariance=exact), POSE).shape == (6, 0)


def test_the_middle_of_a_discs_image_lies_beside_that_of_its_centre() -> None:
    radius, angle = 0.012, np.linspace(0, 2 * np.pi, 4000, endpoint=False)
    rim = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    none = np.zeros(5)
    found = middles_beside_centres(corners(), image(lens=none), POSE, radius)
    for point, beside in zip(POINTS, found, strict=True):
        x, y = project(point + rim, lens=none).T
        area = x * np.roll(y, -1) - np.roll(x, -1) * y  # the centroid of a polygon
        middle = [((c + np.roll(c, -1)) * area).sum() / (3 * area.sum()) for c in (x, y)]
        assert beside == pytest.approx(middle - project(point[None], lens=none)[0], abs=1e-4)
    assert np.abs(found).max() > 0.05


def tilted(rows=40, columns=50):
    """Return an organised scan of a plane that is linear in the pixel, and where a pixel is."""
    origin, across, down = [0.1, 0.2, 0.5], np.array([1e-3, 0, 2e-4]), np.array([0, 1e-3, -3e-4])
    u, v = np.meshgrid(np.arange(columns), np.arange(rows))
    xyz = origin + u[..., None] * across + v[..., None] * down
    return xyz, lambda pixel: origin + pixel[0] * across + pixel[1] * down


def test_a_corner_between_pixels_is_where_the_surface_has_it() -> None:
    xyz, at = tilted()
    pixels = np.array([[3.0, 3.0], [20.3, 17.8], [46.4, 36.4], [2.4, 20.0], [20.0, 36.6]])
    found = points_of(Corners(pixels, np.zeros((5, 3))), PointCloud(CAMERA, xyz))
    for pixel, point in zip(pixels[:3], found[:3], strict=True):
        assert point == pytest.approx(at(pixel), abs=1e-6)
    assert np.isnan(found[3:]).all()  # their windows are cut off by the image's border


@pytest.mark.parametrize(("missing", "known"), [(19, True), (20, False)])
def test_of_its_window_six_tenths_have_to_be_seen(missing: int, known: bool) -> None:
    xyz, at = tilted()
    window = xyz[17:24, 7:14].reshape(-1, 3)  # of 49 points
    window[np.random.default_rng(0).permutation(49)[:missing]] = np.nan
    xyz[17:24, 7:14] = window.reshape(7, 7, 3)
    (found,) = points_of(
        Corners(np.array([[10.2, 19.9]]), np.zeros((1, 3))), PointCloud(CAMERA, xyz)
    )
    assert np.isfinite(found).all() == known
    if known:
        assert found == pytest.approx(at([10.2, 19.9]), abs=1e-6)


def test_measured_points_give_pose_and_size_with_the_scatter_they_have() -> None:
    rng = np.random.default_rng(2)
    placed = POINTS @ POSE[:3, :3].T + POSE[:3, 3]
    exact = pose_from_points(POINTS, placed)
    assert np.abs(between(exact.matrix)).max() < 1e-12
    found, stated, sizes, sigmas = [], [], [], []
    for _ in range(300):
        measured = placed + 1e-4 * rng.standard_normal((24, 3))
        pose = pose_from_points(POINTS, measured)
        found.append(between(pose.matrix))
        stated.append(pose.covariance)
        size, sigma = scale_of(POINTS, 1.02 * measured)
        sizes.append(size)
        sigmas.append(sigma)
    assert np.sqrt(np.diag(np.mean(stated, axis=0))) == pytest.approx(
        np.std(found, axis=0), rel=0.12
    )
    assert np.mean(sizes) == pytest.approx(1.02, abs=2e-4)
    assert np.mean(sigmas) == pytest.approx(np.std(sizes), rel=0.12)


def test_where_a_target_has_its_origin_does_not_change_its_size() -> None:
    measured = 1.02 * (POINTS @ POSE[:3, :3].T + POSE[:3, 3])
    assert scale_of(POINTS + [0.3, -0.2, 0.1], measured)[0] == pytest.approx(1.02, rel=1e-12)


def test_of_four_corners_scatter_and_error_of_the_size_are_unbiased() -> None:
    """Four corners have 12 numbers, a pose takes up 6 of them and the size a seventh."""
    few, rng = POINTS[[0, 5, 18, 23]], np.random.default_rng(0)
    draws = few + 1e-4 * rng.standard_normal((2000, 4, 3))
    noises = [pose_from_points(few, measured).noise for measured in draws]
    sizes, sigmas = np.array([scale_of(few, measured) for measured in draws]).T
    assert np.mean(np.square(noises)) == pytest.approx(1e-8, rel=0.05)
    assert np.mean(sigmas**2) == pytest.approx(np.var(sizes), rel=0.08)
