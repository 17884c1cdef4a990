"""Distances of segments, and what an arm may not touch."""

from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from flangeye.maths.kinematics import Arm
from flangeye.models.bodies import TargetBody
from flangeye.models.loading import load_model
from flangeye.models.robots import Volume
from flangeye.motion.clearance import ArmVolume, BodyView, segment_distance

A_POINT = 2e-6
"""A segment shorter than a micrometre counts as a point [m]."""

coordinates = st.lists(st.floats(-1, 1), min_size=12, max_size=12)


@given(coordinates)
def test_segment_distance_is_the_smallest_of_all_pairs_of_points(numbers: Any) -> None:
    first, second = np.array(numbers).reshape(2, 2, 3)
    share = np.linspace(0, 1, 41)[:, None]
    points1 = first[0] + share * (first[1] - first[0])
    points2 = second[0] + share * (second[1] - second[0])
    brute = np.linalg.norm(points1[:, None] - points2[None], axis=-1).min()
    found = float(segment_distance(first, second))
    spacing = (np.ptp(first, axis=0) + np.ptp(second, axis=0)).max() / 20
    assert found <= brute + A_POINT
    assert found >= brute - spacing - A_POINT


def test_segment_distance_works_on_many_at_once() -> None:
    first = np.array([[[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [0, 0, 0]]], dtype=float)
    second = np.array([[[0.5, 1, 0], [0.5, 2, 0]], [[3, 4, 0], [3, 4, 9]]], dtype=float)
    assert segment_distance(first, second) == pytest.approx([1.0, 5.0])


def volume_at(robot, joints):
    model = load_model("robots", robot)
    volume = ArmVolume(model)
    return volume, volume.axes(Arm(model).frames(np.array(joints, dtype=float)))


def test_an_arm_that_points_down_is_in_the_table() -> None:
    upright, axes = volume_at("ur5", [0, -np.pi / 2, 0, 0, 0, 0])
    assert upright.above(axes, 0.0)
    down, axes = volume_at("ur5", [0, 0.8, 0, 0, 0, 0])
    assert not down.above(axes, 0.0)


@pytest.mark.parametrize("robot", ["ur3e", "ur5", "ur5e", "ur10e", "aubo-i5"])
def test_an_arm_that_stands_upright_touches_nothing(robot: str) -> None:
    upright = [0, -np.pi / 2, 0, 0, 0, 0] if robot != "aubo-i5" else [0] * 6
    volume, axes = volume_at(robot, upright)
    assert volume.apart(axes)


def test_a_folded_arm_touches_itself() -> None:
    volume, axes = volume_at("ur5", [0, -np.pi / 2, 2.75, 0, 1.5, 0])
    assert not volume.apart(axes)


def of_capsules(*links: tuple[int, float, float]) -> tuple[ArmVolume, Any]:
    """Return upright capsules 0.2 m long with a radius of 0.05: each a link, its x and its foot."""
    volumes = [
        Volume.model_construct(link=link, start=(x, 0, z), end=(x, 0, z + 0.2), radius=0.05)
        for link, x, z in links
    ]
    volume = ArmVolume(load_model("robots", "ur5").model_copy(update={"volumes": tuple(volumes)}))
    return volume, volume.axes(np.broadcast_to(np.eye(4), (7, 4, 4)))


@pytest.mark.parametrize(
    ("links", "apart"),
    [
        ([(1, 0.0, 0.0), (3, 0.09, 0.0)], True),  # joined by the link between them
        ([(1, 0.0, 0.0), (4, 0.09, 0.0)], False),
        ([(4, 0.0, 0.0), (1, 0.09, 0.0)], False),
        ([(1, 0.0, 0.0), (4, 0.1, 0.0)], False),  # they touch
        ([(1, 0.0, 0.0), (4, 0.11, 0.0)], True),
        ([(1, 0.0, 0.0), (2, 0.5, 0.0), (6, 0.09, 0.23)], False),  # the ends count, and all pairs
    ],
)
def test_links_that_are_three_joints_apart_must_not_touch(links: Any, apart: bool) -> None:
    volume, axes = of_capsules(*links)
    assert volume.apart(axes) is apart


@pytest.mark.parametrize(
    ("links", "above"),
    [
        ([(0, 0.0, -0.1), (1, 0.0, 0.0), (2, 0.0, 0.351)], True),  # base and shoulder stand on it
        ([(2, 0.0, 0.349)], False),
        ([(2, 0.0, 1.0), (6, 0.0, 0.349)], False),
    ],
)
def test_all_that_moves_stays_above_the_table(links: Any, above: bool) -> None:
    volume, axes = of_capsules(*links)
    assert volume.above(axes, 0.3) is above


def test_what_touches_the_table_is_not_above_it() -> None:
    for foot, above in ((0.05, False), (0.0501, True)):
        volume, axes = of_capsules((2, 0.0, foot))
        assert volume.above(axes, 0.0) is above


@pytest.mark.parametrize(
    ("room", "away"), [(0.0, True), (0.049, True), (0.05, False), (0.051, False)]
)
def test_every_link_keeps_its_distance_from_what_stands_there(room: float, away: bool) -> None:
    volume, axes = of_capsules((1, 0.9, 0.0), (6, 0.1, 0.0))
    assert volume.away(axes, np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]]), room) is away


