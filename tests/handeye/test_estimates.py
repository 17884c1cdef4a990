"""What a solver hands on: columns, covariances about points that matter, pairs and their order."""

from typing import Any

import numpy as np
import pytest

from flangeye.handeye.estimates import (
    columns_of,
    estimate_at,
    hand_eye_of,
    pairs_of,
    points_of_interest,
    transforms_of,
)
from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.maths.kinematics import Arm
from flangeye.types import BASE, CAMERA, Transform
from tests.handeye.cells import CONFIGURATIONS, ROBOT, Noise, session

MADE = session(
    CONFIGURATIONS["two arms, marker"], np.random.default_rng(1), 6, 0.4, Noise(0, 0, 0, 0)
)
POSE = Transform(BASE, CAMERA, rigid(rotation_exp([0.3, -0.2, 0.5]), np.array([0.4, 0.2, 0.9])))


def test_a_covariance_about_a_point_is_that_of_what_the_point_does() -> None:
    """A turn about the origin moves it by its lever; what a turn leaves there is the same turn."""
    rng = np.random.default_rng(0)
    rows, about = rng.normal(size=(9, 6)), np.array([0.1, -0.3, 0.2])
    covariance = rows.T @ rows
    found = estimate_at(POSE, covariance, about, np.zeros((6, 0)))
    lever = about - POSE.translation
    moves = np.eye(6)
    for k in range(3):
        moves[3:, k] = np.cross(np.eye(3)[k], lever)
    assert found.covariance == pytest.approx(moves @ covariance @ moves.T)
    assert found.unobservable.shape == (0, 6) and found.about == pytest.approx(about)
    weak = np.zeros((6, 3))
    weak[5, 0], weak[0, 1], weak[4, 2] = 0.5, 1e-5, 0.9e-6  # the last moves another alone
    directions = estimate_at(POSE, covariance, about, weak).unobservable
    assert directions.shape == (2, 6)
    assert directions @ directions.T == pytest.approx(np.eye(2))
    assert np.abs(directions[0]) == pytest.approx([0, 0, 0, 0, 0, 1.0])
    turned = moves @ np.eye(6)[0]
    assert np.linalg.norm(directions @ turned) == pytest.approx(np.linalg.norm(turned))


def test_each_unknown_has_its_columns() -> None:
    camera, base, place = MADE.configuration.unknowns
    columns = [columns_of(name, MADE.configuration) for name in (camera, base, place)]
    assert columns == [slice(0, 6), slice(6, 12), slice(12, 18)]
    marker = CONFIGURATIONS["eye-in-hand, marker"]
    assert [columns_of(n, marker) for n in marker.unknowns] == [slice(0, 6), slice(12, 18)]


def test_exact_transforms_leave_no_residual_and_errors_matter_where_the_camera_looks() -> None:
    arm = Arm(ROBOT)
    transforms = transforms_of(
        MADE.configuration, *(MADE.truth[n] for n in MADE.configuration.unknowns)
    )
    reasons = [None, "far", None, None, None, None]
    pairs = pairs_of(MADE.configuration, transforms, MADE.observations, arm, reasons)
    assert [p.used for p in pairs] == [True, False, True, True, True, True]
    assert pairs[1].reason == "far" and pairs[0].reason is None
    assert max(np.abs(p.residual).max() for p in pairs) < 1e-9
    camera, base, place = MADE.configuration.unknowns
    points = points_of_interest(MADE.configuration, transforms, MADE.observations, arm)
    centres = np.array([o.feature.centre for o in MADE.observations])
    x = MADE.truth[camera]
    assert points[camera] == pytest.approx(x[:3, :3] @ centres.mean(axis=0) + x[:3, 3])
    assert points[place] == pytest.approx(MADE.truth[place][:3, 3])
    seen = [
        o.base_T_flange.matrix @ x @ np.append(c, 1.0)
        for o, c in zip(MADE.observations, centres, strict=True)
    ]
    assert points[base] == pytest.approx(np.mean(seen, axis=0)[:3])
    estimates: Any = ["camera", "base", "place"]
    found: Any = hand_eye_of(estimates, pairs, "solve.some")
    assert (found.camera, found.others, found.method) == ("camera", ("base", "place"), "solve.some")
