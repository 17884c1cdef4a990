"""The arm's way, posture by posture: what bars one, which is told of, and how it is come to."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.motion.limits import MotionLimits
from flangeye.motion.route import NoRoute, Route
from flangeye.plugin.stage import BoundPart
from flangeye.workflow.recipe.header import LimitsSection
from flangeye_emulators.finger.sensor import (
    SimulatedFingerParams,
    sensor_simulated_finger,
)
from flangeye_plugins.weld import reachability
from flangeye_plugins.weld.following.task import WeldStart
from flangeye_plugins.weld.frame import Tool, WorkSurface
from flangeye_plugins.weld.path import Path
from flangeye_plugins.weld.reachability import (
    JUMP,
    ROOM,
    Barrier,
    SeamReach,
    Station,
    Task,
    _stations,
    flange_speed,
)
from flangeye_plugins.weld.settings import Following, WeldTactileParams
from tests.plugins.weld.bench import straight
from tests.plugins.weld.cell import BOX, FINGER, planned

FREE = Barrier(9, "")


def reach_of(**given: Any) -> Any:
    """A seam's reach that has looked for nothing yet; of an arm of two joints."""
    found: Any = SeamReach.__new__(SeamReach)
    found._task = SimpleNamespace(**given)
    return found


def limits(**given: Any) -> Any:
    bounds = {"lower": np.radians([-180.0, -360.0]), "upper": np.radians([180.0, 360.0])}
    return SimpleNamespace(**{**bounds, **given})


# --- which postures --------------------------------------------------------------------------------


def barred(table=False, itself=False, beyond=None, turn=0.0, fastest=0.1) -> Any:
    """Why a posture is barred for such reasons; turned by so much from the last one [deg]."""
    found = reach_of(limits=limits(beyond=lambda joints, room: beyond, joint_speed=0.5))
    found._arm = SimpleNamespace(frames=lambda joints: joints)
    found._volume = SimpleNamespace(
        axes=lambda frames: frames,
        above=lambda axes, floor: not table,
        apart=lambda axes: not itself,
    )
    found._fastest = lambda joints: fastest
    return found._obstacle(np.zeros(2), np.radians([1.0, -turn]))


def test_of_all_that_bars_a_posture_the_first_is_told() -> None:
    """The farther down this list it came the nearer it was to being driven."""
    reasons = [
        barred(table=True, itself=True), barred(itself=True, beyond="joint 1 is at 9 deg", turn=90),
        barred(beyond="joint 1 is at 9 deg", turn=90), barred(turn=30.1, fastest=1.0),
        barred(turn=29.9, fastest=0.6),
    ]  # fmt: skip
    assert [each.reason for each in reasons] == [
        "the arm touches the table", "the arm touches itself", "joint 1 is at 9 deg",
        "the arm would have to change its posture",
        "a joint may have to turn at 34 deg/s, robot.limits.joint_speed allows 29 deg/s",
    ]  # fmt: skip
    ranks = [each.rank for each in reasons]
    assert ranks == sorted(set(ranks))
    assert barred(turn=29.9, fastest=0.499) is None


def test_a_joint_turns_as_fast_as_going_and_turning_together_ask_for() -> None:
    """By the inverse of the arm's Jacobian: the tool turns about its own z, tilts, and goes."""
    rng, tilting = np.random.default_rng(0), 5.0
    jacobian, normal = rng.normal(size=(6, 6)), np.array([0.0, 0.6, 0.8])
    settings = Following.model_validate({})
    found = reach_of(
        tool=SimpleNamespace(up=lambda rotation: normal, tilting=tilting),
        finger=FINGER,
        params=settings,
    )
    found._arm = SimpleNamespace(jacobian=lambda joints: jacobian, flange=lambda joints: np.eye(4))
    speed = flange_speed(FINGER, settings)
    way, tilts = rng.normal(size=(2, 100000, 3))
    tilts *= tilting * settings.speed / np.linalg.norm(tilts, axis=1, keepdims=True)
    turns = settings.turn_rate * normal * rng.choice([-1, 1], size=(100000, 1)) + tilts
    twists = np.hstack([turns, speed * way / np.linalg.norm(way, axis=1, keepdims=True)])
    worst = float(np.abs(np.linalg.solve(jacobian, twists.T)).max())
    assert found._fastest(np.zeros(6)) == pytest.approx(worst, rel=0.03)
    assert found._fastest(np.zeros(6)) >= worst


