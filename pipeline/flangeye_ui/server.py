"""The server: one address, one token, five pages."""

from __future__ import annotations

import secrets
import socket
import webbrowser
from http.cookies import SimpleCookie
from pathlib import Path
from typing import Any
from urllib.parse import parse_qs

from nicegui import app, ui

from flangeye.errors import StageError
from flangeye.plugin.registry import Registry
from flangeye_ui import archive_page, cell_page, plan_page, run_page, verdict_page
from flangeye_ui.project import Project

COOKIE = "flangeye_token"
DENIED = b"wrong or missing token: open the address that 'flangeye ui' printed\n"


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
    token = secrets.token_urlsafe(16)
    project = Project(folder.resolve(), registry)
    for each in (cell_page, plan_page, run_page, verdict_page, archive_page):
        each.add(project)
    app.add_middleware(Token, token=token)
    app.on_shutdown(lambda: project.run.stop("the page's server ended") if project.run else None)
    address = f"http://{host}:{port}/?token={token}"
    print(f"open {address}", flush=True)  # noqa: T201  the person needs it
    if browser and not webbrowser.open(address):
        print("no browser was found here; open the address yourself", flush=True)  # noqa: T201
    ui.run(
        host=host, port=port, reload=False, show=False, show_welcome_message=False,
        title="flangeye", dark=None, reconnect_timeout=10.0,
    )  # fmt: skip


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


class Token:
    """Lets nobody in, to pages or sockets, who does not bring the token once; then a cookie."""

    def __init__(self, app: Any, token: str) -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: dict[str, Any], receive: Any, send: Any) -> None:
        """Answer a request, or hand it on."""
        if scope["type"] not in ("http", "websocket") or self._brought(scope, "cookie"):
            await self._app(scope, receive, send)
        elif scope["type"] == "http" and self._brought(scope, "query"):
            await self._let_in(scope, send)
        else:
            await _deny(scope, receive, send)

    def _brought(self, scope: dict[str, Any], where: str) -> bool:
        headers = {k.decode().lower(): v.decode("latin-1") for k, v in scope["headers"]}
        if where == "cookie":
            crumb = SimpleCookie(headers.get("cookie", "")).get(COOKIE)
            return crumb is not None and secrets.compare_digest(crumb.value, self._token)
        given = parse_qs(scope["query_string"].decode("latin-1")).get("token", [""])[0]
        return secrets.compare_digest(given.encode(), self._token.encode())

    async def _let_in(self, scope: dict[str, Any], send: Any) -> None:
        """Set the cookie and drop the token from the address."""
        cookie = f"{COOKIE}={self._token}; HttpOnly; SameSite=Strict; Path=/"
        headers = [(b"location", scope["path"].encode()), (b"set-cookie", cookie.encode())]
        await send({"type": "http.response.start", "status": 303, "headers": headers})
        await send({"type": "http.response.body", "body": b""})


async def _deny(scope: dict[str, Any], receive: Any, send: Any) -> None:
    if scope["type"] == "websocket":
        await receive()
        await send({"type": "websocket.close", "code": 1008})
        return
    headers = [(b"content-type", b"text/plain; charset=utf-8")]
    await send({"type": "http.response.start", "status": 403, "headers": headers})
    await send({"type": "http.response.body", "body": DENIED})
