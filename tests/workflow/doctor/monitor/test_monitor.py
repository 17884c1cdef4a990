"""``flangeye monitor``: what it says, what it keeps, and how it refuses."""

from __future__ import annotations

import asyncio
import errno
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from flangeye.cli import commands
from flangeye.errors import FlangeyeError, StageError
from flangeye.types.geometry import rigid
from flangeye.workflow.doctor.monitor import from_arm
from flangeye.workflow.doctor.monitor.chart import figure
from flangeye.workflow.doctor.monitor.drift import DriftTest
from flangeye.workflow.doctor.monitor.history import CheckFinding, History
from flangeye.workflow.doctor.monitor.stored import stored_calibration
from flangeye.workflow.doctor.monitor.verdicts import judge, write_state
from flangeye_plugins.reader.folder import FolderParams, folder
from tests.fuzz.damage import spoilt
from tests.workflow.doctor.monitor.cell import calibrate, check, part_of_sample
from tests.workflow.doctor.sessions import clean


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
        commands(), ["monitor", calibration, *given, "--history", str(history), *options]
    )


def test_ok_then_moved_since_when_and_which_part_and_it_stays_moved(
    cell: Path, tmp_path: Path
) -> None:
    history = tmp_path / "h.jsonl"
    fine = monitor(cell, history, *(f"ok-{i:02}" for i in range(15)))
    assert fine.exit_code == 0, fine.output
    assert [json.loads(line)["state"] for line in fine.stdout.splitlines()] == ["OK"] * 15
    moved = monitor(cell, history, "moved-0", "moved-1", "moved-2")
    assert moved.exit_code == 2
    last = json.loads(moved.stdout.splitlines()[-1])
    assert (last["check"], last["state"], last["since_check"]) == (17, "MOVED", 15)
    assert last["since"].startswith("2001") and last["sightings"] == 3
    assert last["shift_mm"] == pytest.approx(0.6, abs=0.15)
    assert last["part"] is not None and last["probability"] > 0.3
    page = history.with_suffix(".html").read_text()
    assert (
        "<h1>MOVED</h1>" in page
        and "since check 15" in page
        and "https://" not in page.split("<script", 1)[0]
    )
    again = monitor(cell, history, "ok-15")
    assert again.exit_code == 2 and json.loads(again.stdout)["since_check"] == 15


def test_a_camera_that_was_put_back_still_moved(cell: Path, tmp_path: Path) -> None:
    history = tmp_path / "h.jsonl"
    assert monitor(cell, history, *(f"ok-{i:02}" for i in range(5))).exit_code == 0
    assert monitor(cell, history, "moved-0", "moved-1", "moved-2").exit_code == 2
    back = monitor(cell, history, *(f"ok-{i:02}" for i in range(5, 16)))
    assert back.exit_code == 2
    told = [json.loads(line) for line in back.stdout.splitlines()]
    assert {each["state"] for each in told} == {"MOVED"}
    assert {each["since_check"] for each in told} == {5}
    assert told[-1]["shift_mm"] < 0.3  # the shift is the mean since then


def test_the_chart_of_one_check_has_one_time(cell: Path, tmp_path: Path) -> None:
    monitor(cell, tmp_path / "h.jsonl", "ok-00")
    history = History.read(tmp_path / "h.jsonl", stored_calibration(cell / "calibration").key)
    (at,) = figure(history, DriftTest()).layout.xaxis.tickvals
    assert (at.year, at.microsecond) == (2001, 0)
    assert "h.jsonl: 1. A step" in (tmp_path / "h.html").read_text()


def test_a_slow_drift_is_degraded(cell: Path, tmp_path: Path) -> None:
    names = []
    for i in range(30):
        names.append(f"slow-{i}")
        check(cell / names[-1], seed=200 + i, shift=(13e-6 * i, 0.0, 0.0))
    options = ("--false-alarms", "1e-9")
    done = monitor(cell, tmp_path / "h.jsonl", *names, options=options)
    states = [json.loads(line)["state"] for line in done.stdout.splitlines()]
    assert states[0] == "OK" and set(states) == {"OK", "DEGRADED"}
    assert done.exit_code == ["OK", "DEGRADED"].index(states[-1])


