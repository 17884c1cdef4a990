"""What inverse kinematics cost a pose: ``python -m tests.benchmarks.inverse``."""

import time

import numpy as np

from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model, model_names

POSES = 100


def main():
    for name in model_names("robots"):
        arm = Arm(load_model("robots", name))
        low, high = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
        shares = np.random.default_rng(0).uniform(0.1, 0.9, (POSES, arm.n))
        poses = arm.flange(low + shares * (high - low))
        arm.inverse(poses[0])
        seconds = []
        for pose in poses:
            start = time.perf_counter()
            arm.inverse(pose)
            seconds.append(time.perf_counter() - start)
        how = "closed form" if arm.in_closed_form else "iterated"
        print(f"{name:20}  {1e3 * np.median(seconds):7.3f} ms  {how}")


if __name__ == "__main__":
    main()
