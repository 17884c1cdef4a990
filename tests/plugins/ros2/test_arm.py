"""How robot.ros2 refuses, leads and ends a motion, by a stand-in for its bridge and its clock."""

from __future__ import annotations

import re
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any, TypeVar

import numpy as np
import pytest

from flangeye.devices import DeviceError
from flangeye.maths.kinematics import Arm
from flangeye.models.graph import Topic
from flangeye.models.loading import load_model
from flangeye.models.robots import RobotModel
from flangeye_plugins.robot.ros2.driver import (
    FreedriveParams,
    Ros2RobotParams,
    robot_ros2,
    robot_ros2_freedrive,
)
from flangeye_plugins.ros2.client import GraphMessage
from flangeye_plugins.ros2.messages import Type, decoded, encoded, message

ARM = load_model("robots", "ur5e")
JOINTS = tuple(f"j{number}" for number in range(1, 7))
TOPIC = "/controller/joint_trajectory"
TRAJECTORY = Type.TRAJECTORY


class Graph:
    """A bridge whose time passes only while joint states are waited for, one every 2 ms.

    Attributes:
        silent: Whether nothing comes any more.
        skew: By how much the stamps are late [s].
        names: Of the joints that are told.
        published: Topic and decoded message of what was.
    """

    middleware, closed = "stand-in", False

    def __init__(self) -> None:
        self.now, self.silent, self.skew, self.names = 100.0, False, 0.0, JOINTS
        self.period = 0.002
        self.joints = np.array([0.0, -1.57, 1.57, -1.57, -1.57, 0.0])
        self.offered: list[str] = []
        self.published: list[Any] = []
        self.subscribers = {TOPIC: 1, "/other": 0, "/third": 1, "/text": 1}
        self._number = 0
        self._take: Any = None

    def monotonic(self) -> float:
        return self.now

    def monotonic_ns(self) -> int:
        return round(1e9 * self.now)

    def follow(self, topic: str, kind: str, take: Any = None) -> None:
        self._take = take

    def until_known(self) -> float:
        return self.now

    def awaited(self, look: Any) -> Any:
        return look()

    def wait(self, topic: str, after: int, patience: float) -> GraphMessage | None:
        if self.silent or patience < self.period:
            self.now += patience
            return None
        self.now += self.period
        self._number += 1
        nothing = np.zeros(0)
        header = message(
            "std_msgs/msg/Header",
            stamp=message("builtin_interfaces/msg/Time", sec=0, nanosec=0), frame_id="",
        )  # fmt: skip
        state = message(
            Type.JOINT_STATE, header=header, name=list(self.names),
            position=self.joints[: len(self.names)], velocity=nothing, effort=nothing,
        )  # fmt: skip
        came = GraphMessage(self._number, self.monotonic_ns(), 0, encoded(state))
        self._take(came)
        return came

    def local_ns(self, topic: str, came: GraphMessage) -> int:
        return came.received_ns - round(1e9 * self.skew)

    def offer(self, topic: str, kind: str) -> None:
        self.offered.append(topic)

    def listeners(self, topic: str) -> int:
        return self.subscribers.get(topic, 0)

    def topics(self) -> dict[str, Topic]:
        kinds = {"/text": "std_msgs/msg/String"}
        return {
            name: Topic(name, kinds.get(name, TRAJECTORY), (), count)
            for name, count in self.subscribers.items()
        }

    def stamp_ns(self, at: int) -> int:
        return at

    def publish(self, topic: str, raw: bytes) -> None:
        self.published.append((topic, decoded(raw, TRAJECTORY, lambda told: told)))

    def close(self) -> None:
        self.closed = True


G = TypeVar("G", bound=Graph)


def put_in(made: G, monkeypatch: pytest.MonkeyPatch) -> G:
    """Return a graph that stands in for the drivers' bridge and clock."""
    clock = SimpleNamespace(monotonic=made.monotonic, monotonic_ns=made.monotonic_ns)
    for module in ("driver", "listener"):
        monkeypatch.setattr(f"flangeye_plugins.robot.ros2.{module}.time", clock)
    monkeypatch.setattr("flangeye_plugins.robot.ros2.driver.Bridge", lambda asker, sim_time: made)
    return made


