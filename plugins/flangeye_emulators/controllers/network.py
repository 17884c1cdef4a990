"""Ports and connections of an emulated controller, with simulated network faults."""

from __future__ import annotations

import asyncio
import os
from collections import deque
from collections.abc import Callable
from typing import NamedTuple, Protocol

from flangeye.errors import StageError
from flangeye.units import parse_quantity


class DelayLine:
    """Delivers items in order, each after the delay that was set when it arrived."""

    def __init__(self, deliver: Callable[[bytes], None]) -> None:
        self._deliver = deliver
        self._items: deque[bytes] = deque()

    def push(self, item: bytes, seconds: float) -> None:
        """Add an item; with zero delay and an empty queue it is delivered at once."""
        if seconds <= 0.0 and not self._items:
            self._deliver(item)
            return
        self._items.append(item)
        asyncio.get_running_loop().call_later(seconds, self._pop)

    def _pop(self) -> None:
        self._deliver(self._items.popleft())


class Network:
    """The network of one controller: ports, connections, and simulated faults.

    Attributes:
        host: Address of all ports.
        latency: Delay in each direction [s].
        frozen: Whether no data passes although connections stay open.
        garbled: Whether random bytes replace each answer.
        connections: Open connections.
    """

    def __init__(self, host: str) -> None:
        self.host = host
        self.latency = 0.0
        self.frozen = self.garbled = False
        self.connections: set[Connection] = set()
        self._ports: dict[int, Callable[[], Connection]] = {}
        self._servers: list[asyncio.Server] = []

    def offer(self, port: int, factory: Callable[[], Connection]) -> None:
        """Register the handler of a port."""
        self._ports[port] = factory

    async def listen(self) -> None:
        """Open the ports.

        Raises:
            StageError: A port is in use, or the address is not this machine's.
        """
        loop = asyncio.get_running_loop()
        for port, factory in self._ports.items():
            try:
                self._servers.append(await loop.create_server(factory, self.host, port))
            except OSError as error:
                self.kill()
                raise StageError(
                    f"{self.host}:{port} cannot be opened ({_reason(error)}); if another "
                    f"controller runs there, choose another --host, for example 127.0.0.6"
                ) from None

    def kill(self) -> None:
        """Reset every connection and close the ports, as in a power failure."""
        for server in self._servers:
            server.close()
        self._servers.clear()
        self.drop()

    def drop(self) -> None:
        """Reset every connection; the ports stay open."""
        for connection in list(self.connections):
            connection.abort()

    def freeze(self, frozen: bool) -> None:
        """Block data in both directions, or release it."""
        self.frozen = frozen
        for connection in list(self.connections):
            connection.hold(frozen)


def _reason(error: OSError) -> str:
    # asyncio puts a sentence of its own into strerror.
    return os.strerror(error.errno) if error.errno else str(error)


class Connection(asyncio.Protocol):
    """One connection to one port."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._transport: asyncio.Transport | None = None
        self._outgoing = DelayLine(self._write)
        self._incoming = DelayLine(self.received)
        self._held: list[bytes] = []

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Register the connection."""
        if not isinstance(transport, asyncio.Transport):
            raise TypeError("only stream connections (TCP) are supported")
        self._transport = transport
        self._network.connections.add(self)
        self.hold(self._network.frozen)
        self.opened()

    def connection_lost(self, exc: Exception | None) -> None:
        """Unregister the connection."""
        self._transport = None
        self._network.connections.discard(self)
        self.closed()

    def data_received(self, data: bytes) -> None:
        """Receive a client's data after the simulated delay."""
        self._incoming.push(data, self._network.latency)

    def opened(self) -> None:
        """Handle a new connection; does nothing here."""

    def received(self, data: bytes) -> None:
        """Handle a client's data; does nothing here."""

    def closed(self) -> None:
        """Handle the end of the connection; does nothing here."""

    def send(self, data: bytes) -> None:
        """Send an answer; it waits while the network is frozen."""
        if self._network.frozen:
            self._held.append(data)
        else:
            self._outgoing.push(data, self._network.latency)

    def stream(self, data: bytes) -> None:
        """Send streaming data; it is dropped while the network is frozen."""
        # Bytes a client may leave unread before stream data is dropped
        clogged = self._transport is None or self._transport.get_write_buffer_size() > 256 * 1024
        if not (self._network.frozen or clogged):
            self._outgoing.push(data, self._network.latency)

    def hold(self, frozen: bool) -> None:
        """Stop or resume reading; on resuming, send the waiting data."""
        if self._transport is None:
            return
        if frozen:
            self._transport.pause_reading()
            return
        if not self._transport.is_reading():
            self._transport.resume_reading()
        held, self._held = self._held, []
        for data in held:
            self.send(data)

    def abort(self) -> None:
        """Reset the connection."""
        if self._transport is not None:
            self._transport.abort()

    def close(self) -> None:
        """Close the connection after all data is sent."""
        if self._transport is not None:
            self._transport.close()

    def _write(self, data: bytes) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(os.urandom(len(data)) if self._network.garbled else data)


