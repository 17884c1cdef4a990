"""What is known of a cell's arm, and the same cell with a target of another size."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.handeye.observed import Cell
from tests.handeye.cells import CONFIGURATIONS, ROBOT, session

HAND, PLATE = CONFIGURATIONS["eye-in-hand, marker"], CONFIGURATIONS["eye-on-base, flange"]


def test_a_larger_target_is_as_much_farther_away_and_known_as_much_worse() -> None:
    """Turned as before; what a circle's fit says of its centre has nothing to do with it."""
    made = session(HAND, np.random.default_rng(0), 4)
    rows = 1e-4 * np.random.default_rng(1).normal(size=(6, 9))
    observations = [
        replace(o, feature=replace(o.feature, covariance=rows @ rows.T)) for o in made.observations
    ]
    cell = Cell(observations, HAND, None, delay=0.02)
    after = cell.resized(1.5)
    scale = np.diag([1.0, 1, 1, 1.5, 1.5, 1.5])
    for before, now in zip(observations, after.observations, strict=True):
        was, pose = before.feature.camera_T_target, now.feature.camera_T_target
        assert pose.translation == pytest.approx(1.5 * was.translation)
        assert pose.rotation == pytest.approx(was.rotation)
        assert (pose.parent, pose.child) == (was.parent, was.child)
        assert now.feature.covariance == pytest.approx(scale @ rows @ rows.T @ scale)
        assert now.poses is before.poses
    assert after.delay == 0.02
    circles = session(PLATE, np.random.default_rng(0), 4, feature="normal")
    plate = Cell(circles.observations, PLATE, None)
    assert list(plate.resized(2.0).observations) == circles.observations


def test_joints_are_those_reported_where_all_of_the_arms_are() -> None:
    made = session(HAND, np.random.default_rng(0), 4)
    joints = np.random.default_rng(1).normal(size=(4, 6))

    def flange(reported: Any, robot: Any = ROBOT) -> Any:
        observations = [
            replace(o, joints=None if j is None else np.asarray(j))
            for o, j in zip(made.observations, reported, strict=True)
        ]
        return Cell(observations, HAND, robot).flange

    whole = flange(joints)
    np.testing.assert_array_equal(whole.joints, joints)
    assert whole.carries_camera and whole.deviation == ROBOT.joint_accuracy
    np.testing.assert_array_equal(whole.poses, [o.base_T_flange.matrix for o in made.observations])
    assert flange([*joints[:3], None]).joints is None
    assert flange([*joints[:3], joints[3, :5]]).joints is None
    unknown = flange(joints, None)
    assert unknown.joints is None and unknown.kinematics is None and unknown.deviation == 0.0
    plate = Cell(session(PLATE, np.random.default_rng(0), 4).observations, PLATE, ROBOT).flange
    assert plate is not None and not plate.carries_camera
    link = CONFIGURATIONS["eye-on-arm 2, marker"]
    carried = session(link, np.random.default_rng(0), 4)
    assert Cell(carried.observations, link, ROBOT).flange is None
