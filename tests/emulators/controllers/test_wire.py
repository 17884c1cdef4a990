"""A controller in a process of its own, spoken to byte by byte; no client library is needed."""

import contextlib
import os
import signal
import socket
import struct
import sys
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from flangeye.cli import main
from flangeye.errors import StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.graph import EmulatorOptions
from flangeye.models.loading import load_model
from flangeye_emulators.controllers import server
from flangeye_emulators.controllers.arm import SpringSurface
from flangeye_emulators.controllers.client import EmulatorControl
from flangeye_emulators.controllers.network import Network
from flangeye_emulators.controllers.ur.server import serve
from tests.emulators.controllers.desk import HOME, away
from tests.emulators.controllers.process import Process, free_address

pytestmark = pytest.mark.realtime


@pytest.fixture(scope="module")
def process() -> Iterator[Any]:
    with Process() as running:
        yield running


class Rtde:
    """A client of RTDE."""

    def __init__(self, host):
        self.socket = socket.create_connection((host, 30004), timeout=2.0)

    def send(self, kind, body=b""):
        self.socket.sendall(struct.pack(">HB", 3 + len(body), ord(kind)) + body)

    def _read(self, count):
        data = b""
        while len(data) < count:
            more = self.socket.recv(count - len(data))
            if not more:
                raise ConnectionResetError
            data += more
        return data

    def receive(self):
        size, kind = struct.unpack(">HB", self._read(3))
        return chr(kind), self._read(size - 3)

    def ask(self, kind, body=b""):
        self.send(kind, body)
        said, answer = self.receive()
        assert said == kind
        return answer

    def outputs(self, names, frequency=500.0):
        return self.ask("O", struct.pack(">d", frequency) + names.encode())

    def packages(self, count):
        return [self.receive()[1] for _ in range(count)]


@pytest.fixture
def rtde(process: Any) -> Iterator[Any]:
    with contextlib.closing(Rtde(process.host).socket) as connection:
        client = Rtde.__new__(Rtde)
        client.socket = connection
        yield client


def test_the_version_is_negotiated(rtde: Any) -> None:
    assert rtde.ask("V", struct.pack(">H", 2)) == b"\1"
    assert rtde.ask("V", struct.pack(">H", 1)) == b"\0"
    assert struct.unpack(">4I", rtde.ask("v")) == (5, 21, 3, 1)


def test_types_of_variables_are_told_and_unknown_ones_refused(rtde: Any) -> None:
    assert rtde.outputs("timestamp,actual_q,robot_mode,") == b"\1DOUBLE,VECTOR6D,INT32"
    assert rtde.outputs("timestamp,wishes") == b"\0DOUBLE,NOT_FOUND"
    assert rtde.ask("S") == b"\0"
    assert rtde.ask("I", b"input_int_register_40,wishes") == b"\0INT32,NOT_FOUND"


def test_an_input_has_one_writer(process: Any, rtde: Any) -> None:
    assert rtde.ask("I", b"input_int_register_41,input_double_register_41") == b"\1INT32,DOUBLE"
    assert rtde.ask("I", b"input_int_register_41") == b"\2INT32"
    other = Rtde(process.host)
    assert other.ask("I", b"input_int_register_41,input_int_register_42") == b"\0IN_USE,INT32"
    rtde.socket.close()
    time.sleep(0.05)
    assert other.ask("I", b"input_int_register_41") == b"\1INT32"
    other.socket.close()


@pytest.mark.parametrize("rate", [500, 125, 10])
def test_packages_come_at_the_rate_that_was_asked(rtde: Any, rate: int) -> None:
    assert rtde.outputs("timestamp", rate)[:1] == b"\1"
    assert rtde.ask("S") == b"\1"
    times = [struct.unpack(">Bd", body)[1] for body in rtde.packages(6)]
    assert np.diff(times) == pytest.approx(1 / rate)
    rtde.send("P")
    for _ in range(20):
        if rtde.receive() == ("P", b"\1"):
            break
    else:
        pytest.fail("the pause was not answered")
    rtde.socket.settimeout(0.2)
    with pytest.raises(TimeoutError):
        rtde.receive()