@pytest.fixture
def graph(monkeypatch: pytest.MonkeyPatch) -> Graph:
    return put_in(Graph(), monkeypatch)


def opened(topic: str = TOPIC, joints: tuple[str, ...] = JOINTS, model: RobotModel = ARM) -> Any:
    return robot_ros2.function(model, Ros2RobotParams(joints=joints, trajectory=topic))


def refused(why: str) -> Any:
    return pytest.raises(DeviceError, match=f"^{re.escape(why)}")


def test_a_controller_that_nothing_listens_for_is_refused_and_others_are_named(
    graph: Graph,
) -> None:
    graph.subscribers[TOPIC] = 0
    listens = "topics of this type that one listens to: /third: is the controller active?"
    with refused(f"ur5e on /joint_states: no controller listens to {TOPIC}; {listens}"):
        opened()
    assert graph.closed
    graph.subscribers["/third"] = 0
    with refused(f"ur5e on /joint_states: no controller listens to {TOPIC}; topics of this type "
                 "that one listens to: none: is the controller active?"):  # fmt: skip
        opened()


@pytest.mark.parametrize("count", [1, 2])
def test_a_controller_that_somebody_listens_for_is_opened(graph: Graph, count: int) -> None:
    graph.subscribers[TOPIC] = count
    with opened() as arm:
        assert (arm.state().mode, graph.offered) == ("ready", [TOPIC])
        assert arm.period == pytest.approx(0.002)
    assert graph.closed and graph.published == []


def test_a_controller_that_went_takes_no_move(graph: Graph) -> None:
    with opened() as arm:
        graph.subscribers[TOPIC] = 0
        with refused("ur5e on /joint_states: no controller listens to"):
            arm.move_joints(graph.joints + 0.1, 0.5, 1.0)
        assert graph.published == []


def test_joint_states_that_do_not_come_or_are_another_arms_are_refused(graph: Graph) -> None:
    with refused("robot.ros2: joints names 5, but a ur5e has 6"):
        opened(joints=JOINTS[:5])
    graph.names = ("gripper", *JOINTS[1:])
    with refused(
        "robot.ros2: /joint_states: it has no joint j1; it has gripper, j2, j3, j4, j5, j6"
    ):
        opened()
    graph.silent = True
    with refused("robot.ros2: /joint_states: nothing came on it"):
        opened()
    graph.silent = False


@pytest.mark.parametrize(("period", "why"), [(0.049, ""), (0.0625, "comes 16 times a second")])
def test_joint_states_that_come_too_slowly_are_refused(
    graph: Graph, period: float, why: str
) -> None:
    graph.period = period
    with refused(f"robot.ros2: /joint_states {why}, at least 20") if why else nullcontext():
        opened()


@pytest.mark.parametrize("skew", [0.11, -0.11, 0.09, -0.09])
def test_stamps_that_differ_from_the_clock_by_a_tenth_of_a_second_are_refused(
    graph: Graph, skew: float
) -> None:
    graph.skew = skew
    when = "before" if skew > 0 else "after"
    late = f"ur5e on /joint_states: stamped 0.11 s {when} it came, at most 0.1 s are allowed"
    with refused(late) if abs(skew) > 0.1 else nullcontext():
        opened()


def test_an_arm_on_its_way_that_falls_silent_is_no_news_after_a_tenth_of_a_second(
    graph: Graph,
) -> None:
    with opened() as arm:
        arm.move_joints(graph.joints + 0.5, 0.5, 1.0)
        assert len(graph.published) == 1
        graph.silent = True
        graph.now += 0.09
        assert arm.state().mode == "moving"
        graph.now += 0.02
        with refused("ur5e on /joint_states: silent for 0.11 s, at most 0.1 s are allowed"):
            arm.state()
        graph.now += 0.05  # its last piece has ended by itself: nothing may set it moving again
        arm.stop()
        assert len(graph.published) == 1


def test_an_arm_that_is_stopped_in_time_is_told_so(graph: Graph) -> None:
    with opened() as arm:
        arm.move_joints(graph.joints + 0.5, 0.5, 1.0)
        graph.now += 0.14
        arm.stop()
        assert len(graph.published) == 2
        arm.stop()
        assert len(graph.published) == 2


