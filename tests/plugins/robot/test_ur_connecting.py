"""What robot.ur_rtde makes of a controller that refuses it, with stand-ins for dashboard and library.

The bounds stand here as numbers: a test that took them from the code would follow any change of it.
"""

import re
import socketserver
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import nullcontext
from types import SimpleNamespace
from typing import Any

import pytest

from flangeye.devices import DeviceError
from flangeye_plugins.robot.ur import worker
from flangeye_plugins.robot.ur.driver import facts_of, stop
from tests.emulators.controllers.process import free_address

READY = {
    "PolyscopeVersion": "URSoftware 5.12.6.1102099 (Oct 29 2022)",
    "safetymode": "Safetymode: NORMAL",
    "robotmode": "Robotmode: RUNNING",
    "is in remote control": "true",
}


class Dashboard(socketserver.StreamRequestHandler):
    """A dashboard server that says what it is told to, ``late`` [s]; of what it is not, nothing."""

    says: dict[str, str]
    asked: list[str]
    late = 0.0

    def handle(self) -> None:
        self.wfile.write(b"Connected: Universal Robots Dashboard Server\n")
        for line in self.rfile:
            time.sleep(self.late)
            question = line.decode().strip()
            self.asked.append(question)
            if question not in self.says:
                return
            self.wfile.write(self.says[question].encode() + b"\n")


@pytest.fixture
def dashboard(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    host = free_address()
    monkeypatch.setattr(Dashboard, "says", dict(READY), raising=False)
    monkeypatch.setattr(Dashboard, "asked", [], raising=False)
    monkeypatch.setattr(Dashboard, "late", 0.0)
    with socketserver.ThreadingTCPServer((host, 29999), Dashboard) as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.01}).start()
        yield SimpleNamespace(host=host, handler=Dashboard)
        server.shutdown()


@pytest.mark.parametrize(
    ("said", "why"),
    [
        ({}, ""),
        ({"safetymode": "Safetymode: REDUCED"}, ""),
        ({"is in remote control": "could not understand: 'is in remote control'"}, ""),
        ({"is in remote control": "false"}, "it is in local control: choose Remote Control"),
        ({"is in remote control": "False"}, "it is in local control: choose Remote Control"),
        ({"robotmode": "Robotmode: POWER_OFF"}, "the arm has no power or its brakes are on"),
        ({"robotmode": "Robotmode: IDLE"}, "the arm has no power or its brakes are on"),
        ({"safetymode": "Safetymode: PROTECTIVE_STOP"}, "protective stop: find the cause"),
        ({"safetymode": "Safetymode: FAULT", "robotmode": "Robotmode: POWER_OFF"}, "safety fault"),
    ],
)
def test_a_controller_is_driven_where_nothing_is_wrong_with_it(
    dashboard: Any, said: dict[str, str], why: str
) -> None:
    dashboard.handler.says.update(said)
    refused = pytest.raises(DeviceError, match=re.escape(f"ur5e: {why}"))
    with refused if why else nullcontext():
        facts_of("ur5e", dashboard.host)
    facts_of("ur5e", dashboard.host, to_drive=False)  # who only reads does not mind


@pytest.mark.parametrize(
    ("version", "period"),
    [("3.15.8", 0.008), ("4.9.0", 0.008), ("5.0.1", 0.002), ("10.7.0", 0.002), ("?", 0.002)],
)
def test_the_version_says_how_long_a_cycle_is(dashboard: Any, version: str, period: float) -> None:
    dashboard.handler.says["PolyscopeVersion"] = f"URSoftware {version} (Oct 29 2022)"
    facts = facts_of("ur5e", dashboard.host)
    assert (facts.period, facts.version) == (period, f"URSoftware {version} (Oct 29 2022)")


def test_a_controller_behind_a_slow_network_is_not_driven(dashboard: Any) -> None:
    dashboard.handler.late = 0.1
    slow = r"ur5e: the network takes 1\d\d ms to it and back, at most 80 ms are allowed"
    with pytest.raises(DeviceError, match=slow):
        facts_of("ur5e", dashboard.host)


def test_a_dashboard_that_hangs_up_is_one_line(dashboard: Any) -> None:
    del dashboard.handler.says["robotmode"]
    with pytest.raises(DeviceError) as error:
        facts_of("ur5e", dashboard.host)
    assert str(error.value) == (
        "ur5e: its dashboard server does not answer (the dashboard server has ended): is the "
        f"controller on, is {dashboard.host} its address, is this computer in its network?"
    )


def test_the_last_resort_stops_the_program_and_says_where_nothing_answers(dashboard: Any) -> None:
    dashboard.handler.says["stop"] = "Stopped"
    stop(dashboard.host)
    del dashboard.handler.says["stop"]
    with pytest.raises(OSError, match="the dashboard server has ended"):
        stop(dashboard.host)
    assert dashboard.handler.asked == ["stop", "stop"]


def test_a_dashboard_is_waited_for_half_a_second_and_in_the_background_a_whole_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    tried: list[Any] = []

    def create_connection(address: Any, timeout: float) -> Any:
        tried.append((address, timeout))
        raise TimeoutError

    monkeypatch.setattr(worker, "socket", SimpleNamespace(create_connection=create_connection))
    with pytest.raises(TimeoutError), worker.ask_dashboard("10.0.0.1"):
        pass
    with pytest.raises(DeviceError, match=r"does not answer \(nothing within 0.5 s\)"):
        facts_of("ur5e", "10.0.0.1")
    with pytest.raises(TimeoutError):
        stop("10.0.0.1")
    assert tried == [(("10.0.0.1", 29999), seconds) for seconds in (1.0, 0.5, 0.5)]


class Library:
    """A stand-in for rtde_control: it refuses a connection so often, and tells the time."""

    def __init__(self, refuses: int = 0, why: str = "", takes: bool = True) -> None:
        self.tried, self.now = 0, 100.0
        self._refuses, self._why, self._takes = refuses, why, takes

    def RTDEControlInterface(self, host: str) -> Any:  # noqa: N802
        self.tried += 1
        if self.tried <= self._refuses:
            raise RuntimeError(self._why)
        return SimpleNamespace(setWatchdog=lambda hz: self._takes and hz == 5.0)

    def monotonic(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


IN_USE = "One of the RTDE input registers are already in use! Currently you must disable"


@pytest.mark.parametrize(
    ("library", "tried", "why"),
    [
        (Library(), 1, ""),
        (Library(8, IN_USE), 9, ""),
        (Library(99, IN_USE), 12, "already in use"),
        (Library(1, "Timeout connecting to UR dashboard server"), 1, "Timeout connecting"),
        (Library(takes=False), 1, "the controller did not take the watchdog"),
        (Library(3, IN_USE, takes=False), 4, "the controller did not take the watchdog"),
    ],
)
def test_registers_that_the_last_client_still_has_are_waited_for_a_second(
    library: Library, tried: int, why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rtde_control", library)
    monkeypatch.setattr(worker, "time", library)
    with pytest.raises(Exception, match=why) if why else nullcontext():
        worker.connect("10.0.0.1")
    assert library.tried == pytest.approx(tried, abs=1 if tried == 12 else 0)
