"""Graphs as they are: the kit, namespaces, tf, simulated time, markers; in realtime."""

from pathlib import Path

import numpy as np
import pytest

from flangeye.devices import DeviceError
from flangeye.errors import RecipeError
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.testing import RobotConformance, ScannerConformance
from flangeye.types.geometry import quaternion_from_rotation
from flangeye.workflow.recipe.draft import Questions, draft_live
from flangeye_plugins.robot.ros2.driver import (
    FreedriveParams,
    Ros2RobotParams,
    robot_ros2,
    robot_ros2_freedrive,
)
from flangeye_plugins.ros2.graph import Ros2Graph, described_arm
from flangeye_plugins.scanner.ros2 import Ros2ScannerParams as Topics
from flangeye_plugins.scanner.ros2 import scanner_ros2
from tests.plugins.ros2 import installed
from tests.plugins.ros2.cell import (
    FACING,
    TOWARDS,
    Camera,
    Controller,
    Frames,
    Terminal,
    peers,
)
from tests.plugins.ros2.urdf import urdf_of

pytestmark = [pytest.mark.realtime, pytest.mark.ros2]

ARM, EYE = load_model("robots", "ur5e"), load_model("scanners", "phoxi-m")
JOINTS = tuple(f"joint_{i}" for i in range(1, 7))


@pytest.fixture(scope="class")
def cell():
    installed.require()
    given = installed.environment(installed.free_domain())
    with pytest.MonkeyPatch.context() as patch:
        for name, value in given.items():
            patch.setenv(name, value)
        with peers(Controller(given), Camera(given, "phoxi")):
            yield


@pytest.mark.usefixtures("cell")
class TestRobot(RobotConformance):
    part = robot_ros2
    params = Ros2RobotParams(joints=JOINTS, trajectory=Controller.topic)

    def context(self):
        return {bool: False}


@pytest.mark.usefixtures("cell")
class TestScanner(ScannerConformance):
    part = scanner_ros2
    params = Topics(cloud="/camera/points", trigger="/camera/capture")


def test_the_pose_may_come_from_tf_and_is_lost_with_it(env):
    installed.tf2_msgs()
    flange = Arm(ARM).flange(np.radians(FACING))
    numbers = [*flange[:3, 3], *quaternion_from_rotation(flange[:3, :3])]
    tree = Frames(env, [["rail", "base_link", [0, 0, 1, 0, 0, 0, 1]]],
                  [["base_link", "tool0", [float(n) for n in numbers]]])  # fmt: skip
    with peers(Controller(env, controller=None), tree) as (arm, tree):
        params = FreedriveParams(joints=tuple(arm.joints), tf={})
        with robot_ros2_freedrive.function(ARM, params) as robot:
            assert np.allclose(robot.state().base_T_flange.matrix, flange, atol=1e-6)
            tree.kill()
            with pytest.raises(DeviceError, match="tf has not updated tool0 for"):
                for _ in range(100):
                    robot.wait_cycle()
                    robot.state()
        lost = FreedriveParams(joints=tuple(arm.joints), tf={"flange": "gripper"})
        with pytest.raises(DeviceError, match=r"nobody publishes /tf;|does not join base_link"):
            robot_ros2_freedrive.function(ARM, lost)


def test_simulated_time_drives_arm_and_camera(env):
    with peers(Controller(env, sim_time=True), Camera(env, "zivid", sim_time=True)) as (arm, _):
        params = Ros2RobotParams(joints=tuple(arm.joints), trajectory=arm.topic, sim_time=True)
        with robot_ros2.function(ARM, params) as robot:
            goal = robot.state().joints + 0.1
            robot.move_joints(goal, 0.5, 2.0)
            while robot.state().mode != "ready":
                robot.wait_cycle()
            assert np.abs(robot.state().joints - goal).max() < 1e-3
        topics = Topics(cloud="/camera/points", trigger="/camera/capture", sim_time=True)
        with scanner_ros2.function(EYE, topics) as eye:
            assert eye.expose()().cloud.xyz.ndim == 3
        wall = Ros2RobotParams(joints=tuple(arm.joints), trajectory=arm.topic)
        with pytest.raises(DeviceError, match="sim_time: true where stamps are of /clock"):
            robot_ros2.function(ARM, wall)


