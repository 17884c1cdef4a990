"""How quick robot.ur_rtde is on this machine: ``python -m tests.plugins.robot.measure``.

The controller is on loopback, in a process of its own. Where this process may, it comes first, as
a program that closes a loop at 500 Hz has to; what is left is the driver's own time.
"""

from __future__ import annotations

import time

import numpy as np

from flangeye_plugins.robot.ur.worker import take_realtime_priority
from tests.emulators.controllers.process import Process
from tests.plugins.robot.cell import open_ur

CYCLES = 2500
UPWARDS = np.array([0, 0, 0.01, 0, 0, 0])


def seconds(action):
    began = time.perf_counter()
    action()
    return time.perf_counter() - began


def main():
    with Process() as process:
        opening = time.perf_counter()
        with open_ur(process.host) as robot:
            opening = time.perf_counter() - opening
            take_realtime_priority()
            commands, reads = [], []
            for _ in range(CYCLES):
                commands.append(seconds(lambda: robot.move_velocity(UPWARDS, 0.5)))
                reads.append(seconds(robot.state))
                robot.wait_cycle()
            closing = seconds(robot.close)
    print(f"open {opening:.2f} s, close {closing:.2f} s")
    for name, taken in (("velocity command", commands), ("state", reads)):
        median, high, worst = 1e3 * np.percentile(taken, [50, 99, 100])
        print(f"{name}: {median:.2f} ms (median), {high:.2f} ms (99 %), {worst:.2f} ms (worst)")


if __name__ == "__main__":
    main()