def test_what_is_sent_is_where_the_arm_is(process: Any, rtde: Any) -> None:
    process.control.put(HOME)
    rtde.outputs("actual_q,actual_TCP_pose,runtime_state,safety_status_bits")
    rtde.ask("S")
    number, *values = struct.unpack(">B12dII", rtde.packages(1)[0])
    assert number == 1
    assert values[:6] == pytest.approx(HOME)
    flange = Arm(load_model("robots", "ur5e")).flange(HOME)
    assert values[6:9] == pytest.approx(flange[:3, 3])
    assert values[12:] == [1, 1]


def test_packages_may_come_in_pieces_and_nonsense_ends_the_connection(rtde: Any) -> None:
    for byte in struct.pack(">HB", 3, ord("v")):
        rtde.socket.sendall(bytes([byte]))
        time.sleep(0.005)
    assert rtde.receive()[0] == "v"
    rtde.send("?", b"unknown letters are not answered")
    rtde.send("U", b"")
    rtde.send("U", b"\7")
    assert rtde.ask("V", struct.pack(">H", 2)) == b"\1"
    rtde.socket.sendall(b"\0\0\0")
    with pytest.raises(OSError):
        rtde.receive()


def test_a_client_that_does_not_read_does_not_hold_the_clock(process: Any, rtde: Any) -> None:
    rtde.outputs(",".join(["actual_q"] * 30))
    rtde.ask("S")
    before = process.control.figures()["ticks"]
    time.sleep(1.0)
    assert process.control.figures()["ticks"] - before > 400


def test_the_dashboard_speaks_in_lines(process: Any) -> None:
    with socket.create_connection((process.host, 29999), timeout=2.0) as connection:
        lines = connection.makefile("rw", newline="\n")
        assert lines.readline() == "Connected: Universal Robots Dashboard Server\n"
        lines.write("running\nquit\n")
        lines.flush()
        assert lines.readline() == "Program running: false\n"
        assert lines.readline() == "Disconnected\n"
        assert lines.readline() == ""


def test_the_control_channel_tells_the_truth(process: Any) -> None:
    process.control.put(HOME)
    truth = process.control.truth()
    assert np.allclose(truth.base_T_flange, Arm(load_model("robots", "ur5e")).flange(HOME))
    assert truth.joints == pytest.approx(HOME)
    assert truth.speed == 0.0
    state = process.control.state()
    assert (state["robot_mode"], state["safety"], state["runtime"]) == (
        "RUNNING",
        "NORMAL",
        "STOPPED",
    )
    figures = process.control.figures()
    assert figures["ticks"] > 0
    assert figures["cpu"] > 0


def test_the_control_channel_refuses_with_a_reason(process: Any) -> None:
    for action, arguments, message in (
        ("sing", {}, "loopback: cannot do 'sing'; can do truth, state, log, figures, fault,"),
        ("fault", {"fault": "melt"}, "loopback: no fault 'melt'; there are protective-stop,"),
        ("fault", {}, "loopback: not a request: KeyError: 'fault'"),
        ("put", {"joints": [1, 2]}, "loopback: the arm has 6 joints; give 6 finite angles"),
        ("surfaces", {"surfaces": [{"point": [0, 0, 0]}]}, "loopback: not a request: TypeError"),
    ):
        with pytest.raises(StageError) as error:
            process.control.ask(action, **arguments)
        assert str(error.value).startswith(message)


def test_surfaces_can_be_changed(process: Any) -> None:
    process.control.put(HOME)
    height = process.control.truth().base_T_flange[2, 3]
    process.control.set_surfaces(
        SpringSurface(np.array([0, 0, height + 1e-3]), np.array([0, 0, 1]), 10e3)
    )
    time.sleep(0.02)
    assert process.control.state()["force"][2] == pytest.approx(10.0)
    process.control.set_surfaces()
    time.sleep(0.02)
    assert process.control.state()["force"][2] == 0.0


