"""Bad input at the command line, on the real stages: one line, exit code 2, nothing left behind."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from flangeye.files.clouds import write_cloud
from flangeye.types import CAMERA, PointCloud
from tests.conftest import Call

RECIPE = """\
title: Bad input
robot: {model: ur5}
scanner: {model: phoxi-m}
steps:
  - acquire.archive: {reader: folder}
  - segment.flange
  - fit.rim
  - solve.svd
"""
HEADER = "cloud,x_m,y_m,z_m,qx,qy,qz,qw\n"


def pose(i, x=None):
    x = 0.05 * i if x is None else x
    return f"{i:02d}.pcd,{x:.3f},{0.03 * i * i:.3f},0.3,0,0,0,1\n"


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    """A folder of five clouds and their poses."""
    folder = tmp_path / "archive"
    folder.mkdir()
    (tmp_path / "recipe.yaml").write_text(RECIPE)
    rng = np.random.default_rng(0)
    for i in range(5):
        xyz = rng.uniform([-0.1, -0.1, 0.6], [0.1, 0.1, 0.8], (500, 3)).astype(np.float32)
        write_cloud(folder / f"{i:02d}.pcd", PointCloud(CAMERA, xyz))
    (folder / "poses.csv").write_text(HEADER + "".join(pose(i) for i in range(5)))
    return folder


def refusal(told, tmp_path):
    """Return the one line of an exit 2 that left nothing behind."""
    code, _, err = told
    assert "Traceback" not in err
    assert code == 2, err
    assert not (tmp_path / "runs").exists()
    errors = [line for line in err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1, err
    return errors[0].replace(str(tmp_path) + "/", "")


def truncate(folder):
    path = folder / "03.pcd"
    path.write_bytes(path.read_bytes()[:-100])


def same_place(folder):
    turns = [f"{np.sin(0.1 * i)},{np.cos(0.1 * i)}" for i in range(5)]
    rows = "".join(f"{i:02d}.pcd,.1,.1,.3,0,0,{turn}\n" for i, turn in enumerate(turns))
    (folder / "poses.csv").write_text(HEADER + rows)


def two_poses(folder):
    (folder / "poses.csv").write_text(HEADER + pose(0) + pose(1))
    for i in (2, 3, 4):
        (folder / f"{i:02d}.pcd").unlink()


def all_nan(folder):
    for i in range(5):
        xyz = np.full((500 + i, 3), np.nan, np.float32)
        write_cloud(folder / f"{i:02d}.pcd", PointCloud(CAMERA, xyz))


def millimetres(folder):
    rng = np.random.default_rng(0)
    for i in range(5):
        xyz = 1e3 * rng.uniform([-0.1, -0.1, 0.6], [0.1, 0.1, 0.8], (500, 3)).astype(np.float32)
        write_cloud(folder / f"{i:02d}.pcd", PointCloud(CAMERA, xyz))


CASES = {
    "missing archive": (lambda folder: shutil.rmtree(folder), [], "archive"),
    "empty cloud": (lambda folder: (folder / "03.pcd").write_bytes(b""), [], "archive/03.pcd"),
    "no cloud": (lambda folder: (folder / "03.pcd").write_text("hello\n"), [], "archive/03.pcd"),
    "truncated cloud": (truncate, [], "archive/03.pcd"),
    "missing cloud": (lambda folder: [p.unlink() for p in folder.glob("*.pcd")], [], "archive"),
    "no poses": (lambda folder: (folder / "poses.csv").unlink(), [], "archive"),
    "two poses": (two_poses, [], "3"),
    "one place": (same_place, [], "one place"),
    "millimetres as metres": (millimetres, ["--set", "steps.0.unit=m"], "millimetres"),
    "NaN everywhere": (all_nan, [], "finite"),
    "name too long": (lambda _: None, ["--archive", "a" * 300], "File name too long"),
}


@pytest.mark.parametrize("name", CASES)
def test_one_line_that_names_the_place(
    name: str, archive: Path, command: Call, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    spoil, words, mentions = CASES[name]
    spoil(archive)
    monkeypatch.chdir(tmp_path)
    told = command("run", "recipe.yaml", "--archive", archive, *words)
    line = refusal(told, tmp_path)
    assert mentions in line
    assert len(line) < 400


def test_a_file_of_a_parameter_whose_name_is_too_long(
    archive: Path, command: Call, tmp_path: Path
) -> None:
    drift = f"  - verify.drift: {{reference: {'a' * 300}}}\n"
    (tmp_path / "recipe.yaml").write_text(RECIPE + drift)
    told = command("run", tmp_path / "recipe.yaml", "--archive", archive)
    assert "longer than 255 bytes" in refusal(told, tmp_path)


def test_a_disk_that_is_full(tmp_path: Path, ancorasir: Path) -> None:
    """The file size limit of the process stands in for a full disk."""
    script = (
        "import resource, signal, sys; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (1_000_000, 1_000_000)); "
        "from flangeye import cli; sys.argv[0] = 'flangeye'; cli.main()"
    )
    told = subprocess.run(
        [sys.executable, "-c", script, "run", "aubo-i5_phoxi-s_archive", "--archive",
         str(ancorasir), "--out", "full"],
        cwd=tmp_path, capture_output=True, text=True,
    )  # fmt: skip
    assert told.returncode == 2
    assert [x for x in told.stderr.splitlines() if x][-3:] == [
        "the captures recorded so far are in full/run.mcap; flangeye report full shows it",
        "with other parameters: flangeye run aubo-i5_phoxi-s_archive --from full/run.mcap --at "
        "fit.rim --set PATH=VALUE (to do segment.flange again, record with --set log.clouds=full)",
        "error: full/run.mcap: cannot be written: File too large; what was written so far can be "
        "read with 'flangeye show'",
    ]
    assert "Traceback" not in told.stderr
    shown = subprocess.run(
        [sys.executable, "-m", "flangeye.cli", "show", "full/run.mcap"],
        cwd=tmp_path, capture_output=True, text=True, env={**os.environ},
    )  # fmt: skip
    assert shown.returncode == 0
    assert "incomplete" in shown.stdout
