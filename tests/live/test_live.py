"""The online loop against the real client, a controller on loopback and a simulated scanner."""

import json
import signal
import time
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.live.cell import Cell

pytestmark = pytest.mark.realtime


@pytest.fixture
def cell(tmp_path: Path) -> Iterator[Any]:
    pytest.importorskip("rtde_control", reason="needs ur-rtde")
    with Cell(tmp_path) as cell:
        yield cell


def test_without_move_the_plan_is_shown_and_nothing_moves(cell: Any) -> None:
    before = cell.control.truth().joints
    code, out, err = cell.run(cell.recipe(), "--out", "run")
    assert (code, err) == (0, "")
    assert "5 stops" in out.splitlines()[0]
    rows = [line.split() for line in out.splitlines()[2:7]]
    assert [row[0] for row in rows] == ["0000", "0001", "0002", "0003", "0004"]
    assert all("direct" in row or "home" in row for row in rows)
    assert out.splitlines()[-2:] == [
        f"ur5e at {cell.controller.host} was read: no program was started on it, nothing was "
        "commanded",
        "dry run, nothing moved; add --move to execute",
    ]
    assert not [line for line in cell.control.log() if "program" in line]
    assert (cell.control.truth().joints == before).all()
    assert not (cell.folder / "run").exists()


def test_a_run_that_is_stopped_goes_on_where_it_was(cell: Any) -> None:
    recipe = cell.recipe(count=6)
    process = cell.start(recipe, "--move", "--out", "run")
    cell.wait_until(lambda: len(cell.finished()) >= 2, patience=120)
    cell.wait_until(cell.moving)
    process.send_signal(signal.SIGINT)
    sent = time.monotonic()
    cell.wait_until(cell.standing, patience=3)
    _, err = process.communicate(timeout=20)
    assert process.returncode == 130
    assert time.monotonic() - sent < 20
    assert err.splitlines()[-4:] == [
        "the captures recorded so far are in run/run.mcap; flangeye report run shows it",
        f"with other parameters: flangeye run {recipe} --from run/run.mcap --at fit.rim --set "
        "PATH=VALUE (to do segment.flange again, record with --set log.clouds=full)",
        "resume it: flangeye run --resume run --move",
        "error: stopped by Ctrl-C",
    ]
    taken = cell.captures("run")
    assert len(taken) >= 2

    code, _, err = cell.run("--resume", "run", "--move", "--out", "again")
    assert code == 0, err
    assert cell.captures("again") == [f"{i:04d}" for i in range(6)]
    result = cell.result("again")
    assert result["status"] == "verified"
    assert result["truth"]["rms_over_workspace"] < 1e-3
    assert [o["id"] for o in result["observations"]] == cell.captures("again")
    assert 0 < result["timing"]["0.acquire.live"]["idle"] < 1


TIP = np.array([0.0, 0.0, 0.15])
"""A tip on the flange's axis [m]."""


@pytest.mark.slow  # the resumed run loses the emulator's cycles now and then on two busy cores
def test_a_capture_is_taken_again_and_the_calibration_is_touched(cell: Any) -> None:
    code, _, err = cell.run(cell.recipe(), "--move", "--out", "run")
    assert code == 0, err

    code, _, err = cell.run("--resume", "run", "--retake", "0002", "--move", "--out", "again")
    assert code == 0, err
    assert sorted(cell.captures("again")) == sorted(cell.captures("run"))
    before, after = (
        {o.id: o.feature.centre for o in cell.log(run).observations()} for run in ("run", "again")
    )
    assert [i for i in before if not np.array_equal(before[i], after[i])] == ["0002"]
    assert cell.result("again")["status"] == "verified"

    ahead = cell.control.truth().base_T_flange @ [*TIP + [0.0, 0.0, 0.06], 1.0]
    camera = (
        np.linalg.inv(np.asarray(cell.log("again").calibration().base_T_camera.transform.matrix))
        @ ahead
    )
    words = ("--seen", metres(camera[:3]), "--tip", metres(TIP), "--move", "--yes")
    start = cell.control.truth().base_T_flange[:3, 3]
    code, out, err = cell.run("again", *words, command="touch")
    assert code == 0, err
    assert cell.standing()
    gone = np.linalg.norm(cell.control.truth().base_T_flange[:3, 3] - start)
    assert gone == pytest.approx(0.06 - 0.005, abs=1e-3)  # it stops 5 mm before the point
    assert "predicted is off by" in out
    assert (cell.folder / "touch.yaml").exists()

    words = ("run", "--live", "--scans", "2", "--set", "scanner.driver.emulator.seed=2")
    code, out, err = cell.run(*words, command="monitor")
    assert code == 0 and out.endswith("dry run, nothing moved; add --move to execute\n"), err
    assert not (cell.folder / "run/checks").exists()
    code, out, err = cell.run(*words, "--move", command="monitor")
    assert code == 0, err
    said = json.loads(out)
    assert (said["state"], said["sightings"]) == ("OK", 2)
    assert said["time"].startswith(datetime.now(UTC).isoformat()[:10])
    assert len(cell.captures(said["source"])) == 2


