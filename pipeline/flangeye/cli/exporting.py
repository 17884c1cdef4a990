"""Export a run's calibration: as a file, as tables, or on a ROS 2 graph."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from flangeye.cli.app import RunArgument, app, load_plugins
from flangeye.cli.console import say

if TYPE_CHECKING:
    from flangeye.plugin.registry import Registry
    from flangeye.plugin.stage import Stage
    from flangeye.types import CalibratedPose, ExportedFile
    from flangeye.workflow.log.read import RunLog


FORMATS_HINT = "'flangeye export --list' names the formats"
CameraOption = Annotated[
    str | None, typer.Option(help="Camera to export, for a cell with several.")
]
Anyway = Annotated[
    bool, typer.Option("--anyway", help="Export a refused calibration too; the file states that.")
]


def _list_formats(wanted: bool) -> None:
    if wanted:
        for each in load_plugins().exports():
            say(f"{each.name.partition('.')[2]:<16}{each.summary}")
        say(f"{'tables':<16}A cell's session as tables, with a recipe that reads them.")
        raise typer.Exit


@app.command()
def export(
    run: RunArgument,
    to: Annotated[
        str | None, typer.Option(help="The format, for example ros2_launch, ur or kuka.")
    ] = None,
    values: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="NAME=VALUE", help="A parameter of the format: parent=base."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="File to write, or - to print; default RUN/exports/.")
    ] = None,
    camera: CameraOption = None,
    anyway: Anyway = False,
    _list: Annotated[
        bool,
        typer.Option(
            "--list", callback=_list_formats, is_eager=True, help="List the formats and exit."
        ),
    ] = False,
) -> None:
    """Write the calibration for another program.

    --to tables writes a cell's session as tables, one per arm and camera, with a recipe that reads
    them, into the folder --out.

    Exit codes: 0 written, 1 the calibration was refused, 2 there is none.
    """
    from flangeye.errors import StageError
    from flangeye.files.regular import write_whole

    if to is None:
        raise StageError(f"--to: is missing, for example --to ros2_launch; {FORMATS_HINT}")
    if to == "tables":
        _write_tables(run, out)
        return
    file = _exported(run, to.removeprefix("export."), values or [], anyway, camera)
    if out == Path("-"):
        # Unchanged, byte by byte: another program reads it
        typer.echo(file.text, nl=False)
        return
    path = out or (run if run.is_dir() else run.parent) / "exports" / file.name
    write_whole(path, file.text)
    say(f"{path}: {file.use}")


@app.command()
def publish(
    run: RunArgument,
    parent: Annotated[
        str | None, typer.Option(help="tf frame that carries the camera; by default the recipe's.")
    ] = None,
    child: Annotated[
        str | None, typer.Option(help="tf frame of the camera; by default the recipe's.")
    ] = None,
    camera: CameraOption = None,
    anyway: Anyway = False,
) -> None:
    """Keep a calibration on the ROS 2 graph (tf_static).

    Frame names come from the recipe's export.ros2_launch step, or are flangeye's defaults.
    """
    from flangeye.workflow.run.folder import recipe_of_log

    registry = load_plugins()
    ros2 = "export.ros2_launch"
    log, pose = _calibrated(run, registry.stage(ros2), anyway, camera)
    steps = recipe_of_log(log, registry).steps
    named: Any = next((step.params for step in steps if step.stage.name == ros2), None)
    frames = {
        pose.transform.parent: parent or (named and named.parent),
        pose.transform.child: child or (named and named.child),
    }
    with registry.graph() as graph, suppress(KeyboardInterrupt):
        for line in graph.publish(pose, {own: name for own, name in frames.items() if name}):
            say(f"{line}: published until Ctrl-C")
        graph.stay()


def _write_tables(run: Path, out: Path | None) -> None:
    from flangeye.workflow.log.read import read_run
    from flangeye.workflow.run.tables import write_tables

    log = read_run(run)
    *files, recipe = write_tables(log, out or log.path.parent / "tables", load_plugins())
    log.require_sound()
    say(f"{recipe}: calibrates from {', '.join(file.name for file in files)}")


def _format_named(to: str, registry: Registry) -> str:
    """Return the export format of that name, or the only match: ``urscript`` is ``ur``.

    Raises:
        StageError: No format has the name, or several mention it.
    """
    from flangeye.errors import StageError
    from flangeye.files.words import nearest

    if f"export.{to}" in registry.stages:
        return f"export.{to}"
    words = {each.name.partition(".")[2]: each.summary.lower() for each in registry.exports()}
    spoken = [name for name in words if to.lower() in f"{name} {words[name]}"]
    if len(spoken) == 1:
        return f"export.{spoken[0]}"
    near = [name for name in words if to.lower() in name] or spoken or nearest(to, words)
    hint = f"did you mean {' or '.join(near[:3])}? " if near else ""
    raise StageError(f"--to {to}: is not a format; {hint}{FORMATS_HINT}")


def _exported(
    run: Path, to: str, values: list[str], anyway: bool, camera: str | None
) -> ExportedFile:
    from flangeye.errors import StageError
    from flangeye.workflow.recipe.overrides import params_given

    registry = load_plugins()
    name = _format_named(to, registry)
    stage = registry.stage(name)
    if stage not in registry.exports():
        raise StageError(
            f"{name}: needs more than the camera's pose; add it as a step to the recipe"
        )
    if camera and stage.params and "name" in stage.params.model_fields:
        values = [f"name={camera}", *values]  # else the files of all cameras have one name
    params = params_given(stage, values, registry)
    _, pose = _calibrated(run, stage, anyway, camera)
    file: ExportedFile = stage.function(pose=pose, **({"params": params} if params else {}))
    return file


def _calibrated(
    run: Path, stage: Stage, anyway: bool, camera: str | None
) -> tuple[RunLog, CalibratedPose]:
    """Return a run's log, and its calibration as the input of an export format."""
    from flangeye.errors import StageError
    from flangeye.models.configuration import CELL
    from flangeye.workflow.log.read import read_run
    from flangeye.workflow.result import calibrated_pose, logged_result, require_one

    log = read_run(run)
    result = logged_result(log)
    log.require_sound()
    if result is None:
        raise StageError(f"{log.path}: the run did not come to its end; there is nothing to export")
    pose = calibrated_pose(result, anyway, camera)
    if CELL not in stage.serves:
        require_one(stage.name, pose, result)
    return log, pose
