"""A run as it goes, read from a log that is still being written."""

import os
import socket
import threading
import time
from contextlib import nullcontext, suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from flangeye import types as t
from flangeye.devices import RobotState
from flangeye.errors import StageError
from flangeye.plugin.registry import Registry
from flangeye.workflow.log.read import read_run
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.log.watch import RunView, follow, hidden_address, may_connect, watch_run
from flangeye.workflow.recipe.load import parse_recipe
from flangeye.workflow.run.runner import Runner
from tests.conftest import TOY_RECIPE


@pytest.fixture
def log(toy_registry: Registry, tmp_path: Path) -> Any:
    """Return what runs the toy recipe into a log, slowly enough to be watched."""
    path = tmp_path / "2026_toy" / "run.mcap"
    path.parent.mkdir()

    def run(pause=0.0):
        recipe = parse_recipe(TOY_RECIPE, "toy", toy_registry)
        recorder = Recorder(path, {"recipe.yaml": TOY_RECIPE}, False)
        toy_registry.hooks.register(recorder)
        try:
            time.sleep(pause)
            Runner(recipe, toy_registry, t.ArchivePath()).run()
        finally:
            toy_registry.hooks.unregister(recorder)
            recorder.close()

    return path, run


def plain():
    return Console(record=True, width=120, force_terminal=False)


def test_a_run_is_followed_while_it_is_written(log: Any) -> None:
    path, run = log
    runner = threading.Thread(target=run, args=(0.5,))
    runner.start()
    while not path.exists():
        time.sleep(0.01)
    view = watch_run(path.parent, None, plain(), patience=30)
    runner.join()
    assert view.ended
    assert (view.captures, view.fitted, view.total) == (6, 6, 6)
    rows = dict(view.rows())
    assert rows["run"] == "2026_toy, ended"
    assert rows["captures"] == "6 of at most 6, 6 fitted"
    assert rows["arm"].endswith("mm in the base, at the last capture")
    assert view.events[-2] == "3.solve.toy done"
    assert view.events[-1].startswith("4.verify.toy done: verify.toy: 0.")


