"""What a controller on loopback costs and how punctual it is: ``python -m tools.measure_emulator``.

Runs the real client against it; a busy machine makes every figure worse, so its load is printed.
"""

import os
import sys
import time

import numpy as np

from tests.emulators.controllers.process import Process


def cpu_share(control, action):
    """Return the share of one core the controller's process took during an action, and its time."""
    before, began = control.figures()["cpu"], time.monotonic()
    action()
    elapsed = time.monotonic() - began
    return (control.figures()["cpu"] - before) / elapsed, elapsed


def rate(receive, seconds):
    """Return packages per second as the client sees them, and the longest wait for one [s]."""
    seen = []
    last, limit = None, time.perf_counter() + seconds
    while time.perf_counter() < limit:
        stamp = receive.getTimestamp()
        if stamp != last:
            seen.append((stamp, time.perf_counter()))
            last = stamp
        time.sleep(1e-4)
    stamps, times = np.array(seen).T
    return (stamps[-1] - stamps[0]) / 0.002 / (times[-1] - times[0]), np.diff(times).max()


def main():
    import rtde_control
    import rtde_receive

    say = sys.stdout.write
    with Process() as process:
        control = process.control
        began = time.monotonic()
        receive = rtde_receive.RTDEReceiveInterface(process.host)
        say(f"receive connects in {1e3 * (time.monotonic() - began):.0f} ms\n")
        began = time.monotonic()
        robot = rtde_control.RTDEControlInterface(process.host)
        say(f"control connects in {1e3 * (time.monotonic() - began):.0f} ms\n")
        share, _ = cpu_share(control, lambda: time.sleep(3.0))
        say(f"idle, two clients: {100 * share:.1f} % of a core\n")
        pose = receive.getActualTCPPose()
        there = [*pose[:2], pose[2] - 0.2, *pose[3:]]
        share, elapsed = cpu_share(control, lambda: robot.moveL(there, 0.1, 1.2))
        say(
            f"moveL: {100 * share:.1f} % of a core, {elapsed:.3f} s for {0.2 / 0.1 + 0.1 / 1.2:.3f} s\n"
        )
        packages, gap = rate(receive, 5.0)
        say(
            f"{packages:.1f} packages/s of the controller's time, longest wait {1e3 * gap:.1f} ms\n"
        )
        figures = control.figures()
        late = ", ".join(f"{k[5:]} {1e3 * figures[k]:.2f} ms" for k in figures if k[:4] == "late")
        say(f"{figures['ticks']:.0f} cycles, made up {figures['made_up']:.0f}, gaps ")
        say(f"{figures['gaps']:.0f}, late by: {late}\n")
        say(f"load average {os.getloadavg()[0]:.1f} on {os.cpu_count()} cores\n")
        robot.disconnect()
        receive.disconnect()


if __name__ == "__main__":
    main()
