"""``flangeye doctor`` as people call it: of a recipe, and with lines that can be copied."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye.files.clouds import write_cloud
from flangeye.files.yaml_lines import parse_value
from flangeye.plugin.registry import load_registry
from flangeye.types import CAMERA, PointCloud
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.workflow.doctor.diagnosis import as_yaml
from flangeye.workflow.doctor.opening import open_session

SAMPLE = Path(__file__).parents[3] / "data" / "samples" / "ur5_phoxi-m"
WORDS = [
    "null",
    "true",
    "no",
    "5 mm",
    "-1.2 m",
    "a b",
    ".",
    "~",
    "1e3",
    "12",
    "0x1",
    "x: y",
    "it's",
    "",
]

RECIPE = """\
title: Poses of a camera in the hand
configuration: {name: eye-in-hand, place: unknown}
steps:
  - acquire.samples: {path: poses.npz, reader: {table: {file: poses.npz, columns: [robot], rotation: matrix, length: m, target: {columns: [target], rotation: matrix, length: m}}}}
  - solve.robust
"""


def save_with_inverted_targets(folder: Path) -> None:
    rng = np.random.default_rng(0)
    turns = rotation_exp(rng.normal(0, 0.6, (20, 3)))
    arm = np.array(
        [rigid(r, p) for r, p in zip(turns, rng.uniform(0.2, 0.6, (20, 3)), strict=True)]
    )
    # It looks down at a target that faces it: else its axes would be called those of OpenGL
    flange_t_camera = rigid(rotation_exp([3.1, 0.2, 0.1]), [0.05, 0.02, 0.1])
    base_t_target = rigid(rotation_exp([0.2, 0.0, 0.3]), [0.4, 0.4, -0.6])
    seen = np.linalg.inv(arm @ flange_t_camera) @ base_t_target
    np.savez(folder / "poses.npz", robot=arm, target=np.linalg.inv(seen))


def test_each_line_that_would_mend_a_recipe_can_be_copied(
    command: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    save_with_inverted_targets(tmp_path)
    (tmp_path / "cell.yaml").write_text(RECIPE)
    code, out, _ = command("doctor", "cell.yaml")
    assert code == 1
    lines = [line.strip() for line in out.splitlines()]
    choices = [line[5:] for line in lines if line.startswith(("fix: ", "or:  "))]
    assert str(tmp_path) not in out  # a line for the recipe names files as the recipe does
    assert len(choices) == 2  # the arm's poses are not inverted: distances would be unlikely
    for line in choices:
        old = "- acquire.samples" if line.startswith("- ") else "configuration"
        mended = [line if old in row else row for row in RECIPE.splitlines()]
        mended = [f"  {row}" if row.startswith("- ") else row for row in mended]
        (tmp_path / "mended.yaml").write_text("\n".join(mended))
        code, out, err = command("doctor", "mended.yaml")
        assert (code, err) == (0, "")
        assert out.startswith("nothing found: ")


def test_a_recipe_that_reads_no_archive(flangeye: Callable[..., Any], toy_recipe: Path) -> None:
    assert flangeye("doctor", toy_recipe) == (
        2,
        "",
        "error: acquire.toy: reads no archive to examine; name a run's log, or recordings\n",
    )


def test_a_folder_that_no_reader_knows_leads_to_init(
    command: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "a.csv").write_text("1,2,3\n")
    assert command("doctor", "rec") == (
        2, "",
        "error: rec: no reader knows this layout by itself, and no recipe states how it is read; "
        "write one: flangeye init rec; then: flangeye doctor recipe.yaml\n",
    )  # fmt: skip


def test_a_log_keeps_captures_that_showed_nothing_in_their_order(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: Callable[..., Any]
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copytree(SAMPLE, "session")
    wall = np.stack(np.meshgrid(range(60), range(60)), axis=-1).reshape(-1, 2) * 0.01
    points = np.column_stack([wall, np.full(3600, 0.8)])
    write_cloud(tmp_path / "session" / "0003.pcd", PointCloud(CAMERA, points))
    told = command("run", "ur5_phoxi-m_sample", "--archive", "session", "--out", "run")
    assert told[0] == 0, told
    # Of a session whose scans have the pose of the next, the order is all that tells
    session = open_session(tmp_path / "run" / "run.mcap", load_registry())
    assert session.ids == tuple(f"{i:04}" for i in range(8))
    assert session.seen.tolist() == [i != 3 for i in range(8)]


def test_what_the_run_set_aside_is_named_and_coarse_decimals_are_said(
    command: Callable[..., Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    save_with_inverted_targets(tmp_path)
    poses = dict(np.load(tmp_path / "poses.npz"))
    poses["target"] = np.linalg.inv(poses["target"])
    poses["robot"][7, :3, 3] += [0.03, 0, 0]
    poses["robot"][:, :3, 3] = np.round(poses["robot"][:, :3, 3], 3)
    np.savez(tmp_path / "poses.npz", **poses)
    (tmp_path / "cell.yaml").write_text(RECIPE)
    assert command("run", "cell.yaml", "--out", "out")[0] == 0
    _, out, _ = command("doctor", "out/run.mcap")
    assert (
        "note: set aside: the run's solver did not use 1 of the samples, with residuals '0007' "
        in out
    )
    said = "positions of the arm are whole multiples of 1 mm, and the recipe asks for 1 mm; if they"
    assert f"note: rounded: {said} were rounded, that alone is an error of 0.5 mm" in out
    assert "fix: write positions with 4 or more decimals of a metre" in out


@pytest.mark.parametrize("word", WORDS)
def test_a_line_is_read_back_as_what_it_states(word: str) -> None:
    value = {"on": word, "path": [word, None, True, 1, -0.5, {"unit": word}]}
    assert parse_value(as_yaml(value), "a line") == value
