"""One session: a recipe run with its log into a folder, for ``run`` and for ``batch`` alike."""

from __future__ import annotations

from flangeye.errors import FlangeyeError, RunStopped
from flangeye.recipe import Recipe
from flangeye.record import Recorder
from flangeye.registry import Registry
from flangeye.replay import Replay
from flangeye.report import write_report
from flangeye.result import Result
from flangeye.runfolder import RunFolder
from flangeye.runlog import read_run
from flangeye.runner import Runner
from flangeye.types import ArchivePath


def record_run(
    recipe: Recipe,
    registry: Registry,
    folder: RunFolder,
    archive: ArchivePath,
    replay: Replay | None = None,
    report: bool = True,
) -> Result:
    """Run with a log; leave the folder whole, or not at all when nothing was gathered.

    Plugins registered with ``registry`` are told what happens, as ever.

    Args:
        recipe: The checked recipe.
        registry: The registry it was checked with.
        folder: Where everything goes; empty.
        archive: Recordings to run on, if any.
        replay: Steps to take from an earlier log, if any.
        report: Make ``report.html``, which costs a tenth of a second and 5 MB.

    Raises:
        FlangeyeError: The run could not come to a result; the log stays once it holds an
            observation.
    """
    runner = Runner(recipe, registry, archive)
    resolved = recipe.resolved()
    texts = {"recipe.yaml": recipe.text, "recipe.resolved.yaml": resolved}
    recorder = None
    try:
        recorder = Recorder(folder.log, texts, recipe.header.log.clouds == "full")
        registry.hooks.register(recorder)
        result = runner.run(replay)
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
