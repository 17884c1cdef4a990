"""The next best pose: it tells most, and needs fewer poses than a grid."""

import re

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye.motion.reach import Site
from flangeye.types.geometry import angle_between
from flangeye_plugins.plan import NextBestParams, next_best
from tests.plugins.fixed import fixed
from tools.study_next_best import compare

SAID = (
    r"expected error at the work from ([\d.]+) to ([\d.]+) mm rms, mostly in the (?:turn about|"
    r"shift along) base \(.*\)"
)
CENTRE, EYE = np.array([0.6, 0.0, 0.3]), np.array([0.6, 0.0, 1.0])


def site(joints=lambda pose: np.zeros(6), lost=frozenset):
    return Site(CENTRE, EYE, lambda centre: np.eye(3), joints, lost)


def planned(seed=0, place=None, **params):
    plan = next_best(place or site(), np.random.default_rng(seed), fixed(NextBestParams, **params))
    return [pose.base_T_flange for pose in plan.poses]


@given(seed=st.integers(0, 1000), count=st.integers(3, 8))
@settings(max_examples=15)
def test_poses_stay_in_the_region_and_face_the_scanner(seed: int, count: int) -> None:
    params = fixed(NextBestParams, count=count, candidates=50, facing="30 deg")
    poses = planned(seed, count=count, candidates=50, facing="30 deg")
    assert len(poses) == count
    for pose in poses:
        assert (np.abs(pose[:3, 3] - CENTRE) <= 0.5 * 1.6 * np.array(params.size) + 1e-9).all()
        assert angle_between(pose[:3, 2], EYE - pose[:3, 3]) <= params.facing


def test_it_goes_apart_rather_than_to_the_middle() -> None:
    places = np.array(planned(count=8))[:, :3, 3] - CENTRE
    assert np.linalg.norm(places[1:], axis=1).min() > 0.15
    spread = np.linalg.eigvalsh(places.T @ places / 8)
    assert spread[0] > 0.1**2  # in every direction


def test_the_same_seed_gives_the_same_poses() -> None:
    assert np.array(planned(3)).tolist() == np.array(planned(3)).tolist()


def test_a_pose_that_told_nothing_is_made_up_for() -> None:
    lost: set[int] = set()
    place = site(lost=lambda: lost)
    plan = next_best(place, np.random.default_rng(0), fixed(NextBestParams, count=6))
    poses = []
    for index, pose in enumerate(plan.poses):
        poses.append(pose.base_T_flange[:3, 3])
        if index < 3:
            lost.add(index)  # all that were visited: it still knows nothing
    apart = np.linalg.norm(np.array(poses[3:]) - np.array(poses[0]), axis=1)
    assert apart.min() < 0.15  # it goes back to where it would tell most


def test_what_the_arm_cannot_reach_is_passed_over() -> None:
    poses = planned(place=site(joints=lambda pose: None if pose[0, 3] > 0.6 else np.zeros(6)))
    assert (np.array(poses)[:, 0, 3] <= 0.6).all()
    assert planned(place=site(joints=lambda pose: None)) == []


@pytest.mark.slow
def test_it_needs_at_most_three_quarters_of_the_grids_poses() -> None:
    pairs = [compare(seed) for seed in (1, 3)]
    assert sum(found.poses for _, found in pairs) <= 0.75 * sum(w.poses for w, _ in pairs)


def test_a_pose_says_what_it_promises_and_what_it_tells_most_of() -> None:
    plan = next_best(
        site(), np.random.default_rng(0), fixed(NextBestParams, count=6, candidates=50)
    )
    said = [re.fullmatch(SAID, pose.why) for pose in plan.poses]
    before, after = (np.array([float(s[i]) for s in said if s]) for i in (1, 2))
    assert len(before) == 6
    assert (after < before).all()
    np.testing.assert_allclose(before[1:], after[:-1])  # nothing was lost between


def test_a_pose_that_was_lost_is_not_counted_in_what_the_next_promises() -> None:
    lost: set[int] = set()
    plan = next_best(
        site(lost=lambda: lost), np.random.default_rng(0), fixed(NextBestParams, count=3)
    )
    found = []
    for index, pose in enumerate(plan.poses):
        found.append(re.fullmatch(SAID, pose.why))
        lost.add(index)
    assert len({s[1] for s in found if s}) == 1  # it knows as little as before