def test_a_line_of_sight_that_grazes_a_link_is_not_hidden_and_its_width_not_free() -> None:
    volume, axes = of_capsules((3, 0.0, 0.0))
    for x, hidden in ((0.0499, True), (0.05, False)):
        sight = np.array([[[x, -1.0, 0.1], [x, 1.0, 0.1]]])
        assert volume.hides(axes, sight).tolist() == [hidden]
    sight = np.array([[[0.1, -1.0, 0.1], [0.1, 1.0, 0.1]]])
    for width, free in ((0.0499, True), (0.05, False)):
        assert volume.leaves_free(axes, sight, width) is free


def test_segments_on_one_line_and_points_have_their_distance_too() -> None:
    first = np.array(
        [[[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [1, 0, 0]], [[2, 0, 0], [2, 0, 0]]], float
    )
    second = np.array(
        [[[3, 0, 0], [5, 0, 0]], [[0, 2, 0], [1, 2, 0]], [[2, 0, 0], [2, 0, 0]]], float
    )
    assert segment_distance(first, second) == pytest.approx([2.0, 2.0, 0.0], abs=1e-15)


def test_a_line_of_sight_through_the_arm_is_not_free() -> None:
    volume, axes = volume_at("ur5", [0, -np.pi / 2, 0, 0, 0, 0])
    through = np.array([[[-1.0, -0.1, 0.4], [1.0, -0.1, 0.4]]])
    beside = np.array([[[-1.0, 0.4, 0.4], [1.0, 0.4, 0.4]]])
    assert not volume.leaves_free(axes, through, 0.03)
    assert volume.leaves_free(axes, beside, 0.03)


def test_a_body_is_seen_where_the_flange_carries_it() -> None:
    """Its points are on the flange, and it hides what lies behind it there."""
    arm = Arm(load_model("robots", "ur5e"))
    joints = np.radians([10.0, -80.0, 100.0, -60.0, -90.0, 20.0])
    mesh = trimesh.creation.box((0.1, 0.06, 0.04))
    box = TargetBody("box", np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32))
    placed = BodyView(box, arm).placed(joints)
    flange = arm.flange(joints)
    own = (placed.points - flange[:3, 3]) @ flange[:3, :3]
    assert np.abs(own / (0.05, 0.03, 0.02)).max(axis=1) == pytest.approx(1.0, abs=1e-9)
    shown = placed.faces(flange[:3, 3] + 0.5 * flange[:3, 2]) > 0
    assert shown[own[:, 2] > 0.02 - 1e-9].all() and not shown[own[:, 2] < 0.018].any()


@pytest.mark.parametrize("away", [0.2, 0.8])
def test_what_an_eye_sees_of_a_body_is_its_solid_angle(away: float) -> None:
    """Of a cube's face of side a, seen square on from d away: 4 atan(a^2 / 2d sqrt(4d^2 + 2a^2))."""
    arm, side = Arm(load_model("robots", "ur5e")), 0.1
    mesh = trimesh.creation.box((side, side, side))
    cube = TargetBody("cube", np.asarray(mesh.vertices), np.asarray(mesh.faces, np.int32))
    joints = np.radians([10.0, -125.0, -105.0, -40.0, -90.0, 170.0])
    flange = arm.flange(joints)
    seen = BodyView(cube, arm).placed(joints).faces(
        flange[:3, 3] + (away + side / 2) * flange[:3, 2]
    )  # fmt: skip
    angle = seen.mean() * 6 * side**2
    exact = 4 * np.arctan(side**2 / (2 * away * np.sqrt(4 * away**2 + 2 * side**2)))
    assert angle == pytest.approx(exact, rel=0.1)  # 600 points, of which a sixth is seen
