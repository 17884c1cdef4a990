"""estimation.ambiguity: poses that explain a scan alike, told apart by how the arm moved."""

import numpy as np
import pytest

from flangeye.estimation.start.ambiguity import ambiguous, disambiguated
from flangeye.models.cell import cell_of
from flangeye.models.configuration import ORIGIN, Configuration
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    TARGET,
    CircleFeature,
    Observation,
    PoseFeature,
    Transform,
)
from flangeye.types.geometry import invert, rigid, rotation_exp

HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])
CAMERA_PLACE = rigid(rotation_exp([2.0, 0.5, -1.0]), np.array([0.6, 0.1, 0.9]))
DEVIATIONS = np.r_[np.full(3, 3e-4), np.full(3, 1e-4)]


def turned(rng, axes=(1.0, 1.0, 1.0)):
    return rigid(rotation_exp(rng.normal(0, 0.4, 3) * axes), rng.normal(0, 0.1, 3) * axes)


def session(arm, seed=0, place=None, sure=0):
    """Captures of each of which the first pose, and then the second, is the true one in turn."""
    rng, out = np.random.default_rng(seed), []
    for k, pose in enumerate(arm):
        true = invert(CAMERA_PLACE) @ pose @ (np.eye(4) if place is None else place)
        both = [true] if k < sure else [true, true @ HALF_TURN][:: 1 - 2 * (k % 2)]
        noise = rng.normal(0, 1, 6) * DEVIATIONS
        reported = pose @ rigid(rotation_exp(rng.normal(0, 5e-4, 3)), rng.normal(0, 5e-4, 3))
        out.append([
            Observation(
                str(k),
                PoseFeature(
                    Transform(CAMERA, TARGET, rigid(
                        rotation_exp(noise[:3]) @ each[:3, :3], each[:3, 3] + noise[3:]
                    )),
                    np.diag(DEVIATIONS**2),
                ),
                {FLANGE: Transform(BASE, FLANGE, reported)},
            )
            for each in both
        ])  # fmt: skip
    return out


def told(captures, stands=ORIGIN, last=True):
    """Which pose is told of each capture that has several."""
    cell = cell_of(Configuration(stands=stands), None)
    sure = [poses[0] for poses in captures if len(poses) == 1]
    held = [poses for poses in captures if len(poses) > 1]
    found = disambiguated(cell, sure, held, last)
    return [one and poses.index(one) for poses, one in zip(held, found, strict=True)]


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("count", [2, 3, 8])
def test_captures_tell_each_other_apart_where_none_is_sure(count: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    arm = [turned(rng) for _ in range(count)]
    assert told(session(arm, seed)) == [k % 2 for k in range(count)]


def test_one_sure_capture_tells_all_others() -> None:
    rng = np.random.default_rng(1)
    arm = [turned(rng) for _ in range(4)]
    assert told(session(arm, sure=1)) == [1, 0, 1]
    assert told(session(arm, sure=1), last=False) == [1, 0, 1]


def test_a_capture_whose_arm_pose_is_wrong_does_not_mislead() -> None:
    rng = np.random.default_rng(2)
    arm = [turned(rng) for _ in range(6)]
    captures = session(arm)
    captures[2] = session([turned(rng) for _ in range(6)])[2]
    moved = {FLANGE: Transform(BASE, FLANGE, arm[2])}
    captures[2] = [Observation(o.id, o.feature, moved) for o in captures[2]]
    right = told(captures)
    assert [right[k] for k in (0, 1, 3, 4, 5)] == [0, 1, 1, 0, 1]


def test_an_arm_that_moves_about_their_axis_alone_does_not_tell_and_the_motion_is_named() -> None:
    rng = np.random.default_rng(3)
    arm = [turned(rng, (0, 0, 1)) for _ in range(6)]
    captures = session(arm)
    assert told(captures) == [None] * 6
    why = ambiguous(captures[0])
    assert "2 poses of the target explain the scan" in why.reason
    assert "180 deg apart about (" in why.figures
    assert "1.00) of the target" in why.figures
    assert "other axes" in why.fix


def test_nothing_is_told_of_one_capture() -> None:
    assert told(session([np.eye(4)])) == [None]


def test_where_the_place_is_to_be_found_the_only_capture_means_its_best_pose() -> None:
    assert told(session([np.eye(4)]), None) == [0]
    assert told([], None) == []


def test_where_the_place_is_to_be_found_all_captures_mean_the_same_pose() -> None:
    """Whether it is the true one or the other is the same to the camera."""
    rng = np.random.default_rng(4)
    arm = [turned(rng) for _ in range(6)]
    place = rigid(rotation_exp([0.3, -0.2, 1.0]), np.array([0.05, 0.0, 0.1]))
    captures = session(arm, place=place)
    assert told(captures, None, last=False) == [None] * 6
    assert told(captures, None) == [k % 2 for k in range(6)]
    assert told([poses[::-1] for poses in captures], None) == [k % 2 for k in range(6)]
    assert told(session(arm, place=place, sure=1), None) == [1, 0, 1, 0, 1]


def axes_of(captures):
    """The same captures of a rod: a point of its axis, and the axis, which may point either way."""
    upside_down = np.diag([1.0, -1.0, -1.0])
    out = []
    for k, (one, *_) in enumerate(captures):
        pose = one.feature.camera_T_target.matrix
        ends = [pose[:3, :3], pose[:3, :3] @ upside_down][:: 1 - 2 * (k % 2)]
        out.append([
            Observation(
                one.id,
                CircleFeature(
                    centre=pose[:3, 3] + 0.08 * pose[:3, 2],
                    normal=turn[:, 2],
                    radii={},
                    covariance=1e-8 * np.eye(3),
                    normal_covariance=1e-7 * (np.eye(3) - np.outer(turn[:, 2], turn[:, 2])),
                    arc_coverage=0.0,
                    centre_in_flange=np.array([0.0, 0.0, 0.08]),
                ),
                one.poses,
            )
            for turn in ends
        ])  # fmt: skip
    return out


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("count", [2, 3, 8])
def test_which_way_a_rod_points_is_told_by_what_the_arm_moves_along_it(
    count: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    arm = [turned(rng) for _ in range(count)]
    assert told(axes_of(session(arm, seed, sure=count))) == [k % 2 for k in range(count)]


def test_a_rod_that_is_only_turned_about_its_axis_and_moved_across_it_points_either_way() -> None:
    rng = np.random.default_rng(3)
    across = [turned(rng, (0, 0, 1)) for _ in range(6)]
    for pose in across:
        pose[:3, 3] = *rng.normal(0, 0.1, 2), 0.0
    captures = axes_of(session(across, sure=6))
    assert told(captures) == [None] * 6
    why = ambiguous(captures[0])
    assert why.figures == "its axis may point either way"
    assert "along its axis" in why.fix


def test_which_way_a_rod_points_is_not_told_where_its_place_is_to_be_found() -> None:
    rng = np.random.default_rng(4)
    arm = [turned(rng) for _ in range(6)]
    assert told(axes_of(session(arm, sure=6)), None, last=False) == [None] * 6
