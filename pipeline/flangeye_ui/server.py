"""The server: one address, a token for each browser, five pages."""

from __future__ import annotations

import contextlib
import socket
import tempfile
import threading
import webbrowser
from collections.abc import Iterator
from html import escape
from pathlib import Path

from nicegui import app, ui

from flangeye.errors import StageError
from flangeye.plugin.registry import Registry
from flangeye_ui import (
    archive_page,
    cell_page,
    foreign,
    poses_page,
    result_page,
    scan_page,
    shapes,
    use_page,
    watch_page,
)
from flangeye_ui.gate import Gate, Keys
from flangeye_ui.permission import MoveCodes
from flangeye_ui.project import Project

PAGES = (
    cell_page, poses_page, scan_page, result_page, use_page, watch_page, archive_page, shapes,
)  # fmt: skip
OPENS = "<!doctype html><meta http-equiv=refresh content='0;url={}'><title>flangeye</title>"
RECONNECT = 15.0
"""For how long a page may be away [s]. NiceGUI takes a page for dead that leaves a ping unanswered
for 0.4 of it: longer than ``scan_page.SILENCE``, which alone decides whether a page lives."""


def serve(folder: Path, registry: Registry, host: str, port: int, browser: bool) -> None:
    """Serve the pages until Ctrl-C.

    Args:
        folder: Where recipes and runs are.
        registry: The plugins.
        host: Address to listen on.
        port: Port to listen on.
        browser: Open one, where there is one.

    Raises:
        StageError: The port is taken, or the folder is not there.
    """
    if not folder.is_dir():
        raise StageError(f"{folder}: is not a folder")
    require_free(host, port)
    at = f"http://{f'[{host}]' if ':' in host else host}:{port}/?token="
    keys = Keys(lambda token: say(f"for another browser, once: {at}{token}"))
    project = Project(folder.resolve(), registry, MoveCodes(say))
    for each in PAGES:
        each.add(project)
    foreign.add(project.folder)
    app.add_middleware(Gate, keys=keys, host=host, port=port)
    app.on_shutdown(lambda: project.run.stop("the page's server ended") if project.run else None)
    say(f"open {at}{keys.token}")
    app.config.socket_io_js_transports = ["websocket"]
    with way_in(folder, at + keys.token) as file:
        if browser:
            app.on_startup(lambda: threading.Thread(target=show, args=(file,), daemon=True).start())
        ui.run(
            host=host, port=port, reload=False, show=False, show_welcome_message=False,
            title="flangeye", dark=None, reconnect_timeout=RECONNECT,
        )  # fmt: skip


def say(line: str) -> None:
    """Print a line that the person at the terminal needs at once."""
    print(line, flush=True)  # noqa: T201


@contextlib.contextmanager
def way_in(folder: Path, address: str) -> Iterator[Path]:
    """Keep a file that leads to an address which other users of the machine must not see.

    What a program is started with can be read by everybody, so a browser is started with a file
    that only its user can read, in the folder, where a confined browser may read it too.
    """
    with tempfile.NamedTemporaryFile("w", dir=folder, prefix="open_", suffix=".html") as file:
        file.write(OPENS.format(escape(address)))
        file.flush()
        yield Path(file.name).resolve()


def show(file: Path) -> None:
    """Open a file in a browser, where there is one."""
    if not webbrowser.open(file.as_uri()):
        say("no browser was found here; open the address yourself")


def require_free(host: str, port: int) -> None:
    """Refuse a port that another program listens on.

    Raises:
        StageError: It is taken, or the address is not one of this machine.
    """
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise StageError(
                f"{host}:{port} cannot be listened on ({error.strerror}); name another with --port"
            ) from None
