"""What tests of drivers share: controllers on loopback, poses to go to, and a clock on every call."""

from __future__ import annotations

import time
from contextlib import contextmanager

import numpy as np

from flangeye.devices import PATIENCE, SILENT
from flangeye.models.loading import load_model
from flangeye.types import Transform
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_plugins.robot.tool_check import ControllerParams
from flangeye_plugins.robot.ur.driver import robot_ur_rtde

UR5E = load_model("robots", "ur5e")


def open_ur(host, **params):
    return robot_ur_rtde(UR5E, ControllerParams(host=host, **params))


def moved(pose, x=0.0, y=0.0, z=0.0, turn=(0.0, 0.0, 0.0)):
    rotation = rotation_exp(np.array(turn)) @ pose.rotation
    return Transform("base", "flange", rigid(rotation, pose.translation + [x, y, z]))


@contextmanager
def in_time(limit=PATIENCE):
    """Fail when what is inside takes longer than a driver may."""
    began = time.monotonic()
    yield
    lasted = time.monotonic() - began
    assert lasted < limit, f"a call took {lasted:.1f} s"


def until(condition, patience=PATIENCE):
    """Wait until a condition holds; return what it gave."""
    end = time.monotonic() + patience
    while not (found := condition()):
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.002)
    return found


def arrived(robot, order=lambda: None, done=lambda state: state.mode != "moving", patience=20.0):
    """Give an order and watch the arm until it is done; return the last state.

    The order is given again where this computer was too busy to look in time: a motion that nobody
    looks at ends. Nor is an arm believed to be done that was looked at, or told of itself, late
    since the order: it is sent once more, and has arrived when nothing held it up on the way.
    """
    looked = time.monotonic()
    end = looked + patience
    order()
    told, held_up = robot.state().time_ns, False
    while True:
        began = time.monotonic()
        robot.wait_cycle()
        state = robot.state()
        unseen = max(time.monotonic() - looked, 1e-9 * (state.time_ns - told))
        held_up = held_up or unseen > SILENT / 3
        finished = done(state)
        if not state.message and (unseen > SILENT or (finished and held_up)):
            began = time.monotonic()
            order()
            held_up = False
        elif finished:
            return state
        looked, told = began, state.time_ns
        assert time.monotonic() < end, "the arm does not arrive"
