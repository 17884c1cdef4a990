"""What is written into the tables of a cell: numbers, directions, units, spreads."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.files.recording import OF_A_SIMULATOR
from flangeye.models.cell import Cell
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.workflow.result import SIMULATED
from flangeye.workflow.run import tables
from flangeye.workflow.run.tables import (
    _csv,
    _noise,
    _recipe,
    _seen,
    _value,
    _works_on_scans,
    write_tables,
)

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
        "solve.robust",
        {"verify.holdout": {}},
    ]
    assert [_works_on_scans(step) for step in steps] == [True, True, False, False]


@pytest.mark.parametrize("scans", [{}, {"1-camera-target": "1.pcd"}])
def test_steps_that_work_on_scans_go_where_there_are_none(scans: dict[str, str]) -> None:
    text = """
description: of a run
robot: ur5e
steps: [acquire.live, segment.flange, fit.rim, solve.robust]
"""
    cell: Any = SimpleNamespace(movers={"arm": object()})
    recipe = yaml.safe_load(_recipe(text, cell, [circle(1, [1e-8] * 3)], scans))
    acquire, *steps = recipe["steps"]
    assert steps == (["segment.flange", "fit.rim", "solve.robust"] if scans else ["solve.robust"])
    assert list(acquire) == ["acquire.archive" if scans else "acquire.centres"]
    assert list(recipe) == ["robot", "steps"]


def log_of(text: str | None, seen: list[t.Observation], clouds: bool = False) -> Any:
    """Return what of a log is looked at."""
    cloud = t.PointCloud(t.CAMERA, np.ones((4, 3), np.float32))
    captures = [t.Capture(o.id, cloud, o.poses) for o in seen]
    return SimpleNamespace(
        path=Path("run.mcap"), text=lambda _: text, observations=lambda: seen,
        has_full_clouds=clouds, captures=lambda: captures, has_recipe=text is not None, models={},
        source=None,
    )  # fmt: skip


UNUSED: Any = None
TEXT = "title: a cell\nsteps: [acquire.simulated_cell, segment.flange, fit.rim, solve.robust]\n"


@pytest.fixture
def of_a_cell(monkeypatch: pytest.MonkeyPatch) -> None:
    """Any recipe is that of a cell in which one arm moves."""
    recipe = SimpleNamespace(context={Cell: SimpleNamespace(movers={"flange": None})}, text=TEXT)
    monkeypatch.setattr(tables, "recipe_of_log", lambda *_: recipe)


@pytest.mark.usefixtures("of_a_cell")
@pytest.mark.parametrize("clouds", [False, True])
def test_a_table_of_the_arm_one_of_what_was_seen_and_a_recipe(tmp_path: Path, clouds: bool) -> None:
    seen = [circle(k, [1e-8] * 3) for k in (10, 2)]
    files = write_tables(log_of(TEXT, seen, clouds), tmp_path, UNUSED)
    assert files == [tmp_path / n for n in ("flange.csv", "camera_target.csv", "recipe.yaml")]
    arm, sightings, recipe = (file.read_text("utf-8") for file in files)
    assert [row[0] for row in csv.reader(arm.splitlines())] == ["number", "2", "10"]
    rows = list(csv.reader(sightings.splitlines()))
    steps = yaml.safe_load(recipe)["steps"]
    if clouds:
        assert rows[1:] == [
            ["10", "clouds/10-camera-target.pcd"],
            ["2", "clouds/2-camera-target.pcd"],
        ]
        assert all((tmp_path / row[1]).stat().st_size > 0 for row in rows[1:])
        assert steps[1:] == ["segment.flange", "fit.rim", "solve.robust"]
    else:
        assert rows[1:] == [["10", "10", "0.1", "0.2"], ["2", "2", "0.1", "0.2"]]
        assert not (tmp_path / "clouds").exists()
        assert steps[1:] == ["solve.robust"]
    assert next(iter(steps[0])) == ("acquire.archive" if clouds else "acquire.centres")


@pytest.mark.usefixtures("of_a_cell")
def test_an_arms_joints_stand_behind_its_pose_and_are_named_in_the_recipe(tmp_path: Path) -> None:
    seen = [replace(circle(k, [1e-8] * 3), arm_joints={"flange": np.arange(3.0)}) for k in (1, 2)]
    arm, _, recipe = write_tables(log_of(TEXT, seen), tmp_path, UNUSED)
    head, *rows = csv.reader(arm.read_text("utf-8").splitlines())
    assert head[8:] == ["j1_rad", "j2_rad", "j3_rad"]
    assert [row[8:] for row in rows] == [["0", "1", "2"]] * 2
    (told,) = yaml.safe_load(recipe.read_text("utf-8"))["steps"][0].values()
    assert told["reader"]["cell"]["arms"]["flange"]["joints"] == head[8:]


@pytest.mark.usefixtures("of_a_cell")
def test_a_logs_own_models_and_a_simulation_are_told_beside_the_tables(tmp_path: Path) -> None:
    log = log_of(TEXT.replace("a cell", "another"), [circle(k, [1e-8] * 3) for k in (10, 2)])
    log.models, log.source = {"models/arm.yaml": b"name: arm\n"}, SimpleNamespace(simulated=True)
    files = write_tables(log, tmp_path, UNUSED)
    assert tmp_path / "models/arm.yaml" in files and files[-1] == tmp_path / "recipe.yaml"
    assert (tmp_path / "models/arm.yaml").read_bytes() == b"name: arm\n"
    assert (tmp_path / OF_A_SIMULATOR).read_text("utf-8") == f"{SIMULATED}.\n"


def test_what_is_no_run_of_a_cell_has_no_tables(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    said = "run.mcap: is not a run of a cell; only cells are exported as tables"
    with pytest.raises(StageError, match=said):
        write_tables(log_of(None, []), tmp_path, UNUSED)
    monkeypatch.setattr(tables, "recipe_of_log", lambda *_: SimpleNamespace(context={}))
    with pytest.raises(StageError, match=said):
        write_tables(log_of(TEXT, [circle(1, [1e-8] * 3)]), tmp_path, UNUSED)


@pytest.mark.usefixtures("of_a_cell")
def test_where_nothing_was_seen_there_is_nothing_to_write(tmp_path: Path) -> None:
    with pytest.raises(StageError, match=r"run.mcap: nothing was seen in this run"):
        write_tables(log_of(TEXT, []), tmp_path, UNUSED)
    assert not list(tmp_path.iterdir())
