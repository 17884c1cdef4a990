"""The two commands that need no parser, in the form in which they are mostly asked.

Parsing a command line takes twice as long as looking up what was answered before.
"""

from __future__ import annotations

from collections.abc import Sequence

from flangeye.cli.saying import say, say_notes


def answered(words: Sequence[str]) -> bool:
    """Answer ``stages``, if it is remembered, or ``check RECIPE``; return whether it was asked.

    Raises:
        RecipeError: There is no such recipe, or it has mistakes.
    """
    if words == ["stages"]:
        return _say_stages()
    if len(words) == 2 and words[0] == "check" and not words[1].startswith("-"):
        say_verdict(words[1])
        return True
    return False


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
    from flangeye.recipe.verdict import recall_verdict, verdict

    path = find_recipe(name)
    known = None if overrides else recall_verdict(path)
    if known is not None:
        say(known)
        return
    from flangeye.plugin.registry import load_registry

    registry = load_registry()
    say(verdict(path, registry, overrides))
    say_notes(registry.notes())
