"""The server of the pages, with its access control.

A request is accepted by its Host, Origin, method, and a secret cookie. The terminal prints an
address with a one-time token, which is exchanged for a cookie with random name and path, so that no
program on another port of this machine receives or replaces it. The pages behind the access control
do not see cookies.
"""

import ipaddress
import logging
import os
import secrets
import socket
import tempfile
import threading
import webbrowser
from collections.abc import Callable, Iterator
from html import escape
from pathlib import Path
from typing import Any

from nicegui import app, ui
from starlette.datastructures import Headers, QueryParams
from starlette.responses import HTMLResponse, PlainTextResponse, Response

from flangeye.errors import FlangeyeError, StageError
from flangeye.files.words import printable
from flangeye.plugin.registry import Registry
from flangeye_ui import (
    archive_page,
    cell_page,
    poses_page,
    result_page,
    scan_page,
    scene,
    served_files,
    use_page,
    watch_page,
)
from flangeye_ui.project import MoveCodes, Project

DENIED = "wrong, used or missing token: open the address that 'flangeye ui' printed last"

HEADERS = {
    # Vue compiles its templates in the browser, which asks for the unsafe ones.
    "content-security-policy": "default-src 'self'; "
    "script-src 'self' 'unsafe-inline' 'unsafe-eval'; style-src 'self' 'unsafe-inline'; "
    "img-src 'self' data: blob:; frame-ancestors 'none'; base-uri 'none'; form-action 'none'; "
    "object-src 'none'",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-opener-policy": "same-origin",
    "cross-origin-resource-policy": "same-origin",
    "x-frame-options": "DENY",
}
"""Headers of every answer that sets none of its own."""


def serve(folder: Path, registry: Registry, host: str, port: int, browser: bool) -> None:
    """Serve the pages until Ctrl-C.

    Args:
        folder: Folder of recipes and runs.
        registry: The plugins.
        host: Address to listen on.
        port: Port to listen on.
        browser: Whether to open a browser.

    Raises:
        StageError: The port is in use, or the folder does not exist or is not writable.
    """
    if not folder.is_dir():
        raise StageError(f"{folder}: is not a folder")
    require_free(host, port)
    at = f"http://{f'[{host}]' if ':' in host else host}:{port}/?token="
    keys = Keys(lambda token: say(f"for one other browser: {at}{token}"))
    project = Project(folder.resolve(), registry, MoveCodes(say))
    for each in (
        cell_page, poses_page, scan_page, result_page, use_page, watch_page, archive_page, scene,
    ):  # fmt: skip
        each.add(project)
    served_files.add(project.folder)
    app.add_middleware(Gate, keys=keys, host=host, port=port)
    app.on_shutdown(lambda: project.run.stop("the page's server ended") if project.run else None)
    say(f"open {at}{keys.token}")
    app.config.socket_io_js_transports = ["websocket"]
    logging.getLogger("nicegui").addFilter(in_words)
    file = redirect_file(folder, at + keys.token)
    app.on_shutdown(lambda: file.unlink(missing_ok=True))  # also where the server is terminated
    if browser:
        app.on_startup(lambda: threading.Thread(target=show, args=(file,), daemon=True).start())
    # For how long a page may be away [s]. NiceGUI takes a page for dead that leaves a ping
    # unanswered for 0.4 of it: longer than ``scan_page.SILENCE``, which alone decides whether a
    # page lives.
    ui.run(
        host=host, port=port, reload=False, show=False, show_welcome_message=False,
        title="flangeye", dark=None, reconnect_timeout=15.0,
    )  # fmt: skip


def say(line: str) -> None:
    """Print a line to the terminal at once."""
    print(line, flush=True)  # noqa: T201


def in_words(record: logging.LogRecord) -> bool:
    """Return True, after reducing an expected error in a log record to one line."""
    if record.exc_info and isinstance(error := record.exc_info[1], FlangeyeError):
        record.msg, record.exc_info = printable(f"error: {error}"), None
    return True


def redirect_file(folder: Path, address: str) -> Path:
    """Write a file that redirects to an address which other users must not see.

    Command lines are readable by everybody, so the browser is started with a file that only its
    user can read. The file is in the folder, where a sandboxed browser can read it too.

    Raises:
        StageError: The folder cannot be written.
    """
    try:
        handle, name = tempfile.mkstemp(".html", "open_", folder)
        with os.fdopen(handle, "w") as file:
            file.write(forwarding(address))
    except OSError as error:
        raise StageError(f"{folder}: cannot be written: {error.strerror or error}") from None
    return Path(name).resolve()


def forwarding(address: str) -> str:
    """Return a page that opens an address."""
    to = f"0;url={escape(address)}"
    return f"<!doctype html><meta http-equiv=refresh content='{to}'><title>flangeye</title>"


def show(file: Path) -> None:
    """Open a file in the browser, if there is one."""
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


Scope = dict[str, Any]


