"""One session: a recipe run with its log into a folder, for ``run`` and for ``batch`` alike."""

from __future__ import annotations

from dataclasses import dataclass, field

from flangeye.devices import MotionAllowed
from flangeye.errors import FlangeyeError, RunStopped
from flangeye.recipe import Recipe
from flangeye.record import Recorder
from flangeye.registry import Registry
from flangeye.replay import Earlier, Replay
from flangeye.report import write_report
from flangeye.result import Result
from flangeye.runfolder import RunFolder
from flangeye.runlog import read_run
from flangeye.runner import Runner
from flangeye.types import ArchivePath


@dataclass(frozen=True)
class Start:
    """What a run starts from, besides its recipe.

    Attributes:
        archive: Recordings to run on, if any.
        replay: Steps to take from an earlier log, if any.
        earlier: A run that ended early, to go on with, if any.
        motion: Whether the arm may be moved.
    """

    archive: ArchivePath = field(default_factory=ArchivePath)
    replay: Replay | None = None
    earlier: Earlier | None = None
    motion: MotionAllowed = field(default_factory=MotionAllowed)


def record_run(
    recipe: Recipe,
    registry: Registry,
    folder: RunFolder,
    start: Start,
    report: bool = True,
) -> Result:
    """Run with a log; leave the folder whole, or not at all when nothing was gathered.

    Plugins registered with ``registry`` are told what happens, as ever.

    Args:
        recipe: The checked recipe.
        registry: The registry it was checked with.
        folder: Where everything goes; empty.
        start: What it starts from.
        report: Make ``report.html``, which costs a tenth of a second and 5 MB.

    Raises:
        FlangeyeError: The run could not come to a result; the log stays once it holds an
            observation.
    """
    runner = Runner(recipe, registry, start.archive, start.motion)
    resolved = recipe.resolved()
    texts = {"recipe.yaml": recipe.text, "recipe.resolved.yaml": resolved}
    recorder = None
    try:
        recorder = Recorder(folder.log, texts, recipe.header.log.clouds == "full")
        registry.hooks.register(recorder)
        result = runner.run(start.replay, start.earlier)
        folder.write(result, resolved)
        if report:
            write_report(read_run(folder.log), folder.path / "report.html")
    except (FlangeyeError, KeyboardInterrupt) as error:
        if recorder:
            recorder.close()
        if runner.accepted == 0:
            folder.discard()
        if isinstance(error, KeyboardInterrupt):
            raise RunStopped("stopped by Ctrl-C") from None
        raise
    finally:
        if recorder:
            recorder.close()
            registry.hooks.unregister(recorder)
    return result
