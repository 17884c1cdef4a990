"""The local page."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Annotated

import typer

from flangeye.cli.app import app, load_plugins


@app.command("ui")
def local_page(
    folder: Annotated[Path, typer.Argument(help="Folder with recipes and runs.")] = Path(),
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(help="Port to listen on.")] = 8090,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Open the page in a browser.")
    ] = True,
) -> None:
    """Open the local web page: plan, run and judge."""
    from flangeye.errors import StageError

    try:
        pages = import_module("flangeye_ui")  # by name: the page is a layer above the engine
    except ModuleNotFoundError as error:
        raise StageError(f"the page needs {error.name}: pip install 'flangeye[ui]'") from None
    pages.serve(folder, load_plugins(), host, port, browser)
