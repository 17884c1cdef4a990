"""Notes of a step: for the record, or warnings that need action."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Annotated, Any

from pydantic import PlainSerializer, PlainValidator


class Warn(str):
    """A note that asks for something: printed at once, first in the report and on the page.

    The text says what is wrong, in one line.

    Attributes:
        fix: What mends it: a command, a line of the recipe, or what to do at the cell.
    """

    fix: str
    __slots__ = ("fix",)

    def __new__(cls, text: str, fix: str) -> Warn:
        """Return the warning."""
        made = super().__new__(cls, text)
        made.fix = fix
        return made

    def __getnewargs__(self) -> tuple[str, str]:  # type: ignore[override]
        """Travel to another process whole."""
        return str(self), self.fix


def _plain(note: str) -> str | dict[str, str]:
    return {"text": str(note), "fix": note.fix} if isinstance(note, Warn) else note


def _note(plain: Any) -> str:
    if isinstance(plain, str):
        return plain
    if isinstance(plain, dict) and [type(plain.get(key)) for key in ("text", "fix")] == [str, str]:
        return Warn(plain["text"], plain["fix"])
    raise ValueError("a note is a text, or {text: …, fix: …}")


Note = Annotated[str, PlainValidator(_note), PlainSerializer(_plain)]
"""A plain line is for the record: ``flangeye show``, the report's end and ``result.json``. Logged
as a text, and a :class:`Warn` as ``{text, fix}``."""


def as_line(note: str) -> str:
    """Return a note as commands say it: what it is, and what mends it."""
    return f"warning: {note}; {note.fix}" if isinstance(note, Warn) else f"note: {note}"


def warnings_of(notes: Iterable[str]) -> list[Warn]:
    """Return the notes that ask for something."""
    return [note for note in notes if isinstance(note, Warn)]


def records_of(notes: Iterable[str]) -> list[str]:
    """Return the notes for the record."""
    return [note for note in notes if not isinstance(note, Warn)]
