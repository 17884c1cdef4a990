"""What happened in a run, while it goes and afterwards."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from flangeye.cli.app import LogFile, Overrides, app, load_plugins


@app.command()
def show(log: LogFile) -> None:
    """Say what happened in a run, step by step; also for a run that was killed."""
    from rich.console import Console

    from flangeye.runlog import read_run
    from flangeye.terminal import print_log

    print_log(Console(), read_run(log))


@app.command()
def report(
    log: LogFile,
    out: Annotated[Path | None, typer.Option(help="Default: report.html beside the log.")] = None,
) -> None:
    """Make the HTML report of a run from its log alone."""
    from flangeye.report import write_report
    from flangeye.runlog import read_run

    path = out or log.parent / "report.html"
    write_report(read_run(log), path)
    typer.echo(path)


@app.command("replay")
def replay_log(log: LogFile) -> None:
    """Make the decisions in a log again, from what was measured, and compare."""
    from flangeye.redo import redo

    same = True
    for step, redone in redo(log, load_plugins()):
        typer.echo(f"{step}: {redone.what}: {'the same' if redone.same else 'NOT the same'}")
        for name, value in redone.figures.items():
            typer.echo(f"  {name}: {value:.3g}")
        same = same and redone.same
    if not same:
        raise typer.Exit(1)


@app.command()
def watch(
    run: Annotated[
        Path | None,
        typer.Argument(metavar="[RUN]", help="A run's folder or log; the newest in ./runs."),
    ] = None,
    foxglove: Annotated[
        int | None,
        typer.Option(metavar="PORT", help="Serve Foxglove on this port too, 8765 by custom."),
    ] = None,
    patience: Annotated[
        float, typer.Option(metavar="SECONDS", help="Give up when nothing new came for so long.")
    ] = 60.0,
) -> None:
    """Watch a run as it goes: arm, captures, uncertainty so far."""
    from rich.console import Console

    from flangeye.watch import watch_run

    watch_run(run, foxglove, Console(), patience)


@app.command()
def doctor(
    archive: Annotated[Path, typer.Argument(help="A run.mcap, or recordings that a reader knows.")],
    recipe: Annotated[
        str | None,
        typer.Option(help="The recipe that would run on it: a file, or the name of a shipped one."),
    ] = None,
    overrides: Overrides = None,
    json_: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """Name what is wrong with recordings, with the evidence and the recipe's line to change.

    Exit codes: 0 nothing found, 1 something was, 2 the archive cannot be read.
    """
    import json

    from flangeye.doctor import as_json, as_text, examine, open_session
    from flangeye.recipe import find_recipe, load_recipe

    registry = load_plugins()
    checked = load_recipe(find_recipe(recipe), registry, overrides or ()) if recipe else None
    session = open_session(archive, registry, checked)
    checks = [part for part in registry.parts.values() if part.kind == "check"]
    diagnosis = examine(session, checks)
    typer.echo(json.dumps(as_json(diagnosis), indent=2) if json_ else as_text(diagnosis))
    if diagnosis.findings:
        raise typer.Exit(1)
