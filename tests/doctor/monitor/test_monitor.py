"""``flangeye monitor``: what it says, what it keeps, and how it refuses."""

from __future__ import annotations

import asyncio
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from flangeye.cli.commands import app
from flangeye.doctor.monitor import History, from_arm, judge, stored_calibration
from flangeye.doctor.monitor.chart import figure
from flangeye.doctor.monitor.history import Finding
from flangeye.doctor.monitor.opcua import write_state
from flangeye.errors import FlangeyeError, StageError
from flangeye.handeye.drift import DriftTest
from flangeye_plugins.reader.folder import FolderParams, folder
from tests.doctor.monitor.cell import calibrate, check
from tests.doctor.sessions import clean


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cell")
    calibrate(folder / "calibration")
    for i in range(16):
        check(folder / f"ok-{i:02}", seed=i)
    for i in range(3):
        check(folder / f"moved-{i}", seed=100 + i, shift=(0.0, 0.6e-3, 0.0))
    return folder


def monitor(cell: Path, history: Path, *archives: str, options: tuple[str, ...] = ()) -> Result:
    given = [x for name in archives for x in ("--archive", str(cell / name))]
    calibration = str(cell / "calibration")
    return CliRunner().invoke(
        app, ["monitor", calibration, *given, "--history", str(history), *options]
    )


def test_ok_then_moved_since_when_and_which_part(cell: Path, tmp_path: Path) -> None:
    history = tmp_path / "h.parquet"
    fine = monitor(cell, history, *(f"ok-{i:02}" for i in range(16)))
    assert fine.exit_code == 0, fine.output
    assert [json.loads(line)["state"] for line in fine.stdout.splitlines()] == ["OK"] * 16
    moved = monitor(cell, history, "moved-0", "moved-1", "moved-2")
    assert moved.exit_code == 2
    last = json.loads(moved.stdout.splitlines()[-1])
    assert (last["check"], last["state"], last["since_check"]) == (18, "MOVED", 16)
    assert last["since"].startswith("2001") and last["sightings"] == 3
    assert last["shift_mm"] == pytest.approx(0.6, abs=0.15)
    assert last["part"] is not None and last["probability"] > 0.3
    page = history.with_suffix(".html").read_text()
    assert (
        "<h1>MOVED</h1>" in page
        and "since check 16" in page
        and "https://" not in page.split("<script", 1)[0]
    )


def test_the_chart_of_one_check_has_one_time(cell: Path, tmp_path: Path) -> None:
    monitor(cell, tmp_path / "h.parquet", "ok-00")
    history = History.read(tmp_path / "h.parquet", stored_calibration(cell / "calibration").key)
    (at,) = figure(history, DriftTest()).layout.xaxis.tickvals
    assert (at.year, at.microsecond) == (2001, 0)
    assert "h.parquet: 1. A step" in (tmp_path / "h.html").read_text()


def test_what_has_moved_stays_moved(cell: Path, tmp_path: Path) -> None:
    history = tmp_path / "h.parquet"
    monitor(cell, history, *(f"ok-{i:02}" for i in range(12)), "moved-0", "moved-1", "moved-2")
    again = monitor(cell, history, "ok-12")
    assert again.exit_code == 2 and json.loads(again.stdout)["since_check"] == 12


def test_a_slow_drift_is_degraded(cell: Path, tmp_path: Path) -> None:
    names = []
    for i in range(60):
        names.append(f"slow-{i}")
        check(cell / names[-1], seed=200 + i, shift=(6.5e-6 * i, 0.0, 0.0))
    options = ("--false-alarms", "1e-9")
    done = monitor(cell, tmp_path / "h.parquet", *names, options=options)
    states = [json.loads(line)["state"] for line in done.stdout.splitlines()]
    assert states[0] == "OK" and set(states) == {"OK", "DEGRADED"}
    assert done.exit_code == ["OK", "DEGRADED"].index(states[-1])


def test_one_scan_in_which_something_else_was_found_raises_no_alarm(
    cell: Path, tmp_path: Path
) -> None:
    check(cell / "wrong", seed=300, misfit=0.02)
    done = monitor(cell, tmp_path / "h.parquet", "ok-00", "wrong", "ok-01")
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["state"] for line in lines] == ["OK"] * 3
    assert [line["set_aside"] for line in lines] == [[], ["scan-1"], []]
    assert [line["sightings"] for line in lines] == [3, 2, 3]


