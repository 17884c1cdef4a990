"""Text tables: any separator, decimal commas, with a heading or without."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

from flangeye.files.tables.table import Row, number_of


def text_rows(file: Path, text: str) -> tuple[tuple[str, ...], list[Row]]:
    """Return the heading, empty without one, and the rows of a text.

    ``#`` and ``%`` begin a comment, of which the last before the numbers may be the heading.
    """
    lines = text.splitlines()
    numbered = [(n, line.strip()) for n, line in enumerate(lines, 1) if line.strip()]
    plain = [(n, line) for n, line in numbered if line[0] not in "#%"]
    if not plain:
        return (), []
    split = _splitter([line for _, line in plain])
    rows = [(f"{file}:{n}", split(line)) for n, line in plain]
    rows = [(where, cells) for where, cells in rows if cells]
    if number_of(rows[0][1][-1]) is None:
        return rows[0][1], rows[1:]
    comments = [split(line[1:].strip()) for n, line in numbered if n < plain[0][0]]
    fitting = [c for c in comments if len(c) == len(rows[0][1])]
    return (fitting[-1] if fitting else ()), rows


class _splitter:  # noqa: N801  a function with a memory
    """Splits lines at the mark that the first of them shows."""

    def __init__(self, lines: Sequence[str]) -> None:
        # Where blanks separate, every comma is a decimal one: "1,5 2,0 3,25".
        blanks = all(len(line.split()) > 2 and _plain(line) for line in lines[-3:])
        marks = ";\t" if blanks else ";\t,"
        self.mark = next((m for m in marks if m in lines[0]), " ")

    def __call__(self, line: str) -> tuple[str, ...]:
        if self.mark == " ":
            return tuple(line.split())
        (cells,) = csv.reader([line], delimiter=self.mark, skipinitialspace=True)
        cells = [cell.strip() for cell in cells]
        # A mark at the line's end makes an empty last cell.
        return tuple(cells[:-1] if cells and not cells[-1] else cells)


def _plain(line: str) -> bool:
    """Return whether each word but the first, split at blanks, is a number by itself."""
    return all(number_of(word) is not None for word in line.split()[1:])