def metres(point: np.ndarray) -> str:
    return ", ".join(f"{x:.6f} m" for x in point)


@pytest.mark.slow
def test_a_run_that_is_killed_leaves_a_standing_arm_and_a_readable_log(cell: Any) -> None:
    process = cell.start(cell.recipe(), "--move", "--out", "run")
    cell.wait_until(cell.finished, patience=120)
    cell.wait_until(cell.moving)
    process.kill()
    cell.wait_until(cell.standing, patience=3)
    place = cell.control.truth().base_T_flange
    time.sleep(0.5)
    assert cell.control.truth().base_T_flange == pytest.approx(place, abs=1e-6)
    assert cell.finished()
    process.communicate()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fault", "line"),
    [
        ("protective-stop@moving", "the controller reports protective stop"),
        ("die=30 s@moving", "ur5e at"),
        ("freeze=30 s@moving", "ur5e at"),
    ],
)
def test_a_doubt_ends_the_run_and_nothing_gathered_is_lost(
    cell: Any, fault: str, line: str
) -> None:
    process = cell.start(cell.recipe(), "--move", "--out", "run")
    cell.wait_until(lambda: len(cell.finished()) >= 2, patience=120)
    cell.control.fault(fault)
    _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert "Traceback" not in err
    assert err.splitlines()[-1].startswith(f"error: {line}")
    assert "resume it: flangeye run --resume run --move" in err
    taken, finished = cell.captures(), cell.finished()
    assert len(finished) >= 2
    assert taken == finished


def test_a_scanner_that_is_lost_stops_the_arm(cell: Any) -> None:
    code, _, err = cell.run(cell.recipe(scanner="lost_after: 2"), "--move", "--out", "run")
    assert code == 2
    assert "disconnected after 2 exposures" in err.splitlines()[-1]
    assert cell.captures("run") == ["0000", "0001"]
    assert cell.standing()


@pytest.mark.slow
def test_a_dropped_frame_costs_one_pose(cell: Any) -> None:
    recipe = cell.recipe(count=8, scanner="dropped: 0.4, seed: 3")
    code, _, err = cell.run(recipe, "--move", "--out", "run")
    log = cell.log()
    assert code == 0, err
    assert log.rejections
    assert {"acquire.live"} == {r.stage for r in log.rejections}
    assert all("was lost on its way" in r.reason for r in log.rejections)
    assert len(log.poses) + len(log.rejections) == 8


@pytest.mark.slow
def test_the_arm_stands_while_it_is_scanned_and_the_pose_is_its_own(cell: Any) -> None:
    code, _, err = cell.run(cell.recipe(), "--move", "--out", "run")
    assert code == 0, err
    for observation in cell.log().observations():
        nominal = np.asarray(observation.joints)
        assert np.isfinite(nominal).all()
    held_out = cell.result("run")["holdout"]["rms"]
    assert held_out < 1e-3


def test_an_arm_outside_its_limits_is_not_moved(tmp_path: Path) -> None:
    pytest.importorskip("rtde_control", reason="needs ur-rtde")
    with Cell(tmp_path, "--joints", "0 -90 90 -90 -90 0 deg") as cell:
        code, _, err = cell.run(cell.recipe(), "--move", "--out", "run")
        assert code == 2
        assert err.splitlines()[-1] == (
            "error: the arm is outside robot.limits, outside the box: x is -492 mm, allowed -50 "
            "to 950 mm: jog it inside with its pendant, or widen the limits"
        )
        assert not (tmp_path / "run").exists()
