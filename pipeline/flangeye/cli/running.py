"""Run recipes: one, or many at once."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flangeye.cli.app import Overrides, RecipeName, app, load_plugins
from flangeye.errors import FlangeyeError

if TYPE_CHECKING:
    from flangeye.recipe import Recipe
    from flangeye.registry import Registry
    from flangeye.replay import Earlier, Replay
    from flangeye.result import Result
    from flangeye.runfolder import RunFolder
    from flangeye.session import Start


@app.command()
def run(  # noqa: PLR0913  one for each option
    recipe: Annotated[
        str | None,
        typer.Argument(help="A recipe file, or the name of a shipped recipe."),
    ] = None,
    archive: Annotated[
        Path | None,
        typer.Option(help="Recordings to run on, for recipes that start with acquire.archive."),
    ] = None,
    overrides: Overrides = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the run's files; default runs/<time>_<recipe>."),
    ] = None,
    source: Annotated[
        Path | None,
        typer.Option(
            "--from", metavar="RUN.MCAP", help="Take the steps before --at from this log."
        ),
    ] = None,
    at: Annotated[
        str | None,
        typer.Option(metavar="STEP", help="First step to do again, for example solve.svd."),
    ] = None,
    move: Annotated[
        bool,
        typer.Option("--move", help="Move the arm; without it the plan is checked and shown."),
    ] = False,
    resume: Annotated[
        Path | None,
        typer.Option(metavar="RUN", help="Go on with a run that ended early: its folder or log."),
    ] = None,
) -> None:
    """Run a recipe: a calibration, its log and its report."""
    from flangeye.devices import MotionAllowed
    from flangeye.runfolder import RunFolder
    from flangeye.session import Start
    from flangeye.types import ArchivePath

    registry = load_plugins()
    checked, earlier = _recipe_of(recipe, resume, registry, overrides or ())
    replay = _replay(checked, source, at)
    start = Start(ArchivePath(archive), replay, earlier, MotionAllowed(move))
    result = _record(checked, registry, RunFolder.create(checked.name, out), start)
    if result.status == "refused" or (result.weld and not result.weld.completed):
        raise typer.Exit(1)


def _recipe_of(
    name: str | None, resume: Path | None, registry: Registry, overrides: Sequence[str]
) -> tuple[Recipe, Earlier | None]:
    """Return the checked recipe, named or of the run to go on with; and that run."""
    from flangeye.errors import StageError
    from flangeye.recipe import find_recipe, load_recipe
    from flangeye.replay import earlier_run

    if (name is None) == (resume is None):
        raise StageError("name a recipe, or --resume RUN, which brings its own")
    if resume is not None:
        if overrides:
            raise StageError("--set and --resume: a run goes on with the recipe it began with")
        return earlier_run(resume, registry)
    return load_recipe(find_recipe(str(name)), registry, overrides), None


def _replay(recipe: Recipe, source: Path | None, at: str | None) -> Replay | None:
    from flangeye.errors import StageError
    from flangeye.replay import replay_from
    from flangeye.runlog import read_run

    if (source is None) != (at is None):
        raise StageError("--from and --at go together: --from run.mcap --at solve.svd")
    if source is None or at is None:
        return None
    return replay_from(read_run(source), recipe, at)


def _record(recipe: Recipe, registry: Registry, folder: RunFolder, start: Start) -> Result:
    """Run with a log and a progress bar, and say what came of it."""
    from rich.console import Console

    from flangeye.replay import resumable
    from flangeye.session import record_run
    from flangeye.terminal import ProgressBar, print_result

    try:
        with ProgressBar(Console(stderr=True)) as progress:
            registry.hooks.register(progress)
            result = record_run(recipe, registry, folder, start)
    except FlangeyeError:
        if folder.log.exists():
            sys.stderr.write(f"what was gathered is in {folder.log}\n")
            if resumable(recipe):
                sys.stderr.write(
                    f"go on with it: flangeye run --resume {folder.path}"
                    f"{' --move' if start.motion.allowed else ''}\n"
                )
        raise
    print_result(Console(), result)
    typer.echo(f"\n{folder.path}/: report.html  calibration.yaml  result.json  run.mcap")
    return result


@app.command()
def batch(  # noqa: PLR0913  one argument an option
    recipe: RecipeName,
    archives: Annotated[
        list[Path] | None,
        typer.Argument(help="Recordings, a session each; none for recipes that simulate."),
    ] = None,
    overrides: Overrides = None,
    grid: Annotated[
        list[str] | None,
        typer.Option(
            "--set-grid", metavar="PATH=A,B,C", help="Run with each value; may be repeated."
        ),
    ] = None,
    repeat: Annotated[int | None, typer.Option(min=1, help="Run with so many seeds.")] = None,
    vary: Annotated[str, typer.Option(help="What --repeat counts up.")] = "seed",
    workers: Annotated[
        int | None,
        typer.Option(min=1, help="Processes on this machine; default one for each core."),
    ] = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="tcp://HOST:PORT", help="A running dask scheduler to use instead."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for everything; default batches/<recipe>."),
    ] = None,
    report: Annotated[
        bool, typer.Option("--report/--no-report", help="Make each session's report.html.")
    ] = True,
) -> None:
    """Run a recipe over archives, values and seeds, and compare the sessions.

    Finished sessions are not run again. Exit codes: 0 every session gave a calibration, 1 one
    was refused, failed or crashed, 2 nothing could start.
    """
    from rich.console import Console

    from flangeye.batch import Request, run_batch, summary_text

    request = Request(
        recipe, tuple(archives or ()), tuple(overrides or ()), tuple(grid or ()), repeat, vary,
        workers, scheduler, out, report,
    )  # fmt: skip
    try:
        done = run_batch(request, load_plugins(), Console(stderr=True))
    except KeyboardInterrupt:
        sys.stderr.write("stopped; the same command goes on from here\n")
        raise typer.Exit(130) from None
    typer.echo(summary_text(done))
    if not done.accepted:
        raise typer.Exit(1)