def test_faults_on_the_command_line_happen_in_their_time() -> None:
    with Process("--fault", "protective-stop@300 ms", "--fault", "remote-control-off") as own:
        states = [own.control.state()]
        while states[-1]["safety"] == "NORMAL" and states[-1]["time"] < 10.0:
            states.append(own.control.state())
        assert states[-1]["safety"] == "PROTECTIVE_STOP"
        assert states[-1]["time"] >= 0.3
        assert not states[-1]["remote_control"]
        assert own.control.log()[-1].endswith(" protective stop: on command")
        own.control.reset()
        assert own.control.state()["safety"] == "NORMAL"
        assert own.control.state()["remote_control"]


def test_nobody_there_is_said() -> None:
    host = free_address()
    with pytest.raises(StageError) as error:
        EmulatorControl(host)
    assert str(error.value) == (
        f"no controller on loopback at {host}:29998 (Connection refused); "
        f"start one: flangeye emulator ur5e --host {host}"
    )


def test_the_end_is_orderly() -> None:
    with Process("--floor", "200 mm", "--joints", "10 -90 90 -90 -90 0 deg", "--seed", "3") as own:
        assert own.greeting == (
            f"ur5e on {own.host}: RTDE 30004, script 30003, dashboard 29999, control 29998; "
            "Ctrl-C ends it\n"
        )
        truth = own.control.truth()
        assert truth.joints == pytest.approx(away(HOME, np.radians(10), 0, 0, 0, 0, 0), abs=1e-3)
        assert truth.joints[1] != HOME[1]
        words = own.end(signal.SIGINT)
        assert own.process.returncode == 0
        assert " cycles, late by " in words


@pytest.mark.parametrize(
    ("host", "where"),
    [
        ("127.0.0.9", "control 29998;"),
        (
            "0.0.0.0",
            "control 29998 on 127.0.0.1 alone (from elsewhere: ssh -L 29998:127.0.0.1:29998 HOST);",
        ),
    ],
)
def test_the_control_channel_stays_on_this_machine(
    host: str, where: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    opened = []

    async def listen(network: Network) -> None:
        opened.append(network.host)
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(Network, "listen", listen)
    monkeypatch.setattr(server, "_take_realtime_priority", lambda: None)
    serve(EmulatorOptions(robot=load_model("robots", "ur5e"), host=host))
    assert opened == [host, "127.0.0.1" if host == "0.0.0.0" else host]
    assert where in capsys.readouterr().out


@pytest.fixture
def loopback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., Any]:
    """Run the command here, for what ends before anything listens."""

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["flangeye", "emulator", *arguments])
        with pytest.raises(SystemExit) as ended:
            main()
        return ended.value.code, capsys.readouterr().err

    return run


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            ["franka-panda"],
            "error: no controller on loopback for a franka-panda of Franka Emika; there is one "
            "for arms of: AUBO, Universal Robots\n",
        ),
        (
            ["ur5e", "--floor", "100"],
            "error: --floor: '100' has no unit: a length needs one (mm, m, um, for example "
            "'31.5 mm')\n",
        ),
        (
            ["ur5e", "--joints", "0 -90 90 deg"],
            "error: the arm has 6 joints; give 6 finite angles\n",
        ),
        (
            ["ur5e", "--joints", "0 x deg"],
            "error: --joints '0 x deg': 'x deg' is not an angle: write a number and a unit "
            "(deg, rad, mrad, for example '17 deg')\n",
        ),
        (
            ["ur5e", "--host", "203.0.113.1"],
            "error: 203.0.113.1:30004 cannot be opened (Cannot assign requested address); if another controller runs there, choose another --host, for example 127.0.0.6\n",
        ),
        (
            ["ur5e", "--fault", "melt"],
            "error: no fault 'melt'; there are protective-stop, singularity, joint-limit, "
            "emergency-stop, drop, die, freeze, garbage, latency, program-stop, "
            "remote-control-off, inputs-low\n",
        ),
    ],
)
def test_mistakes_on_the_command_line_are_one_line(
    loopback: Callable[..., Any], arguments: list[Any], message: str
) -> None:
    assert loopback(*arguments) == (2, message)


def test_a_taken_address_is_said(process: Any, loopback: Callable[..., Any]) -> None:
    assert loopback("ur5e", "--host", process.host) == (
        2,
        f"error: {process.host}:30004 cannot be opened (Address already in use); if another controller runs there, choose another --host, for example 127.0.0.6\n",
    )