def test_captures_of_a_cell_count_whatever_its_arms_are_called(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap", {"recipe.yaml": TOY_RECIPE}, False)
    pose = t.Transform("base", "left_flange", np.eye(4))
    cloud = t.PointCloud(t.CAMERA, np.zeros((0, 3), np.float32))
    recorder.flangeye_captured("0.acquire.toy", t.Capture("0", cloud, {"left_flange": pose}), 0.1)
    recorder.ended("")
    recorder.close()
    view = watch_run(tmp_path, None, plain(), patience=30)
    assert (view.captures, view.arm) == (1, None)
    assert not any(line.startswith("message") for line in view.events)


def test_a_killed_run_is_given_up_on(log: Any, tmp_path: Path) -> None:
    path, run = log
    run()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    with pytest.raises(StageError, match=r"nothing new for 0 s; the run is over$"):
        watch_run(torn, None, plain(), patience=0.3)


def test_what_is_no_log_is_one_line(tmp_path: Path) -> None:
    bad = tmp_path / "bad.mcap"
    bad.write_bytes(b"x" * 100)
    with pytest.raises(StageError, match=r"bad.mcap: is not an MCAP file"):
        list(follow(bad, lambda: None))


def test_no_run_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(StageError) as error:
        watch_run(None, None, plain(), patience=0.2)
    assert str(error.value) == "./runs: no run started within 0.2 s"
    with pytest.raises(StageError) as error:
        watch_run(tmp_path / "nowhere.mcap", None, plain(), patience=0.2)
    assert str(error.value).endswith("nowhere.mcap: no run started within 0.2 s")


def test_a_run_that_is_still_to_come_is_waited_for(log: Any) -> None:
    path, run = log
    late = threading.Timer(0.5, run)
    late.start()
    view = watch_run(path.parent, None, plain(), patience=30)
    late.join()
    assert view.ended


def test_a_run_that_failed_is_not_waited_for(tmp_path: Path) -> None:
    recorder = Recorder(tmp_path / "run.mcap", {"recipe.yaml": TOY_RECIPE}, False)
    recorder.ended("step 3 failed")
    recorder.close()
    began = time.monotonic()
    watch_run(tmp_path, None, plain(), patience=60)
    assert time.monotonic() - began < 5
    assert read_run(tmp_path).messages == ["step 3 failed"]


def test_of_a_calibration_that_is_checked_the_newest_check_is_watched(tmp_path: Path) -> None:
    for folder, why in ((tmp_path, "a calibration"), (tmp_path / "checks" / "one", "a check")):
        folder.mkdir(parents=True, exist_ok=True)
        recorder = Recorder(folder / "run.mcap", {"recipe.yaml": TOY_RECIPE}, False)
        recorder.ended(why)
        recorder.close()
    os.utime(tmp_path / "run.mcap", (0, 0))
    assert watch_run(tmp_path, None, plain(), patience=5).rows()[0] == ("run", "one, ended")


def test_a_journal_and_a_solvers_progress_are_shown(log: Any) -> None:
    path, _ = log
    recorder = Recorder(path, {}, False)
    recorder.flangeye_noted("3.solve.robust", "progress", t.Progress(7, 0.4e-3, 0.35e-3))
    recorder.flangeye_run_finished({})
    rows = dict(watch_run(path, None, plain(), patience=5).rows())
    assert rows["error so far"] == "95 % below 0.400 mm after 7 poses, 0.350 mm required"


def test_what_has_no_error_yet_is_not_observable(log: Any) -> None:
    path, _ = log
    recorder = Recorder(path, {}, False)
    recorder.flangeye_noted("3.solve.robust", "progress", t.Progress(4, None, 0.35e-3))
    recorder.flangeye_run_finished({})
    rows = dict(watch_run(path, None, plain(), patience=5).rows())
    assert rows["error so far"] == "not observable yet after 4 poses"


@pytest.mark.parametrize(
    ("silent", "told"),
    [(4.9, ""), (5.1, ", nothing new for 5 s"), (61.0, ", nothing new for 61 s")],
)
def test_a_silence_of_five_seconds_is_said_until_the_run_has_ended(
    monkeypatch: pytest.MonkeyPatch, silent: float, told: str
) -> None:
    view = RunView("2026_toy")
    monkeypatch.setattr(time, "time", lambda: 1000.0 + silent)
    assert view.rows()[0] == ("run", "2026_toy")  # nothing was heard of it yet
    view.newest_ns = 1000 * 10**9
    assert view.rows()[0] == ("run", f"2026_toy{told}")
    view.ended = True
    assert view.rows()[0] == ("run", "2026_toy, ended")


def test_the_last_six_events_are_shown() -> None:
    view = RunView("2026_toy")
    for number in range(8):
        view.note(f"event {number}")
    assert view.events == [f"event {number}" for number in range(2, 8)]


def test_labels_and_texts_stand_in_two_columns() -> None:
    console = plain()
    console.print(RunView("2026_toy").rendered())
    lines = [line.rstrip() for line in console.export_text().splitlines()]
    # Two blanks beside the longest label, "error so far", and no empty line between
    assert lines[:2] == ["run           2026_toy", "captures      0, 0 fitted"]


def test_a_log_is_looked_at_ten_times_a_second(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    Recorder(tmp_path / "run.mcap", {}, False).close()
    slept, now = list[float](), [0.0]

    def sleep(seconds: float) -> None:
        slept.append(seconds)
        now[0] += seconds

    clock = SimpleNamespace(sleep=sleep, monotonic=lambda: now[0], time=lambda: now[0])
    monkeypatch.setattr("flangeye.workflow.log.watch.time", clock)
    for name in ("run.mcap", "nowhere.mcap"):
        slept.clear()
        with pytest.raises(StageError):
            watch_run(tmp_path / name, None, plain(), patience=0.25)
        assert slept == [0.1, 0.1, 0.1]


def test_an_arm_under_way_is_shown_in_millimetres_with_its_mode(log: Any) -> None:
    path, _ = log
    pose = np.eye(4)
    pose[:3, 3] = [0.4, -0.12345, 1.0]
    state = RobotState(t.Transform(t.BASE, t.FLANGE, pose), np.zeros(6), np.zeros(6), 1, "moving")
    recorder = Recorder(path, {}, False)
    recorder.flangeye_noted("0.acquire.live", "arm", state)
    recorder.flangeye_run_finished({})
    rows = dict(watch_run(path, None, plain(), patience=5).rows())
    assert rows["arm"] == "400.0, -123.5, 1000.0 mm in the base, moving"
    assert rows["captures"] == "0, 0 fitted"


def test_the_next_pose_is_shown_with_what_it_promises(log: Any) -> None:
    path, _ = log
    recorder = Recorder(path, {}, False)
    recorder.flangeye_noted("0.acquire.live", "next", {"id": "0004", "why": "tells most"})
    recorder.flangeye_run_finished({})
    assert (
        dict(watch_run(path, None, plain(), patience=5).rows())["next pose"] == "0004: tells most"
    )


def test_foxglove_is_served_the_same_messages(log: Any) -> None:
    websockets = pytest.importorskip("websockets.sync.client")
    path, run = log
    run()
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    from flangeye.workflow.log.watch import foxglove_server

    with foxglove_server(port) as send:
        for message in follow(path, lambda: None):
            send(message)
        with websockets.connect(
            f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"]
        ) as viewer:
            told = [viewer.recv(timeout=10) for _ in range(2)]
    advertised = next(text for text in told if "advertise" in str(text))
    for topic in ("/capture/cloud", "/tf", "/step/2.fit.toy", "foxglove.PointCloud"):
        assert topic in str(advertised)


@pytest.mark.parametrize(
    ("origin", "lets_in"),
    [
        (None, True),
        ("https://app.foxglove.dev", True),
        ("file://", True),
        ("null", False),
        ("https://evil.example", False),
        ("https://app.foxglove.dev.evil.example", False),
        ("http://localhost:8080", False),
    ],
)
def test_no_other_page_than_foxgloves_own_may_look(origin: str | None, lets_in: bool) -> None:
    pytest.importorskip("foxglove")
    websockets = pytest.importorskip("websockets.sync.client")
    from websockets.exceptions import InvalidStatus

    from flangeye.workflow.log.watch import foxglove_server

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    refused = nullcontext() if lets_in else pytest.raises(InvalidStatus, match="403")
    with (
        foxglove_server(port),
        refused,
        websockets.connect(
            f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"], origin=origin
        ) as viewer,
    ):
        assert "serverInfo" in viewer.recv(timeout=10)


@pytest.mark.parametrize("before", ["", "Host: 127.0.0.1:1\r\n"])
@pytest.mark.parametrize("name", ["Origin", "origin", "ORIGIN "])
def test_an_origin_is_seen_wherever_it_stands(before: str, name: str) -> None:
    head = f"GET / HTTP/1.1\r\n{before}{name}: {{}}\r\n\r\n"
    assert may_connect(head.format("https://app.foxglove.dev").encode())
    assert not may_connect(head.format("http://evil.example").encode())


def test_what_a_program_sends_reaches_no_terminal(caplog: pytest.LogCaptureFixture) -> None:
    pytest.importorskip("foxglove")
    websockets = pytest.importorskip("websockets.sync.client")
    from websockets.exceptions import ConnectionClosed

    from flangeye.workflow.log.watch import foxglove_server

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address, protocol = f"ws://127.0.0.1:{port}", ["foxglove.sdk.v1"]
    with foxglove_server(port):
        for sent in ('{"op":"\\u001b]0;mine\\u0007"}', "x", b"\xff", "x" * 20_000_000):
            with websockets.connect(address, subprotocols=protocol) as viewer:
                assert "serverInfo" in viewer.recv(timeout=10)
                with suppress(OSError, ConnectionClosed):
                    viewer.send(sent)
                    while True:
                        viewer.recv(timeout=0.5)
    assert not caplog.records


def test_the_address_behind_the_gate_is_any_of_the_loopback_s(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[int] = []

    def drawn(below: int) -> int:
        asked.append(below)
        return 0x010203

    monkeypatch.setattr("secrets.randbelow", drawn)
    host, port = hidden_address()
    assert asked == [2**24] and port > 1023  # one that the system chose
    assert host in ("127.1.2.3", "127.0.0.1")  # the second where a system has no other


def test_where_a_system_has_one_loopback_address_the_port_is_free_all_the_same(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    real = socket.create_server

    def only(address: tuple[str, int]) -> socket.socket:
        if address[0] != "127.0.0.1":
            raise OSError
        return real(address)

    monkeypatch.setattr("secrets.randbelow", lambda below: 0x010203)
    monkeypatch.setattr(socket, "create_server", only)
    host, port = hidden_address()
    assert host == "127.0.0.1" and port > 1023


def test_a_port_that_is_taken_is_one_line(log: Any) -> None:
    pytest.importorskip("foxglove")
    path, run = log
    run()
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(StageError, match="cannot serve there"):
            watch_run(path, taken.getsockname()[1], plain(), patience=5)