def test_one_scan_in_which_something_else_was_found_raises_no_alarm(
    cell: Path, tmp_path: Path
) -> None:
    check(cell / "wrong", seed=300, misfit=0.02)
    done = monitor(cell, tmp_path / "h.jsonl", "ok-00", "wrong", "ok-01")
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert [line["state"] for line in lines] == ["OK"] * 3
    assert [line["set_aside"] for line in lines] == [[], ["scan-1"], []]
    assert [line["sightings"] for line in lines] == [3, 2, 3]


def test_a_scanner_that_was_knocked_hard_is_no_misfit(cell: Path, tmp_path: Path) -> None:
    check(cell / "knocked", seed=301, shift=(0.02, 0.0, 0.0))
    done = monitor(cell, tmp_path / "h.jsonl", "ok-00", "knocked")
    assert done.exit_code == 2 and json.loads(done.stdout.splitlines()[-1])["set_aside"] == []


def test_scans_that_contradict_each_other_check_nothing(cell: Path, tmp_path: Path) -> None:
    check(cell / "torn", seed=302, misfit=0.05, shift=(0.02, 0.0, 0.0))
    done = monitor(cell, tmp_path / "h.jsonl", "ok-00", "torn")
    assert isinstance(done.exception, StageError)
    assert str(done.exception).endswith(
        "torn: nothing is checked: no single change of scanner, flange or arm explains its 3 scans; "
        "inspect them and scan again, or calibrate if the scanner was moved far"
    )
    assert len(done.stdout.splitlines()) == 1, "the check before is said and kept"


def test_the_same_scans_do_not_count_twice(cell: Path, tmp_path: Path) -> None:
    history = tmp_path / "h.jsonl"
    twice = monitor(cell, history, "ok-00", "ok-00")
    assert isinstance(twice.exception, StageError)
    assert f"is already in {history}, as check 0" in str(twice.exception)
    assert len(twice.stdout.splitlines()) == 1  # the first is kept
    assert len(History.read(history, stored_calibration(cell / "calibration").key).checks) == 1


def test_the_history_comes_back_as_it_was(cell: Path, tmp_path: Path) -> None:
    history, stored = tmp_path / "h.jsonl", stored_calibration(cell / "calibration")
    monitor(cell, history, *(f"ok-{i:02}" for i in range(4)))
    read = History.read(history, stored.key)
    last = read.findings.pop()
    assert judge(stored, read, DriftTest(limit=0.4e-3)) == last
    assert (last.since, last.part, last.probability) == (None, "", 0.0)
    assert [f.check for f in read.findings] == [0, 1, 2]


@pytest.mark.parametrize(
    ("write", "message"),
    [
        (lambda p: p.write_bytes(b"PAR1 broken"), "is not a history of flangeye monitor"),
        (lambda p: History(p, "another", [], []).write(), "is the history of another calibration"),
    ],
    ids=["broken", "another"],
)
def test_a_history_that_is_not_ours_is_refused(
    cell: Path, tmp_path: Path, write: Callable[..., Any], message: str
) -> None:
    history = tmp_path / "h.jsonl"
    write(history)
    refused = monitor(cell, history, "ok-00")
    assert isinstance(refused.exception, StageError)
    assert message in str(refused.exception) and "\n" not in str(refused.exception)