class LineConnection(Connection):
    """A connection that exchanges lines of text."""

    def __init__(self, network: Network) -> None:
        super().__init__(network)
        self._buffer = b""

    def received(self, data: bytes) -> None:
        """Handle each complete line."""
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        for line in lines:
            self.line(line.decode("utf-8", "replace").strip())

    def line(self, text: str) -> None:
        """Handle one line."""

    def say(self, text: str) -> None:
        """Send one line."""
        self.send(text.encode() + b"\n")


class Stoppable(Protocol):
    """Interface: a controller that can stop by itself."""

    def protective_stop(self, why: str) -> None:
        """Make a protective stop; the message states ``why``."""

    def emergency_stop(self, why: str) -> None:
        """Make an emergency stop, which switches the power off; the message states ``why``."""


class FaultInjector:
    """Injects faults, and clears those that can be cleared.

    * ``protective-stop``, ``singularity``, ``joint-limit``: a protective stop with this reason.
    * ``emergency-stop``: the button is pressed, and the power goes off.
    * ``drop``: every connection is reset, once.
    * ``die``: connections are reset and no port answers, permanently or for a duration.
    * ``freeze``: connections stay open but no data passes, permanently or for a duration.
    * ``garbage``: random bytes replace the controller's reports, permanently.
    * ``latency``: every byte is delayed by a duration, in both directions.

    The arm continues its motion when the network fails, as a real one does.

    Attributes:
        kinds: The faults by name.
    """

    def __init__(self, box: Stoppable, network: Network) -> None:
        self._network = network
        self._dead = False
        self._revival: asyncio.Task[None] | None = None
        self.kinds = {
            "protective-stop": Kind(lambda _: box.protective_stop("on command")),
            "singularity": Kind(lambda _: box.protective_stop("near a singularity, on command")),
            "joint-limit": Kind(lambda _: box.protective_stop("a joint's limit, on command")),
            "emergency-stop": Kind(lambda _: box.emergency_stop("on command")),
            "drop": Kind(lambda _: network.drop()),
            "die": Kind(self._die, takes_seconds=True),
            "freeze": Kind(self._freeze, takes_seconds=True),
            "garbage": Kind(lambda _: self._garble(True)),
            "latency": Kind(self._slow_down, takes_seconds=True),
        }

    def clear(self) -> None:
        """Clear all network faults."""
        self._network.latency = 0.0
        self._garble(False)
        self._network.freeze(False)
        self._revive()

    def _die(self, seconds: float | None) -> None:
        self._network.kill()
        self._dead = True
        if seconds is not None:
            asyncio.get_running_loop().call_later(seconds, self._revive)

    def _revive(self) -> None:
        if self._dead:
            self._dead = False
            self._revival = asyncio.get_running_loop().create_task(self._network.listen())

    def _freeze(self, seconds: float | None) -> None:
        self._network.freeze(True)
        if seconds is not None:
            asyncio.get_running_loop().call_later(seconds, self._network.freeze, False)

    def _garble(self, garbled: bool) -> None:
        self._network.garbled = garbled

    def _slow_down(self, seconds: float | None) -> None:
        self._network.latency = 0.1 if seconds is None else seconds


class Fault(NamedTuple):
    """A fault to inject.

    Attributes:
        name: Kind of fault.
        seconds: Duration or delay [s]; None if not given.
        after: Time until the fault [s]; None for the arm's next motion.
    """

    name: str
    seconds: float | None
    after: float | None


class Kind(NamedTuple):
    """A kind of fault: its action, and whether it has a duration."""

    cause: Callable[[float | None], None]
    takes_seconds: bool = False


def parse_fault(text: str, kinds: dict[str, Kind]) -> Fault:
    """Return a fault parsed from ``NAME[=DURATION][@WHEN]``, such as ``freeze=3 s@moving``.

    Raises:
        StageError: The kind or a duration is invalid; the message lists the valid kinds.
    """
    what, _, when = text.partition("@")
    name, _, amount = what.partition("=")
    name = name.strip()
    if name not in kinds:
        raise StageError(f"no fault '{name}'; there are {', '.join(kinds)}")
    if amount and not kinds[name].takes_seconds:
        raise StageError(f"the fault '{name}' takes no duration")
    seconds = _seconds(amount, text) if amount else None
    after = None if when.strip() == "moving" else _seconds(when, text) if when else 0.0
    return Fault(name, seconds, after)


def _seconds(text: str, fault: str) -> float:
    try:
        return parse_quantity(text, "duration")
    except ValueError as error:
        raise StageError(f"fault '{fault}': {error}") from None


class Schedule:
    """Schedule of faults to inject."""

    def __init__(self, kinds: dict[str, Kind]) -> None:
        self._kinds = kinds
        self._waiting: list[tuple[Fault, float | None]] = []

    def add(self, fault: Fault, now: float) -> None:
        """Schedule a fault."""
        due = None if fault.after is None else now + fault.after
        self._waiting.append((fault, due))

    def clear(self) -> None:
        """Remove the faults that have not occurred yet."""
        self._waiting.clear()

    def step(self, now: float, moving: bool) -> None:
        """Inject the faults that are due."""
        if not self._waiting:
            return
        due = [(f, t) for f, t in self._waiting if (moving if t is None else now >= t)]
        self._waiting = [entry for entry in self._waiting if entry not in due]
        for fault, _ in due:
            self._kinds[fault.name].cause(fault.seconds)
