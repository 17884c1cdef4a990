"""What somebody may have meant."""

from __future__ import annotations

from collections.abc import Iterable


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
