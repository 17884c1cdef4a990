"""Commands that read the log of a run: show, report, watch."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from flangeye.cli.app import Overrides, RunArgument, app, load_plugins, read_recipe
from flangeye.cli.console import as_damage, progress_bar, require_undamaged, say, say_notes
from flangeye.errors import FlangeyeError, RecipeError, StageError

if TYPE_CHECKING:
    from flangeye.workflow.log.read import RunLog
    from flangeye.workflow.recipe.load import Recipe


@app.command()
def show(
    log: RunArgument,
    outlook: Annotated[
        bool,
        typer.Option(
            "--outlook",
            help="Assess the poses so far instead: residuals, expected error, missing views. Also "
            "for a run that is under way or was killed.",
        ),
    ] = False,
    replay: Annotated[
        bool,
        typer.Option(
            "--replay", help="Repeat the decisions in the log from its measurements and compare."
        ),
    ] = False,
) -> None:
    """Show what happened in a run: steps, figures, notes.

    Exit codes with --replay: 0 the same decisions, 1 others.
    """
    if outlook and replay:
        raise FlangeyeError("--outlook and --replay: give one of them")
    if replay:
        _replay(log)
        return
    from flangeye.workflow.log.read import read_run

    read = read_run(log)
    if outlook:
        _print_outlook(read)
        return
    from rich.console import Console

    from flangeye.cli.details import print_log

    print_log(Console(), read)
    require_undamaged(read)


def _print_outlook(read: RunLog) -> None:
    from flangeye.workflow.run.outlook import outlook_of_log

    read.require_gathered()
    registry = load_plugins()
    with progress_bar("assessing the poses"), as_damage(read.path, "it cannot be judged"):
        found = outlook_of_log(read, registry)
    for line in found.lines():
        say(line)
    say_notes(read.notes)


def _replay(log: Path) -> None:
    from flangeye.workflow.run.replay import replay_steps

    same = True
    with progress_bar("repeating"), as_damage(log, "its decisions cannot be repeated"):
        redone_steps = list(replay_steps(log, load_plugins()))
    for step, redone in redone_steps:
        say(f"{step}: {redone.what}: {'the same' if redone.same else 'NOT the same'}")
        for name, value in redone.figures.items():
            say(f"  {name}: {value:.3g}")
        same = same and redone.same
    if not same:
        raise typer.Exit(1)


@app.command()
def report(
    log: RunArgument,
    out: Annotated[
        Path | None, typer.Option(help="File to write; default report.html beside the log.")
    ] = None,
) -> None:
    """Write the HTML report of a run from its log."""
    from flangeye.workflow.log.read import read_run
    from flangeye.workflow.report import write_report

    read = read_run(log)
    path = out or read.path.parent / "report.html"
    read.require_gathered()
    with progress_bar("report"), as_damage(read.path, "no report can be made of it"):
        write_report(read, path)
    say(path)
    require_undamaged(read)


@app.command()
def certificate(  # noqa: PLR0913  one argument an option
    run: RunArgument,
    out: Annotated[
        Path | None, typer.Option(help="File to write; default certificate.html beside the log.")
    ] = None,
    temperature: Annotated[
        float | None, typer.Option(metavar="DEGC", help="Air temperature in degrees Celsius.")
    ] = None,
    spread: Annotated[
        float | None,
        typer.Option(
            metavar="KELVIN", min=0.0, help="Temperature range in use, coldest to warmest."
        ),
    ] = None,
    place: Annotated[str, typer.Option(help="Place of the calibration.")] = "",
    operator: Annotated[str, typer.Option(help="Name of the operator.")] = "",
    camera: Annotated[
        str | None, typer.Option(help="Camera to certify, for a cell with several.")
    ] = None,
    pdf: Annotated[
        bool, typer.Option("--pdf/--no-pdf", help="Also print it to PDF with Chromium.")
    ] = True,
) -> None:
    """Write a certificate after the GUM, to print and sign."""
    from flangeye.workflow.report.certificate import print_pdf, write_certificate
    from flangeye.workflow.report.certificate.budget import Conditions

    conditions = Conditions(temperature, spread, place, operator)
    with progress_bar("certificate"):
        page = write_certificate(run, out, conditions, camera)
        printed = print_pdf(page) if pdf else None
    for path in filter(None, (page, printed)):
        say(path)


@app.command()
def layout(
    viewer: Annotated[str, typer.Argument(help="foxglove (also for Lichtblick) or rerun.")],
    out: Annotated[
        Path | None, typer.Option(help="File to write; default flangeye.json or flangeye.rbl.")
    ] = None,
) -> None:
    """Write a layout for logs in Foxglove or Rerun."""
    from flangeye.files.regular import write_whole
    from flangeye.workflow.log.foxglove import foxglove_layout, write_rerun_blueprint

    if viewer not in ("foxglove", "rerun"):
        raise StageError(f"no layout for '{viewer}'; known: foxglove, rerun")
    path = out or Path("flangeye.json" if viewer == "foxglove" else "flangeye.rbl")
    if viewer == "foxglove":
        write_whole(path, foxglove_layout())
        say(f"{path}: in Foxglove, Layouts, Import from file; then open the run.mcap")
    else:
        write_rerun_blueprint(path)
        say(f"{path}: rerun run.mcap {path}")


@app.command()
def watch(
    run: Annotated[
        Path | None,
        typer.Argument(
            metavar="[RUN]", help="Folder of a run, or its log. Default: the newest in ./runs."
        ),
    ] = None,
    foxglove: Annotated[
        int | None,
        typer.Option(metavar="PORT", help="Also serve Foxglove on this port, usually 8765."),
    ] = None,
    patience: Annotated[
        float, typer.Option(metavar="SECONDS", help="Stop after this long without new data.")
    ] = 60.0,
) -> None:
    """Follow a run live: arm, captures, uncertainty so far."""
    from rich.console import Console

    from flangeye.workflow.log.watch import watch_run

    watch_run(run, foxglove, Console(), patience)


@app.command()
def doctor(
    archive: Annotated[
        Path,
        typer.Argument(help="A run.mcap, recordings that a reader supports, or a recipe of these."),
    ],
    recipe: Annotated[
        str | None,
        typer.Option(help="Recipe that reads the recordings: a file, or a bundled one by name."),
    ] = None,
    overrides: Overrides = None,
    json_: Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")] = False,
) -> None:
    """Find mistakes in recordings and the line that corrects each.

    Exit codes: 0 nothing found, 1 something was, 2 the archive cannot be read.
    """
    import json

    from flangeye.workflow.doctor import as_json, as_text
    from flangeye.workflow.doctor.opening import examined
    from flangeye.workflow.log.read import log_of
    from flangeye.workflow.recipe.find import is_recipe

    registry = load_plugins()
    if recipe is None and is_recipe(archive) and log_of(archive) == archive:
        recipe = str(archive)
    checked = read_recipe(recipe, registry, overrides) if recipe else None
    if checked is not None and recipe == str(archive):
        archive = _archive_of(checked)
    with (
        as_damage(archive, "it cannot be examined"),
        progress_bar("looking for mistakes", len(registry.of_kind("check"))) as step,
    ):
        diagnosis = examined(archive, registry, checked, step)
    say_notes(diagnosis.damage)
    say(json.dumps(as_json(diagnosis), indent=2) if json_ else as_text(diagnosis))
    if diagnosis.findings or diagnosis.damage:
        raise typer.Exit(1)


def _archive_of(recipe: Recipe) -> Path:
    """Return the archive that a recipe reads.

    Raises:
        RecipeError: Its first step reads no archive.
    """
    if recipe.archive is None:
        raise RecipeError(
            f"{recipe.steps[0].stage.name}: reads no archive to examine; name a run's log, or "
            "recordings"
        )
    return recipe.archive
