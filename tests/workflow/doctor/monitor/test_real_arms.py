"""The monitor on recordings of a real arm: nothing moved, and a scanner that did."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from flangeye.cli import commands
from flangeye.types import Observation
from flangeye.workflow.doctor.monitor.drift import DriftTest
from flangeye.workflow.doctor.monitor.history import History, MonitorCheck
from flangeye.workflow.doctor.monitor.stored import StoredCalibration, stored_calibration
from flangeye.workflow.doctor.monitor.verdicts import judge

RECIPE = "aubo-i5_phoxi-s_archive"


@pytest.fixture(scope="module")
def recorded(
    ancorasir: Path, tmp_path_factory: pytest.TempPathFactory
) -> tuple[StoredCalibration, list[Observation]]:
    """A calibration from the first 18 poses, and the sightings at the other 12."""
    folder = tmp_path_factory.mktemp("aubo")
    whole, first = folder / "whole", folder / "first"
    _run(RECIPE, "--archive", str(ancorasir / "data"), "--out", str(whole))
    seen = [pair.observation for pair in stored_calibration(whole).calibration.pairs]
    without = [word for o in seen[18:] for word in ("--leave-out", o.id)]
    log = str(whole / "run.mcap")
    _run(RECIPE, "--from", log, "--at", "solve.robust", *without, "--out", str(first))
    return stored_calibration(first), seen[18:]


@pytest.mark.parametrize(
    ("shift", "states"), [(0.0, ["OK"] * 4), (0.8e-3, ["OK", "OK", "MOVED", "MOVED"])]
)
def test_a_real_arm_at_other_poses_is_no_alarm_and_a_knock_is_one(
    recorded: tuple[StoredCalibration, list[Observation]],
    tmp_path: Path,
    shift: float,
    states: list[str],
) -> None:
    stored, seen = recorded
    history = History(tmp_path / "h.jsonl", stored.key)
    for i in range(4):
        later = seen[3 * i : 3 * i + 3]
        history.add(MonitorCheck(str(i), tuple(_aside(o, shift if i > 1 else 0.0) for o in later)))
        history.findings.append(judge(stored, history, DriftTest()))
    assert [finding.state for finding in history.findings] == states


def _aside(seen: Observation, shift: float) -> Observation:
    circle = seen.circle
    centre = circle.centre + shift * np.array([0.6, 0.0, 0.8])
    return replace(seen, feature=replace(circle, centre=centre))


def _run(*words: str) -> None:
    done = CliRunner().invoke(commands(), ["run", *words])
    assert done.exit_code == 0, done.output
