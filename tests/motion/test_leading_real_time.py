"""Whatever becomes of who leads an arm, or of its controller: the arm rests, and its arc is out."""

import os
import signal
import subprocess
import sys
import time
from contextlib import contextmanager

import pytest

from tests.emulators.controllers.process import Process
from tests.motion.leader import ARC
from tests.plugins.robot.cell import until

pytestmark = [pytest.mark.realtime, pytest.mark.alone]

pytest.importorskip("rtde_control")

RESTS, WATCHED = 0.3, 0.2
"""An arm that nobody leads any more rests after this, by its controller's clock; an arc may be out for
so long before [s]."""

OPENING = 40.0
TWENTY = pytest.param(20, marks=pytest.mark.slow)


@contextmanager
def leading(host):
    """A program that leads the arm."""
    command = [sys.executable, "-m", "tests.motion.leader", host]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as program:
        try:
            yield program
        finally:
            program.kill()


def killed(controller, program):
    os.kill(program.pid, signal.SIGKILL)


def hung(controller, program):
    os.kill(program.pid, signal.SIGSTOP)


def faulted(controller, program):
    controller.control.fault("protective-stop")


def gone_out(controller, program):
    controller.control.fault("inputs-low")


def burns(controller):
    return bool(controller.control.state()["digital_outputs"] >> ARC & 1)


@pytest.mark.parametrize("end", [killed, hung, faulted, gone_out])
@pytest.mark.parametrize("times", [1, TWENTY])
def test_the_arm_comes_to_rest_and_its_arc_is_out(end, times: int) -> None:
    with Process() as controller:
        for _ in range(times):
            controller.control.reset()
            controller.control.clear()
            with leading(controller.host) as program:
                until(lambda: controller.control.truth().speed > 0.02, OPENING)
                time.sleep(0.2)
                assert burns(controller)
                end(controller, program)
                began = controller.control.truth().time
                until(lambda: controller.control.truth().speed == 0.0, 3.0)
                rested = controller.control.truth().time
                assert rested - began <= RESTS + WATCHED * (end is gone_out)
                until(lambda: not burns(controller), 0.1)
                time.sleep(0.5)
                assert controller.control.truth().speed == 0.0
