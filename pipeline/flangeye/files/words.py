"""Make foreign text safe to print on a terminal."""

import re
from collections.abc import Iterable

from flangeye.errors import RecipeError

QUOTED = 160
"""Most characters quoted of a parser's message; some messages quote the whole file."""


def require_name(where: str, name: str) -> str:
    """Return a name that a file gives to a link, joint or frame; refuse odd ones.

    Raises:
        RecipeError: It has other characters than names have, or more than 128.
    """
    # Exports write these names into other programs' files: no quotes, line breaks or markup.
    if not re.fullmatch(r"\w[\w ./:+()\-]{0,127}", name):
        raise RecipeError(
            f"{where}: {name[:QUOTED]!a} is not a valid name: letters, digits and _ . / : + - ( ) "
            "or a space are allowed, 128 at most; rename it in the file"
        )
    return name


def printable(text: str) -> str:
    """Return a text with its control characters written out as escapes."""
    # All control characters but tab and line feed, as escape sequences begin with them; and marks
    # of writing direction, which can hide text.
    return re.sub(
        "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]",
        lambda found: ascii(found[0])[1:-1],
        text,
    )


def reason_of(error: BaseException) -> str:
    """Return a library's message about damaged input as one short line."""
    line = printable(str(error)).strip().partition("\n")[0].strip()
    return line[:QUOTED] or type(error).__name__


def nearest(word: str, known: Iterable[str], n: int = 3, cutoff: float = 0.6) -> list[str]:
    """Return the known words that are nearest to one, the nearest first.

    Args:
        word: The word as written.
        known: The valid words.
        n: Largest number of words returned.
        cutoff: Least similarity, from 0 to 1.
    """
    from difflib import get_close_matches  # a command without mistakes does not wait for it

    # The time grows with the product of both lengths, and words from files can be long
    return get_close_matches(word[:200], list(known), n, cutoff)
