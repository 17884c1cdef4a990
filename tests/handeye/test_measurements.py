"""Measurements of the loop: which numbers were measured, and what is left out of them."""

from __future__ import annotations

import numpy as np

from flangeye.handeye.measurements import Measurements


def some() -> Measurements:
    """A pose, three centres with normals, and a bare centre."""
    freedoms = np.array([6.0, 5.0, 5.0, 5.0, 3.0])
    projectors = np.tile(np.eye(6), (5, 1, 1))
    projectors[1:4, 2, 2] = 0.0
    projectors[4, :3, :3] = 0.0
    still, rng = np.tile(np.eye(4), (5, 1, 1)), np.random.default_rng(0)
    return Measurements(
        rotations=np.tile(np.eye(3), (5, 1, 1)),
        centres=rng.normal(size=(5, 3)),
        covariances=np.tile(1e-6 * np.eye(6), (5, 1, 1)),
        projectors=projectors,
        freedoms=freedoms,
        a=still,
        b=still,
        offsets=np.zeros((5, 3)),
    )


def test_a_normal_that_is_left_out_leaves_its_centre_and_no_pose_is_touched() -> None:
    given = some()
    left = given.without_normals(np.array([True, True, False, False, True]))
    assert left.freedoms.tolist() == [6.0, 3.0, 5.0, 5.0, 3.0]
    assert left.has_normal.tolist() == [False, False, True, True, False]
    assert [np.trace(p) for p in left.projectors] == [6.0, 3.0, 5.0, 5.0, 3.0]
    assert not left.projectors[1, :3].any() and not left.projectors[1, :, :3].any()
    assert np.array_equal(left.projectors[1, 3:, 3:], np.eye(3))
    assert given.freedoms.tolist() == [6.0, 5.0, 5.0, 5.0, 3.0]
    assert [np.trace(p) for p in given.projectors] == [6.0, 5.0, 5.0, 5.0, 3.0]


def test_measurements_are_poses_or_have_normals_where_all_do() -> None:
    given = some()
    assert given.where(np.array([0])).are_poses and not given.where(np.array([0, 1])).are_poses
    assert given.where(np.arange(4)).have_normals and not given.have_normals


def test_a_mirrored_scanner_sees_z_the_other_way() -> None:
    given = some()
    other = given.mirrored()
    assert np.array_equal(other.centres, given.centres * [1, 1, -1])
    seen = given.rotations @ np.array([0.3, -0.2, 0.5]) + given.centres
    mirrored = other.rotations @ np.array([0.3, -0.2, -0.5]) + other.centres
    assert np.allclose(mirrored, seen * [1, 1, -1])
