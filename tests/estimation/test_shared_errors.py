"""A camera that was found by the board's views: its errors are the same at every pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from flangeye.errors import CalibrationRefused
from flangeye.maths.statistics import without_shared
from flangeye.models.configuration import Configuration
from flangeye.models.corners import Corners
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    TARGET,
    Floats,
    HandEye,
    Image,
    Observation,
    PoseFeature,
    Transform,
    by_frame,
)
from flangeye.types.geometry import invert, rigid, rotation_exp, rotation_log
from flangeye_plugins.acquire.images import camera_of
from flangeye_plugins.fit.planar import moved_by_camera, poses_from_pixels
from flangeye_plugins.verify.holdout import HoldoutParams, verify_holdout
from tests.estimation.cells import answer

MATRIX = np.array([[1400.0, 0, 639.5], [0, 1400, 511.5], [0, 0, 1]])
LENS = np.array([-0.12, 0.08, 0.0005, -0.0003])
SIZE = (1280, 1024)
GRID = np.stack(np.meshgrid(0.03 * np.arange(-2.5, 3), 0.03 * np.arange(-1.5, 2)), axis=-1)
POINTS = np.ascontiguousarray(np.insert(GRID.reshape(-1, 2), 2, 0.0, axis=1))
X = rigid(rotation_exp([0.1, 0.2, 1.5]), np.array([0.06, 0.0, 0.04]))
Z = rigid(rotation_exp([3.1, 0.1, 0.0]), np.array([-0.45, -0.1, 0.0]))
IN_HAND = Configuration("eye-in-hand", FLANGE, BASE, None)
NOISE = 0.1
"""Of a corner [px]."""
QUANTILE = 12.59
"""95 % of a chi-square of six numbers."""


def views(rng: np.random.Generator, count: int = 15) -> list[tuple[Floats, Floats]]:
    """Return camera_T_target and the corners' pixels of views that tilt as a hand does."""
    found = []
    for _ in range(count):
        tilt = rotation_exp([*rng.uniform(-0.45, 0.45, 2), rng.uniform(-0.6, 0.6)])
        place = rng.uniform([-0.1, -0.08, 0.45], [0.1, 0.08, 0.75])
        pose = rigid(tilt @ np.diag([1.0, -1.0, -1.0]), place)
        turn = rotation_log(pose[:3, :3])
        pixels = np.asarray(cv2.projectPoints(POINTS, turn, pose[:3, 3], MATRIX, LENS)[0])
        found.append((pose, pixels.reshape(-1, 2) + NOISE * rng.standard_normal((len(POINTS), 2))))
    return found


def session(seed: int, shares: bool = True) -> list[Observation]:
    """Return what a hand with a camera found by the same views sees of the board."""
    rng = np.random.default_rng(seed)
    seen = views(rng)
    corners = [Corners(pixels, POINTS) for _, pixels in seen]
    lens, _ = camera_of({str(i): c for i, c in enumerate(corners)}, SIZE, None)
    image = Image(np.zeros((2, 2), np.uint8), lens.matrix, lens.distortion, lens.covariance)
    return [
        observation(str(i), each, true, image, shares, rng)
        for i, (each, (true, _)) in enumerate(zip(corners, seen, strict=True))
    ]


def observation(
    name: str, corners: Corners, true: Floats, image: Image, shares: bool, rng: np.random.Generator
) -> Observation:
    pose = poses_from_pixels(corners, image, NOISE)[0]
    shared = moved_by_camera(corners, image, pose.matrix) if shares else np.zeros((6, 0))
    feature = PoseFeature(Transform(CAMERA, TARGET, pose.matrix), pose.covariance, shared=shared)
    flange = Z @ invert(true) @ invert(X)
    flange[:3, :3] = flange[:3, :3] @ rotation_exp(2e-4 * rng.standard_normal(3))
    flange[:3, 3] += 5e-5 * rng.standard_normal(3)
    return Observation(name, feature, by_frame(Transform(BASE, FLANGE, flange)))


def solved(observations: list[Observation], size_limit: float = 0.005) -> HandEye:
    return answer(observations, IN_HAND, None, size_limit=size_limit)


def distance(found: HandEye) -> float:
    """Return how far X is from the truth, squared, in what is stated."""
    estimate = found.camera
    told, about = estimate.transform.matrix, estimate.about
    turn = X[:3, :3] @ told[:3, :3].T
    error = np.r_[rotation_log(turn), turn @ (about - told[:3, 3]) + X[:3, 3] - about]
    return float(error @ np.linalg.solve(estimate.covariance, error))


def test_the_camera_s_own_error_is_in_the_region_that_is_stated() -> None:
    stated = [distance(solved(session(seed))) for seed in range(16)]
    assert np.mean(np.array(stated) < QUANTILE) >= 0.8
    assert 2.5 < np.median(stated) < 9.0  # 5.3 is right, 4.7 what 80 sessions give