def test_a_controller_that_rejects_what_it_is_given_is_noticed_after_less_than_a_second(
    graph: Graph,
) -> None:
    with opened() as arm:
        arm.move_joints(graph.joints + 0.5, 0.5, 1.0)
        began = graph.now
        with refused(f"ur5e on /joint_states: {TOPIC} was given trajectories for 0.8 s and the arm "
                     "has not moved: its controller rejects them"):  # fmt: skip
            while True:
                arm.wait_cycle()
        assert 0.8 < graph.now - began < 0.84


@pytest.mark.parametrize(("by", "moves"), [(1.1e-3, True), (0.9e-3, False)])
def test_an_arm_has_moved_when_a_joint_turned_by_a_thousandth_of_a_radian(
    graph: Graph, by: float, moves: bool
) -> None:
    with opened() as arm:
        began = graph.now
        arm.move_joints(graph.joints + 0.5, 0.5, 1.0)
        for _ in range(200):
            arm.wait_cycle()
        graph.joints = graph.joints - by * np.eye(6)[2]
        with refused("ur5e on /joint_states: /controller/joint_trajectory was given trajectories"):
            while True:
                arm.wait_cycle()
        assert graph.now - began == pytest.approx(1.2 if moves else 0.8, abs=0.06)


@pytest.mark.parametrize(("late", "pieces"), [(0.146, 2), (0.15, 1)])
def test_a_motion_that_was_not_renewed_in_time_is_not_resumed(
    graph: Graph, late: float, pieces: int
) -> None:
    with opened() as arm:
        arm.move_joints(graph.joints + 0.5, 0.5, 1.0)
        graph.now += late
        arm.wait_cycle()
        assert len(graph.published) == pieces
        if pieces == 1:
            for _ in range(20):
                arm.wait_cycle()
            assert len(graph.published) == 1


def test_the_bound_of_silence_itself_is_borne(graph: Graph) -> None:
    """Where the clock's numbers are exact: 0.3 - 0.15 is 0.15."""
    graph.now = 0.0
    with opened() as arm:
        for stop in (True, False):
            graph.now = 0.148
            arm.wait_cycle()
            graph.now = 0.15
            arm.move_joints(graph.joints + 0.5, 0.5, 1.0)
            count = len(graph.published)
            graph.now = 0.3 if stop else 0.298
            if stop:
                arm.stop()
            else:
                arm.wait_cycle()
                assert graph.now == 0.3
            assert len(graph.published) == count + 1
            arm.stop()


def test_pieces_follow_one_another_and_begin_a_quarter_of_a_second_ago(graph: Graph) -> None:
    with opened() as arm:
        arm.move_joints(graph.joints + 0.5, 0.5, 1.0)
        for _ in range(13 * 20):
            arm.wait_cycle()
        assert len(graph.published) == 1 + 20
        topic, piece = graph.published[-1]
        began = piece.header.stamp.sec + 1e-9 * piece.header.stamp.nanosec
        assert (topic, piece.joint_names) == (TOPIC, list(JOINTS))
        assert graph.now - began == pytest.approx(0.25)
        after = piece.points[-1].time_from_start
        assert 0.25 < after.sec + 1e-9 * after.nanosec <= 0.25 + 0.3


def test_a_velocity_that_is_asked_for_again_goes_on(graph: Graph) -> None:
    with opened() as arm:
        twist = np.array([0.0, 0.0, -0.05, 0.0, 0.0, 0.0])
        arm.move_velocity(twist, 0.5)
        arm.move_velocity(twist, 0.5)
        assert len(graph.published) == 1
        for _ in range(13):
            arm.wait_cycle()
            arm.move_velocity(twist, 0.5)
        assert len(graph.published) == 2
        speeds = np.array(graph.published[-1][1].points[-2].velocities)
        flange = Arm(ARM).jacobian(graph.joints) @ speeds
        assert flange[5] < 0.0


