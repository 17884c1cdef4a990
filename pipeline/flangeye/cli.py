"""The ``flangeye`` command: parse, delegate, say what happened. No logic of the field is here.

Modules are imported inside the commands, so that ``--help`` answers at once.
"""

from __future__ import annotations

import os
import sys
import traceback
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from flangeye import __version__
from flangeye.errors import FlangeyeError, NothingMoved

if TYPE_CHECKING:
    from flangeye.recipe import Recipe
    from flangeye.registry import Registry
    from flangeye.replay import Earlier, Replay
    from flangeye.result import Result
    from flangeye.runfolder import RunFolder
    from flangeye.session import Start

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
    help="Hand-eye calibration from the robot's own flange, driven by YAML recipes.\n\n"
    "Start with: flangeye run ur5_phoxi-m_simulated\n\n"
    "Exit codes: 0 done, 1 the calibration was refused, 2 bad input.",
)

RecipeName = Annotated[str, typer.Argument(help="A recipe file, or the name of a shipped recipe.")]
Overrides = Annotated[
    Optional[list[str]],  # noqa: UP045  typer reads the annotation at run time
    typer.Option(
        "--set", metavar="PATH=VALUE", help="Override one value: steps.2.inlier='0.2 mm'."
    ),
]
LogFile = Annotated[Path, typer.Argument(help="The run.mcap of a run.")]


def _print_version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"flangeye {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", callback=_print_version, is_eager=True, help="Say which one this is."
        ),
    ] = False,
) -> None:
    """Nothing but what stands before a command."""


def main() -> None:
    """Run the command line; every foreseen mistake is one line and an exit code."""
    try:
        app()
    except NothingMoved as plan:
        typer.echo(str(plan))
    except FlangeyeError as error:
        _fail(error)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(0)


def _fail(error: FlangeyeError) -> None:
    if os.environ.get("FLANGEYE_DEBUG"):
        traceback.print_exception(error)
    for line in str(error).splitlines():
        sys.stderr.write(f"error: {line}\n")
    sys.exit(error.exit_code)


