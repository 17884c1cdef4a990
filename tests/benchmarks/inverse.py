"""What inverse kinematics cost a pose: ``python -m tests.benchmarks.inverse``."""

import time

import numpy as np

from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model, model_names

POSES = 30


def median_ms(solve, poses):
    solve(poses[0])
    seconds = []
    for pose in poses:
        start = time.perf_counter()
        solve(pose)
        seconds.append(time.perf_counter() - start)
    return 1e3 * np.median(seconds)


def main():
    for name in model_names("robots"):
        arm = Arm(load_model("robots", name))
        low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
        shares = np.random.default_rng(0).uniform(0.1, 0.9, (POSES, arm.n))
        poses = arm.flange(low + shares * (high - low))
        starts = arm._starting_points(48)
        ours = median_ms(arm.inverse, poses)
        many = median_ms(lambda pose, arm=arm, starts=starts: arm.inverse_near(pose, starts), poses)
        how = "closed form" if arm.in_closed_form else "searched" if arm._search else "iterated"
        print(
            f"{name:20}  {ours:7.3f} ms  {how:11}  {many / ours:6.1f} times faster than many starts"
        )


if __name__ == "__main__":
    main()
