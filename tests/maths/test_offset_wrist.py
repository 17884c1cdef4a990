"""The search over joint 6 against what many starting points find."""

from typing import Any

import numpy as np
import pytest

from flangeye.maths.kinematics import Arm
from flangeye.maths.offset_wrist import offset_wrist
from flangeye.models.loading import load_model

ARMS = ("abb-gofa-crb15000-5", "fanuc-crx10ial", "ufactory-xarm6", "yaskawa-hc10")


def postures(arm: Arm, count: int, seed: int) -> Any:
    low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    shares = np.random.default_rng(seed).uniform(0.02, 0.98, (count, arm.n))
    return low + shares * (high - low)


def missed(found: Any, wanted: Any) -> int:
    """Return how many of (K, 6) wanted joints are not among the found ones."""
    turns = np.sin((found[:, None] - wanted) / 2)
    return int((np.abs(turns).max(axis=-1).min(axis=0, initial=1.0) > 1e-4).sum())


@pytest.mark.parametrize("name", ARMS)
def test_it_finds_what_many_starts_find(name: str) -> None:
    arm = Arm(load_model("robots", name))
    for joints in postures(arm, 6, 7):
        pose = arm.flange(joints)
        found = arm.inverse(pose)
        assert np.abs(arm.flange(found) - pose).max() < 2e-9
        assert ((found >= arm.lower) & (found <= arm.upper)).all()
        assert missed(found, arm.inverse_near(pose, arm._starting_points(100))) == 0


@pytest.mark.parametrize("name", ARMS)
def test_the_posture_a_pose_was_made_of_is_among_its_solutions(name: str) -> None:
    arm = Arm(load_model("robots", name))
    lost = [missed(arm.inverse(arm.flange(q)), q[None]) for q in postures(arm, 150, 8)]
    assert sum(lost) == 0


def test_a_wrist_that_is_spherical_is_solved_too() -> None:
    arm = Arm(load_model("robots", "kuka-kr6-r900"))
    search = offset_wrist(*arm.axes(np.zeros(6)), arm.flange(np.zeros(6)))
    assert search is not None
    for joints in postures(arm, 20, 9):
        pose = arm.flange(joints)
        assert missed(arm.inverse_near(pose, search(pose)), arm.inverse(pose)) == 0


def test_a_calibrated_arm_starts_from_the_nominal_one() -> None:
    nominal = Arm(load_model("robots", "fanuc-crx10ial"))
    off = np.random.default_rng(1).normal(0.0, 2e-4, (6, 3))
    arm = nominal.perturbed(off)
    for joints in postures(arm, 20, 10):
        found = arm.inverse(arm.flange(joints))
        assert np.abs(arm.flange(found) - arm.flange(joints)).max() < 2e-9
        assert missed(found, joints[None]) == 0


def test_a_pose_out_of_reach_has_no_solutions() -> None:
    arm = Arm(load_model("robots", "yaskawa-hc10"))
    far = np.eye(4)
    far[0, 3] = 5.0
    assert arm.inverse(far).shape == (0, 6)


def test_axes_that_stand_otherwise_are_not_searched() -> None:
    arm = Arm(load_model("robots", "ufactory-xarm6"))
    zero = np.zeros(6)
    directions, points = arm.axes(zero)
    apart = points.copy()
    apart[4, 1] += 0.1  # along y, as axis 5 runs
    assert offset_wrist(directions, apart, arm.flange(zero)) is not None
    apart[4, 0] += 0.05
    assert offset_wrist(directions, apart, arm.flange(zero)) is None
    skew = directions.copy()
    skew[2] = [0.0, 0.6, 0.8]
    assert offset_wrist(skew, points, arm.flange(zero)) is None