@app.command()
def run(  # noqa: PLR0913  one for each option
    recipe: Annotated[
        Optional[str],  # noqa: UP045
        typer.Argument(help="A recipe file, or the name of a shipped recipe."),
    ] = None,
    archive: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Recordings to run on, for recipes that start with acquire.archive."),
    ] = None,
    overrides: Overrides = None,
    out: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(help="Folder for the run's files; default runs/<time>_<recipe>."),
    ] = None,
    source: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(
            "--from", metavar="RUN.MCAP", help="Take the steps before --at from this log."
        ),
    ] = None,
    at: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(metavar="STEP", help="First step to do again, for example solve.svd."),
    ] = None,
    move: Annotated[
        bool,
        typer.Option("--move", help="Move the arm; without it the plan is checked and shown."),
    ] = False,
    resume: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Option(metavar="RUN", help="Go on with a run that ended early: its folder or log."),
    ] = None,
) -> None:
    """Run a recipe: a calibration, its log and its report."""
    from flangeye.devices import MotionAllowed
    from flangeye.registry import load_registry
    from flangeye.runfolder import RunFolder
    from flangeye.session import Start
    from flangeye.types import ArchivePath

    registry = load_registry()
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
        Optional[list[Path]],  # noqa: UP045
        typer.Argument(help="Recordings, a session each; none for recipes that simulate."),
    ] = None,
    overrides: Overrides = None,
    grid: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--set-grid", metavar="PATH=A,B,C", help="Run with each value; may be repeated."
        ),
    ] = None,
    repeat: Annotated[Optional[int], typer.Option(min=1, help="Run with so many seeds.")] = None,  # noqa: UP045
    vary: Annotated[str, typer.Option(help="What --repeat counts up.")] = "seed",
    workers: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(min=1, help="Processes on this machine; default one for each core."),
    ] = None,
    scheduler: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(metavar="tcp://HOST:PORT", help="A running dask scheduler to use instead."),
    ] = None,
    out: Annotated[
        Optional[Path],  # noqa: UP045
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
    from flangeye.registry import load_registry

    request = Request(
        recipe, tuple(archives or ()), tuple(overrides or ()), tuple(grid or ()), repeat, vary,
        workers, scheduler, out, report,
    )  # fmt: skip
    try:
        done = run_batch(request, load_registry(), Console(stderr=True))
    except KeyboardInterrupt:
        sys.stderr.write("stopped; the same command goes on from here\n")
        raise typer.Exit(130) from None
    typer.echo(summary_text(done))
    if not done.accepted:
        raise typer.Exit(1)


@app.command()
def check(recipe: RecipeName, overrides: Overrides = None) -> None:
    """Check a recipe without running it: every mistake, with its line; what it has to find."""
    from flangeye.configuration import Configuration
    from flangeye.recipe import find_recipe, load_recipe
    from flangeye.registry import load_registry

    path = find_recipe(recipe)
    checked = load_recipe(path, load_registry(), overrides or ())
    typer.echo(f"{path}: ok, {len(checked.steps)} steps")
    typer.echo(checked.context[Configuration].describe())


@app.command()
def recipes() -> None:
    """List the shipped recipes."""
    from flangeye.recipe import recipe_names
    from flangeye.yamlfile import read_yaml

    names = recipe_names()
    width = max(map(len, names), default=0)
    for name, path in names.items():
        typer.echo(f"{name:{width}}  {read_yaml(path).data.get('title', '')}")


@app.command()
def stages(
    name: Annotated[str | None, typer.Argument(help="A stage or part, for its parameters.")] = None,
) -> None:
    """List stages and parts; with NAME its parameters, units, defaults and meaning."""
    if name is None:
        from flangeye.listing import list_stages

        typer.echo(list_stages())
        return
    from flangeye.catalogue_text import describe_one
    from flangeye.registry import load_registry

    typer.echo(describe_one(load_registry(), name))


@app.command()
def plugins() -> None:
    """List the installed plugins, what each offers, and those that could not be loaded."""
    from flangeye.registry import load_registry

    registry = load_registry()
    for plugin, version in registry.versions().items():
        offers = sorted(n for n, owner in registry.owners.items() if owner == plugin)
        typer.echo(f"{plugin} {version}: {', '.join(offers) or 'no stages or parts'}")
    for plugin, error in registry.broken.items():
        typer.echo(f"{plugin}: could not be loaded: {type(error).__name__}: {error}")


@app.command()
def schema(
    result: Annotated[bool, typer.Option("--result", help="The schema of result.json.")] = False,
    out: Annotated[Optional[Path], typer.Option(help="File to write instead of printing.")] = None,  # noqa: UP045
) -> None:
    """Print the JSON Schema of recipes, for editors that check YAML while you type."""
    import json

    from flangeye.registry import load_registry
    from flangeye.result import Result
    from flangeye.schema import header_line, recipe_schema

    document = Result.model_json_schema() if result else recipe_schema(load_registry())
    text = json.dumps(document, indent=2, ensure_ascii=False)
    if out is None:
        typer.echo(text)
    else:
        out.write_text(text + "\n", encoding="utf-8")
    if not result:
        typer.echo(f"first line of your recipe: {header_line(out)}", err=True)


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
    from flangeye.registry import load_registry

    same = True
    for step, redone in redo(log, load_registry()):
        typer.echo(f"{step}: {redone.what}: {'the same' if redone.same else 'NOT the same'}")
        for name, value in redone.figures.items():
            typer.echo(f"  {name}: {value:.3g}")
        same = same and redone.same
    if not same:
        raise typer.Exit(1)


@app.command()
def watch(
    run: Annotated[
        Optional[Path],  # noqa: UP045
        typer.Argument(metavar="[RUN]", help="A run's folder or log; the newest in ./runs."),
    ] = None,
    foxglove: Annotated[
        Optional[int],  # noqa: UP045
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


tactile = typer.Typer(no_args_is_help=True, help="Tactile fingers: find out how one moves.")
app.add_typer(tactile, name="tactile")


@tactile.callback()
def tactile_group() -> None:
    """Keep 'calibrate' a word of its own, though it is the only one yet."""


@tactile.command("calibrate")
def tactile_calibrate(
    recipe: RecipeName,
    out: Annotated[Path, typer.Option(help="The finger's file to write.")] = Path("finger.yaml"),
    overrides: Overrides = None,
    move: Annotated[bool, typer.Option("--move", help="Move the arm, by millimetres.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not wait for Enter.")] = False,
) -> None:
    """Find a finger's rest pose, gain and stiffness, with the arm and the sensor of a recipe."""
    from flangeye.devices import MotionAllowed
    from flangeye.recipe import find_recipe, load_recipe
    from flangeye.registry import load_registry

    registry = load_registry()
    checked = load_recipe(find_recipe(recipe), registry, overrides or ())

    def ask(text: str) -> None:
        typer.echo(text)
        if not yes:
            typer.prompt("then press Enter", default="", show_default=False)

    guide = registry.part("guide.tactile")
    typer.echo(guide(checked, MotionAllowed(move), ask, out))


@app.command()
def doctor(
    archive: Annotated[Path, typer.Argument(help="A run.mcap, or recordings that a reader knows.")],
    recipe: Annotated[
        Optional[str],  # noqa: UP045
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
    from flangeye.registry import load_registry

    registry = load_registry()
    checked = load_recipe(find_recipe(recipe), registry, overrides or ()) if recipe else None
    session = open_session(archive, registry, checked)
    checks = [part for part in registry.parts.values() if part.kind == "check"]
    diagnosis = examine(session, checks)
    typer.echo(json.dumps(as_json(diagnosis), indent=2) if json_ else as_text(diagnosis))
    if diagnosis.findings:
        raise typer.Exit(1)


@app.command()
def loopback(
    robot: Annotated[str, typer.Argument(help="A robot model, for example ur5e, or a file.")],
    host: Annotated[str, typer.Option(help="Address to listen on.")] = "127.0.0.1",
    faults: Annotated[
        Optional[list[str]],  # noqa: UP045
        typer.Option(
            "--fault",
            metavar="NAME[=DURATION][@WHEN]",
            help="Let something go wrong, for example 'freeze=3 s@moving'.",
        ),
    ] = None,
    floor: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Height of a surface to touch, for example '100 mm'."),
    ] = None,
    joints: Annotated[
        Optional[str],  # noqa: UP045
        typer.Option(help="Where the arm starts, for example '0 -90 90 -90 -90 0 deg'."),
    ] = None,
    seed: Annotated[
        Optional[int],  # noqa: UP045
        typer.Option(help="Give the arm errors of its joints' zeros, drawn with this seed."),
    ] = None,
) -> None:
    """Be a robot's controller on loopback, for its own driver to connect to."""
    from flangeye.catalogue import load_model
    from flangeye.loopback import LoopbackOptions, find_loopback, read_height, read_joints
    from flangeye.registry import load_registry

    model = load_model("robots", robot)
    offered = [each for some in load_registry().hooks.hook.flangeye_loopbacks() for each in some]
    options = LoopbackOptions(
        robot=model,
        host=host,
        joints=read_joints(joints) if joints is not None else None,
        floor=read_height(floor) if floor is not None else None,
        faults=tuple(faults or ()),
        seed=seed,
    )
    find_loopback(offered, model).serve(options)


@app.command("new-plugin")
def new_plugin(
    name: Annotated[str, typer.Argument(help="Of the plugin, for example acme_hull.")],
    kind: Annotated[str, typer.Option(help="What it is: scanner, fit, solve, …")],
    into: Annotated[Path, typer.Option(help="Where its folder is made.")] = Path(),
) -> None:
    """Write an installable package with one plugin, a stand-in whose tests pass at once."""
    from flangeye.newplugin import write_plugin

    folder = write_plugin(name, kind, into)
    typer.echo(f"{folder}: pip install --editable '{folder}[dev]' && pytest {folder}")


if __name__ == "__main__":
    main()
