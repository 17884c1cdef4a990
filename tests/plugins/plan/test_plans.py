"""The grid plan, with an arm that can go everywhere and with a real one."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye.models.loading import load_model
from flangeye.motion.reach import Reach, Site
from flangeye.types.geometry import rpy_from_rotation
from flangeye_plugins.plan import GridParams, grid

UP = np.diag([1.0, -1.0, -1.0])


def easy_site(joints=lambda pose: np.zeros(6)):
    centre = np.array([0.6, 0.0, 0.3])
    return Site(centre, np.array([0.6, 0.0, 1.0]), lambda centre: np.eye(3), joints)


def rng(seed=0):
    return np.random.default_rng(seed)


@given(
    counts=st.tuples(*[st.integers(1, 4)] * 3),
    tilt=st.floats(0.0, 0.3),
    seed=st.integers(0, 1000),
)
@settings(max_examples=25)
def test_poses_stay_within_their_limits(counts: Any, tilt: float, seed: int) -> None:
    params = GridParams(counts=counts, tilt=f"{tilt!r} rad", facing="60 deg")
    plan = grid(easy_site(), rng(seed), params=params)
    assert len(plan.poses) == plan.wanted == np.prod(counts)
    places = np.array([pose.base_T_flange[:3, 3] for pose in plan.poses])
    assert (np.abs(places - plan.centre) <= plan.size / 2 + 1e-12).all()
    assert len(np.unique(places.round(9), axis=0)) == plan.wanted
    for pose in plan.poses:
        turned = np.abs(rpy_from_rotation(pose.base_T_flange[:3, :3]))
        assert (turned <= params.tilt + 1e-9).all()


def test_the_papers_grid() -> None:
    plan = grid(easy_site(), rng(), params=GridParams(counts=(5, 5, 3)))
    assert plan.wanted == 75
    assert plan.size == pytest.approx([0.3, 0.3, 0.2])
    places = np.array([pose.base_T_flange[:3, 3] for pose in plan.poses])
    assert np.ptp(places, axis=0) == pytest.approx([0.3, 0.3, 0.2])


def test_the_default_is_a_smaller_one_in_random_order() -> None:
    plans = [grid(easy_site(), rng(seed), params=GridParams()) for seed in (0, 0, 1)]
    first, again, other = (np.array([p.base_T_flange for p in plan.poses]) for plan in plans)
    assert len(first) == 18
    assert np.array_equal(first, again)
    assert not np.array_equal(first[:, :3, 3], other[:, :3, 3])


def test_every_normal_is_near_enough_to_the_view() -> None:
    params = GridParams(size=("1 m", "1 m", "100 mm"), facing="25 deg")
    plan = grid(easy_site(), rng(), params=params)
    assert 3 < len(plan.poses) < plan.wanted or len(plan.poses) == plan.wanted
    for pose in plan.poses:
        view = np.array([0.6, 0.0, 1.0]) - pose.base_T_flange[:3, 3]
        cosine = pose.base_T_flange[:3, 2] @ view / np.linalg.norm(view)
        assert cosine >= np.cos(np.radians(25)) - 1e-12


def test_a_point_where_the_arm_cannot_go_is_left_out() -> None:
    beyond = easy_site(lambda pose: np.zeros(6) if pose[0, 3] < 0.65 else None)
    plan = grid(beyond, rng(), params=GridParams())
    assert len(plan.poses) == 12
    assert plan.wanted == 18


def test_an_arm_that_cannot_show_its_flange_has_no_plan() -> None:
    site = Site(np.zeros(3), np.ones(3), lambda centre: None, lambda pose: np.zeros(6))
    assert grid(site, rng(), params=GridParams()).poses == []


@pytest.mark.parametrize("robot", ["ur5", "franka-panda"])
def test_an_arm_reaches_what_is_planned_for_it(robot: str) -> None:
    model, scanner = load_model("robots", robot), load_model("scanners", "phoxi-m")
    base_T_camera = np.array(
        [[0, -1, 0, 0.6], [-1, 0, 0, -0.0125], [0, 0, -1, 1], [0, 0, 0, 1]], dtype=float
    )
    reach = Reach(model, scanner, base_T_camera, 0.0375)
    site = Site(
        np.array([0.6, -0.0125, 0.3]), base_T_camera[:3, 3], reach.facing_rotation, reach.joints
    )
    plan = grid(site, rng(3), params=GridParams(counts=(2, 2, 2)))
    assert len(plan.poses) >= 6
    for pose, joints, _ in plan.poses:
        assert reach.arm.flange(joints) == pytest.approx(pose, abs=1e-8)
        assert ((joints >= reach.arm.lower) & (joints <= reach.arm.upper)).all()
        assert reach.in_view(pose)


def test_a_flange_beside_the_view_or_behind_the_range_is_not_in_view() -> None:
    model, scanner = load_model("robots", "ur5"), load_model("scanners", "phoxi-m")
    reach = Reach(model, scanner, np.eye(4), 0.04)
    pose = np.eye(4)
    pose[:3, :3] = UP
    for place, seen in [
        ((0, 0, 0.7), True),
        ((0.31, 0, 0.7), False),
        ((0, 0.24, 0.7), False),
        ((0, 0, 0.44), False),
        ((0, 0, 1.15), False),
        ((0.45, 0, 1.1), False),  # seen by the camera, beyond the projector's light
    ]:
        pose[:3, 3] = place
        assert reach.in_view(pose) is seen
