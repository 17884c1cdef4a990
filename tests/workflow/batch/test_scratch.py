"""The folder that dask works in: a batch's own, and no killed batch's for long."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from flangeye.workflow.batch.cluster import PREFIX, remove_forgotten, scratch


@pytest.fixture(autouse=True)
def temporary(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def folder(parent: Path, name: str) -> Path:
    made = parent / f"{PREFIX}{name}"
    (made / "dask-scratch-space").mkdir(parents=True)
    return made


def gone() -> int:
    """Return the number of a process that has ended."""
    process = subprocess.Popen([sys.executable, "-c", ""])
    process.wait()
    return process.pid


def test_a_batch_has_a_folder_of_its_own_and_leaves_none(temporary: Path) -> None:
    with scratch() as first, scratch() as second:
        assert first != second and first.parent == temporary
        assert first.name.startswith(f"{PREFIX}{os.getpid()}-")
    assert not list(temporary.iterdir())


def test_the_next_batch_removes_a_killed_ones_folder_and_no_other(temporary: Path) -> None:
    killed = folder(temporary, f"{gone()}-x1")
    kept = [
        folder(temporary, f"{os.getpid()}-x2"),  # of a batch that runs
        folder(temporary, "notes-x3"),
        folder(temporary, f"{gone()}"),
        folder(temporary, "9" * 40 + "-x4"),
    ]
    elsewhere = temporary / "else" / "where"
    elsewhere.mkdir(parents=True)
    link = temporary / f"{PREFIX}{gone()}-x5"
    link.symlink_to(elsewhere)
    remove_forgotten()
    assert not killed.exists() and link.is_symlink() and elsewhere.exists()
    assert all(each.exists() for each in kept)


def test_nobody_elses_folder_is_removed(temporary: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    theirs = folder(temporary, f"{gone()}-x1")
    monkeypatch.setattr("os.getuid", lambda: theirs.stat().st_uid + 1)
    remove_forgotten()
    assert theirs.exists()
