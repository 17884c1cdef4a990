"""The commands that need no parser, in the form in which they are mostly asked.

Parsing a command line takes twice as long as looking up what was answered before; a report waits
for it for a twentieth of its time.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from flangeye.cli.console import say, say_notes
from flangeye.files.deferred import defer


def answered(words: Sequence[str]) -> bool:
    """Answer ``stages`` from memory, ``check RECIPE`` or ``report LOG``; return if it was asked.

    Raises:
        RecipeError: There is no such recipe, or it has mistakes.
        StageError: There is no such log, or it is damaged.
    """
    if words == ["stages"]:
        return _say_stages()
    if len(words) != 2 or words[1].startswith("-"):
        return False
    if words[0] == "check":
        say_verdict(words[1])
    elif words[0] == "report":
        say_report(Path(words[1]))
    return words[0] in ("check", "report")


def _say_stages() -> bool:
    from flangeye.plugin.stage_list import recall_list

    known = recall_list()
    if known is not None:
        say(known)
    return known is not None


def say_verdict(name: str, overrides: Sequence[str] = ()) -> None:
    """Check a recipe, unless its verdict is remembered; say what it has and solves for.

    Raises:
        RecipeError: Names every mistake found.
    """
    from flangeye.recipe.find import find_recipe
    from flangeye.recipe.verdict import key_of, recall_verdict, verdict

    path = find_recipe(name)
    key = key_of(path)
    known = None if overrides else recall_verdict(key)
    if known is not None:
        say(known)
        return
    defer("numpy")
    from flangeye.plugin.registry import load_registry

    registry = load_registry()
    say(verdict(path, key, registry, overrides))
    say_notes(registry.notes())


def say_report(log: Path, out: Path | None = None) -> None:
    """Write the report of a run from its log; say where it is, and what of the log is damaged.

    Args:
        log: A run's folder, or a file in it.
        out: File to write; ``report.html`` beside the log if not given.

    Raises:
        StageError: There is no such log, or it is damaged.
    """
    from flangeye.cli.foreign import name_damage, of_foreign, require_gathered
    from flangeye.log.read import read_run
    from flangeye.report import write_report

    read = read_run(log)
    path = out or read.path.parent / "report.html"
    require_gathered(read)
    with of_foreign(read.path, "no report can be made of it"):
        write_report(read, path)
    say(path)
    name_damage(read)
