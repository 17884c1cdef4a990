"""From a terminal in which ROS 2 runs to a verified matrix on the graph; in realtime."""

import itertools
import json
import signal
import time

import numpy as np
import pytest

from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.types.geometry import rigid, rotation_exp
from tests.plugins.ros2 import installed
from tests.plugins.ros2.cell import (
    TOWARDS,
    Camera,
    Controller,
    Frames,
    Terminal,
    peers,
)

pytestmark = [pytest.mark.realtime, pytest.mark.ros2]

QUICK = ("--set", "robot.limits.speed=500 mm/s", "--set", "robot.limits.joint_speed=60 deg/s")
FEW = ("--set", "acquire.live.poses.next_best.count=8")
PRODUCTION = ("--set", "scanner.driver={ros2: {cloud: /cell/eye/points}}")
OUTSIDE = np.radians([-90.0, -90.0, 90.0, -90.0, -90.0, 0.0]).tolist()
"""Where the cell's program takes the arm besides: out of the box, and the camera sees no flange."""
DRIFT = "  - verify.drift: {reference: run/run.mcap}\n  - export"
TRIGGERED = ("--trigger", "/camera/capture")
PRINTED = "charuco: {columns: 6, rows: 5, square: 18 mm, marker: 13 mm, dictionary: 4X4_50}"
SEES = {"realsense": TRIGGERED, "zivid": TRIGGERED, "image": ("--target", PRINTED)}
ROOT = {"realsense": "camera_link", "zivid": "camera", "image": "optical_frame"}
"""What is joined to the arm's base: the root of the camera's own frames, where it has any."""
LINK = [0.01, 0.02, -0.03, -0.5, 0.5, -0.5, 0.5]


@pytest.fixture
def terminal(tmp_path):
    installed.require()
    return Terminal(tmp_path, installed.environment(installed.free_domain()))


def found(terminal, run="run", name="base_T_camera"):
    result = terminal.result(run)
    assert result["status"] == "verified"
    return np.array(result["transforms"][name]["matrix"])


def require_near(matrix, truth):
    assert np.abs((matrix - truth)[:3, 3]).max() < 3e-3
    assert np.abs((matrix - truth)[:3, :3]).max() < 5e-3


@pytest.mark.parametrize("layout", ["realsense", "zivid", "image"])
def test_two_commands_lead_to_a_verified_matrix_and_a_third_to_the_graph(terminal, layout):
    installed.tf2_msgs()
    env = terminal.env
    own = [["camera_link", "optical_frame", LINK]] if layout == "realsense" else []
    arm = Controller(env, seed=1, joints=TOWARDS)
    eye = Camera(env, layout, resolution=0.4)
    with peers(arm, eye, Frames(env, own)) as (_, camera, tree):
        out, _ = terminal.run("init", "--ros2", "--scanner", "phoxi-m", "--yes", *SEES[layout])
        assert "ur5e: base_link to tool0, 6 joints" in out
        terminal.run("run", "recipe.yaml", "--move", "--out", "run", *QUICK, *FEW)
        matrix = found(terminal)
        require_near(matrix, camera.pose())
        if not own:
            check = ("monitor", "run", "--live", "--scans", "2", "--move")
            assert json.loads(terminal.run(*check, *QUICK)[0])["state"] == "OK"
        publishing = terminal.start("publish", "run")
        try:
            parent, pose = tree.heard_of(ROOT[layout])
            assert parent == "base_link"
            link_T_camera = tree.heard_of("optical_frame")[1] if own else np.eye(4)
            assert np.allclose(pose @ link_T_camera, matrix, atol=1e-6)
            publishing.send_signal(signal.SIGINT)
            said, wrong = publishing.communicate(timeout=30)
        finally:
            publishing.kill()
        assert publishing.returncode == 0, wrong
        assert "published until Ctrl-C" in said


