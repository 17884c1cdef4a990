"""``robot.ros2`` and ``scanner.ros2`` with the real rclpy in other processes; in realtime."""

import os
import re
import signal
import time

import numpy as np
import pytest

from flangeye.devices import DeviceError
from flangeye.models.loading import load_model
from flangeye_plugins.robot.ros2.driver import (
    FreedriveParams,
    Ros2RobotParams,
    robot_ros2,
    robot_ros2_freedrive,
)
from flangeye_plugins.ros2.client import Bridge
from flangeye_plugins.ros2.messages import Type, decoded, positions_of
from flangeye_plugins.scanner.ros2 import Ros2ScannerParams as Topics
from flangeye_plugins.scanner.ros2 import scanner_ros2
from tests.plugins.fixed import fixed
from tests.plugins.ros2.cell import Camera, Controller, peers

pytestmark = [pytest.mark.realtime, pytest.mark.ros2]

NO_SERVICE = "/camera/capture did not answer|nobody offers the service /camera/capture"
"""DDS notices a killed node by its silence, up to 20 s later: until then it is one that is slow."""

ARM, EYE = load_model("robots", "ur5e"), load_model("scanners", "phoxi-m")


def opened(controller, **params):
    given = {"joints": tuple(controller.joints), "trajectory": controller.topic}
    return robot_ros2.function(ARM, Ros2RobotParams(**given | params))


def drive(robot, goal, speed=0.5, seconds=10.0):
    """Go there; return the fastest joint's speed on the way."""
    robot.move_joints(goal, speed, 1.0)
    fastest, until = 0.0, time.monotonic() + seconds
    while robot.state().mode != "ready":
        assert time.monotonic() < until
        robot.wait_cycle()
        fastest = max(fastest, float(np.abs(robot.state().joint_speeds).max()))
    return fastest


def under_way(robot, turn=1.0, seconds=1.0):
    robot.move_joints(robot.state().joints + turn * np.eye(6)[0], 0.5, 1.0)
    lead_on(robot, seconds)


def lead_on(robot, seconds):
    until = time.monotonic() + seconds
    while time.monotonic() < until:
        robot.wait_cycle()
        robot.state()


@pytest.mark.parametrize("latency", [0.01, 0.1])
def test_a_move_keeps_its_speed_and_whatever_dies_the_arm_rests(env, latency):
    with peers(Controller(env, latency=latency, prefix="left_")) as (arm,), opened(arm) as robot:
        start = robot.state().joints
        goal = start + 0.4 * np.eye(6)[0]
        assert drive(robot, goal) < 1.15 * 0.5
        assert np.abs(robot.state().joints - goal).max() < 1e-3
        height, until = robot.state().base_T_flange.translation[2], time.monotonic() + 0.6
        while time.monotonic() < until:
            robot.move_velocity(np.array([0.0, 0.0, 0.05, 0.0, 0.0, 0.0]), 0.5)
            robot.wait_cycle()
        assert robot.state().base_T_flange.translation[2] - height > 0.01
        robot.stop()
        under_way(robot)
        moment = time.monotonic()
        robot.stop()
        time.sleep(1.0)
        assert 0.0 < arm.rest_after(moment) < 0.5
        robot.wait_cycle()
        under_way(robot)
        moment = time.monotonic()
        arm.tell(silent=0.5)
        with pytest.raises(DeviceError, match="/joint_states: silent for 0.1"):
            while True:
                robot.wait_cycle()
                robot.state()
        robot.stop()
        time.sleep(1.0)
        assert 0.0 < arm.rest_after(moment) < 0.5
        robot.wait_cycle()
        under_way(robot)
        moment = time.monotonic()
        robot._bridge._pipe._process.kill()
        time.sleep(1.0)
        assert 0.0 < arm.rest_after(moment) < 0.5
        with pytest.raises(DeviceError, match="the bridge to ROS 2 has ended"):
            robot.wait_cycle()