@pytest.mark.parametrize(("robot", "stretched"), [("ur10e", True), ("ur5e", False)])
def test_a_velocity_speeds_the_joints_up_by_the_acceleration_at_a_lever_of_a_metre_or_more(
    graph: Graph, robot: str, stretched: bool
) -> None:
    model = load_model("robots", robot)
    if stretched:
        graph.joints = np.array([0.0, 0.0, 0.0, -1.57, -1.57, 0.0])
    lever = float(np.linalg.norm(Arm(model).jacobian(graph.joints)[3:], axis=0).max())
    assert lever > 1.2 if stretched else lever < 0.95
    with opened(model=model) as arm:
        twist = np.array([0.0, 0.3, 0.0, 0.0, 0.0, 0.0])
        for _ in range(50):
            arm.move_velocity(twist, 0.5)
            arm.wait_cycle()
    speeds = [np.abs(piece.points[-2].velocities).max() for _, piece in graph.published[1:]]
    ends = [piece.header.stamp.sec + 1e-9 * piece.header.stamp.nanosec
            for _, piece in graph.published[1:]]  # fmt: skip
    assert np.diff(speeds)[:2] / np.diff(ends)[:2] == pytest.approx(0.5 / max(lever, 1.0))


def test_a_piece_s_points_have_places_and_speeds_alone(graph: Graph) -> None:
    with opened() as arm:
        arm.move_joints(graph.joints + 0.5, 0.5, 1.0)
    points = [point for _, piece in graph.published for point in piece.points]
    assert {(len(p.positions), len(p.velocities)) for p in points} == {(6, 6)}
    assert {(len(p.accelerations), len(p.effort)) for p in points} == {(0, 0)}


def test_an_arm_that_was_stopped_moves_until_stop_and_controller_had_their_time(
    graph: Graph,
) -> None:
    with opened() as arm:
        assert ready_after(graph, arm) == 0.0
        arm.move_joints(graph.joints + 0.5, 0.5, 1.0)
        arm.stop()
        assert ready_after(graph, arm) == pytest.approx(0.2 + 0.3, abs=0.0021)


def test_an_arm_that_has_come_to_its_goal_is_ready_0_33_s_after_its_last_piece(
    graph: Graph,
) -> None:
    with opened() as arm:
        goal = graph.joints + 0.04
        arm.move_joints(goal, 0.5, 1.0)  # takes half a second, smoothed
        graph.joints = goal
        assert ready_after(graph, arm) == pytest.approx(0.5 + 0.33, abs=0.01)
    assert graph.published[-1][1].points[-1].positions == pytest.approx(goal)


@pytest.mark.parametrize(("moves", "closed"), [(False, False), (True, True), (True, False)])
def test_only_an_arm_that_moves_is_stopped_at_the_end_while_its_bridge_is_there(
    graph: Graph, monkeypatch: pytest.MonkeyPatch, moves: bool, closed: bool
) -> None:
    asked: list[str] = []
    arm = opened()
    if moves:
        arm.move_joints(graph.joints + 0.5, 0.5, 1.0)
    count, graph.closed = len(graph.published), closed
    monkeypatch.setattr(graph, "listeners", asked.append)
    arm.close()
    stops = moves and not closed
    assert (len(graph.published) - count, len(asked)) == (int(stops), int(stops))
    assert graph.closed


def ready_after(graph: Graph, arm: Any) -> float:
    """Return after which time an arm is ready, longest a second [s]."""
    began = graph.now
    while arm.state().mode != "ready" and graph.now < began + 1.0:
        arm.wait_cycle()
    return graph.now - began


def test_an_arm_moved_by_others_is_scanned_when_it_has_moved_on_and_stood(graph: Graph) -> None:
    with robot_ros2_freedrive.function(ARM, FreedriveParams(joints=JOINTS)) as arm:
        assert arm.state().mode == "ready"
        opened_at = graph.now
        arm.move_joints(graph.joints, 0.5, 1.0)
        assert ready_after(graph, arm) < 0.51
        assert graph.now - opened_at > 0.45
        arm.move_joints(graph.joints, 0.5, 1.0)
        graph.joints = graph.joints + 0.019
        assert ready_after(graph, arm) >= 1.0
        graph.joints = graph.joints + 0.002
        assert 0.5 < ready_after(graph, arm) < 0.56
        with refused(
            "ur5e on /joint_states: a person or another program moves the arm; it cannot be servoed"
        ):
            arm.move_velocity(np.zeros(6), 0.5)
        arm.stop()
    assert graph.published == [] and graph.offered == []
