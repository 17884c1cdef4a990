"""Listening ports and connections, and everything that can go wrong with a wire between."""

from __future__ import annotations

import asyncio
import os
from collections import deque
from collections.abc import Callable

from flangeye.errors import StageError


class DelayLine:
    """Hands things on in order, each after the delay that held when it came."""

    def __init__(self, deliver: Callable[[bytes], None]) -> None:
        self._deliver = deliver
        self._items: deque[bytes] = deque()

    def push(self, item: bytes, seconds: float) -> None:
        """Take one thing; without a delay, and with nothing before it, it goes straight on."""
        if seconds <= 0.0 and not self._items:
            self._deliver(item)
            return
        self._items.append(item)
        asyncio.get_running_loop().call_later(seconds, self._pop)

    def _pop(self) -> None:
        self._deliver(self._items.popleft())


class Network:
    """The wire of one controller: its ports, its connections, and what is wrong with them.

    Attributes:
        host: Address of all ports.
        latency: Delay in each direction [s].
        frozen: Whether nothing gets through while connections stay open.
        garbled: Whether random bytes are sent in place of each answer.
        connections: Those that are open.
    """

    def __init__(self, host: str) -> None:
        self.host = host
        self.latency = 0.0
        self.frozen = self.garbled = False
        self.connections: set[Connection] = set()
        self._ports: dict[int, Callable[[], Connection]] = {}
        self._servers: list[asyncio.Server] = []

    def offer(self, port: int, factory: Callable[[], Connection]) -> None:
        """Say what will answer on a port."""
        self._ports[port] = factory

    async def listen(self) -> None:
        """Open the ports.

        Raises:
            StageError: One is taken, or the address is not this machine's.
        """
        loop = asyncio.get_running_loop()
        for port, factory in self._ports.items():
            try:
                self._servers.append(await loop.create_server(factory, self.host, port))
            except OSError as error:
                self.kill()
                raise StageError(
                    f"{self.host}:{port} cannot be opened ({_reason(error)}); where another "
                    "controller runs there, take another --host, for example 127.0.0.6"
                ) from None

    def kill(self) -> None:
        """Reset every connection and close the ports, as when the power fails."""
        for server in self._servers:
            server.close()
        self._servers.clear()
        self.drop()

    def drop(self) -> None:
        """Reset every connection; the ports stay open."""
        for connection in list(self.connections):
            connection.abort()

    def freeze(self, frozen: bool) -> None:
        """Block the connection in both directions, or open it again."""
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
        """Join the network."""
        if not isinstance(transport, asyncio.Transport):
            raise TypeError("a connection is a stream")
        self._transport = transport
        self._network.connections.add(self)
        self.hold(self._network.frozen)
        self.opened()

    def connection_lost(self, exc: Exception | None) -> None:
        """Leave the network."""
        self._transport = None
        self._network.connections.discard(self)
        self.closed()

    def data_received(self, data: bytes) -> None:
        """Take what a client sent, after the wire's delay."""
        self._incoming.push(data, self._network.latency)

    def opened(self) -> None:
        """Act on a new connection."""

    def received(self, data: bytes) -> None:
        """Act on what a client sent."""

    def closed(self) -> None:
        """Act on the end of the connection."""

    def send(self, data: bytes) -> None:
        """Send an answer; while the wire is frozen it waits."""
        if self._network.frozen:
            self._held.append(data)
        else:
            self._outgoing.push(data, self._network.latency)

    def stream(self, data: bytes) -> None:
        """Send what is out of date tomorrow; while the wire is frozen or clogged it is lost."""
        # Bytes a client may leave unread before stream data is dropped
        clogged = self._transport is None or self._transport.get_write_buffer_size() > 256 * 1024
        if not (self._network.frozen or clogged):
            self._outgoing.push(data, self._network.latency)

    def hold(self, frozen: bool) -> None:
        """Stop or go on reading; going on, send what had to wait."""
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
        """End the connection when everything is sent."""
        if self._transport is not None:
            self._transport.close()

    def _write(self, data: bytes) -> None:
        if self._transport is not None and not self._transport.is_closing():
            self._transport.write(os.urandom(len(data)) if self._network.garbled else data)


class LineConnection(Connection):
    """A connection of lines of text."""

    def __init__(self, network: Network) -> None:
        super().__init__(network)
        self._buffer = b""

    def received(self, data: bytes) -> None:
        """Act on each whole line."""
        *lines, self._buffer = (self._buffer + data).split(b"\n")
        for line in lines:
            self.line(line.decode("utf-8", "replace").strip())

    def line(self, text: str) -> None:
        """Act on one line."""

    def say(self, text: str) -> None:
        """Send one line."""
        self.send(text.encode() + b"\n")
