"""What the study of figure 13 says of welds whose errors are known."""

import csv
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import FlangeyeError
from flangeye.types import CAMERA, PointCloud, Seam, WeldReport, WorkpieceScan
from flangeye.workflow.log.record import Recorder
from flangeye_paper import fig13
from flangeye_paper.fig13 import SeenWeld, seen
from flangeye_paper.misplanned import (
    AsLaidParams,
    scan_as_laid,
    seam_misplanned,
)
from flangeye_paper.tables import SessionRow, read_csv, read_sessions

UP = np.array([0.0, 0.0, 1.0])
TRUTH = np.column_stack([np.linspace(0, 0.2, 201), np.zeros(201), np.zeros(201)])
TIME = np.arange(0.0, 48.0, 0.025)
TIP = 5e-3 * TIME


def weld(torch_off=0.0, robot_off=0.0, phases=("following",), mode="tactile"):
    """A weld along x at 5 mm/s, the torch 40 mm behind the tip; offsets [m] may be arrays."""
    zero = np.zeros_like(TIME)

    def path(along, off):
        return np.column_stack([along, zero + off, zero])

    names = np.repeat(phases, -(-len(TIME) // len(phases)))[: len(TIME)]
    return WeldReport(
        mode=mode, completed=True, reason="", planned=TRUTH, refined=TRUTH, openings=np.tile(UP, (len(TRUTH), 1)),
        time=TIME, tip=path(TIP, 0.0), torch=path(TIP - 0.04, torch_off),
        robot=path(TIP, robot_off), deflection=zero, wanted=zero, speed=zero + 5e-3,
        turn=zero + 0.1, along=TIP - 0.04, phases=tuple(names),
    )  # fmt: skip


def test_the_deviation_is_that_of_the_torch_on_the_part_asked_for() -> None:
    found = SeenWeld(weld(np.where(TIP - 0.04 > 0.1, 2e-3, 1e-3)), TRUTH)
    np.testing.assert_allclose(found.deviation((0.0, 0.09)), 1e-3)
    np.testing.assert_allclose(found.deviation((0.11, 0.2)), 2e-3)
    assert found.deviation().max() == pytest.approx(2e-3)


def test_recovery_is_the_tip_s_way_until_the_torch_is_near_for_good() -> None:
    off = np.where((TIP < 0.02) | ((TIP > 0.05) & (TIP < 0.06)), -1e-3, 0.3e-3)
    assert SeenWeld(weld(off), TRUTH).recovery == pytest.approx(0.06, abs=2e-4)
    assert SeenWeld(weld(), TRUTH).recovery == 0.0


def test_contact_is_regained_only_after_it_was_lost() -> None:
    assert SeenWeld(weld(phases=("following", "bridging", "following")), TRUTH).regained
    assert not SeenWeld(weld(phases=("following", "bridging")), TRUTH).regained
    assert not SeenWeld(weld(phases=("following", "ending")), TRUTH).regained


def test_a_step_counts_at_the_end_and_a_ramp_by_what_it_does_in_a_tenth_of_a_second() -> None:
    early = np.where(TIP > 0.1, 1e-3, 0.0)
    assert SeenWeld(weld(robot_off=early), TRUTH).end_step == pytest.approx(0.0, abs=1e-12)
    late = np.where(TIP > 0.21, 1e-3, 0.0)
    assert SeenWeld(weld(robot_off=late), TRUTH).end_step == pytest.approx(1e-3)
    assert SeenWeld(weld(torch_off=late), TRUTH).end_step == pytest.approx(1e-3)
    ramp = np.clip(TIP - 0.19, 0.0, None) / 5e-3 * 0.8e-3
    assert SeenWeld(weld(robot_off=ramp), TRUTH).end_step == pytest.approx(0.08e-3)


def test_a_weld_that_never_came_to_the_end_of_its_seam_has_no_step_there() -> None:
    longer = np.vstack([TRUTH, [0.5, 0.0, 0.0]])
    assert SeenWeld(weld(), longer).end_step == 0.0


# --- from batches to the table --------------------------------------------------------------------


def scan():
    cloud = PointCloud(CAMERA, TRUTH.astype(np.float32))
    return WorkpieceScan(cloud, "a test", (), {"groove": TRUTH})


def log(folder, *values):
    folder.mkdir(parents=True)
    recorder = Recorder(folder / "run.mcap", {"recipe.yaml": "title: T"}, False)
    for i, value in enumerate(values):
        recorder.flangeye_stage_finished(f"{i}.a.step", None, value, 0.0)
    recorder.close()


def batch(folder, *reports):
    rows = []
    for i, report in enumerate(reports):
        log(folder / f"s{i}", scan(), report)
        rows.append({"session": f"s{i}", "status": "verified", "steps.5.mode": report.mode})
    with (folder / "sessions.csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


@pytest.fixture
def batches(tmp_path: Path) -> Any:
    bridged = weld(0.1e-3, phases=("following", "bridging", "following"))
    stopped = replace(weld(10e-3, mode="as_printed"), completed=False, reason="astray")
    for name in fig13.WORKPIECES:
        batch(tmp_path / f"fig13_{name}", weld(0.01e-3), weld(0.03e-3))
        batch(tmp_path / f"fig13-others_{name}", weld(3e-3, mode="vision"), stopped)
        batch(tmp_path / f"fig13-gap_{name}", bridged)
        batch(tmp_path / f"fig13-across_{name}", weld(np.where(TIP < 0.08, 2e-3, 0.02e-3)))
    return tmp_path


def test_the_table_says_what_the_welds_did(batches: Any, tmp_path: Path) -> None:
    fig13.fig13(batches, tmp_path)
    rows = {row["followed"]: row for row in read_csv(tmp_path / "fig13.csv")[:5]}
    touch = rows["by touch"]
    assert (touch["welds"], touch["to the end"]) == ("2", "2")
    assert float(touch["rms mm"]) == pytest.approx(np.hypot(0.01, 0.03) / np.sqrt(2), abs=1e-3)
    assert (touch["worst weld's rms mm"], touch["largest mm"]) == ("0.030", "0.030")
    assert touch["step at the end mm"] == "0.000"
    assert touch["turn rate deg/s"] == "5.7"
    assert rows["the plan alone"]["rms mm"] == "3.000"
    assert rows["Algorithm 2 as printed"]["to the end"] == "0"
    assert rows[fig13.FOLLOWED["across"]]["back on the seam after mm"] == "80"
    assert rows[fig13.FOLLOWED["across"]]["largest mm"] == "0.020"
    assert rows[fig13.FOLLOWED["bridged"]]["contact regained"] == "1"
    assert (tmp_path / "fig13.png").read_bytes().startswith(b"\x89PNG")


def test_a_session_that_did_not_weld(tmp_path: Path) -> None:
    log(tmp_path / "s0", scan())
    with pytest.raises(FlangeyeError, match="did not weld"):
        seen(SessionRow({}, tmp_path / "s0"))
    with pytest.raises(FlangeyeError, match="shows the command that makes it"):
        read_sessions(tmp_path / "nothing")


# --- the seam that is planned wrong on purpose ----------------------------------------------------


@pytest.mark.parametrize("workpiece", ["v-straight", "v-curved"])
def test_the_planning_error_is_as_large_as_asked_and_differs_by_seed(workpiece: str) -> None:
    params = AsLaidParams(workpiece=workpiece)
    truth = scan_as_laid.function(AsLaidParams(workpiece=workpiece)).truth["groove"]
    seams = [seam_misplanned.function(None, seed, params) for seed in range(6)]
    ways = set()
    for seam in seams:
        assert isinstance(seam, Seam)
        shift = seam.points_in_base.mean(axis=0) - truth.mean(axis=0)
        assert np.linalg.norm(shift) == pytest.approx(3e-3)
        planned, true = (line[-1] - line[0] for line in (seam.points_in_base, truth))
        cosine = planned @ true / np.linalg.norm(planned) / np.linalg.norm(true)
        assert np.degrees(np.arccos(cosine)) == pytest.approx(1.0, abs=1e-6)
        ways.add(tuple(np.round(shift, 6)))
    assert len(ways) == 6
    again = seam_misplanned.function(None, 0, params)
    np.testing.assert_array_equal(again.points_in_base, seams[0].points_in_base)
