"""Serve files of runs and batches in a browser sandbox, as they may come from anywhere."""

from contextlib import suppress
from pathlib import Path
from urllib.parse import quote

from nicegui import app
from starlette.responses import FileResponse, PlainTextResponse, Response

POLICY = (
    "sandbox allow-scripts; default-src 'none'; script-src 'unsafe-inline'; "
    "style-src 'unsafe-inline'; img-src data: blob:; frame-ancestors 'none'; form-action 'none'; "
    "base-uri 'none'"
)
"""An origin of its own for each file: its drawings run and reach neither the page nor a network."""


def address_of(folder: Path, path: Path) -> str:
    """Return the URL at which a file of the folder is served."""
    return "/files/" + quote(path.relative_to(folder).as_posix())


def add(folder: Path) -> None:
    """Serve the files of runs and batches in a folder."""

    @app.get("/files/{path:path}")
    def file(path: str) -> Response:
        return answer(folder, path)


def answer(folder: Path, path: str) -> Response:
    """Return a file with its security policy; 404 if it belongs to no run or batch."""
    found = _found(folder, path)
    if found is None:
        return PlainTextResponse("no such file of a run\n", 404)
    # What a browser opens; anything else is saved
    kind = {
        ".html": "text/html; charset=utf-8", ".pdf": "application/pdf", ".png": "image/png",
        **dict.fromkeys((".json", ".csv", ".yaml", ".txt"), "text/plain; charset=utf-8"),
    }.get(found.suffix.lower())  # fmt: skip
    return FileResponse(
        found, media_type=kind or "application/octet-stream", filename=found.name,
        content_disposition_type="inline" if kind else "attachment",
        headers={"content-security-policy": POLICY, "cache-control": "no-store"},
    )  # fmt: skip


def _found(folder: Path, path: str) -> Path | None:
    """Return a file with links resolved, if it lies in a folder that may be served."""
    with suppress(OSError, ValueError, RuntimeError):  # of names that no system has
        found = (folder / path).resolve()
        inside = any(
            found.is_relative_to((folder / room).resolve()) for room in ("runs", "batches")
        )
        return found if inside and found.is_file() else None
    return None