def test_a_compressed_image_shows_a_marker_with_its_camera(env):
    with peers(Controller(env, joints=TOWARDS), Camera(env, "image")):
        with scanner_ros2.function(None, Topics(image="/camera/image_raw/compressed")) as eye:
            image = eye.expose()().image
            assert image.pixels.shape[:2] == (1024, 1280)
            assert np.allclose(np.diag(image.camera_matrix), [1400, 1400, 1])
        questions = Questions({"plate": "ISO 9409-1-50-4-M6", "scanner": "phoxi-m"})
        with Ros2Graph() as graph:
            found = graph.cell(questions.ask, "cell")
        assert found.scanner["driver"]["ros2"] == {"image": "/camera/image_raw/compressed"}
        shown = r"the camera shows a ChArUco board of 6 x 5 squares, .*add --target 'charuco: {"
        with pytest.raises(RecipeError, match=shown):
            draft_live(found, questions, Path("recipe.yaml"))
        with pytest.raises(DeviceError, match="carries sensor_msgs/msg/CompressedImage, sensor_ms"):
            scanner_ros2.function(None, Topics(depth="/camera/image_raw/compressed",
                                               camera_info="/camera/camera_info"))  # fmt: skip


def test_a_graph_of_two_cells_is_told_apart(env, tmp_path):
    cells = [
        peer
        for side, towards in (("left", FACING), ("right", TOWARDS))
        for peer in (
            Controller(env, namespace=f"/{side}", prefix=f"{side}_", joints=towards,
                       controller="arm_controller", split=side == "right"),
            Camera(env, "realsense", namespace=f"/{side}/eye", prefix=f"{side}_"),
        )
    ]  # fmt: skip
    asked = {}
    chosen = {"robot": "/right/robot_description", "scans": "/right/eye/points"}

    def ask(flag, question, default, example=""):
        asked[flag] = default
        return chosen.get(flag) or default or "/right/arm_controller/joint_trajectory"

    with peers(*cells), Ros2Graph() as graph:
        names = {topic.name: topic for topic in graph.topics()}
        assert names["/left/eye/points"].publishers == ("camera",)
        found = graph.cell(ask, "cell")
    assert asked == {"robot": None, "scans": None, "trajectory": None}
    assert found.robot["base"] == "right_base_link"
    assert found.robot["driver"]["ros2"]["joint_states"] == "/right/joint_states"
    assert found.scanner["driver"]["ros2"] == {"cloud": "/right/eye/points"}
    assert np.allclose(found.flange, Arm(ARM).flange(np.radians(TOWARDS)), atol=1e-3)
    assert found.steps[0]["export.ros2_launch"]["child"] == "right_optical_frame"


def test_a_flange_that_no_name_tells_is_asked_for() -> None:
    def ask(flag, question, default, example=""):
        assert (flag, default, example) == ("flange", None, "plate")
        return "eye"

    text = urdf_of(ARM, ends=["plate", "eye"])
    found, section = described_arm(text, Path("cell.urdf"), ask)
    assert section == {"urdf": "cell.urdf", "base": "base_link", "flange": "eye"}
    assert found.flange == "eye"


@pytest.mark.parametrize(
    ("peer", "words", "said"),
    [
        (None, (), "ROS 2: no arm and no camera runs (ROS_DOMAIN_ID "),
        ({"controller": None}, (), "which topic has the scans (none runs)"),
        (
            {"joints": TOWARDS},
            ("--scans", "/none"),
            "nobody publishes clouds, depth images or images on /",
        ),
        ({"joints": TOWARDS}, ("--robot", "none.urdf"), "none.urdf"),
        ({"ends": ["plate", "eye"]}, (), "which link is the flange, z outwards (plate, eye)"),
        ({"ends": ["plate", "eye"]}, ("--flange", "tool0"), "no link 'tool0'"),
    ],
)
def test_what_init_cannot_see_is_one_line(env, tmp_path, peer, words, said):
    with peers(*([Controller(env, **peer)] if peer else [])):
        _, wrong = Terminal(tmp_path, env).run(
            "init", "--ros2", "--scanner", "phoxi-m", "--yes", *words, expect=2
        )
    assert said in wrong
    assert len(wrong.splitlines()) == 1
    assert not [*tmp_path.iterdir()]


def test_init_keeps_what_is_there_and_finds_a_service_outside_the_namespace(env, tmp_path):
    eye = Camera(env, "zivid", namespace="", joints=TOWARDS)
    with peers(Controller(env, joints=TOWARDS), eye):
        words = ("init", "--ros2", "--scanner", "phoxi-m", "--yes")
        mine = tmp_path / "recipe.urdf"
        mine.write_text("mine")
        _, wrong = Terminal(tmp_path, env).run(*words, expect=2)
        assert wrong == "error: recipe.urdf: exists already; choose another name with --out\n"
        assert mine.read_text() == "mine"
        Terminal(tmp_path, env).run(*words, "--out", "cell.yaml")
        assert "trigger: /capture" in (tmp_path / "cell.yaml").read_text()
        # A description that is given as the file it would be written to
        (tmp_path / "cell.yaml").unlink()
        own = ("--robot", "cell.urdf", "--plate", "none", "--out", "cell.yaml")
        Terminal(tmp_path, env).run(*words, *own, expect=2)
        assert (tmp_path / "cell.urdf").exists()
