"""Text tables as people and programs write them: any separator, decimal commas, with a heading."""

from __future__ import annotations

import csv
import difflib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from flangeye.errors import StageError
from flangeye.files.regular import read_text
from flangeye.types import Floats

Column = str | int
"""A column by its name in the heading, or by its number from 1."""

_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")


@dataclass(frozen=True)
class TextTable:
    """A table of text.

    Attributes:
        file: Where it is from.
        heading: Names of the columns; empty without a heading.
        rows: Line number and cells of each row.
    """

    file: Path
    heading: tuple[str, ...]
    rows: tuple[tuple[int, tuple[str, ...]], ...]

    def where(self, row: int) -> str:
        """Return what messages about a row begin with."""
        return f"{self.file}:{self.rows[row][0]}"

    def index(self, column: Column) -> int:
        """Return which column is meant, from 0.

        Raises:
            StageError: There is none; names the nearest.
        """
        width = min(len(cells) for _, cells in self.rows)
        if isinstance(column, int):
            if 1 <= column <= width:
                return column - 1
            raise StageError(f"{self.file}: has no column {column}; they are 1 to {width}")
        if column in self.heading:
            return self.heading.index(column)
        near = difflib.get_close_matches(column, self.heading, n=2) or list(self.heading)
        known = f"known: {', '.join(near)}" if near else "it has no heading; give numbers from 1"
        raise StageError(f"{self.file}: has no column '{column}'; {known}")

    def numbers(self, columns: Sequence[int]) -> Floats:
        """Return the numbers (N, k) of columns.

        Raises:
            StageError: A cell is none; names its line.
        """
        return np.array([self._row(row, columns) for row in range(len(self.rows))])

    def texts(self, column: int) -> list[str]:
        """Return the cells of a column."""
        return [cells[column] for _, cells in self.rows]

    def _row(self, row: int, columns: Sequence[int]) -> list[float]:
        line, cells = self.rows[row]
        if columns and len(cells) <= max(columns):
            raise StageError(f"{self.file}:{line}: has {len(cells)} columns, too few")
        found = [number_of(cells[column]) for column in columns]
        for column, number in zip(columns, found, strict=True):
            if number is None:
                raise StageError(f"{self.where(row)}: '{cells[column]}' is not a number")
        return [number for number in found if number is not None]


def number_of(cell: str) -> float | None:
    """Return the number in a cell, with a decimal point or comma; None if it is none."""
    text = cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell
    try:
        return float(text)
    except ValueError:
        return None


def read_text_table(file: Path) -> TextTable:
    """Read a table; ``#`` and ``%`` begin a comment, of which the last may be the heading.

    Raises:
        StageError: It cannot be read, or has no rows.
    """
    lines = read_text(file).splitlines()
    numbered = [(n, line.strip()) for n, line in enumerate(lines, 1) if line.strip()]
    plain = [(n, line) for n, line in numbered if line[0] not in "#%"]
    if not plain:
        return TextTable(file, (), ())
    split = _splitter([line for _, line in plain])
    rows = [(n, split(line)) for n, line in plain]
    rows = [(n, cells) for n, cells in rows if cells]
    if number_of(rows[0][1][-1]) is None:
        return TextTable(file, rows[0][1], tuple(rows[1:]))
    comments = [split(line[1:].strip()) for n, line in numbered if n < plain[0][0]]
    fitting = [c for c in comments if len(c) == len(rows[0][1])]
    return TextTable(file, fitting[-1] if fitting else (), tuple(rows))


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
        # A mark at the line's end makes an empty last cell.
        return tuple(cell.strip() for cell in (cells[:-1] if not cells[-1].strip() else cells))


def _plain(line: str) -> bool:
    """Return whether each word but the first, split at blanks, is a number by itself."""
    return all(number_of(word) is not None for word in line.split()[1:])