def test_without_it_the_region_is_far_too_small() -> None:
    stated = [distance(solved(session(seed, shares=False), 0.05)) for seed in range(6)]
    assert np.median(stated) > 30


def longer_focal(share: float, known: bool, seed: int = 0) -> list[Observation]:
    """Return what is seen by a camera whose focal length is said to be longer than it is.

    Args:
        share: By how much.
        known: Whether it is said to be known as it is, or to be that uncertain.
        seed: Of the session.
    """
    rng = np.random.default_rng(seed)
    both = share * 1400 * np.array([1.0, 1, 0, 0, 0, 0, 0, 0])
    wrong = MATRIX * [[1 + share, 1, 1], [1, 1 + share, 1], [1, 1, 1]]
    image = Image(np.zeros((2, 2), np.uint8), wrong, LENS, np.outer(both, both))
    return [
        observation(str(i), Corners(pixels, POINTS), pose, image, not known, rng)
        for i, (pose, pixels) in enumerate(views(rng))
    ]


def test_a_focal_length_known_badly_is_corrected_by_the_arms_motion() -> None:
    off, found = (
        np.linalg.norm(
            solved(longer_focal(0.03, known), 0.1).camera.transform.translation - X[:3, 3]
        )
        for known in (True, False)
    )
    assert off > found
    assert found < 2e-3


def held_out(found: HandEye, keeps: bool) -> float:
    """Return the held-out error [m], with what the features share or, wrongly, without."""

    def again(some: Sequence[Observation]) -> HandEye:
        answer = replace(solved(list(some), 0.1), without=None)
        return answer if keeps else replace(answer, shared=np.zeros(0))

    found = replace(found, without=None)
    return verify_holdout(found, again, HoldoutParams(), configuration=IN_HAND).figures["rms"]


def test_poses_held_out_are_judged_by_the_camera_as_it_was_found() -> None:
    found = solved(longer_focal(0.03, known=False), 0.1)
    assert 0.8 < abs(float(found.shared[0])) < 1.2  # one standard deviation is what it is off by
    assert held_out(found, keeps=True) < 0.5e-3
    assert held_out(found, keeps=False) > 3e-3


def test_a_feature_without_what_all_share_is_where_a_right_camera_has_it() -> None:
    seen, right = (longer_focal(share, known=False)[0] for share in (0.01, 1e-9))
    cleaned = without_shared(seen, np.array([1.0])), without_shared(seen, np.array([-1.0]))
    before = np.linalg.norm(seen.feature.centre - right.feature.centre)
    after = min(np.linalg.norm(c.feature.centre - right.feature.centre) for c in cleaned)
    assert before > 4e-3
    assert after < 0.05 * before


def test_nothing_is_taken_from_a_feature_that_shares_nothing() -> None:
    alone = longer_focal(0.01, known=True)[0]
    assert without_shared(alone, np.array([1.0])) is alone


@pytest.mark.parametrize("share", [0.01, 0.03])
def test_a_focal_length_that_is_said_to_be_known_and_is_not_is_refused(share: float) -> None:
    with pytest.raises(CalibrationRefused, match="the camera's focal length is 0.9") as refused:
        solved(longer_focal(share, known=True))
    told, _, sigma = str(refused.value).split("length is ")[1].split()[:3]
    assert abs(float(told) - 1 / (1 + share)) < 5 * float(sigma) < 0.01


@pytest.mark.parametrize("seed", range(3))
def test_a_focal_length_that_is_right_is_not_refused(seed: int) -> None:
    assert distance(solved(longer_focal(0.0, known=True, seed=seed), 1e-4)) < 30


def test_what_the_camera_does_to_a_pose_is_what_another_camera_gives() -> None:
    rng = np.random.default_rng(3)
    _, pixels = views(rng, 1)[0]
    corners, step = Corners(pixels, POINTS), np.zeros(8)
    step[0] = 0.5  # fx [px]
    image = Image(np.zeros((2, 2), np.uint8), MATRIX, LENS, np.diag(step**2))
    pose = poses_from_pixels(corners, image, NOISE)[0].matrix
    other = Image(image.pixels, MATRIX + np.diag([0.5, 0, 0]), LENS)
    moved = poses_from_pixels(corners, other, NOISE)[0].matrix
    effect = moved_by_camera(corners, image, pose)
    (column,) = effect.T[np.abs(effect).max(axis=0) > 0]
    got = np.r_[rotation_log(moved[:3, :3] @ pose[:3, :3].T), moved[:3, 3] - pose[:3, 3]]
    assert np.abs(np.abs(column) - np.abs(got)).max() < 2e-6
