"""Where the program and the person meet: lines of text, from a terminal or from a pipe."""

from __future__ import annotations

import os
import select
import sys
from typing import TextIO


class OperatorConsole:
    """Says things, and hears lines without ever waiting for one.

    No thread reads: one that waits for input when the interpreter ends takes it down with it.
    """

    def __init__(self, heard: TextIO | None = None, said: TextIO | None = None) -> None:
        """Hear standard input and speak on standard error, where nothing else is said to."""
        self._heard = (sys.stdin if heard is None else heard).fileno()
        self._said = sys.stderr if said is None else said
        self._buffer = b""
        self._ended = False

    def say(self, text: str) -> None:
        """Say a line."""
        self._said.write(text + "\n")
        self._said.flush()

    def line(self, patience: float = 0.0) -> str | None:
        """Return a line that has been typed, blank ones aside; None while there is none.

        Args:
            patience: How long to wait for one [s].

        Raises:
            EOFError: There will be none any more.
        """
        while (line := self._take()) is None:
            if self._ended:
                raise EOFError
            if not select.select([self._heard], [], [], patience)[0]:
                return None
            more = os.read(self._heard, 65536)
            self._ended = not more
            # The last line may have no end.
            self._buffer += more or b"\n"
        return line

    def _take(self) -> str | None:
        while b"\n" in self._buffer:
            first, _, self._buffer = self._buffer.partition(b"\n")
            if text := first.decode("utf-8", "replace").strip():
                return text
        return None
