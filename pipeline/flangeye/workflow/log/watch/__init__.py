"""``flangeye watch``: follow a run live by its log, in the terminal and in Foxglove."""

from __future__ import annotations

import asyncio
import io
import ipaddress
import logging
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from rich.console import Console, Group, RenderableType
from typing_extensions import Buffer

from flangeye.errors import StageError
from flangeye.files.regular import open_regular
from flangeye.files.words import printable
from flangeye.types import FLANGE
from flangeye.workflow.log.read import decode_json
from flangeye.workflow.log.records import Channel, LogFile, LogMessage, NotMcapError, reason_of


class WaitingFile(io.RawIOBase):
    """A file that is still written: reading at its end waits for more."""

    def __init__(self, file: BinaryIO, wait: Callable[[], None]) -> None:
        """Wrap a growing file; ``wait`` is called without new data, and may raise to give up."""
        self._file, self._wait = file, wait

    def readinto(self, buffer: Buffer) -> int:
        """Read the available bytes into the buffer, waiting for at least one."""
        while not (new := self._file.read(len(memoryview(buffer)))):
            self._wait()
        memoryview(buffer)[: len(new)] = new
        return len(new)

    def readable(self) -> bool:
        """Return True: the file can be read."""
        return True

    def close(self) -> None:
        """Close the file."""
        self._file.close()
        super().close()


def follow(
    path: Path, wait: Callable[[], None], note: Callable[[str], None] = lambda what: None
) -> Iterator[LogMessage]:
    """Yield the messages of a log from its beginning until the run ends.

    Args:
        path: The log.
        wait: Called while there is no new data; an exception from it ends the reading.
        note: Called with a sentence about each damaged part.

    Raises:
        StageError: The file cannot be read, or is not an MCAP file.
    """

    def damaged(what: str) -> None:
        note(f"damaged: {what}")

    with WaitingFile(open_regular(path), wait) as file:
        try:
            yield from LogFile(damaged).messages(io.BufferedReader(file))
        except NotMcapError:
            raise StageError(f"{path}: is not an MCAP file") from None