def test_what_goes_wrong_with_an_arm_is_one_line(env):
    with peers(Controller(env)) as (arm,):
        with pytest.raises(DeviceError, match="no controller listens to /other"):
            opened(arm, trajectory="/other")
        with pytest.raises(DeviceError, match="it has no joint elbow; it has gripper_finger"):
            opened(arm, joints=(*arm.joints[:5], "elbow"))
        with opened(arm) as robot:
            arm.tell(rejects=True)
            with pytest.raises(DeviceError, match="controller rejects them"):
                under_way(robot, seconds=2.0)
            robot.stop()
            arm.ask(rejects=False, truth=True)
            time.sleep(0.3)
            robot.wait_cycle()
            under_way(robot)
            arm.tell(rejects=True)  # the last piece that was taken ends by itself
            with pytest.raises(DeviceError, match="controller rejects them"):
                lead_on(robot, 2.0)
            robot.stop()
            arm.tell(rejects=False, silent=1.2)
            time.sleep(0.6)  # it stands: half a second would be waited for
            with pytest.raises(DeviceError, match="silent for"):
                robot.state()
            time.sleep(0.5)
            robot.wait_cycle()
            arm.tell(jump=-5.0)
            time.sleep(0.1)
            with pytest.raises(DeviceError, match="stamps jumped back by"):
                for _ in range(50):
                    robot.wait_cycle()
            arm.tell(jump=0.0, stamped=False)
            with pytest.raises(DeviceError, match="robot.ros2: /joint_states is stamped 0, so nob"):
                for _ in range(50):
                    robot.wait_cycle()
            arm.tell(stamped=True, nan=True)
            with pytest.raises(DeviceError, match="a joint's position is not a number"):
                for _ in range(50):
                    robot.wait_cycle()


def test_a_publisher_that_comes_later_and_does_not_resend_is_heard(env):
    heard = set()

    def hear(message):
        heard.update(decoded(message.data, Type.JOINT_STATE, positions_of))

    with peers(Controller(env, prefix="left_")), Bridge("a test") as bridge:
        bridge.follow("/joint_states", Type.JOINT_STATE, take=hear)
        with peers(Controller(env, best_effort=True)):
            until = time.monotonic() + 10
            while not {"left_joint_1", "joint_1"} <= heard:
                assert time.monotonic() < until, heard
                time.sleep(0.1)


def test_an_arm_that_others_move_is_ready_when_it_stands_elsewhere(env):
    with peers(Controller(env, controller=None, split=True)) as (arm,):
        params = fixed(FreedriveParams, joints=tuple(arm.joints), still=0.2)
        with robot_ros2_freedrive.function(ARM, params) as robot:
            start = robot.state().joints
            for turn in (0.0, 0.3):
                robot.move_joints(start, 1.0, 1.0)
                if turn:
                    robot.wait_cycle()
                    assert robot.state().mode == "moving"
                    arm.tell(hand=(start + turn).tolist(), seconds=0.5)
                until = time.monotonic() + 5
                while robot.state().mode != "ready":
                    assert time.monotonic() < until
                    robot.wait_cycle()
                assert np.allclose(robot.state().joints, start + turn, atol=1e-3)
            arm.ask(silent=0.3, truth=True)
            time.sleep(0.15)
            before = time.monotonic_ns()
            assert robot.state().time_ns > before  # waited for: nothing of ours depends on it
            arm.ask(silent=2.0, truth=True)
            with pytest.raises(DeviceError, match=r"silent for 0\.[5-9]\d s, at most 0\.5 s"):
                while True:
                    robot.wait_cycle()
                    robot.state()


@pytest.mark.parametrize(
    ("signal_of", "said"),
    [
        (signal.SIGKILL, "the bridge to ROS 2 has ended"),
        (signal.SIGSTOP, r"the bridge to ROS 2 did not answer within 2.5 s"),
    ],
)
def test_a_camera_whose_bridge_is_killed_or_held_names_its_topic_in_one_line(env, signal_of, said):
    topics = {"depth": "/camera/image_rect_raw"}
    with (
        peers(Controller(env), Camera(env, "depth")),
        scanner_ros2.function(EYE, Topics(**topics)) as eye,
    ):
        eye.expose()()
        eye.require_alive()
        os.kill(eye._bridge._pipe._process.pid, signal_of)
        with pytest.raises(DeviceError) as error:
            while True:
                eye.expose()
        if signal_of == signal.SIGKILL:  # an arm on its way asks some times a second, and stops
            with pytest.raises(
                DeviceError, match="/camera/image_rect_raw: the bridge to ROS 2 has"
            ):
                eye.require_alive()
        assert re.match(f"scanner.ros2: /camera/image_rect_raw: {said}", str(error.value))
        assert "\n" not in str(error.value)


