"""Poses drawn near a place: as many as asked for, as near as said, and no endless search."""

import numpy as np
import pytest

from flangeye.motion.reach import Site, poses_near, tilted
from flangeye.types.geometry import angle_between, rotation_from_rpy, rpy_from_rotation

PLACE = np.array([0.5, 0.1, 0.3])
FACING = rotation_from_rpy(np.pi, 0.0, 0.3)


def site(joints=lambda pose: np.zeros(6), facing=lambda place: FACING) -> Site:
    return Site(PLACE, np.array([0.5, 0.0, 1.0]), facing, joints)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


@pytest.mark.parametrize(("near", "tilt"), [(0.02, 0.2), (0.1, 0.05)])
def test_poses_fill_the_space_they_are_allowed_and_stay_in_it(near: float, tilt: float) -> None:
    poses = poses_near(PLACE, 200, site(), rng(), (near, tilt))
    assert len(poses) == 200
    away = np.array([pose.base_T_flange[:3, 3] - PLACE for pose in poses])
    turns = np.array([rpy_from_rotation(p.base_T_flange[:3, :3] @ FACING.T) for p in poses])
    for values, bound in ((away, near), (turns, tilt)):
        assert (np.abs(values) <= bound).all()
        assert (values.max(axis=0) > 0.9 * bound).all()
        assert (values.min(axis=0) < -0.9 * bound).all()


def test_poses_near_are_within_2_cm_and_0_2_rad_unless_said_otherwise() -> None:
    for pose in poses_near(PLACE, 100, site(), rng()):
        assert np.abs(pose.base_T_flange[:3, 3] - PLACE).max() <= 0.02
        assert np.abs(rpy_from_rotation(pose.base_T_flange[:3, :3] @ FACING.T)).max() <= 0.2


def test_where_the_arm_cannot_go_the_search_ends_after_fifty_trials_a_pose() -> None:
    tried: list[int] = []
    assert poses_near(PLACE, 3, site(lambda pose: tried.append(1)), rng()) == []
    assert len(tried) == 150


def test_as_many_are_found_as_the_arm_can_do_and_none_where_the_flange_cannot_be_shown() -> None:
    answers = iter([None, np.zeros(6), None, np.ones(6)])
    found = poses_near(PLACE, 2, site(lambda pose: next(answers)), rng())
    assert [pose.joints[0] for pose in found] == [0.0, 1.0]
    assert poses_near(PLACE, 2, site(facing=lambda place: None), rng()) == []


def test_a_flange_shows_its_face_unless_said_otherwise() -> None:
    assert site().shown().tolist() == [0.0, 0.0, 1.0]


def test_no_tilt_is_the_facing_itself() -> None:
    assert tilted(PLACE, FACING, 0.0, rng())[:3, :3] == pytest.approx(FACING)


def test_the_angle_of_two_vectors_does_not_depend_on_their_lengths() -> None:
    first = np.array([2.0, 0.0, 0.0])
    for angle in (0.0, 1e-9, 1.0, np.pi / 2, 3.0, np.pi):
        second = 5.0 * np.array([np.cos(angle), 0.0, np.sin(angle)])
        assert angle_between(first, second) == pytest.approx(angle, abs=1e-12)