@dataclass
class RunView:
    """The state of a run.

    Attributes:
        name: The run's folder.
        total: Largest expected number of captures, if known.
        captures: Number of captures so far.
        fitted: Number of captures that became an observation.
        arm: Last position of the arm [m], with its time [s].
        progress: The solver's last estimate of its error.
        next: Next capture's id, and the reason for its pose.
        events: Latest lines of the log.
        newest_ns: Time of the last message [ns].
        ended: Whether the run has ended.
    """

    name: str
    total: int | None = None
    captures: int = 0
    fitted: int = 0
    arm: tuple[list[float], str] | None = None
    progress: dict[str, Any] | None = None
    next: tuple[str, str] | None = None
    events: list[str] = field(default_factory=list)
    newest_ns: int = 0
    ended: bool = False

    def take(self, message: LogMessage) -> None:
        """Take in one message."""
        self.newest_ns = message.time_ns
        before = vars(self).copy()
        try:
            self._take(message)
            self.rows()  # what cannot be shown is not taken in
        except Exception as error:  # what a foreign log holds can be wrong in any way
            vars(self).update(before)
            self.note(f"message {message.number} on {message.channel.topic}: {reason_of(error)}")

    def note(self, what: str) -> None:
        """Show a line of our own among the events."""
        self._say(what)

    def _take(self, message: LogMessage) -> None:
        topic, schema = message.channel.topic, message.channel.schema
        # Clouds and images are for Foxglove alone
        if message.channel.encoding != "json":
            return
        content = decode_json(message.data)
        if topic == "/source":
            self.total = content["total"]
            self._say(*content["notes"])
        elif topic == "/capture":
            self.captures += 1
            if flange := content["poses"].get(FLANGE):  # a cell's arms have names of their own
                self._place(flange, "at the last capture")
        elif topic == "/rejection":
            self._say(f"set aside {content['id']}: {content['stage']}: {content['reason']}")
        elif topic.startswith("/step/"):
            self._step(topic.removeprefix("/step/"), schema, content)
        elif topic.startswith("/note/"):
            self._note(topic.rpartition("/")[2], schema, content["value"])

    def _step(self, step: str, schema: str, content: dict[str, Any]) -> None:
        if content["capture"] is None:
            reason = f": {content['value']['reason']}" if schema.endswith("Verification") else ""
            self._say(f"{step} done{reason}")
        elif step.partition(".")[2].startswith("fit"):
            self.fitted += 1
            self._say(f"fitted {content['capture']}")

    def _note(self, name: str, schema: str, value: dict[str, Any]) -> None:
        if name == "next":
            self.next = value["id"], value["why"]
        elif schema == "flangeye.RobotState":
            self._place(value["base_T_flange"], value["mode"])
        elif schema == "flangeye.Progress":
            self.progress = value

    def _place(self, base_T_flange: dict[str, Any], when: str) -> None:
        self.arm = [row[3] for row in base_T_flange["matrix"][:3]], when

    def _say(self, *lines: str) -> None:
        # Latest events that are shown
        self.events = [*self.events, *map(str, lines)][-6:]

    def rendered(self) -> RenderableType:
        """Return the view for the terminal."""
        from rich.table import Table
        from rich.text import Text

        table = Table.grid(padding=(0, 2))
        for label, text in self.rows():
            table.add_row(Text(label, style="bold"), Text(printable(text)))
        return Group(table, *(Text(printable(f"  {line}"), style="dim") for line in self.events))

    def rows(self) -> list[tuple[str, str]]:
        """Return labels and texts."""
        of = f" of at most {self.total}" if self.total else ""
        return [
            ("run", f"{self.name}{', ended' if self.ended else self._silence()}"),
            ("captures", f"{self.captures}{of}, {self.fitted} fitted"),
            ("arm", self._arm()),
            ("error so far", self._error()),
            *([("next pose", ": ".join(filter(None, self.next)))] if self.next else []),
        ]

    def _arm(self) -> str:
        if self.arm is None:
            return "not known yet"
        place, when = self.arm
        return ", ".join(f"{1e3 * x:.1f}" for x in place) + f" mm in the base, {when}"

    def _error(self) -> str:
        if self.progress is None:
            return "not known yet"
        error, required = (self.progress[key] for key in ("error", "required"))
        if not np.isfinite(error or np.inf):
            return f"not observable yet after {self.progress['poses']} poses"
        return (
            f"95 % below {error * 1e3:.3f} mm after {self.progress['poses']} poses, "
            f"{required * 1e3:.3f} mm required"
        )

    def _silence(self) -> str:
        silent = time.time() - self.newest_ns * 1e-9
        return f", nothing new for {silent:.0f} s" if self.newest_ns and silent > 5 else ""


Send = Callable[[LogMessage], None]


@contextmanager
def foxglove_server(port: int) -> Iterator[Send]:
    """Serve messages to Foxglove on a local port; whatever is given is sent to all clients.

    Raises:
        StageError: foxglove-sdk is not installed, or the port is taken.
    """
    try:
        import foxglove
    except ImportError:
        raise StageError("--foxglove needs foxglove-sdk: pip install 'flangeye[watch]'") from None
    channels: dict[str, foxglove.Channel] = {}
    # It quotes whatever a client sent, escapes and all
    logging.getLogger("foxglove").setLevel(logging.CRITICAL)
    host, hidden = hidden_address()
    opened = ExitStack()
    try:
        opened.enter_context(gate(port, (host, hidden)))
        server = foxglove.start_server(name="flangeye", host=host, port=hidden)
    except (OSError, RuntimeError) as error:
        opened.close()
        raise StageError(f"--foxglove {port}: cannot serve there: {error}") from None

    def send(message: LogMessage) -> None:
        topic = message.channel.topic
        if topic not in channels:
            channels[topic] = _opened(message.channel)
        channels[topic].log(message.data, log_time=message.time_ns)

    try:
        yield send
    finally:
        for channel in channels.values():
            channel.close()
        opened.close()
        server.stop()


def _opened(channel: Channel) -> foxglove.Channel:  # type: ignore[name-defined]  # noqa: F821
    import foxglove

    schema = foxglove.Schema(
        name=channel.schema, encoding=channel.schema_encoding, data=channel.schema_data
    )
    return foxglove.Channel(channel.topic, schema=schema, message_encoding=channel.encoding)


@contextmanager
def gate(port: int, inside: tuple[str, int]) -> Iterator[None]:
    """Forward allowed connections from a local port to a server while the context lasts.

    Raises:
        OSError: The port is taken.
    """
    door = socket.create_server(("127.0.0.1", port))
    opened: Future[Callable[[], object]] = Future()
    serving = threading.Thread(target=lambda: asyncio.run(_serve(door, inside, opened)))
    serving.start()
    end = opened.result()
    try:
        yield
    finally:
        end()
        serving.join()


