"""Sessions of the foreign generator as problems of the estimator, and how wrong its answers are."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from flangeye.estimation.answers.answer import (
    Answer,
    as_reported,
    as_true,
    expected_error,
    predicted_work,
)
from flangeye.estimation.answers.work import work_of
from flangeye.estimation.estimate import Estimate, estimate
from flangeye.estimation.graph import Carrier, Problem, Sightings
from flangeye.estimation.session.session import ModelOptions, effects_of
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import Frame
from flangeye.models.model import read_model
from flangeye.models.robots import RobotModel
from flangeye.types.geometry import hat, kabsch, rigid
from tests.estimation import foreign

ROBOTS = Path(__file__).parents[2] / "data/robots"


class Score(NamedTuple):
    """NEES over 6, and the mean squares of what is stated and what is true over the box [m^2]."""

    nees: float
    stated: float
    true: float


class Scores(NamedTuple):
    """Of one session."""

    true: Score
    reported: Score
    svd: float
    expected: float
    outliers: int


@cache
def robot(name: str) -> tuple[RobotModel, Arm]:
    model = read_model(ROBOTS / f"{name}.yaml", RobotModel)
    return model, Arm(model)


def problem_of(s: foreign.Session, kind: str, poses, joints, seen) -> Problem:
    """Return the sightings of a session, or of its work, with what is stated of their noise."""
    model, arm = robot(s.arm["name"])
    hand, n = kind == "hand", len(seen)
    place = None if kind in ("marker", "hand") else np.eye(4)
    frames = {
        "flange": Frame("base", poses),
        "camera": Frame("flange" if hand else "base"),
        "target": Frame("base" if hand else "flange", place),
    }
    rotation, position = foreign.NOISE[kind]
    covariances = np.tile(np.diag([rotation**2] * 3 + [position**2] * 3), (n, 1, 1))
    projectors = np.tile(np.eye(6), (n, 1, 1))
    if kind == "flange":
        projectors[:, :3, :3] -= seen[:, :3, 2, None] * seen[:, None, :3, 2]
    if kind == "centres":
        projectors[:, :3, :3] = 0
    circles = kind in ("flange", "centres")
    sightings = Sightings(
        np.arange(n), np.zeros(n, dtype=np.intp), seen[:, :3, :3], seen[:, :3, 3],
        projectors @ covariances @ projectors, projectors, np.zeros((n, 3)), np.full(n, circles),
        np.zeros((n, 6, 0)),
    )  # fmt: skip
    carrier = Carrier("flange", "flange", arm, joints, model.joint_accuracy)
    return Problem(frames, [("camera", "target")], sightings, [carrier])


def estimated(s: foreign.Session, kind: str, told: bool = True) -> Estimate:
    """Return the estimate of a session, begun 10 mm and 0.6 degrees from the truth.

    Without its joints, where they are not ``told``.
    """
    problem = problem_of(s, kind, s.reported, s.joints, s.seen)
    if not told:
        bare = [replace(c, kinematics=None, joints=None) for c in problem.carriers]
        problem = replace(problem, carriers=bare)
    truth = {"camera": s.camera, "target": s.target}
    start = problem.moved(truth, np.full(6 * len(problem.unknown), 0.01))
    effects = effects_of(problem, None, ModelOptions())
    return estimate(problem, start, effects, np.ones(len(s.seen), dtype=bool))


def score(kind: str, arm: dict, s: float, poses: int, seed: int, told: bool = True) -> Scores:
    """Return how wrong both answers of one session are, and how wrong they say.

    The estimator is not told the box of the work that it is judged by: its own is where the
    session's poses were.
    """
    session = foreign.session(kind, arm, s, poses, seed)
    found = estimated(session, kind, told)
    work = work_of(found.problem.where(found.inliers), found.places)
    answer = as_reported(found, work)
    reported, real, _ = foreign.work(session)
    truth = foreign.reported_camera(session, reported, real)
    camera = reported @ session.camera if session.in_hand else session.camera
    points = (
        np.linalg.inv(camera) @ (session.target if session.in_hand else reported @ session.target)
    )[:, :3, 3]
    return Scores(
        _scored(found, as_true(found), session.camera, points),
        _scored(found, answer, truth, points),
        _of_svd(session, truth, points) if kind in ("flange", "centres") else np.nan,
        expected_error(predicted_work(found, work), answer.mean).rms,
        int((~found.inliers).sum()),
    )


def _scored(found: Estimate, answer: Answer, truth, seen) -> Score:
    """Return an answer's score by its truth over points (N, 3) in the camera."""
    x = found.problem.moved(found.places, answer.mean)["camera"]
    turned = Rotation.from_matrix(truth[:3, :3] @ x[:3, :3].T).as_rotvec()
    error = np.concatenate([turned, truth[:3, 3] - x[:3, 3]])
    own = answer.covariance[:6, :6]
    lever = seen @ x[:3, :3].T
    moves = np.concatenate([-hat(lever), np.tile(np.eye(3), (len(lever), 1, 1))], axis=2)
    stated = np.trace(moves @ own @ np.swapaxes(moves, 1, 2), axis1=1, axis2=2).mean()
    true = ((moves @ error) ** 2).sum(axis=1).mean()
    return Score(float(error @ np.linalg.solve(own, error)) / 6, float(stated), float(true))


def _of_svd(s: foreign.Session, truth, seen) -> float:
    """Return the mean square over the points of the plain least-squares pose of the centres."""
    x = rigid(*kabsch(s.seen[:, :3, 3], s.reported[:, :3, 3]))
    off = seen @ (x - truth)[:3, :3].T + (x - truth)[:3, 3]
    return float((off**2).sum(axis=1).mean())