def test_an_arm_that_others_move_is_calibrated_and_then_watched(terminal):
    poses, eye = leaning(), {"layout": "phoxi", "resolution": 0.4, "namespace": "/cell/eye"}
    with peers(
        Controller(terminal.env, controller=None, joints=TOWARDS, prefix="left_",
                   namespace="/cell"), Camera(terminal.env, **eye),
    ) as (arm, camera):  # fmt: skip
        terminal.run("init", "--ros2", "--scanner", "phoxi-m", "--yes",
                     "--trigger", "/cell/eye/capture")  # fmt: skip
        by_hand(terminal, arm, poses, "run", "recipe.yaml", "--out", "run", *FEW)
        require_near(found(terminal), camera.pose())
        camera.kill()
        # From here on the cell works: its own program moves the arm and triggers the camera
        places = [next(poses).tolist() for _ in range(6)]
        arm.tell(program=[*places[:3], OUTSIDE, *places[3:]], stands=1.5)
        with peers(Camera(terminal.env, **eye, production=True)):
            checked, watched = check_a_running_cell(terminal, 0)
            assert checked["state"] == "OK"
            assert "live: ur5e on /cell/joint_states and /cell/eye/points" in watched
        with peers(Camera(terminal.env, **eye, production=True, moved=[0.005, 0.0, 0.0])):
            assert check_a_running_cell(terminal, 2)[0]["state"] == "MOVED"
            recipe = (terminal.folder / "recipe.yaml").read_text()
            (terminal.folder / "again.yaml").write_text(recipe.replace("  - export", DRIFT, 1))
            terminal.run("run", "again.yaml", "--out", "again", *FEW, *PRODUCTION, expect=1)
            drift = terminal.result("again")["verifications"]["5.verify.drift"]
            assert not drift["passed"]
            assert drift["reason"].startswith("the cell has moved since")


@pytest.mark.parametrize("moved_by", ["the run", "hand"])
def test_a_camera_in_hand_is_calibrated_before_a_fixed_board(terminal, moved_by):
    installed.tf2_msgs()
    env, words = terminal.env, ("run", "recipe.yaml", "--out", "run", *FEW)
    controller = "arm_controller" if moved_by == "the run" else None
    arm = Controller(env, seed=1, joints=TOWARDS, controller=controller)
    with peers(arm, Camera(env, "image", in_hand=True), Frames(env)) as (arm, camera, tree):
        out, _ = terminal.run("init", "--ros2", "--scanner", "phoxi-m", "--yes",
                              "--camera", "flange", "--target", PRINTED)  # fmt: skip
        assert "rough position of the printed target in the base" in out
        if controller:
            terminal.run(*words, "--move", *QUICK)
        else:
            by_hand(terminal, arm, leaning(0.2), *words)
        matrix = found(terminal, name="flange_T_camera")
        require_near(matrix, camera.pose())
        with terminal.start("publish", "run") as publishing:
            parent, pose = tree.heard_of("optical_frame")
            publishing.send_signal(signal.SIGINT)
        assert parent == "tool0"
        assert np.allclose(pose, matrix, atol=1e-6)


def check_a_running_cell(terminal, code):
    """Return what a check of a cell that goes on printed, and what watching it showed."""
    check = ("monitor", "run", "--live", "--scans", "2", *PRODUCTION)
    with terminal.start(*check) as checking:
        while not [*terminal.folder.glob("run/checks/*_check/run.mcap")]:
            assert checking.poll() is None, checking.stderr.read()
            time.sleep(0.1)
        watched, _ = terminal.run("watch", "run")
        said, wrong = checking.communicate(timeout=120)
    assert checking.returncode == code and said, wrong
    return json.loads(said), watched


def by_hand(terminal, arm, poses, *words):
    """Run a command, and move the arm whenever it asks for it."""
    told = []
    with terminal.start(*words) as run:
        for line in run.stderr:
            told.append(line)
            if line.startswith("Move the flange on"):
                arm.tell(hand=next(poses).tolist(), seconds=1.0)
    assert run.returncode == 0, told[-1]


def leaning(lean=0.35):
    """Joint angles (6,) [rad] at which the flange faces the camera, each leaning another way."""
    arm = Arm(load_model("robots", "ur5e"))
    start = np.radians(TOWARDS)
    for i in itertools.count():
        turn, around = lean * np.array([np.cos(2.4 * i), np.sin(2.4 * i), 0.0]), arm.flange(start)
        shift = 0.06 * np.array([np.sin(1.9 * i), np.cos(1.3 * i), np.sin(2.9 * i)])
        pose = rigid(around[:3, :3] @ rotation_exp(turn), around[:3, 3] + shift)
        near = [q for q in arm.inverse(pose) if np.abs(q - start).max() < 1.0]
        if near:
            yield near[0]
