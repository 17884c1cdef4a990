"""A cell under ROS 2: an arm behind a controller and a camera, each a node in its own process."""

import json
import queue
import subprocess
import sys
import threading
import time
from contextlib import contextmanager, suppress
from typing import Any, ClassVar, NamedTuple

import numpy as np

from flangeye.types.geometry import rigid, rotation_from_quaternion
from flangeye.workflow.log.read import read_run
from tests.plugins.ros2.installed import environment, free_domain

FACING = [180.0, -90.0, 90.0, -90.0, -90.0, 0.0]
"""Joint angles at which the UR5e holds its flange below the camera [deg]."""

TOWARDS = [16.0, -119.0, -112.0, -39.0, -86.0, 164.0]
"""Those at which the flange faces the camera, 0.6 m before it [deg]."""


class Peer:
    """A node in a process of its own, that takes words and says some."""

    def __init__(self, script, options, env):
        command = [sys.executable, "-m", f"tests.plugins.ros2.peers.{script}", json.dumps(options)]
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=env
        )
        self._said: queue.Queue = queue.Queue()
        self._listener = threading.Thread(target=self._listen, daemon=True)
        self._listener.start()
        assert self.heard()["ready"]

    def tell(self, **words):
        self.process.stdin.write(json.dumps(words) + "\n")
        self.process.stdin.flush()

    def ask(self, **words):
        self.tell(**words)
        return self.heard()

    def heard(self, patience=30):
        said = self._said.get(timeout=patience)
        assert said is not None, "the peer has ended"
        return said

    def kill(self):
        self.process.kill()
        self.process.wait()
        self._listener.join()
        with suppress(OSError):
            self.process.stdin.close()
        self.process.stdout.close()

    def _listen(self):
        for line in self.process.stdout:
            self._said.put(json.loads(line))
        self._said.put(None)


class Controller(Peer):
    """The arm and its controller."""

    topic = "/arm_controller/joint_trajectory"

    def __init__(self, env, **options):
        given = {
            "robot": "ur5e", "joints": FACING, "prefix": "", "namespace": "", "seed": None,
            "controller": "arm_controller", "latency": 0.01, "lag": 0.02, "sim_time": False,
            "ends": ["tool0"], "split": False, "best_effort": False,
        }  # fmt: skip
        super().__init__("controller", given | options, env)
        self.joints = [f"{options.get('prefix', '')}joint_{i}" for i in range(1, 7)]

    def history(self):
        """Rows of time.monotonic() and the fastest joint's speed [rad/s], on the arm's side."""
        return self.ask(history=True)["history"]

    def rest_after(self, moment):
        """How long after a moment of time.monotonic() the arm came to rest for good [s]."""
        moving = [time for time, speed, _ in self.history() if speed > 1e-3]
        return max(moving[-1] - moment, 0.0) if moving else 0.0


class Camera(Peer):
    """The camera's driver."""

    def __init__(self, env, layout="zivid", **options):
        given = {
            "robot": "ur5e", "scanner": "phoxi-m", "layout": layout, "namespace": "/camera",
            "seed": 1, "resolution": 0.2, "prefix": "", "sim_time": False, "moved": [0.0, 0.0, 0.0],
            "refuses": "", "lens": "plumb_bob", "joints": FACING, "triggered": False,
            "production": False, "in_hand": False,
        }  # fmt: skip
        super().__init__("camera", given | options, env)

    def pose(self):
        """Where it really stands, base_T_camera (4, 4); in hand, flange_T_camera."""
        return np.array(self.ask(pose=True)["pose"])


class Frames(Peer):
    """The tf tree, rows of parent, child, and x y z qx qy qz qw."""

    def __init__(self, env, static=(), tf=()):
        super().__init__("frames", {"static": static, "tf": tf}, env)

    def heard_of(self, child, patience=30.0):
        """Return the parent and the pose (4, 4) that /tf_static gives a frame."""
        until = time.monotonic() + patience
        while child not in (told := self.ask(heard=True)["heard"]):
            assert time.monotonic() < until, f"of {child} nothing was told, but of {[*told]}"
            time.sleep(0.1)
        parent, numbers = told[child]
        return parent, rigid(rotation_from_quaternion(np.array(numbers[3:])), numbers[:3])


class Terminal:
    """A terminal in which ROS 2 is sourced, in a folder of its own."""

    def __init__(self, folder, env):
        self.folder, self.env = folder, env

    def start(self, *words, **terminal):
        return subprocess.Popen(
            [sys.executable, "-m", "flangeye.cli", *map(str, words)], cwd=self.folder,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=self.env,
            **{"stdin": subprocess.DEVNULL, **terminal},
        )  # fmt: skip

    def run(self, *words, expect=0, patience=240):
        """Return what a command wrote, its output first."""
        process = self.start(*words)
        out, err = process.communicate(timeout=patience)
        assert process.returncode == expect, (process.returncode, out, err)
        return out, err

    def result(self, run="run"):
        return json.loads((self.folder / run / "result.json").read_text())


class Truth(NamedTuple):
    """How fast the flange really goes [m/s], and when [s]."""

    time: float
    speed: float


class Ros2Cell(Terminal):
    """A cell that runs under ROS 2, as ``tools.faults`` has one on loopback."""

    faults: ClassVar[dict[str, dict[str, Any]]] = {
        "controller rejects": {"rejects": True}, "joint states silent": {"silent": 3.0},
        "silent for 0.5 s": {"silent": 0.5}, "stamps jump back": {"jump": -5.0},
        "stamps jump ahead": {"jump": 5.0},
    }  # fmt: skip

    def __init__(self, folder):
        super().__init__(folder, environment(free_domain()))
        self.arm = Controller(self.env, seed=1, joints=TOWARDS)
        self.eye = Camera(self.env, "zivid")
        self.control = self

    def recipe(self):
        self.run("init", "--ros2", "--scanner", "phoxi-m", "--yes", "--trigger", "/camera/capture")
        return self.folder / "recipe.yaml"

    def truth(self):
        return Truth(**self.arm.ask(truth=True))

    def fault(self, name):
        self.arm.tell(**self.faults[name])

    def finished(self, run="run"):
        """Return the captures that have gone through so far."""
        log = self.folder / run / "run.mcap"
        return read_run(log).finished if log.exists() else []

    def wait_until(self, condition, patience):
        until = time.monotonic() + patience
        while not condition():
            assert time.monotonic() < until, "it did not come so far"
            time.sleep(0.02)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.arm.kill()
        self.eye.kill()


@contextmanager
def peers(*started):
    try:
        yield started
    finally:
        for peer in started:
            peer.kill()