class Keys:
    """The secrets of one server.

    Attributes:
        path: Random path prefix of the pages, such as ``/q3V…``.
        token: One-time token for the next browser.
    """

    def __init__(self, issued: Callable[[str], None]) -> None:
        """Create the first token; ``issued`` is called with each new token after one is used."""
        name = secrets.token_urlsafe(12)
        self.path, self._cookie, self._issued = f"/{name}", f"flangeye-{name}", issued
        self.token = secrets.token_urlsafe(16)
        self._sessions: list[bytes] = []

    def exchange(self, given: str) -> str | None:
        """Return the cookie for the valid token, which is used up; None for another token."""
        if not secrets.compare_digest(given.encode(), self.token.encode()):
            return None
        self.token = secrets.token_urlsafe(16)
        self._sessions.append(secrets.token_urlsafe(24).encode())
        self._issued(self.token)
        value = self._sessions[-1].decode()
        # HttpOnly: no script reads it; SameSite=Strict: no other page sends it
        return f"{self._cookie}={value}; HttpOnly; SameSite=Strict; Path={self.path}"

    def known(self, headers: Headers) -> bool:
        """Return whether one of the cookies belongs to a browser that has signed in."""
        given = list(cookies(headers, self._cookie))
        # Compared in constant time, so that answers leak no part of a session's secret
        return any(secrets.compare_digest(g, s) for g in given for s in self._sessions)


def cookies(headers: Headers, name: str) -> Iterator[bytes]:
    """Yield the values of all cookies of a name; malformed entries are skipped."""
    for key, line in headers.raw:
        for crumb in line.split(b";") if key.lower() == b"cookie" else ():
            found, _, value = crumb.strip().partition(b"=")
            if found == name.encode():
                yield value


class Gate:
    """The outermost layer of the server."""

    def __init__(self, app: Any, keys: Keys, host: str, port: int) -> None:
        self._app, self._keys, self._port = app, keys, port
        self._names = {host, f"[{host}]", "localhost", "127.0.0.1"}
        self._any = host in ("0.0.0.0", "::")  # asked for by --host

    async def __call__(self, scope: Scope, receive: Any, send: Any) -> None:
        """Answer a request, or hand it on."""
        if scope["type"] not in ("http", "websocket"):
            await self._app(scope, receive, send)
        elif (answer := self._answer(scope, Headers(scope=scope))) is None:
            try:
                await self._app(self._inside(scope), receive, _guarded(send))
            except RuntimeError as error:
                # What Starlette says of a page that was closed before its answer
                if str(error) != "No response returned.":
                    raise
        elif scope["type"] == "http":
            await answer(scope, receive, _guarded(send))
        else:
            await receive()
            await send({"type": "websocket.close", "code": 1008})

    def _answer(self, scope: Scope, headers: Headers) -> Response | None:
        """Return a refusal or the sign-in response; None to forward the request."""
        if not self.is_ours(headers.get("host", "")):
            return PlainTextResponse("this server has another name\n", 421)
        if not _same_origin(scope, headers):
            return PlainTextResponse("asked for by another page\n", 403)
        if scope["type"] == "http" and scope["method"] not in ("GET", "HEAD"):
            return PlainTextResponse("GET only\n", 405)
        token = QueryParams(scope["query_string"]).get("token")
        if scope["path"] == "/" and token:
            return self._enter(token)
        inside = scope["path"].startswith(f"{self._keys.path}/")
        if not inside or not self._keys.known(headers):
            return PlainTextResponse(f"{DENIED}\n", 403)
        if scope["type"] == "http" and scope["path"].startswith(f"{self._keys.path}/_nicegui_ws/"):
            return PlainTextResponse("web sockets only\n", 403)  # they alone always name an origin
        return None

    def _enter(self, token: str) -> Response:
        cookie = self._keys.exchange(token)
        if cookie is None:
            return PlainTextResponse(f"{DENIED}\n", 403)
        # The page navigates by itself: after a redirect a strict cookie would not be sent.
        page = forwarding(f"{self._keys.path}/")
        return HTMLResponse(page, headers={"set-cookie": cookie, "cache-control": "no-store"})

    def is_ours(self, host: str) -> bool:
        """Return whether a Host header names this server by address, against DNS rebinding."""
        name, _, port = host.rpartition(":")
        if port != str(self._port):
            return False
        return name in self._names or (self._any and _is_address(name.strip("[]")))

    def _inside(self, scope: Scope) -> Scope:
        """Return the request for the pages, without cookies and with the server's prefix."""
        # A client must not choose the prefix from which the pages build their links
        hidden = (b"cookie", b"x-forwarded-prefix")
        headers = [(k, v) for k, v in scope["headers"] if k.lower() not in hidden]
        return {**scope, "headers": headers, "root_path": self._keys.path}


def _is_address(name: str) -> bool:
    try:
        return bool(ipaddress.ip_address(name))
    except ValueError:
        return False


def _same_origin(scope: Scope, headers: Headers) -> bool:
    """Return whether a request comes from these pages, or from a user who opened the address.

    Browsers do not restrict web sockets to their origin, so these must state it. The first visit
    has another origin and is authenticated by its token.
    """
    origin, site = headers.get("origin"), headers.get("sec-fetch-site", "none")
    if scope["type"] == "websocket":
        return origin == f"http://{headers.get('host')}"
    visit = scope["path"] == "/" and headers.get("sec-fetch-dest", "document") == "document"
    ours = origin in (None, f"http://{headers.get('host')}")
    return ours and (site in ("same-origin", "none") or visit)


def _guarded(send: Any) -> Any:
    """Return a ``send`` that adds the security headers to each response."""

    async def guarded(message: dict[str, Any]) -> None:
        if message["type"] == "http.response.start":
            there = {key.lower() for key, _ in message["headers"]}
            more = [(k.encode(), v.encode()) for k, v in HEADERS.items() if k.encode() not in there]
            message = {**message, "headers": [*message["headers"], *more]}
        await send(message)

    return guarded
