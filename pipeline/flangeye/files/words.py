"""Make foreign text safe to print on a terminal."""

from __future__ import annotations

import re
from collections.abc import Iterable

from flangeye.errors import RecipeError

LONGEST = 160
"""What is quoted of a parser's message [characters]: some quote the file."""


def require_name(where: str, name: str) -> str:
    """Return a name that a file gives to a link, joint or frame; refuse odd ones.

    Raises:
        RecipeError: It has other characters than names have, or more than 128.
    """
    # A link, joint or frame in another program's file: no quote, no line break, no markup.
    if not re.fullmatch(r"\w[\w ./:+()\-]{0,127}", name):
        raise RecipeError(
            f"{where}: {name[:LONGEST]!a} is not a valid name: letters, digits and _ . / : + - ( ) "
            "or a space are allowed, 128 at most; rename it in the file"
        )
    return name


def printable(text: str) -> str:
    """Return a text with its control characters written out as escapes."""
    # All but tab and line feed: escape sequences begin with them, and directions hide what is
    # said.
    return re.sub(
        "[\x00-\x08\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]",
        lambda found: ascii(found[0])[1:-1],
        text,
    )


def reason_of(error: BaseException) -> str:
    """Return a library's message about damaged input as one short line."""
    line = printable(str(error)).strip().partition("\n")[0].strip()
    return line[:LONGEST] or type(error).__name__


def nearest(word: str, known: Iterable[str], n: int = 3, cutoff: float = 0.6) -> list[str]:
    """Return the known words that are nearest to one, the nearest first.

    Args:
        word: What was written.
        known: What could have been.
        n: How many at most.
        cutoff: How alike they must be, from 0 to 1.
    """
    from difflib import get_close_matches  # a command without mistakes does not wait for it

    # Of a word from a file, what is compared [characters]: it takes time with their product
    return get_close_matches(word[:200], list(known), n, cutoff)