def chained(bars: dict[tuple[int, int], Barrier], starts: int = 2, stations: int = 3) -> Any:
    """Chains from postures that start 1 rad apart, of which some are barred at some stations."""
    ends = {"lower": np.full(1, -2.0), "upper": np.full(1, 2.0)}
    found = reach_of(limits=limits(beyond=lambda joints, room: None, **ends))
    firsts = np.arange(starts, dtype=float)[:, None]
    postures = [firsts + 0.01 * i for i in range(stations)]
    asked: list[tuple[int, int]] = []

    def bars_of(before: Any, joints: Any) -> Barrier | None:
        start = round(float(joints[0]))
        asked.append((start, round((float(joints[0]) - start) / 0.01)))
        assert abs(float(joints[0] - before[0])) < 0.011
        return bars.get(asked[-1])

    found._obstacle = bars_of
    nowhere: Any = None
    named = [Station(f"at {i}", nowhere) for i in range(stations)]
    return found._drivable(named, postures)


def test_every_posture_that_starts_a_whole_chain_is_kept() -> None:
    both = chained({})
    assert [chain.ravel().tolist() for chain in both] == [
        pytest.approx([0.0, 0.01, 0.02]), pytest.approx([1.0, 1.01, 1.02]),
    ]  # fmt: skip
    (one,) = chained({(0, 1): Barrier(0, "table")})
    assert one.ravel() == pytest.approx([1.0, 1.01, 1.02])


@pytest.mark.parametrize(("first", "turned"), [(170, -190), (-10, -10), (100, -260)])
def test_a_joint_that_goes_far_round_begins_a_turn_earlier(first: int, turned: int) -> None:
    """Once around is 270 deg of a joint: it begins where all of that is within its limits."""
    box, full = np.zeros(3), np.radians([358.0])
    found = reach_of(limits=MotionLimits(box, box, 0.0, 0.0, 0.0, -full, full))
    found._obstacle = lambda before, joints: None
    way = np.radians(first + 15.0 * np.arange(19))
    postures = [np.array([[math.remainder(angle, math.tau)]]) for angle in way]
    (chain,) = found._drivable([None] * len(way), postures)
    assert np.degrees(chain.ravel()) == pytest.approx(turned + 15.0 * np.arange(19))


def test_of_several_refusals_the_one_that_came_farthest_is_told() -> None:
    with pytest.raises(StageError, match="weld.tactile: at 2, the arm touches the table"):
        chained({(0, 1): Barrier(3, "posture"), (1, 2): Barrier(0, "the arm touches the table")})
    with pytest.raises(StageError, match="weld.tactile: at 1, the posture"):
        chained({(0, 1): Barrier(3, "the posture"), (1, 1): Barrier(0, "the table")})


def test_a_chain_is_wound_to_where_the_arm_stands_where_its_limits_let_it() -> None:
    """Each joint by whole turns; two degrees stay free."""
    found = reach_of(limits=limits())
    chain = np.radians([[170.0, -100.0], [175.0, -110.0]])
    here = np.radians([-170.0, 250.0])
    assert np.degrees(found._turned_to(here, chain)) == pytest.approx(
        np.array([[170.0, 260.0], [175.0, 250.0]])
    )
    for sign in (1.0, -1.0):
        for last, wound in ((357.0, 357.0), (359.0, -1.0)):
            chain = sign * np.radians([[0.0, -10.0], [0.0, last - 360.0]])
            turned = found._turned_to(sign * np.radians([0.0, 350.0]), chain)
            assert np.degrees(turned)[1, 1] == pytest.approx(sign * wound)


# --- the way to the start -------------------------------------------------------------------------


def started(ways: dict[float, Any], here: float = 0.0) -> Any:
    """Start from a joint angle, of chains that begin at others and whose way is this [rad]."""
    found, tried = reach_of(), list[float]()
    found._chains = [np.array([[start], [start + 0.1], [9.0]]) for start in ways]
    found._turned_to = lambda at, chain: chain

    def way(at: Any, high: Any, low: Any) -> Any:
        assert low[0] == pytest.approx(high[0] + 0.1)
        tried.append(float(high[0]))
        return ways[float(high[0])]

    found._way = way
    return found.to_start(np.array([here])), tried


