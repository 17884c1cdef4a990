"""Runs that bring their own controller: side by side, without the arm, and killed."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from flangeye_emulators.controllers.client import CONTROL_PORT, OWN

pytestmark = pytest.mark.realtime

RECIPE = "ur5e_phoxi-m_loopback"
FEW = ("--set", "acquire.live.poses={next_best: {count: 4}}")


def start(folder, *words):
    """Start a run of the shipped recipe, alone in a process group."""
    return subprocess.Popen(
        [sys.executable, "-m", "flangeye.cli", "run", RECIPE, *FEW, *words],
        cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        stdin=subprocess.DEVNULL, start_new_session=True,
    )  # fmt: skip


def host_of(run):
    return str(OWN[run.pid % OWN.num_addresses])


def listens(host):
    with socket.socket() as line:
        line.settimeout(1.0)
        return line.connect_ex((host, CONTROL_PORT)) == 0


def until(condition, patience):
    end = time.monotonic() + patience
    while not condition():
        assert time.monotonic() < end, "it did not happen"
        time.sleep(0.05)


@pytest.fixture
def live() -> None:
    pytest.importorskip("rtde_control", reason="needs ur-rtde")


def test_two_runs_side_by_side_have_a_controller_each(live: None, tmp_path: Path) -> None:
    runs = [start(tmp_path) for _ in range(2)]
    told = [run.communicate(timeout=120) for run in runs]
    for run, (out, err) in zip(runs, told, strict=True):
        assert (run.returncode, err) == (0, "")
        assert f"ur5e at {host_of(run)} (emulated) was read: no program was started" in out
        assert not listens(host_of(run))


def test_a_killed_run_leaves_no_controller(live: None, tmp_path: Path) -> None:
    run = start(tmp_path, "--move", "--out", "run")
    until(lambda: listens(host_of(run)), patience=60)
    os.killpg(run.pid, signal.SIGKILL)
    run.communicate()
    until(lambda: not listens(host_of(run)), patience=5)


def test_offline_asks_no_arm(tmp_path: Path) -> None:
    home = "[180 deg, -90 deg, 90 deg, -90 deg, -90 deg, 0 deg]"
    nowhere = "robot.driver={ur_rtde: {host: 127.0.0.254}}"
    run = start(tmp_path, "--offline", "--set", nowhere, "--set", f"acquire.live.home={home}")
    out, err = run.communicate(timeout=60)
    assert (run.returncode, err) == (0, "")
    assert out.splitlines()[-2:] == [
        "offline: the plan begins at acquire.live's home",
        "dry run, nothing moved; add --move to execute",
    ]
    assert "not known" not in out


def test_an_arm_that_does_not_answer_is_named_and_the_plan_shown(
    live: None, tmp_path: Path
) -> None:
    run = start(tmp_path, "--set", "robot.driver={ur_rtde: {host: 127.0.0.254}}")
    out, _ = run.communicate(timeout=60)
    assert run.returncode == 0
    assert (
        "the arm was not read, so the path to the first stop is not known: ur5e at 127.0.0.254: its "
        "dashboard server does not answer"
    ) in out


def test_a_home_of_another_arm_and_an_offline_move_are_refused(tmp_path: Path) -> None:
    for words, line in [
        (
            ("--offline", "--set", "acquire.live.home=[0 deg, 0 deg]"),
            "error: acquire.live: home has 2 angles, a ur5e has 6 joints",
        ),
        (
            ("--offline", "--move"),
            "error: --move and --offline: leave out one; --offline connects to no arm",
        ),
        (("--json", "--move"), "error: --move and --json: only the plan is printed as JSON"),
    ]:
        run = start(tmp_path, *words)
        _, err = run.communicate(timeout=60)
        assert (run.returncode, err.strip()) == (2, line)
