"""``flangeye watch``: a run as it goes, in the terminal and in Foxglove; all of it from its log."""

from __future__ import annotations

import time
from contextlib import nullcontext
from pathlib import Path

from rich.console import Console

from flangeye.errors import StageError
from flangeye.log.watch.server import foxglove_server
from flangeye.log.watch.view import RunView, follow

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
