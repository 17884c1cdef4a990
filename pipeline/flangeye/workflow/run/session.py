"""Run a recipe with its log into a folder; used by ``run`` and ``batch``."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from flangeye.devices import MotionAllowed
from flangeye.errors import FlangeyeError, RunStopped
from flangeye.plugin.registry import Registry
from flangeye.types import ArchivePath
from flangeye.workflow.log.read import read_run
from flangeye.workflow.log.record import Recorder
from flangeye.workflow.recipe.load import Recipe
from flangeye.workflow.report import write_report
from flangeye.workflow.result.contract import Result
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.restart import FromNothing
from flangeye.workflow.run.runner import Runner


@dataclass(frozen=True)
class Start:
    """Starting point of a run, besides its recipe.

    Attributes:
        archive: Recordings to run on, if any.
        point: Source of earlier results: nothing, a log, or a run that ended early.
        motion: Whether the arm may be moved.
    """

    archive: ArchivePath = field(default_factory=ArchivePath)
    point: FromNothing = field(default_factory=FromNothing)
    motion: MotionAllowed = field(default_factory=MotionAllowed)


def record_run(
    recipe: Recipe,
    registry: Registry,
    folder: RunFolder,
    start: Start,
    report: bool = True,
    library: Path | None = None,
) -> Result:
    """Run a recipe with a log; delete the folder if nothing was recorded.

    The hooks of the plugins registered with ``registry`` are called as in any run.

    Args:
        recipe: The checked recipe.
        registry: The registry it was checked with.
        folder: Empty folder for the output.
        start: Starting point of the run.
        report: Make ``report.html``, which costs a tenth of a second and 2.4 MB.
        library: A copy of plotly.js that several reports share, if they do.

    Raises:
        FlangeyeError: The run failed; its log is kept if anything was recorded.
    """
    runner = Runner(recipe, registry, start.archive, start.motion)
    with _logged(recipe, registry, folder):
        result = runner.run(start.point)
        folder.write(result, recipe.files)
        if report:
            write_report(read_run(folder.log), folder.path / "report.html", library)
    return result


def record_scans(
    recipe: Recipe, registry: Registry, folder: RunFolder, motion: MotionAllowed, count: int
) -> None:
    """Log the first ``count`` flanges found by a recipe, without solving.

    Raises:
        FlangeyeError: As :func:`record_run`.
    """
    runner = Runner(recipe, registry, ArchivePath(), motion)
    with _logged(recipe, registry, folder) as recorder:
        taken = runner.take(count)
        recorder.ended(f"{len(taken)} scans were requested, without a calibration")


@contextmanager
def _logged(recipe: Recipe, registry: Registry, folder: RunFolder) -> Iterator[Recorder]:
    """Log a run into a folder; remove the folder if nothing was recorded."""
    texts = {"recipe.yaml": recipe.text, **recipe.files}
    recorder = None
    try:
        recorder = Recorder(folder.log, texts, recipe.header.log.clouds == "full")
        registry.hooks.register(recorder)
        yield recorder
    except (FlangeyeError, KeyboardInterrupt) as error:
        if recorder:
            recorder.ended(_why(error))
            recorder.close()
        if not (recorder and recorder.gathered):
            folder.discard()
        if isinstance(error, KeyboardInterrupt):
            raise RunStopped(_why(error)) from None
        raise
    finally:
        if recorder:
            recorder.close()
            registry.hooks.unregister(recorder)


def _why(error: BaseException) -> str:
    return str(error) or "stopped by Ctrl-C"
