"""How many poses each planner needs for the same uncertainty: python -m tools.study_next_best

The simulated cell (a UR5e with the joint zeros and the repeatability of its file, before a
PhoXi M), without clouds: each centre and normal is drawn with the covariance that ``fit.rim``
states at that distance. ``solve.robust`` states, pose by pose, what no point of the work is off by
more than with 95 % probability, but for what the arm does wrong alike at all poses: what ends an
online session (``required``), for no pose lessens the rest. The grid's level after so many poses is the uncertainty to reach.
"""

import sys
from typing import NamedTuple

import numpy as np

from flangeye.maths.statistics import corners_of, largest_error_quantile
from flangeye.models.cell import cell_of
from flangeye.models.configuration import DEFAULT
from flangeye.models.loading import load_model
from flangeye.models.scanners import middle_of_view
from flangeye.motion.reach import Reach, Site
from flangeye.types import BASE, FLANGE, Box, CircleFeature, Observation, Transform, by_frame
from flangeye_emulators.world.arm import ImperfectArm
from flangeye_emulators.world.scanner import CameraPose
from flangeye_plugins.plan import GridParams, NextBestParams, grid, next_best
from flangeye_plugins.solve.robust import RobustParams, solve_cell

ROBOT, SCANNER = load_model("robots", "ur5e"), load_model("scanners", "phoxi-m")
BASE_T_CAMERA = CameraPose().matrix
WORK = np.array([0.3, 0.3, 0.2])
CENTRE_NOISE = np.array([20e-6, 20e-6, 40e-6])
NORMAL_NOISE = np.radians(0.01)
GRID_POSES = 20


class Level(NamedTuple):
    """Uncertainty after some poses: the stated 95 % error at the work, and the true rms [m]."""

    poses: int
    stated: float
    true: float


def observe(joints, base_T_flange, arm, rng):
    """Return the simulated observation of the flange at a pose."""
    camera_T_flange = np.linalg.inv(BASE_T_CAMERA) @ arm.stand(joints, rng)[1]
    normal = camera_T_flange[:3, 2] + rng.normal(0.0, NORMAL_NOISE, 3)
    normal /= np.linalg.norm(normal)
    circle = CircleFeature(
        camera_T_flange[:3, 3] + rng.normal(0.0, CENTRE_NOISE), normal, {"rim": 0.0305},
        np.diag(CENTRE_NOISE**2), NORMAL_NOISE**2 * (np.eye(3) - np.outer(normal, normal)), 1.0,
    )  # fmt: skip
    pose = Transform(BASE, FLANGE, arm.reported(joints))
    return Observation(str(rng.integers(1 << 30)), circle, by_frame(pose), joints)


def levels(plan, params, seed, poses):
    """Return the level after each pose of a plan, from the first that may end a run on."""
    reach = Reach(ROBOT, SCANNER, BASE_T_CAMERA, 0.0375)
    site = Site(
        middle_of_view(SCANNER, BASE_T_CAMERA),
        BASE_T_CAMERA[:3, 3],
        reach.facing_rotation,
        reach.joints,
    )
    planned = plan(site, np.random.default_rng(seed), params)
    arm, rng = ImperfectArm(ROBOT, 1.0, np.random.default_rng(seed)), np.random.default_rng(seed)
    seen = []
    for pose, _ in zip(planned.poses, range(poses), strict=False):
        seen.append(observe(pose.joints, pose.base_T_flange, arm, rng))
        if len(seen) >= 6:
            yield level(seen, planned.centre)


def level(seen, centre):
    found = solve_cell(seen, cell_of(DEFAULT, ROBOT), RobustParams())
    known = found.base_T_camera
    stated = largest_error_quantile(known.covariance, known.about, corners_of(centre, WORK))
    off = known.transform.matrix @ np.linalg.inv(BASE_T_CAMERA)
    work = Box(centre, WORK).grid()
    errors = work @ off[:3, :3].T + off[:3, 3] - work
    return Level(len(seen), stated, float(np.sqrt((errors**2).sum(axis=1).mean())))


def compare(seed):
    """Return the grid's level after :data:`GRID_POSES`, and the first of next_best that is as good."""
    *_, wanted = levels(grid, GridParams(counts=(5, 5, 3)), seed, GRID_POSES)
    chosen = levels(next_best, NextBestParams(), seed, GRID_POSES)
    return wanted, next((each for each in chosen if each.stated <= wanted.stated), None)


if __name__ == "__main__":
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    print("seed  95 % below  grid  next_best  share  true error of each (mm)")
    for seed in range(seeds):
        wanted, found = compare(seed)
        share = found.poses / wanted.poses
        print(
            f"{seed:4}  {wanted.stated * 1e3:7.3f} mm  {wanted.poses:4}  {found.poses:9}  "
            f"{share:4.0%}   {wanted.true * 1e3:.3f}  {found.true * 1e3:.3f}"
        )
