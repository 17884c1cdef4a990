"""Ways between postures: checked from end to end, and as slow as the limits want."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from flangeye.maths.kinematics import Arm
from flangeye.motion.clearance import ArmVolume
from flangeye.motion.route import NoRoute, Route, Router
from tests.motion.stand_in import LIMITS, MODEL, turned

HOME = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])
ROUTER = Router(MODEL, LIMITS, HOME)


@given(st.lists(st.floats(-0.6, 0.6), min_size=6, max_size=6))
@example([0.0, 0.25, 0.0, 0.5, 0.5, 0.0])
@settings(max_examples=20)
def test_flange_and_joints_stay_below_their_speeds(turns: Any) -> None:
    goal = HOME + np.array(turns)
    way = ROUTER.route(HOME, goal)
    if isinstance(way, NoRoute) or np.abs(goal - HOME).max() < 1e-3:
        return
    (leg,) = way.legs
    assert leg.speed <= LIMITS.joint_speed + 1e-12
    share = np.linspace(0.0, 1.0, 2001)[:, None]
    places = Arm(MODEL).flange(HOME + share * (goal - HOME))[:, :3, 3]
    fastest = np.linalg.norm(np.diff(places, axis=0), axis=1).max()
    seconds_a_step = np.abs(goal - HOME).max() / 2000 / leg.speed
    assert fastest / seconds_a_step <= LIMITS.speed * 1.01


def test_the_time_is_that_of_a_ramp_up_a_ride_and_a_ramp_down() -> None:
    way = ROUTER.route(HOME, turned(HOME, j6=1.0))
    (leg,) = way.legs
    assert leg.speed == pytest.approx(LIMITS.joint_speed)
    assert way.seconds == pytest.approx(1.0 / leg.speed + leg.speed / leg.acceleration)


@pytest.mark.parametrize("turn", [0.001, 0.05, 1.0])
def test_the_arm_is_as_fast_as_the_flange_s_limit_allows_and_no_faster(turn: float) -> None:
    way = ROUTER.route(HOME, turned(HOME, j1=turn))
    assert isinstance(way, Route)
    place = Arm(MODEL).flange(HOME)[:3, 3]
    radius = np.hypot(place[0], place[1])
    assert radius * LIMITS.joint_speed > LIMITS.speed  # the flange's is the one that counts
    (leg,) = way.legs
    assert radius * leg.speed == pytest.approx(LIMITS.speed, rel=1e-3)


def test_a_short_way_takes_its_ramps_alone() -> None:
    gentle = replace(LIMITS, acceleration=0.02)
    way = Router(MODEL, gentle, HOME).route(HOME, turned(HOME, j1=0.01))
    assert isinstance(way, Route)
    (leg,) = way.legs
    assert leg.speed**2 / leg.acceleration > 0.01  # it never comes to its speed
    shortest = 2 * np.sqrt(0.01 / leg.acceleration)
    assert way.seconds == pytest.approx(shortest)


def test_a_way_is_checked_from_its_start_to_its_end_every_two_degrees() -> None:
    seen: list[Any] = []

    class Watching(Router):
        def _obstacle(self, joints: Any, frames: Any, place: Any) -> str | None:
            seen.append(joints)
            return super()._obstacle(joints, frames, place)

    start = np.zeros(6)
    start[0] = -0.6
    assert isinstance(Watching(MODEL, LIMITS, HOME).route(start, -start), Route)
    assert seen[0] == pytest.approx(start, abs=1e-12)
    assert seen[-1] == pytest.approx(-start, abs=1e-12)
    assert np.degrees(np.abs(np.diff(seen, axis=0)).max()) <= 2.0


def test_no_joint_accelerates_by_more_than_60_degrees_a_second_squared() -> None:
    way = ROUTER.route(HOME, turned(HOME, j6=1.0))
    assert isinstance(way, Route)
    assert np.degrees(way.legs[0].acceleration) == pytest.approx(60.0)


def test_an_arm_passes_a_millimetre_above_the_table_and_says_where_it_would_touch() -> None:
    joints = np.radians([0.0, -30.0, 60.0, -30.0, -90.0, 0.0])
    volume = ArmVolume(MODEL)
    axes, moving = volume.axes(Arm(MODEL).frames(joints)), volume.links >= 2
    lowest = (axes[moving, :, 2].min(axis=1) - volume.radii[moving]).min()
    pose = Arm(MODEL).flange(joints)
    for gap, clear in ((0.0005, True), (-0.0005, False)):
        pose[2, 3] += gap - lowest
        lowest = gap
        (near, *_) = Arm(MODEL).inverse_near(pose, joints[None])
        way = ROUTER.route(near, near)
        assert isinstance(way, Route) is clear
    assert isinstance(way, NoRoute)
    place = ", ".join(f"{1e3 * x:.0f}" for x in pose[:3, 3])
    assert way.reason == f"touches the table with the flange at {place} mm"


def test_a_way_that_leads_through_the_table_is_barred() -> None:
    low = np.radians([0.0, 0.0, 30.0, -90.0, -90.0, 0.0])
    way = ROUTER.route(HOME, low)
    assert isinstance(way, NoRoute)
    assert "table" in way.reason


def test_a_way_out_of_the_box_is_barred_and_says_where() -> None:
    narrow = replace(LIMITS, high=np.array([-0.4, 1.0, 1.1]))
    way = Router(MODEL, narrow, HOME).route(HOME, turned(HOME, j1=np.pi))
    assert isinstance(way, NoRoute)
    assert way.reason.startswith("outside the box: x is -")
    assert "allowed -1000 to -400 mm" in way.reason


def test_where_the_straight_way_is_barred_it_goes_by_home() -> None:
    arm, start, goal = Arm(MODEL), turned(HOME, j1=-1.2), turned(HOME, j1=1.2)
    furthest = np.abs(arm.flange(HOME)[0, 3])
    behind = replace(LIMITS, low=np.array([-furthest + 0.02, -1.0, -0.3]))
    assert isinstance(Router(MODEL, behind, HOME).route(start, goal), NoRoute)
    folded = turned(HOME, j2=-0.3, j3=0.5)
    way = Router(MODEL, behind, folded).route(start, goal)
    assert isinstance(way, Route)
    assert way.via == "home"
    assert (way.legs[0].joints == folded).all()
    assert (way.legs[1].joints == goal).all()
