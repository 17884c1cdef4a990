"""The two commands whose answers are remembered, in the form in which they are mostly asked.

Parsing a command line takes twice as long as looking up what was answered before.
"""

from __future__ import annotations

from collections.abc import Sequence

from flangeye.cli.saying import say


def said_again(words: Sequence[str]) -> bool:
    """Say what ``stages`` or ``check RECIPE`` said before; return whether it is remembered.

    Raises:
        RecipeError: There is no such recipe.
    """
    known = _known(words)
    if known is not None:
        say(known)
    return known is not None


def _known(words: Sequence[str]) -> str | None:
    if words == ["stages"]:
        from flangeye.plugin.stage_list import recall_list

        return recall_list()
    if len(words) == 2 and words[0] == "check" and not words[1].startswith("-"):
        from flangeye.recipe.find import find_recipe
        from flangeye.recipe.verdict import recall_verdict

        return recall_verdict(find_recipe(words[1]))
    return None
