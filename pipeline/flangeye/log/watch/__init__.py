"""``flangeye watch``: a run as it goes, in the terminal and in Foxglove; all of it from its log."""

from __future__ import annotations

import asyncio
import ipaddress
import secrets
import socket
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import ExitStack, closing, contextmanager, nullcontext, suppress
from functools import partial
from pathlib import Path

from rich.console import Console

from flangeye.errors import StageError
from flangeye.log.watch.view import Channel, LogMessage, RunView, follow

Send = Callable[[LogMessage], None]

HERE = "127.0.0.1"


@contextmanager
def foxglove_server(port: int) -> Iterator[Send]:
    """Serve on a port of this machine alone; what is given is sent to whoever may watch.

    Raises:
        StageError: foxglove-sdk is not installed, or the port is taken.
    """
    try:
        import foxglove
    except ImportError:
        raise StageError("--foxglove needs foxglove-sdk: pip install 'flangeye[watch]'") from None
    channels: dict[str, foxglove.Channel] = {}
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
    """Hand on what may pass, from a port of this machine to a server, while the context lasts.

    Raises:
        OSError: The port is taken.
    """
    door = socket.create_server((HERE, port))
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
            # Whoever says nothing for so long [s] is no browser
            head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), 10.0)
            if may_look(head):
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


def may_look(head: bytes) -> bool:
    """Return whether a request is a program's, or that of Foxglove's page or desktop files."""
    lines = head.decode("latin-1").split("\r\n")[1:]
    told = [
        v.strip() for k, _, v in (line.partition(":") for line in lines) if k.lower() == "origin"
    ]
    return all(o in ("https://app.foxglove.dev", "file://") for o in told)


def hidden_address() -> tuple[str, int]:
    """Return an address of this machine and a port that are free, and that no page can try out."""
    host = str(ipaddress.IPv4Address("127.0.0.0") + secrets.randbelow(1 << 24))
    try:
        found = socket.create_server((host, 0))
    except OSError:  # not every system has more than one address of its own
        found = socket.create_server((HERE, 0))
    with found:
        address: tuple[str, int] = found.getsockname()
    return address


async def _joined(
    head: bytes, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, inside: tuple[str, int]
) -> None:
    further, back = await asyncio.open_connection(*inside)
    with closing(back):
        back.write(head)
        ways = (_handed(reader, back), _handed(further, writer))
        both = [asyncio.create_task(way) for way in ways]
        await asyncio.wait(both, return_when=asyncio.FIRST_COMPLETED)
        for task in both:
            task.cancel()


async def _handed(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with suppress(OSError):
        while data := await reader.read(1 << 16):
            writer.write(data)
            await writer.drain()


__all__ = ["watch_run"]


POLL = 0.1
"""Between two looks for something new [s]."""


def watch_run(run: Path | None, port: int | None, console: Console, patience: float) -> RunView:
    """Show a run until it ends.

    Args:
        run: Its folder or log, which may be still to come; of a folder with later checks of the
            calibration, the newest. The newest in ``runs/`` when not given.
        port: Serve Foxglove there, if given.
        console: Where to show it.
        patience: Give up when nothing new came for so long [s].

    Raises:
        StageError: There is no run, or nothing new came in time.
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
    """Return the log as soon as it is there."""
    since = time.monotonic()
    while (log := _log_of(run)) is None:
        if time.monotonic() - since > patience:
            where = "./runs" if run is None else run
            raise StageError(f"{where}: no run came to be watched within {patience:g} s")
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