def test_the_way_is_taken_to_the_posture_that_is_nearest_and_free() -> None:
    free, other = Route(()), Route(())
    route, tried = started({2.0: other, -1.0: free, -3.0: other})
    assert route is free and tried == [-1.0]
    route, tried = started({2.0: free, -1.0: NoRoute("a wall"), -3.0: other})
    assert route is free and tried == [-1.0, 2.0]
    # Near is where the arm first comes to: it turns on from there whatever it has taken.
    route, tried = started({-1.02: free, 1.0: other})
    assert route is other and tried == [1.0]
    with pytest.raises(StageError) as told:
        started({2.0: NoRoute("the far one"), -1.0: NoRoute("the near one")})
    assert str(told.value) == (
        "weld.tactile: no collision-free path from the arm's pose to the seam: the near one; "
        "bring the arm above the work by hand"
    )


@pytest.mark.parametrize(
    ("over", "down", "touches"),
    [("", "", ""), ("over", "", ""), ("", "down", "work"), ("", "", "work")],
)
def test_a_way_goes_over_and_down_slowly_and_what_bars_it_first_is_told(
    monkeypatch: pytest.MonkeyPatch, over: str, down: str, touches: str
) -> None:
    asked = list[Any]()

    class Router:
        def __init__(self, model: Any, limits: Any, here: Any) -> None:
            asked.append((limits.speed, limits.joint_speed))

        def route(self, start: Any, goal: Any) -> Any:
            assert (start, goal) in (("here", "high"), ("high", "low"))
            why = over if goal == "high" else down
            return NoRoute(why) if why else Route((goal,))

    monkeypatch.setattr(reachability, "Router", Router)
    box, params = np.zeros(3), SimpleNamespace(approach_speed=0.1, approach_joint_speed=0.2)
    for given, slower in ((0.01, 0.01), (0.3, 0.1)):
        allowed = MotionLimits(box, box, given, 0.0, 2 * given, box, box)
        found = reach_of(model=None, limits=allowed, params=params)
        found._touches = lambda start, goal: NoRoute(touches) if touches else None
        way = found._way("here", "high", "low")
        assert getattr(way, "reason", "") == (over or down or touches)
        assert over or down or touches or way.legs == ("high", "low")
        assert asked[-1] == (slower, pytest.approx(2 * slower))


def test_neither_finger_nor_torch_comes_nearer_to_the_work_than_nine_tenths_of_the_clearance() -> (
    None
):
    plan = Path(np.column_stack([straight(0.1)[:, :2], np.linspace(0.0, 2e-3, 200)]))
    found = reach_of(
        plan=plan, params=SimpleNamespace(clearance=20e-3), tool=SimpleNamespace(lowest=float)
    )
    found._arm = SimpleNamespace(flange=lambda postures: postures[:, 0])  # its joint is its height
    low = 2e-3 + 0.9 * 20e-3
    assert found._touches(np.array([0.5]), np.array([low + 1e-6])) is None
    assert found._touches(np.array([low + 1e-6]), np.array([0.5])) is None
    for start, goal in ((0.5, low - 1e-6), (low - 1e-6, 0.5), (low - 1e-6, low - 2e-6)):
        told = found._touches(np.array([start]), np.array([goal]))
        assert told.reason == (
            "finger or torch would come to 20 mm above the work, 20 mm are asked for"
        )
    found._arm = SimpleNamespace(flange=lambda postures: np.abs(postures[:, 0]))
    told = found._touches(np.array([-1.0]), np.array([1.001]))  # between them it is at the work
    assert told is not None


# --- the poses that are looked at -----------------------------------------------------------------