async def _serve(
    door: socket.socket, inside: tuple[str, int], opened: Future[Callable[[], object]]
) -> None:
    async def enter(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        with closing(writer), suppress(OSError, TimeoutError, EOFError, asyncio.LimitOverrunError):
            # Whoever says nothing for so long [s] is not a browser
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), 10.0)
            if may_connect(head):
                await _joined(head, reader, writer, inside)
            else:
                writer.write(
                    b"HTTP/1.1 403 Forbidden\r\nConnection: close\r\nContent-Length: 0\r\n\r\n"
                )

    ended = asyncio.Event()
    # Longest first request [bytes]: that of a browser has about 500
    server = await asyncio.start_server(enter, sock=door, limit=16_384)
    opened.set_result(partial(asyncio.get_running_loop().call_soon_threadsafe, ended.set))
    await ended.wait()
    server.close()


def may_connect(head: bytes) -> bool:
    """Return whether a request may connect: a web page may only if it is Foxglove's own."""
    lines = head.decode("latin-1").split("\r\n")[1:]
    told = [
        v.strip()
        for k, _, v in (line.partition(":") for line in lines)
        if k.strip().lower() == "origin"
    ]
    # A browser states the origin of every web socket; programs state none
    return all(o in ("https://app.foxglove.dev", "file://") for o in told)


def hidden_address() -> tuple[str, int]:
    """Return a random free loopback address and port, which a web page cannot guess."""
    host = str(ipaddress.IPv4Address("127.0.0.0") + secrets.randbelow(1 << 24))
    try:
        found = socket.create_server((host, 0))
    except OSError:  # not every system has more than one address of its own
        found = socket.create_server(("127.0.0.1", 0))
    with found:
        address: tuple[str, int] = found.getsockname()
    return address


async def _joined(
    head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, inside: tuple[str, int]
) -> None:
    further, back = await asyncio.open_connection(*inside)
    with closing(back):
        # The request was read for its origin; the server has to get it as well
        back.write(head)
        ways = (_handed(reader, back), _handed(further, writer))
        both = [asyncio.create_task(way) for way in ways]
        await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        for task in both:
            task.cancel()


async def _handed(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(65_536):
            writer.write(data)
            await writer.drain()


POLL = 0.1
"""Interval between two reads of the log [s]."""


def watch_run(run: Path | None, port: int | None, console: Console, patience: float) -> RunView:
    """Show a run until it ends.

    Args:
        run: Folder or log of the run, which need not exist yet; in a folder with later checks the
            newest one. By default the newest run in ``runs/``.
        port: Port for serving Foxglove; None does not serve.
        console: Console for the output.
        patience: Time without new data after which to give up [s].

    Raises:
        StageError: There is no run, or no new data arrived in time.
    """
    from rich.live import Live

    log = _log_to_come(run, patience)
    view = RunView(log.parent.name)
    serving = foxglove_server(port) if port else nullcontext(lambda message: None)
    with serving as send, Live(console=console, refresh_per_second=8) as live:
        quiet_since = time.monotonic()

        def wait() -> None:
            live.update(view.rendered())
            if time.monotonic() - quiet_since > patience:
                raise StageError(f"{log}: nothing new for {patience:.0f} s; the run is over")
            time.sleep(POLL)

        for message in follow(log, wait, view.note):
            quiet_since = time.monotonic()
            send(message)
            view.take(message)
            if message.channel.topic == "/ended":
                break
        view.ended = True
        live.update(view.rendered())
    return view


def _log_to_come(run: Path | None, patience: float) -> Path:
    """Return the path of the log once it exists."""
    since = time.monotonic()
    while (log := _log_of(run)) is None:
        if time.monotonic() - since > patience:
            where = "./runs" if run is None else run
            raise StageError(f"{where}: no run started within {patience:g} s")
        time.sleep(POLL)
    return log


def _log_of(run: Path | None) -> Path | None:
    if run is None:
        logs = [*Path("runs").glob("*/run.mcap")]
    elif run.suffix == ".mcap":
        logs = [run] if run.exists() else []
    else:
        logs = [*run.glob("run.mcap"), *run.glob("checks/*/run.mcap")]
    return max(logs, key=lambda path: path.stat().st_mtime, default=None)
