"""What is written into the tables of a cell: numbers, directions, units, spreads."""

from __future__ import annotations

import csv
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from flangeye import types as t
from flangeye.maths.geometry import rigid, rotation_exp
from flangeye.run.tables import _csv, _noise, _recipe, _seen, _value, _works_on_scans

POSE = t.Transform(t.BASE, t.FLANGE, rigid(rotation_exp([0, 0, np.pi / 2]), [1.0, -2.0, 0.5]))


def circle(number: int, variances: list[float]) -> t.Observation:
    feature = t.CircleFeature(np.array([number, 0.1, 0.2]), None, {}, np.diag(variances), None, 1.0)
    return t.Observation(f"{number}-camera-target", feature, t.by_frame(POSE))


def pose(number: int, turn: float, shift: float) -> t.Observation:
    covariance = np.diag([turn**2] * 3 + [shift**2] * 3)
    feature = t.PoseFeature(t.Transform(t.CAMERA, t.TARGET, POSE.matrix), covariance, {})
    return t.Observation(f"{number}-camera-target", feature, t.by_frame(POSE))


def test_a_centre_has_three_numbers_and_a_pose_seven() -> None:
    head, *rows = csv.reader(_csv(_seen([circle(7, [1e-8] * 3)], {})).splitlines())
    assert head == ["number", "x", "y", "z"]
    assert rows == [["7", "7", "0.1", "0.2"]]
    head, *rows = csv.reader(_csv(_seen([pose(7, 1e-3, 1e-4)], {})).splitlines())
    assert head == ["number", "x", "y", "z", "qx", "qy", "qz", "qw"]
    half = f"{np.sqrt(0.5):.12g}"
    assert rows[0][:4] == ["7", "1", "-2", "0.5"] and rows[0][6:] == [half, half]


def test_a_scan_stands_by_its_file() -> None:
    files = {"7-camera-target": "clouds/a.pcd"}
    assert list(_seen([circle(7, [1e-8] * 3)], files)) == [
        ("number", "scan"),
        ("7", "clouds/a.pcd"),
    ]


@pytest.mark.parametrize(("turns", "value"), [(True, np.pi / 2), (False, 0.5)])
def test_an_axis_has_its_turn_or_its_way(turns: bool, value: float) -> None:
    axis: Any = SimpleNamespace(turns=turns, direction=np.array([0.0, 0.0, 1.0]))
    assert _value(axis, POSE) == pytest.approx([value])


def test_the_noise_is_the_middle_deviation_along_an_axis() -> None:
    centres = [circle(k, [1e-8 * k**2, 4e-8 * k**2, 4e-8 * k**2]) for k in (1, 2, 30)]
    assert _noise(centres) == {"centre_noise": f"{0.2 * np.sqrt(3):.4g} mm"}
    poses = [pose(k, np.radians(0.1 * k), 1e-4 * k) for k in (1, 2, 30)]
    assert _noise(poses) == {"position_noise": "0.2 mm", "angle_noise": "0.2 deg"}


def test_steps_that_work_on_scans_are_known_by_their_kind() -> None:
    steps = [
        "segment.flange",
        {"fit.rim": {"inlier": "1 mm"}},
        "solve.cell",
        {"verify.holdout": {}},
    ]
    assert [_works_on_scans(step) for step in steps] == [True, True, False, False]


@pytest.mark.parametrize("scans", [{}, {"1-camera-target": "1.pcd"}])
def test_steps_that_work_on_scans_go_where_there_are_none(scans: dict[str, str]) -> None:
    text = """
description: of a run
robot: ur5e
steps: [acquire.live, segment.flange, fit.rim, solve.cell]
"""
    cell: Any = SimpleNamespace(movers={"arm": object()})
    recipe = yaml.safe_load(_recipe(text, cell, [circle(1, [1e-8] * 3)], scans))
    acquire, *steps = recipe["steps"]
    assert steps == (["segment.flange", "fit.rim", "solve.cell"] if scans else ["solve.cell"])
    assert list(acquire) == ["acquire.archive" if scans else "acquire.centres"]
    assert list(recipe) == ["robot", "steps"]
