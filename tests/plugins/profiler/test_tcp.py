"""Measured values as lines of text, from a socket."""

import socket
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from flangeye.devices import DeviceError
from flangeye.testing import ProfilerConformance
from flangeye_plugins.profiler import TcpParams, TcpProfiler, profiler_tcp

LOCAL = "127.0.0.1"


class Sender:
    """The other end.

    Attributes:
        port: Where it listens.
    """

    def __init__(self, steadily: bytes = b"") -> None:
        self._listening = socket.create_server((LOCAL, 0))
        self._listening.settimeout(0.05)
        self.port = self._listening.getsockname()[1]
        self._steadily = steadily
        self._connected: list[socket.socket] = []
        self._ready, self._ended = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while not self._ended.is_set():
            try:
                connection, _ = self._listening.accept()
            except TimeoutError:
                continue
            self._connected.append(connection)
            self._ready.set()
            if self._steadily:
                threading.Thread(target=self._repeat, args=(connection,), daemon=True).start()

    def _repeat(self, connection: socket.socket) -> None:
        try:
            while not self._ended.wait(0.01):
                connection.sendall(self._steadily)
        except OSError:
            return

    def send(self, data: bytes) -> None:
        assert self._ready.wait(5.0)
        self._connected[-1].sendall(data)

    def hang_up(self) -> None:
        assert self._ready.wait(5.0)
        self._connected[-1].close()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()
        self._listening.close()
        for connection in self._connected:
            connection.close()


@pytest.fixture
def sender() -> Iterator[Sender]:
    made = Sender()
    yield made
    made.close()


def params(port: int, **given: Any) -> TcpParams:
    return TcpParams.model_validate({"host": LOCAL, "port": port, "behind": "25 mm", **given})


def next_look(profiler: TcpProfiler) -> Any:
    until = time.monotonic() + 5.0
    while time.monotonic() < until:
        if (look := profiler.profile()) is not None:
            return look
        time.sleep(1e-3)
    raise AssertionError("there was no look")


@pytest.mark.parametrize(
    ("given", "line", "offset"),
    [
        ({}, b"0.125\n", 0.125e-3),
        ({"positive": "right"}, b"0.125\r\n", -0.125e-3),
        ({"unit": "um", "column": 3, "separator": ";"}, b"7; 1 ; -40 ;9\n", -40e-6),
        ({"unit": "m", "column": 2, "separator": " "}, b"OK 1.5e-4\n", 1.5e-4),
    ],
)
def test_a_column_in_its_unit_is_the_offset(
    sender: Sender, given: Any, line: bytes, offset: float
) -> None:
    before = time.monotonic_ns()
    told = {"sigma": "0.08 mm", "latency": "100 ms", **given}
    with TcpProfiler(params(sender.port, **told)) as profiler:
        sender.send(line)
        look = next_look(profiler)
        assert profiler.profile() is None
    assert look.offset == pytest.approx(offset)
    assert look.sigma == 0.08e-3
    assert before - 100_000_000 <= look.time_ns <= time.monotonic_ns() - 100_000_000
    assert profiler.behind == 0.025


def test_a_line_may_come_in_pieces_and_one_without_a_number_is_no_look(sender: Sender) -> None:
    with TcpProfiler(params(sender.port, column=2)) as profiler:
        for piece in (b"1,--\n2\n3,nan\n4,in", b"f\n5,0.", b"2", b"5\n"):
            sender.send(piece)
            time.sleep(0.02)
        assert next_look(profiler).offset == pytest.approx(0.25e-3)


def test_of_several_lines_the_newest_is_given(sender: Sender) -> None:
    with TcpProfiler(params(sender.port)) as profiler:
        sender.send(b"0.1\n0.2\n0.3\n")
        assert next_look(profiler).offset == pytest.approx(0.3e-3)
        assert profiler.profile() is None


def lost(profiler: TcpProfiler) -> str:
    until = time.monotonic() + 5.0
    while time.monotonic() < until:
        try:
            profiler.profile()
        except DeviceError as error:
            return str(error)
        time.sleep(1e-3)
    raise AssertionError("it is not lost")


def test_a_sensor_that_hangs_up_is_lost(sender: Sender) -> None:
    with TcpProfiler(params(sender.port)) as profiler:
        sender.hang_up()
        assert (
            lost(profiler) == f"profile sensor at {LOCAL}:{sender.port}: has ended the connection"
        )


def test_what_has_no_lines_is_not_read_for_ever(sender: Sender) -> None:
    with TcpProfiler(params(sender.port)) as profiler:
        sender.send(b"0" * (2 * 4096 + 1))
        assert "sends no lines" in lost(profiler)


def test_nobody_there_is_told(sender: Sender) -> None:
    sender.close()  # its port is nobody's now
    with pytest.raises(DeviceError, match=r"cannot be reached .* is it on"):
        TcpProfiler(params(sender.port))


class TestConformance(ProfilerConformance):
    """Against a sender that goes on and on."""

    stage = profiler_tcp
    unreachable = TcpParams.model_validate({"host": LOCAL, "port": 1, "behind": "25 mm"})

    def open(self) -> Any:
        return profiler_tcp.function(None, None, 0, params(self.sender.port))

    @pytest.fixture(autouse=True)
    def _sender(self) -> Iterator[None]:
        self.sender = Sender(b"0.1\n")
        yield
        self.sender.close()
