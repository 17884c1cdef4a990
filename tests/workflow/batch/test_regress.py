"""``flangeye regress``: manifests run as a batch; what differs and what is absent is said."""

import shutil
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from flangeye.cli import commands
from flangeye.files.paths import bundled
from flangeye.workflow.batch.dataset import Dataset
from flangeye.workflow.batch.regress import read_manifests

DATA = Path(__file__).parents[3] / "data"
MANIFEST = """\
title: Mine
recording: {recording}
recipe: {recipe}
{more}expected: {expected}
source: https://example.org
licence: CC-BY-4.0
"""
RECIPE = """\
title: Points
steps:
  - acquire.centres
  - solve.svd
  - verify.holdout: {max_rms: 20 mm}
"""
READER = (
    "reader: {table: {file: t.csv, rotation: vector, angle: rad, length: m, pose: base_T_flange, "
    "columns: [1, 2, 3, 4, 5, 6], target: {columns: [7, 8, 9], rotation: point, length: m}}}\n"
)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Points of a camera that is the base, with 1 mm of noise: any calibration is the identity."""
    monkeypatch.chdir(tmp_path)
    rows = [(0.1 * k, 0.1 * (k % 3), 0.1 * (k % 2), 0.2 * k, 0.1, 0.1 * k) for k in range(9)]
    text = "\n".join(
        ",".join(map(str, [*row, row[0], row[1] + 1e-3 * (-1) ** i, row[2]]))
        for i, row in enumerate(rows)
    )
    (tmp_path / "rec").mkdir()
    (tmp_path / "rec" / "t.csv").write_text(text + "\n")
    (tmp_path / "points.yaml").write_text(RECIPE)
    (tmp_path / "known").mkdir()
    return tmp_path / "known"


def manifest(folder, name="mine", recording="../rec", recipe="../points.yaml", more=READER,
             expected="{status: verified, closure: 1.0 mm, tolerance: 0.5 mm}"):  # fmt: skip
    text = MANIFEST.format(recording=recording, recipe=recipe, more=more, expected=expected)
    (folder / f"{name}.yaml").write_text(text)


def regress():
    return CliRunner().invoke(commands(), ["regress", "known", "--workers", "1"])


def test_each_manifest_is_compared_and_a_second_start_runs_nothing(folder: Path) -> None:
    manifest(folder)
    manifest(folder, "absent", recording="../nowhere")
    manifest(folder, "closer", expected="{closure: 0.1 mm, tolerance: 0.01 mm}")
    manifest(folder, "sound", expected="{findings: []}")
    manifest(folder, "worse", expected="{status: refused, findings: [clock]}")
    done = regress()
    lines = {line.split(":")[0].split()[-1]: line for line in done.stdout.splitlines()}
    assert lines["mine"].startswith("as expected  mine: verified; closure 1.")
    assert lines["absent"].startswith("skipped      absent: nowhere is not there; https://")
    assert lines["closer"].startswith("DIFFERS      closer: closure 1.")
    assert lines["closer"].endswith("mm, expected 0.100 +- 0.010 mm")
    assert lines["sound"] == "as expected  sound: verified; findings none"
    assert lines["worse"] == (
        "DIFFERS      worse: verified, expected refused; findings none, expected clock"
    )
    assert done.exit_code == 1
    for name in ("closer", "worse"):
        (folder / f"{name}.yaml").unlink()
    again = regress()
    assert again.exit_code == 0, again.output
    assert len(list(Path("regressions").glob("*/result.json"))) == 1


def test_a_folder_that_another_batch_writes_to_is_one_line(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    manifest(folder)
    monkeypatch.setattr(Dataset, "rows", lambda *_: [])  # as if the other had settled its own
    error = regress().exception
    assert getattr(error, "exit_code", None) == 2
    assert str(error).startswith("regressions: holds no outcome of points_rec_")
    assert str(error).endswith(
        "; another batch writes to this folder: wait for its end, or give --out"
    )


@pytest.mark.parametrize(
    ("given", "line"),
    [
        ({"recipe": "nothing"}, "known/mine.yaml: no recipe 'nothing'; "),
        ({"more": "reader: tables\n"}, "known/mine.yaml: --set steps.0.acquire.centres.reader: no "),
        ({"more": "licence: none\n"}, "known/mine.yaml:7: "),
        ({"more": "colour: red\n"}, "known/mine.yaml:4: colour: unknown key 'colour' (allowed: "),
        ({"expected": "{closure: 1}"}, "known/mine.yaml:4: expected.closure: '1' has no unit"),
        ({"expected": "{closure: 1 mm}"},
         "known/mine.yaml: expected.closure and expected.tolerance go together"),
    ],
)  # fmt: skip
def test_a_wrong_manifest_is_bad_input(folder: Path, given: dict[str, Any], line: str) -> None:
    manifest(folder, **({"more": ""} | given))
    error = regress().exception
    assert str(error).startswith(line)
    assert error.exit_code == 2


def test_a_folder_without_manifests_says_what_one_is(folder: Path) -> None:
    assert str(regress().exception) == (
        "known: holds no manifests; one is a .yaml file with title, recording, recipe, expected, "
        "source and licence"
    )


def test_every_shipped_manifest_names_a_recipe_a_source_and_a_licence() -> None:
    manifests = read_manifests(bundled("data") / "manifests")
    assert {file.stem for file in manifests} >= {"ur5_phoxi-m_sample", "ancorasir_aubo"}


@pytest.mark.slow
def test_the_shipped_manifests_are_as_expected(ancorasir: Path, tmp_path: Path) -> None:
    shutil.copytree(DATA / "manifests", tmp_path / "data" / "manifests")
    done = CliRunner().invoke(commands(), ["regress", "--out", str(tmp_path / "runs")])
    assert done.exit_code == 0, done.output
