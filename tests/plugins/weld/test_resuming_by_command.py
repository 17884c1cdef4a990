"""flangeye run --resume: a run that ended in its weld goes on there, and overlaps."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from flangeye.workflow.log.read import read_notes

SEAM = "ur10e_phoxi-m_weld_simulated"


def flangeye(folder: Path, *words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "flangeye.cli", "run", *words]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True)


@pytest.mark.slow
def test_a_run_killed_in_its_weld_goes_on_where_it_was(tmp_path: Path) -> None:
    whole = flangeye(tmp_path, SEAM, "--set", "steps.0.resolution=0.3", "--out", "whole")
    assert whole.returncode == 0, whole.stderr
    log = (tmp_path / "whole" / "run.mcap").read_bytes()
    (tmp_path / "killed").mkdir()
    (tmp_path / "killed" / "run.mcap").write_bytes(log[: int(0.7 * len(log))])
    again = flangeye(tmp_path, "--resume", "killed", "--out", "again")
    assert again.returncode == 0, again.stderr
    weld = json.loads((tmp_path / "again" / "result.json").read_text())["weld"]
    assert weld["completed"]
    assert weld["truth"]["rms"] < 0.15e-3
    assert weld["figures"]["arc_from"] > 0.03  # m: it did not begin at the seam's start
    start = next(n for n in read_notes(tmp_path / "again" / "run.mcap") if n.name == "start")
    assert start.value["kept"]["torch"] - weld["figures"]["arc_from"] == pytest.approx(
        0.03, abs=0.5e-3
    )
    told = flangeye(tmp_path, "--resume", "again")
    assert told.returncode == 2
    assert "again/run.mcap: this run is complete" in told.stderr


@pytest.mark.slow
def test_a_weld_that_stopped_by_itself_is_gone_on_with_too(tmp_path: Path) -> None:
    # The recipe hides the tag of the second run too; the tip then lets go of the wall already.
    hidden = "steps.7.sensor.simulated_finger.hidden=[50 s, 52 s]"
    small = "steps.0.resolution=0.3"
    stopped = flangeye(tmp_path, SEAM, "--set", small, "--set", hidden, "--out", "stopped")
    assert stopped.returncode == 1
    assert "Weld stopped   no tag was seen for 500 ms" in stopped.stdout
    again = flangeye(tmp_path, "--resume", "stopped", "--out", "again")
    assert again.returncode == 0, again.stderr + again.stdout
    weld = json.loads((tmp_path / "again" / "result.json").read_text())["weld"]
    assert weld["completed"]
    assert weld["truth"]["rms"] < 0.15e-3