@pytest.mark.parametrize(("angle", "turns"), [(0.0, 2), (-0.5, 4), (math.pi / 2, 8)])
def test_the_seam_is_looked_at_from_above_its_start_to_where_the_torch_comes_to_its_end(
    angle: float, turns: int
) -> None:
    points = straight(0.1)
    surface = WorkSurface(points, np.tile([0.0, 0, 1.0], (len(points), 1)))
    tool = Tool(FINGER, surface)
    plan = surface.path
    params: Any = SimpleNamespace(clearance=15e-3, overlapping=lambda plan: 0.0)
    task: Any = SimpleNamespace(plan=plan, params=params, tool=tool, aside=2e-3, finger=FINGER,
                                start=WeldStart(5e-3, angle=angle))  # fmt: skip
    stations = _stations(task)
    poses = [tool.pose(station.pose, 0.0) for station in stations]
    places = np.array([pose.position for pose in poses])
    start = plan.at(5e-3).point + 2e-3 * plan.at(5e-3).normal
    above = [station.name == "above the seam's start" for station in stations]
    count = above.index(False)
    assert not any(above[count:]) and count == turns
    assert places[0] == pytest.approx([*start, 15e-3 + 0.05])
    assert places[1:count] == pytest.approx(np.tile([*start, 15e-3], (count - 1, 1)))
    angles = np.array([pose.angle for pose in poses])
    assert angles[0] == angles[1] == pytest.approx(angle)
    assert np.abs(np.diff(angles[:count])).max(initial=0.0) <= math.radians(15.0) + 1e-9
    assert angles[count - 1 :] == pytest.approx(0.0 if count > 2 else angle, abs=1e-9)
    along = places[count:, 0] - places[count, 0]
    assert along == pytest.approx(10e-3 * np.arange(len(along)))
    assert 0.1 + FINGER.torch - 10e-3 <= along[-1] < 0.1 + FINGER.torch + 1e-9
    assert places[count:, 1:] == pytest.approx(0.0, abs=1e-9)
    assert stations[count + 3].name == "30 mm along the seam (the tip goes on beyond its end)"


# --- real arms -------------------------------------------------------------------------------------

SENSOR = BoundPart(sensor_simulated_finger, SimulatedFingerParams())


def task_of(name, angle: float = 0.0):
    model = load_model("robots", name)
    seam = planned("v-curved", shift=(-0.1, 0.0, 0.0))
    surface = WorkSurface(seam.points_in_base, seam.openings_in_base)
    limits = LimitsSection.model_validate({"box": BOX}).for_robot(model)
    settings = WeldTactileParams(sensor=SENSOR)
    start = WeldStart(settings.set_down, angle=angle)
    return Task(model, limits, FINGER, Tool(FINGER, surface), surface.path, settings, start)


@pytest.mark.parametrize("name", ["ur10e", "ur5e", "franka-panda", "aubo-i5"])
@pytest.mark.parametrize("angle", [0.0, -np.pi / 2])
def test_every_chain_of_postures_is_one_smooth_way(name: str, angle: float) -> None:
    task = task_of(name, angle)
    arm, chains = Arm(task.model), SeamReach(task)._chains
    assert chains
    for chain in chains:
        assert np.abs(np.diff(chain, axis=0)).max() <= JUMP
        assert (chain >= task.limits.lower + ROOM).all()
        assert (chain <= task.limits.upper - ROOM).all()
        heights = [task.tool.lowest(pose) for pose in arm.flange(chain)]
        assert heights[0] == pytest.approx(task.params.clearance + 0.05, abs=2e-3)
        assert min(heights) == pytest.approx(0.0, abs=1e-3)  # on the seam itself
    # The last posture has the tip beyond the seam's end, where the torch comes to it.
    tip = arm.flange(chains[0][-1]) @ [*FINGER.tip, 1.0]
    end = task.plan.at(task.plan.length + FINGER.torch)
    beyond = task.tool.base_T_flange(np.array([*end.point, end.height]), 0.0, task.plan.length)
    assert np.linalg.norm(tip[:3] - beyond.apply(np.array(FINGER.tip))) < 15e-3


def test_the_way_to_the_start_begins_where_the_arm_stands_by_whole_turns() -> None:
    task = task_of("ur10e")
    passage = SeamReach(task)
    above = passage._chains[0][0]
    wound = above + np.array([0, 0, 0, 0, 0, 2 * np.pi])
    if not (wound <= task.limits.upper - ROOM).all():
        wound = above - np.array([0, 0, 0, 0, 0, 2 * np.pi])
    route = passage.to_start(wound)
    np.testing.assert_allclose(route.legs[0].joints, wound, atol=1e-9)
    assert all(leg.speed <= task.params.approach_joint_speed + 1e-9 for leg in route.legs)
