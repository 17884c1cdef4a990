"""Simulate a year of monitor checks in a cell with daily and seasonal temperature changes.

The arm and the scanner's stand expand with temperature. Each scan has noise, and each check its own
pose error of the arm. The monitor gets the calibration, its covariance and the maker's noise
figures, and the simulated observations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.types import Floats
from flangeye.types.geometry import rigid, rotation_exp, rotation_from_rpy
from flangeye.workflow.doctor.monitor.drift import CheckSightings, sightings_of

ABOUT = np.array([0.45, 0.0, 0.35])
CORNERS = 0.15 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])

Change = Callable[[NDArray[np.intp]], Floats]
"""What a check's index, (n,), gives: (n, k)."""


@dataclass(frozen=True)
class Year:
    """Parameters of the simulated year.

    Attributes:
        checks: Number of checks, three a day.
        scans: Scans of the flange at each.
        centre_noise: Standard deviation of a fitted centre per axis [m].
        normal_noise: Standard deviation of a fitted normal [rad].
        arm_noise: Repeatability per axis [m].
        daily: Amplitude of the daily temperature cycle [K].
        seasonal: Amplitude of the seasonal temperature cycle [K].
        calibration: Standard deviation of the stored calibration, at the work [m].
    """

    checks: int = 1095
    scans: int = 3
    centre_noise: float = 0.05e-3
    normal_noise: float = 4e-4
    arm_noise: float = 0.03e-3
    daily: float = 2.0
    seasonal: float = 3.0
    calibration: float = 0.05e-3


@dataclass(frozen=True, eq=False)
class Happening:
    """Changes of the cell, each as a function of the check's index.

    Attributes:
        motion: (n,) checks to (n, 6) motions of the scanner about itself.
        joints: (n,) checks to (n, 6) errors of the joint zeros [rad].
        tool: (n,) checks to (n, 3) displacements of the circle on the flange [m].
    """

    motion: Change = lambda k: np.zeros((len(k), 6))
    joints: Change = lambda k: np.zeros((len(k), 6))
    tool: Change = lambda k: np.zeros((len(k), 3))


@dataclass(frozen=True, eq=False)
class Watched:
    """Input of the monitor from a simulated year.

    Attributes:
        sightings: Observations of every check.
        prior: (6, 6) covariance of the calibration about :data:`ABOUT`.
        scanner: (3,) position of the scanner by the calibration [m].
    """

    sightings: CheckSightings
    prior: Floats
    scanner: Floats


def step_at(check: int, size: Floats) -> Change:
    """Return a step function: zero before a check, ``size`` from it on."""
    return lambda k: np.where(k[:, None] >= check, size, 0.0)


def ramp_to(size: Floats, start: int, end: int) -> Change:
    """Return a ramp from zero to ``size``."""
    return lambda k: np.clip((k[:, None] - start) / (end - start), 0.0, 1.0) * size


def watch(year: Year, happening: Happening, rng: np.random.Generator) -> Watched:
    """Return the monitor's input for a random year."""
    arm, stations = _arm()
    check = np.asarray(np.repeat(np.arange(year.checks), year.scans), dtype=np.intp)
    joints = stations[np.arange(len(check)) % year.scans]
    believed = arm.flange(joints)
    truth = scanner_pose()
    prior = np.diag([(year.calibration / 0.3) ** 2] * 3 + [year.calibration**2] * 3)
    pose = _moved(truth, rng.multivariate_normal(np.zeros(6), prior), ABOUT)
    centres, normals = _seen(year, happening, rng, (arm, joints, check, truth))
    own = np.zeros((len(check), 5, 5))
    own[:, :3, :3] = (year.centre_noise**2 + year.arm_noise**2) * np.eye(3)
    own[:, 3:, 3:] = year.normal_noise**2 * np.eye(2)
    jacobians = arm.jacobian(joints)
    sightings = sightings_of(pose, ABOUT, centres, normals, own, believed, jacobians, check)
    return Watched(sightings, prior, pose[:3, 3])


def _seen(
    year: Year,
    happening: Happening,
    rng: np.random.Generator,
    cell: tuple[Arm, Floats, NDArray[np.intp], Floats],
) -> tuple[Floats, Floats]:
    """Return the measured centres and normals in the camera."""
    arm, joints, check, truth = cell
    warm = _temperature(year, rng)[check]
    flanges = arm.flange(joints + happening.joints(check))
    # Expansion of aluminium [1/K].
    flanges[:, :3, 3] *= 1 + 23e-6 * warm[:, None]
    flanges[:, :3, 3] += np.einsum("nij,nj->ni", flanges[:, :3, :3], happening.tool(check))
    flanges[:, :3, 3] += rng.normal(0, year.arm_noise, (len(check), 3))
    cameras = np.array([_moved(truth, m, truth[:3, 3]) for m in happening.motion(check)])
    cameras[:, 2, 3] *= 1 + 12e-6 * warm  # the stand is of steel
    inverse = np.linalg.inv(cameras)
    centres = np.einsum("nij,nj->ni", inverse[:, :3, :3], flanges[:, :3, 3]) + inverse[:, :3, 3]
    normals = np.einsum("nij,nj->ni", inverse[:, :3, :3], flanges[:, :3, 2])
    turned = rotation_exp(rng.normal(0, year.normal_noise, (len(check), 3)))
    noise = rng.normal(0, year.centre_noise, centres.shape)
    return centres + noise, np.einsum("nij,nj->ni", turned, normals)


def _temperature(year: Year, rng: np.random.Generator) -> Floats:
    """Return (n,) kelvin away from where the cell was calibrated, three checks a day."""
    day = np.arange(year.checks) / 3
    phase = rng.uniform(0, 2 * np.pi, 2)
    cycle = year.seasonal * np.sin(2 * np.pi * day / 365 + phase[0])
    cycle += year.daily * np.sin(2 * np.pi * day + phase[1])
    return np.asarray(cycle - year.seasonal * np.sin(phase[0]) + rng.normal(0, 0.5, year.checks))


@lru_cache(maxsize=1)
def _arm() -> tuple[Arm, Floats]:
    """Return the arm, and joint angles (3, 6) that show the flange with different tilts."""
    arm, poses = Arm(load_model("robots", "ur5")), []
    for tilt, at in zip(
        [(0.25, 0.0), (-0.2, 0.2), (0.0, -0.3)],
        [(0.40, -0.10, 0.40), (0.52, 0.08, 0.30), (0.42, 0.12, 0.36)],
        strict=True,
    ):
        poses.append(rigid(rotation_from_rpy(tilt[0], tilt[1], 0.0), np.array(at)))
    return arm, np.array([arm.inverse(pose)[0] for pose in poses])


def scanner_pose() -> Floats:
    """Return the calibrated ``base_T_camera`` of the cell."""
    return rigid(rotation_from_rpy(np.pi - 0.1, 0.1, 0.4), np.array([0.5, 0.1, 1.05]))


def _moved(pose: Floats, motion: Floats, about: Floats) -> Floats:
    """Return a pose turned and shifted about a point."""
    turn = rotation_exp(motion[:3])
    shift = turn @ (pose[:3, 3] - about) + about + motion[3:]
    return rigid(turn @ pose[:3, :3], shift)