@pytest.fixture(scope="module")
def written(cell: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    history = tmp_path_factory.mktemp("written") / "h.jsonl"
    monitor(cell, history, "ok-00", "ok-01", "ok-02")
    return history


def test_a_spoilt_history_is_refused_in_one_line_or_holds_what_it_held(
    cell: Path, written: Path, tmp_path: Path
) -> None:
    key, raw = stored_calibration(cell / "calibration").key, written.read_bytes()
    chance, spoilt_file = random.Random(0), tmp_path / "h.jsonl"
    refused = 0
    for _ in range(700):
        spoilt_file.write_bytes(spoilt(raw, chance))
        try:
            read = History.read(spoilt_file, key)
        except StageError as error:
            refused += 1
            assert "\n" not in str(error)
        else:
            read.path = tmp_path / "again.jsonl"
            read.write()
            assert read.path.read_bytes() == raw
    assert refused > 690


CRAFTED: dict[str, Callable[[dict[str, Any]], Any]] = {
    "no finding": lambda r: r.pop("finding"),
    "no sightings": lambda r: r["check"]["seen"].clear(),
    "a text for a number": lambda r: r["finding"].update(shift="far"),
    "an unknown state": lambda r: r["finding"].update(state="FINE"),
    "another's finding": lambda r: r["finding"].update(check=7),
    "since the future": lambda r: r["finding"].update(since=2),
    "a motion of three": lambda r: r["finding"].update(motion=[0.0, 0.0, 0.0]),
    "a time before all": lambda r: r["check"].update(time_ns=-1),
    "a time beyond all": lambda r: r["check"].update(time_ns=10**30),
    "a centre of two": lambda r: r["check"]["seen"][0]["feature"].update(centre=[1.0, 2.0]),
    "a centre at infinity": lambda r: r["check"]["seen"][0]["feature"].update(centre=[1e999, 0, 0]),
    "a covariance that is none": lambda r: r["check"]["seen"][0]["feature"].update(
        covariance=[[0, 1e-8, 0], [1e-8, 0, 0], [0, 0, 1e-8]]
    ),
    "no pose of the flange": lambda r: r["check"]["seen"][0]["poses"].clear(),
    "a pose that is not a rotation": lambda r: r["check"]["seen"][0]["poses"]["flange"].update(
        matrix=[[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    ),
    "another kind of feature": lambda r: r["check"]["seen"][0].update(feature={}),
}  # fmt: skip


@pytest.mark.parametrize("wrong", CRAFTED)
def test_a_made_history_with_a_right_checksum_is_refused(
    cell: Path, written: Path, tmp_path: Path, wrong: str
) -> None:
    head, *lines = [json.loads(line) for line in written.read_text().splitlines()]
    CRAFTED[wrong](lines[1])
    body = "".join(json.dumps(line) + "\n" for line in lines)
    digest = hashlib.sha256(f"{head['calibration']}\n{body}".encode()).hexdigest()
    made = tmp_path / "h.jsonl"
    made.write_text(json.dumps(head | {"sha256": digest}) + "\n" + body)
    with pytest.raises(StageError, match="h.jsonl: check 1: ") as error:
        History.read(made, head["calibration"])
    assert "\n" not in str(error.value)


def test_two_checks_at_once_are_both_kept(cell: Path, tmp_path: Path) -> None:
    history = tmp_path / "h.jsonl"
    words = [sys.executable, "-m", "flangeye.cli", "monitor", str(cell / "calibration")]
    at_once = [
        subprocess.Popen([*words, "--archive", str(cell / f"ok-{i:02}"), "--history", str(history)])
        for i in range(2)
    ]
    assert [one.wait(120) for one in at_once] == [0, 0]
    kept = History.read(history, stored_calibration(cell / "calibration").key)
    assert {check.source[-5:] for check in kept.checks} == {"ok-00", "ok-01"}


def test_what_cannot_be_written_is_not_said_and_harms_nothing(
    cell: Path, written: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    history = tmp_path / "h.jsonl"
    shutil.copy(written, history)

    def full(*_: Any) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    refused = monitor(cell, history, "ok-03")
    assert str(refused.exception) == f"{history}: cannot be written: No space left on device"
    assert refused.stdout == "" and history.read_bytes() == written.read_bytes()


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
    refused = monitor(cell, tmp_path / "h.jsonl", options=options)
    assert isinstance(refused.exception, FlangeyeError)
    assert "\n" not in str(refused.exception)
    assert message in str(refused.exception)


@pytest.mark.parametrize("robot", ["ur10e", "kuka-iiwa14-r820"])  # as many joints, and one more
def test_a_run_of_another_robot_checks_nothing(robot: str, tmp_path: Path) -> None:
    of = "robot: {{model: {}}}".format
    calibrate(tmp_path / "calibration", of("ur5e"))
    check(tmp_path / "same", 400, recipe=of("ur5e"))
    check(tmp_path / "other", 401, recipe=of(robot))
    done = monitor(tmp_path, tmp_path / "h.jsonl", "same", "other")
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
        moved = CheckFinding(0, "MOVED", 1e-3, (0.0,) * 6, 0, 2.0)
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
            "opc.tcp://127.0.0.1:1", "ns=2;s=x", CheckFinding(0, "OK", 0.0, (0.0,) * 6, None, 0.1)
        )


def test_a_plc_is_waited_for_ten_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("asyncua", reason="asyncua is not installed")
    waited: list[float] = []

    async def waits(writing: Any, timeout: float) -> None:
        writing.close()
        waited.append(timeout)
        raise TimeoutError

    monkeypatch.setattr(asyncio, "wait_for", waits)
    with pytest.raises(StageError, match="cannot be written: TimeoutError$"):
        write_state(
            "opc.tcp://127.0.0.1:1", "ns=2;s=x", CheckFinding(0, "OK", 0.0, (0.0,) * 6, None, 0.1)
        )
    assert waited == [10]


def test_a_plc_on_another_machine_is_written_to_in_the_open_only_when_asked(cell: Path) -> None:
    plc = "opc.tcp://192.0.2.1:4840"
    words = ("--archive", str(cell / "ok-00"), "--opcua", f"{plc},ns=2;s=x")
    refused = monitor(cell, cell / "never.jsonl", options=words)
    assert str(refused.exception).startswith(f"{plc}: is on another machine")
    assert "--opcua-security" in str(refused.exception) and not (cell / "never.jsonl").exists()


def test_a_plc_is_told_even_where_the_chart_cannot_be_written(
    cell: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "h.html").mkdir()
    told: list[str] = []
    monkeypatch.setattr(
        "flangeye.workflow.doctor.monitor.verdicts.write_state",
        lambda url, node, finding, security: told.append(finding.state),
    )
    plc = ("--opcua", "opc.tcp://127.0.0.1:1,ns=2;s=x")
    refused = monitor(cell, tmp_path / "h.jsonl", "ok-00", options=plc)
    assert str(refused.exception) == f"{tmp_path / 'h.html'}: cannot be written: Is a directory"
    assert told == ["OK"]


def test_a_state_is_written_signed_and_encrypted(tmp_path: Path) -> None:
    asyncua = pytest.importorskip("asyncua", reason="asyncua is not installed")
    crypto = pytest.importorskip("asyncua.crypto.cert_gen")
    cert, key = tmp_path / "cert.der", tmp_path / "key.pem"
    name, url = "urn:example.org:FreeOpcUa:opcua-asyncio", "opc.tcp://127.0.0.1:48412"

    async def serve() -> str:
        await crypto.setup_self_signed_certificate(key, cert, name, "localhost", [], {})
        server = asyncua.Server()
        await server.init()
        server.set_endpoint(url)
        server.set_security_policy([asyncua.ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
        await server.load_certificate(str(cert))
        await server.load_private_key(str(key))
        node = await server.nodes.objects.add_variable("ns=1;s=state", "state", "")
        await node.set_writable()
        moved = CheckFinding(0, "MOVED", 1e-3, (0.0,) * 6, 0, 2.0)
        async with server:
            with pytest.raises(StageError, match="cannot be written"):
                await asyncio.to_thread(write_state, url, "ns=1;s=state", moved, "none")
            secured = f"Basic256Sha256,SignAndEncrypt,{cert},{key}"
            await asyncio.to_thread(write_state, url, "ns=1;s=state", moved, secured)
            return await node.read_value()

    assert asyncio.run(serve()) == "MOVED"


def test_live_needs_a_calibration_that_was_live(cell: Path) -> None:
    from flangeye.plugin.registry import load_registry

    with pytest.raises(StageError, match=r"was not calibrated live"):
        from_arm(stored_calibration(cell / "calibration"), load_registry(), 3, move=False)


def calibrated(folder: Path, name: str, *more: str) -> None:
    """Calibrate from a folder's scans."""
    words = ["run", "ur5_phoxi-m_sample", "--archive", str(folder / "scans")]
    done = CliRunner().invoke(commands(), [*words, "--out", str(folder / name), *more])
    assert done.exit_code == 0, done.output


@pytest.fixture(scope="module")
def six(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the sample's first six scans and a calibration from them."""
    folder = tmp_path_factory.mktemp("six")
    part_of_sample(folder / "scans", range(6))
    calibrated(folder, "calibration")
    return folder


def test_the_calibrations_own_scans_are_no_check_even_fitted_anew(
    six: Path, tmp_path: Path
) -> None:
    calibrated(six, "anew", "--set", "fit.rim.inlier=0.2 mm")
    for again in ("calibration", "anew", "scans"):
        refused = monitor(six, tmp_path / "h.jsonl", again)
        assert str(refused.exception).endswith(
            f"{again}: 6 of its scans are the calibration's own, which check nothing; scan again, "
            "with another seed where the cell is simulated"
        )


def test_recordings_may_be_laid_out_otherwise_than_the_calibrations(
    six: Path, tmp_path: Path
) -> None:
    later = part_of_sample(tmp_path / "later", range(6, 8))
    poses = [r.base_T_flange for r in folder(later, FolderParams()).recordings]
    (later / "poses.csv").unlink()
    np.save(later / "arm.npy", poses)
    words = ["monitor", str(six / "calibration" / "calibration.yaml"), "--archive", str(later)]
    words += ["--history", str(tmp_path / "h.jsonl")]
    reader = "acquire.archive.reader={table: {file: arm.npy, rotation: matrix, length: m}}"
    found = CliRunner().invoke(commands(), [*words, "--set", reader])
    assert found.exit_code == 0, found.output
    assert json.loads(found.stdout)["state"] == "OK"


def table_of(folder: Path, kind: str, count: int) -> np.ndarray:
    """Write what another program measured of a target, as a table; return one more row of it."""
    folder.mkdir()
    session = clean(np.random.default_rng(0), count, kind, turn=0.4)
    measured = [session.centres]
    if kind == "marker":
        seen = [rigid(r, p) for r, p in zip(session.rotations, session.centres, strict=True)]
        measured = [np.array(seen).reshape(count, 16)]
    rows = np.hstack([session.poses.reshape(count, 16), *measured])
    np.savetxt(folder / "poses.csv", rows[:-1], delimiter=",")
    return rows[-1]


POSE = "rotation: matrix, length: m, columns"
TABLES = {
    "centres": """
title: Centres
robot: ur5e
steps:
  - acquire.centres: {path: calibrated, reader: {table: {pose: base_T_flange, POSE: [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16], target: {columns: [17, 18, 19], rotation: point, length: m}}}}
  - solve.robust
""",
    "marker": """
title: A marker
robot: ur5e
configuration: {name: eye-on-base, place: unknown}
steps:
  - acquire.samples: {path: calibrated, reader: {table: {pose: base_T_flange, POSE: [1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16], target: {POSE: [17, 18, 19, 20, 21, 22, 23, 24, 25, 26, 27, 28, 29, 30, 31, 32]}}}}
  - solve.robust
""",
}


def calibrated_from_a_table(folder: Path, kind: str) -> np.ndarray:
    """Calibrate from a table; return one more row of it."""
    row = table_of(folder / "calibrated", kind, 21)
    (folder / "recipe.yaml").write_text(TABLES[kind].replace("POSE", POSE))
    words = ["run", str(folder / "recipe.yaml"), "--out", str(folder / "calibration")]
    assert CliRunner().invoke(commands(), words).exit_code == 0
    return row


@pytest.mark.parametrize(("kind", "x"), [("centres", 16), ("marker", 19)])
def test_a_calibration_from_a_table_is_checked_with_tables_of_a_single_row(
    tmp_path: Path, kind: str, x: int
) -> None:
    row = calibrated_from_a_table(tmp_path, kind)
    for name, aside in (("fine", 0.0), ("moved", 0.02)):
        (tmp_path / name).mkdir()
        row[x] += aside
        np.savetxt(tmp_path / name / "poses.csv", row[None], delimiter=",")
    done = monitor(tmp_path, tmp_path / "h.jsonl", "fine", "moved")
    told = [json.loads(line) for line in done.stdout.splitlines()]
    assert [(each["state"], each["sightings"]) for each in told] == [("OK", 1), ("MOVED", 1)]


def test_a_check_of_another_target_than_the_calibrations_is_refused(
    cell: Path, tmp_path: Path
) -> None:
    calibrated_from_a_table(tmp_path, "marker")
    (tmp_path / "circles").symlink_to(cell / "ok-00")
    done = monitor(tmp_path, tmp_path / "h.jsonl", "circles")
    assert "shows another target than the calibration's" in str(done.exception)
