"""A program that leads an arm, its arc burning, on loopback sideways for ever: python -m tests.motion.leader HOST."""

import sys
from functools import partial

import numpy as np

from flangeye.devices import RobotDriver
from flangeye.models.arc import ArcTimes
from flangeye.motion.arc import BURN, with_arc
from flangeye.motion.executor import servo
from flangeye.plugin.stage import BoundPart
from flangeye_plugins.arc import UrDigitalParams, arc_ur_digital
from tests.motion.stand_in import LIMITS, MODEL
from tests.plugins.robot.cell import open_ur

ARC = 3
"""The output that starts the arc."""


def main(host):
    """Lead until this process is ended, or the guard ends it; say where it has got to."""
    driver = RobotDriver("robot.ur_rtde", partial(open_ur, host))
    params = UrDigitalParams(host=host, output=ARC, established=ARC)
    arc = BoundPart(arc_ur_digital, params)
    with servo(with_arc(driver, arc, ArcTimes()), MODEL, LIMITS) as arm:
        print("leading", flush=True)
        began = arm.state().time_ns
        while True:
            arm.wait_cycle()
            turn = 0.3 * (arm.state().time_ns - began) * 1e-9  # to and fro, within the box
            arm.move_velocity(np.array([0.0, 0.05 * np.cos(turn), 0.0, 0.0, 0.0, 0.0, BURN]), 0.5)


if __name__ == "__main__":
    main(sys.argv[1])