def test_an_answer_that_comes_too_late_is_not_that_to_the_next_question(env):
    with peers(Camera(env, "depth")), Bridge("a test") as bridge:
        bridge.follow("/camera/camera_info", Type.INFO)
        process = bridge._pipe._process.pid
        os.kill(process, signal.SIGSTOP)
        with pytest.raises(DeviceError, match="a test: the bridge to ROS 2 did not answer"):
            bridge.services()
        os.kill(process, signal.SIGCONT)
        assert bridge.topics()["/camera/camera_info"].type == Type.INFO


def test_a_camera_info_may_come_with_the_first_scan_and_has_to_fit_it(env):
    topics = {"depth": "/camera/image_rect_raw", "trigger": "/camera/capture"}
    with peers(Controller(env), Camera(env, "depth", triggered=True)) as (_, camera):  # noqa: SIM117
        with scanner_ros2.function(EYE, Topics(**topics)) as eye:
            assert 0.8 < np.median(eye.expose()().cloud.points()[:, 2]) < 1.1
            for info, said in (
                (
                    {"height": 7, "width": 9},
                    "and /camera/camera_info is of 9 x 7: camera_info names",
                ),
                ({"k": [0.0] * 9, "p": [0.0] * 12}, "camera_info has focal lengths of 0 and 0 px"),
                ({"d": [0.1]}, "and 1 distortion coefficients: calibrate"),
            ):
                camera.ask(info=info | {"p": [0.0] * 12}, pose=True)
                # The first scan may still be seen with the one before
                assert any(said in complaint_of(eye) for _ in range(2))


def test_a_cloud_in_millimetres_or_without_a_stamp_is_refused_in_one_line(env):
    topics = Topics(cloud="/camera/points", trigger="/camera/capture")
    with (
        peers(Controller(env), Camera(env, "zivid")) as (_, camera),
        scanner_ros2.function(EYE, topics) as eye,
    ):
        camera.ask(scale=1000.0, pose=True)
        assert re.fullmatch(
            r"/camera/points: median distance \d+ m, but phoxi-m sees 0.458 to 1.118 m; these "
            "look like millimetres: let its driver give metres", complaint_of(eye),
        )  # fmt: skip
        camera.ask(scale=1.0, stamped=False, pose=True)
        assert complaint_of(eye) == (
            "scanner.ros2: /camera/points is stamped 0, so nobody knows when it was measured: "
            "let its driver fill in header.stamp"
        )
        camera.ask(stamped=True, pose=True)
        assert not complaint_of(eye)


def complaint_of(eye):
    try:
        eye.expose()()
    except DeviceError as error:
        return str(error)
    return ""


@pytest.mark.parametrize(
    ("layout", "topics", "shape", "gone"),
    [
        ("zivid", {"cloud": "/camera/points", "trigger": "/camera/capture"}, 3, NO_SERVICE),
        ("phoxi", {"cloud": "/camera/points", "trigger": "/camera/capture"}, 3, NO_SERVICE),
        pytest.param(
            "realsense",
            {"cloud": "/camera/points"},
            2,
            "nothing came on",
            marks=pytest.mark.slow,  # a cloud at 30 Hz does not always come within 2.5 s on two cores
        ),
        ("empty", {"cloud": "/camera/points", "trigger": "/camera/trigger"}, 3, "nothing came on"),
        ("depth", {"depth": "/camera/image_rect_raw"}, 3, "nothing came on"),
    ],
)
def test_a_scan_is_the_first_stamped_after_it_was_asked_for(env, layout, topics, shape, gone):
    with peers(Controller(env), Camera(env, layout)) as (_, camera):  # noqa: SIM117
        with scanner_ros2.function(EYE, Topics(**topics)) as eye:
            scan = eye.expose()()
            assert scan.cloud.xyz.ndim == shape
            assert 0.8 < np.median(scan.cloud.points()[:, 2]) < 1.1
            assert scan.cloud.points().any(axis=1).all()
            camera.ask(offset=-9.0, pose=True)
            with pytest.raises(DeviceError, match="all stamped before they were asked for"):
                eye.expose()
            camera.kill()
            with pytest.raises(DeviceError, match=gone):
                eye.expose()
