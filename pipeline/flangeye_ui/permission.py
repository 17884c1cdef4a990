"""What moves an arm asks for a code that only the terminal shows: no script in a page knows it."""

from __future__ import annotations

import secrets
import shlex
import time
from collections.abc import Callable, Sequence

from flangeye.errors import StageError

DIGITS = 6
LIFE = 120.0
"""A code is good for so long [s]: time to walk to the terminal and back."""
MOST_WRONG = 5
"""Wrong codes of one server, by mistyping; guessing that often meets 5 of 10^6."""


class MoveCodes:
    """Makes codes, each for one command of one page, and takes each once."""

    def __init__(self, show: Callable[[str], None]) -> None:
        self._show, self._wrong = show, 0
        self._open: tuple[str, tuple[str, ...], str, float] | None = None

    def ask(self, words: Sequence[str], page: str) -> None:
        """Show a new code in the terminal, with the command that it would start."""
        code = f"{secrets.randbelow(10**DIGITS):0{DIGITS}d}"
        self._open = (code, tuple(words), page, time.monotonic() + LIFE)
        line = shlex.join(["flangeye", "run", *words, "--move"])
        self._show(f"code {code} moves the arm: {line}   (asked for by the page, {LIFE:.0f} s)")

    def spend(self, given: str, words: Sequence[str], page: str) -> None:
        """Take the code back.

        Raises:
            StageError: It is not the one that was shown for this, or is used up.
        """
        if self._wrong >= MOST_WRONG:
            raise StageError("too many wrong codes: nothing moves until 'flangeye ui' is restarted")
        shown, self._open = self._open, None
        if shown is None or shown[1:3] != (tuple(words), page) or time.monotonic() > shown[3]:
            raise StageError("the code has expired: start again, and type the new one")
        if not secrets.compare_digest(given.strip().encode(), shown[0].encode()):
            self._wrong += 1
            raise StageError("that is not the code in the terminal: start again for a new one")