def test_a_scanner_that_was_knocked_hard_is_no_misfit(cell: Path, tmp_path: Path) -> None:
    check(cell / "knocked", seed=301, shift=(0.02, 0.0, 0.0))
    done = monitor(cell, tmp_path / "h.parquet", "ok-00", "knocked")
    assert done.exit_code == 2 and json.loads(done.stdout.splitlines()[-1])["set_aside"] == []


def test_scans_that_contradict_each_other_check_nothing(cell: Path, tmp_path: Path) -> None:
    check(cell / "torn", seed=302, misfit=0.05, shift=(0.02, 0.0, 0.0))
    done = monitor(cell, tmp_path / "h.parquet", "ok-00", "torn")
    assert isinstance(done.exception, StageError)
    assert str(done.exception).endswith(
        "torn: nothing is checked: no one change of scanner, flange or arm explains its 3 scans; "
        "look at them and scan again; where the scanner was moved far, calibrate"
    )
    assert len(done.stdout.splitlines()) == 1, "the check before is said and kept"


def test_the_same_scans_do_not_count_twice(cell: Path, tmp_path: Path) -> None:
    history = tmp_path / "h.parquet"
    twice = monitor(cell, history, "ok-00", "ok-00")
    assert isinstance(twice.exception, StageError)
    assert f"is already in {history}, as check 0" in str(twice.exception)
    assert len(twice.stdout.splitlines()) == 1  # the first is kept
    assert len(History.read(history, stored_calibration(cell / "calibration").key).checks) == 1


def test_the_history_comes_back_as_it_was(cell: Path, tmp_path: Path) -> None:
    history, stored = tmp_path / "h.parquet", stored_calibration(cell / "calibration")
    monitor(cell, history, *(f"ok-{i:02}" for i in range(4)))
    read = History.read(history, stored.key)
    last = read.findings.pop()
    assert judge(stored, read, DriftTest(limit=0.4e-3)) == last
    assert [f.check for f in read.findings] == [0, 1, 2]


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda p: p.write_bytes(b"PAR1 broken"), "cannot be read"),
        (lambda p: History(p, "another", [], []).write(), "is the history of another calibration"),
    ],
    ids=["broken", "another"],
)
def test_a_history_that_is_not_ours_is_refused(
    cell: Path, tmp_path: Path, write: Callable[..., Any], message: str
) -> None:
    history = tmp_path / "h.parquet"
    write(history)
    refused = monitor(cell, history, "ok-00")
    assert isinstance(refused.exception, StageError)
    assert message in str(refused.exception) and "\n" not in str(refused.exception)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ((), "name later scans with --archive, or let the arm take them with --live"),
        (("--archive", "nowhere"), "nowhere: does not exist"),
        (("--live",), "was not calibrated live"),
        (("--live", "--limit", "3"), "--limit: '3' has no unit"),
    ],
)
def test_mistakes_are_one_line(
    cell: Path, tmp_path: Path, options: tuple[Any, ...], message: str
) -> None:
    refused = monitor(cell, tmp_path / "h.parquet", options=options)
    assert isinstance(refused.exception, FlangeyeError)
    assert "\n" not in str(refused.exception)
    assert message in str(refused.exception)


@pytest.mark.parametrize("robot", ["ur10e", "kuka-iiwa14-r820"])  # as many joints, and one more
def test_a_run_of_another_robot_checks_nothing(robot: str, tmp_path: Path) -> None:
    of = "robot: {{model: {}}}".format
    calibrate(tmp_path / "calibration", of("ur5e"))
    check(tmp_path / "same", 400, recipe=of("ur5e"))
    check(tmp_path / "other", 401, recipe=of(robot))
    done = monitor(tmp_path, tmp_path / "h.parquet", "same", "other")
    assert len(done.stdout.splitlines()) == 1
    assert isinstance(done.exception, StageError)
    assert str(done.exception).endswith(
        "other/run.mcap: is a run of another robot than this calibration's; name runs of the same "
        "cell"
    )


def test_a_run_without_a_calibration_cannot_be_watched(cell: Path) -> None:
    with pytest.raises(StageError, match="holds no calibration"):
        stored_calibration(cell / "ok-00")


