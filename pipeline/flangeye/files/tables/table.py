"""Rows of named cells, whatever file they are from."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from flangeye.errors import StageError
from flangeye.files.words import nearest
from flangeye.types import Floats

Column = str | int
"""A column by its name in the heading, or by its number from 1."""
Cell = str | float
Row = tuple[str, tuple[Cell, ...]]
"""Where a row stands, as messages begin with it, and its cells."""

_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+([eE][-+]?\d+)?")


class Rows(NamedTuple):
    """What one source gives: a block of a text, a program, the lists of one length in a document.

    Attributes:
        heading: Names of the columns; empty without a heading.
        rows: Of each row, where it stands and its cells.
        part: What names it within its file: an array's name, a block's title; empty for all of it.
        names: What each row is called, where rows have names; else empty.
        convention: Of the poses, where the way of writing shows it: a robot program's.
    """

    heading: tuple[str, ...]
    rows: Sequence[Row]
    part: str = ""
    names: Sequence[str] = ()
    convention: str | None = None


@dataclass(frozen=True)
class Table:
    """Rows of one file, of a part of it, or of several files.

    Attributes:
        name: As a recipe names it: FILE, FILE:PART, a pattern of files, or files side by side.
        file: The first of it with the folder, for messages.
        heading: Names of the columns; empty without a heading.
        rows: Of each row, where it stands and its cells.
        files: The files that were read.
        names: What each row is called, where rows have names; else empty.
        convention: Of the poses, where the way of writing shows it.
    """

    name: str
    file: Path
    heading: tuple[str, ...]
    rows: tuple[Row, ...]
    files: tuple[Path, ...]
    names: tuple[str, ...] = ()
    convention: str | None = None

    def where(self, row: int) -> str:
        """Return what messages about a row begin with."""
        return self.rows[row][0]

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
        near = nearest(column, self.heading, n=2) or list(self.heading)
        known = f"known: {', '.join(near)}" if near else "it has no heading; give numbers from 1"
        raise StageError(f"{self.file}: has no column '{column}'; {known}")

    def indices(self, columns: Sequence[Column]) -> list[int]:
        """Return which columns are meant, from 0; ``pose`` is also all of ``pose.0``, ``pose.1``.

        Raises:
            StageError: There is none of a name; names the nearest.
        """
        return [i for column in columns for i in (self._listed(column) or [self.index(column)])]

    def numbers(self, columns: Sequence[int]) -> Floats:
        """Return the numbers (N, k) of columns.

        Raises:
            StageError: A cell is none; names its line.
        """
        return np.array([self._row(row, columns) for row in range(len(self.rows))])

    def texts(self, column: int) -> list[str]:
        """Return the cells of a column."""
        return [str(cells[column]) for _, cells in self.rows]

    def _listed(self, column: Column) -> list[int]:
        """Return the columns of a list's entries, in their order."""
        if column in self.heading:
            return []
        entry = re.compile(re.escape(str(column)) + r"(\.\d+)+")
        return [i for i, name in enumerate(self.heading) if entry.fullmatch(name)]

    def _row(self, row: int, columns: Sequence[int]) -> list[float]:
        where, cells = self.rows[row]
        if columns and len(cells) <= max(columns):
            raise StageError(f"{where}: has {len(cells)} columns, too few")
        found = [number_of(cells[column]) for column in columns]
        for column, number in zip(columns, found, strict=True):
            if number is None:
                raise StageError(f"{where}: '{cells[column]}' is not a number")
        return [number for number in found if number is not None]


def number_of(cell: Cell) -> float | None:
    """Return the number in a cell, with a decimal point or comma; None if it is none."""
    if not isinstance(cell, str):
        return cell
    text = cell.replace(",", ".") if _DECIMAL_COMMA.fullmatch(cell) else cell
    try:
        return float(text)
    except ValueError:
        return None