def test_the_state_is_written_into_an_opc_ua_node() -> None:
    asyncua = pytest.importorskip("asyncua", reason="asyncua is not installed")

    async def serve() -> tuple[object, object]:
        server = asyncua.Server()
        await server.init()
        server.set_endpoint("opc.tcp://127.0.0.1:48411")
        space = await server.register_namespace("cell")
        text = await server.nodes.objects.add_variable(f"ns={space};s=state", "state", "")
        number = await server.nodes.objects.add_variable(f"ns={space};s=code", "code", 7)
        for node in (text, number):
            await node.set_writable()
        moved = Finding(0, "MOVED", 1e-3, (0.0,) * 6, 0, 2.0)
        async with server:
            for name in ("state", "code"):
                url = "opc.tcp://127.0.0.1:48411"
                await asyncio.to_thread(write_state, url, f"ns={space};s={name}", moved)
            return await text.read_value(), await number.read_value()

    assert asyncio.run(serve()) == ("MOVED", 2)


def test_a_plc_that_does_not_answer_is_one_line() -> None:
    pytest.importorskip("asyncua", reason="asyncua is not installed")
    with pytest.raises(
        StageError, match="opc.tcp://127.0.0.1:1, node 'ns=2;s=x': cannot be written"
    ):
        write_state(
            "opc.tcp://127.0.0.1:1", "ns=2;s=x", Finding(0, "OK", 0.0, (0.0,) * 6, None, 0.1)
        )


def test_live_needs_a_calibration_that_was_live(cell: Path) -> None:
    from flangeye.plugin.registry import load_registry

    with pytest.raises(StageError, match=r"was not calibrated live"):
        from_arm(stored_calibration(cell / "calibration"), load_registry(), 3, move=False)


def test_recordings_may_be_laid_out_otherwise_than_the_calibrations(tmp_path: Path) -> None:
    sample = Path(__file__).parents[3] / "data" / "samples" / "ur5_phoxi-m"
    done = CliRunner().invoke(app, ["run", "ur5_phoxi-m_sample", "--out", str(tmp_path / "run")])
    assert done.exit_code == 0, done.output
    later = tmp_path / "later"
    shutil.copytree(sample, later)
    poses = [r.base_T_flange for r in folder(sample, FolderParams()).recordings]
    (later / "poses.csv").unlink()
    np.save(later / "arm.npy", poses)
    words = ["monitor", str(tmp_path / "run" / "calibration.yaml"), "--archive", str(later)]
    reader = "acquire.archive.reader={table: {file: arm.npy, rotation: matrix, length: m}}"
    found = CliRunner().invoke(app, [*words, "--set", reader])
    assert found.exit_code == 0, found.output
    assert json.loads(found.stdout)["state"] == "OK"


def table_of(folder: Path, count: int) -> None:
    """Write centres that another program found, as a table."""
    folder.mkdir()
    session = clean(np.random.default_rng(0), count, "centres", turn=0.4)
    rows = np.hstack([session.poses.reshape(count, 16), session.centres])
    lines = [",".join(map(repr, row)) for row in rows.tolist()]
    (folder / "poses.csv").write_text("\n".join(lines))


TABLE = """
title: Centres
robot: ur5e
steps:
  - acquire.centres:
      path: calibrated
      reader:
        table:
          rotation: matrix
          length: m
          pose: base_T_flange
          columns: [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16]
          target: {columns: [17, 18, 19], rotation: point, length: m}
  - solve.robust
"""


def test_a_calibration_from_a_table_is_checked_with_tables_of_a_single_row(tmp_path: Path) -> None:
    table_of(tmp_path / "calibrated", 20)
    (tmp_path / "recipe.yaml").write_text(TABLE)
    words = ["run", str(tmp_path / "recipe.yaml"), "--out", str(tmp_path / "calibration")]
    assert CliRunner().invoke(app, words).exit_code == 0
    row = (tmp_path / "calibrated" / "poses.csv").read_text().splitlines()[3]
    for name, aside in (("fine", 0.0), ("moved", 0.02)):
        (tmp_path / name).mkdir()
        *pose, x, y, z = map(float, row.split(","))
        numbers = [*pose, x + aside, y, z]
        (tmp_path / name / "poses.csv").write_text(",".join(map(repr, numbers)) + "\n")
    done = monitor(tmp_path, tmp_path / "h.parquet", "fine", "moved")
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(each["state"], each["sightings"]) for each in told] == [("OK", 1), ("MOVED", 1)]
