"""Text tables: any separator, decimal commas, with a heading or without, one block or several."""

from __future__ import annotations

import csv
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from flangeye.files.tables.table import Row, Rows, number_of


@dataclass
class Block:
    """Rows without a blank line, a comment or a title between them.

    Attributes:
        rows: Of each row, where it stands and its cells.
        heading: Names of its columns.
        title: The last line of words above it.
        after_blank: Whether a blank line or a title stands above it, not a comment alone.
        marked: Whether a mark, not blanks, stands between the cells.
    """

    rows: list[Row] = field(default_factory=list)
    heading: tuple[str, ...] = ()
    title: str = ""
    after_blank: bool = False
    marked: bool = False

    @property
    def width(self) -> int:
        """Columns of the first row."""
        return len(self.rows[0][1])


def text_rows(file: Path, text: str) -> list[Rows]:
    """Return the blocks of a text, mostly one.

    ``#`` and ``%`` begin a comment, of which the last before the numbers may be the heading. Blank
    lines and titles part blocks of three rows and more, and so do comments between blocks of one
    length. Matrices that stand line by line are a row each.
    """
    blocks = [_with_matrices(block) for block in _blocks(file, text.splitlines())]
    merged = _merged(blocks)
    names = [block.title for block in merged]
    distinct = len(set(names)) == len(names) > 1 and all(names)
    return [
        Rows(block.heading, block.rows, (block.title if distinct else f"{n}") if merged[1:] else "",
             _names(block, blocks))
        for n, block in enumerate(merged, 1)
    ]  # fmt: skip


def row_of(file: Path, text: str) -> Rows | None:
    """Return all numbers of a text as one row; a heading stays if there is one row under it."""
    blocks = text_rows(file, text)
    if not blocks:
        return None
    if len(blocks) == 1 and len(blocks[0].rows) == 1:
        return blocks[0]
    cells = tuple(cell for block in blocks for _, row in block.rows for cell in row)
    return Rows((), [(str(file), cells)])


def _blocks(file: Path, lines: Sequence[str]) -> Iterator[Block]:
    split = _splitter([line for line in lines if line.strip() and line.strip()[0] not in "#%"])
    block = Block(after_blank=True, marked=split.mark != " ")
    for n, line in enumerate(map(str.strip, lines), 1):
        comment = line[:1] in ("#", "%")
        cells = split(line.lstrip("#% ") if comment else line) if line else ()
        if cells and not comment and any(number_of(cell) is not None for cell in cells):
            block.rows.append((f"{file}:{n}", cells))
            continue
        if block.rows:
            yield block
            block = Block(marked=block.marked)
        block.after_blank |= not comment
        if any(cells):
            block.heading, block.title = cells, line.lstrip("#% ").rstrip(" :")
    if block.rows:
        yield block


def _with_matrices(block: Block) -> Block:
    """Return a block whose matrices, line by line, are a row of numbers each."""
    widths = {len(cells) for _, cells in block.rows}
    if not (len(block.heading) in widths or (block.marked and len(block.heading) > 2)):
        block.heading = ()
    else:
        block.title = ""
    for lines, width in ((4, 4), (3, 4), (3, 3)):
        if block.heading or widths != {width} or len(block.rows) % lines:
            continue
        numbers = np.array([[_or_nan(cell) for cell in cells] for _, cells in block.rows])
        stack = numbers.reshape(-1, lines, width)
        gram = stack[:, :3, :3] @ stack[:, :3, :3].swapaxes(1, 2)
        last = lines == 3 or bool((stack[:, 3] == [0, 0, 0, 1]).all())
        # By how much rows of a written rotation may differ from unit length, and from right angles
        if last and np.abs(gram - np.eye(3)).max() < 2e-3:
            rows = [block.rows[i : i + lines] for i in range(0, len(block.rows), lines)]
            block.rows = [(r[0][0], tuple(c for _, cells in r for c in cells)) for r in rows]
            return block
    return block


def _or_nan(cell: str | float) -> float:
    number = number_of(cell)
    return float("nan") if number is None else number


def _merged(blocks: list[Block]) -> list[Block]:
    """Return blocks of one table as one: short ones, and those that only a comment parts."""
    sections: list[Block] = []
    # Rows of a block; fewer between blank lines are a pose each
    short = [block for block in blocks if len(block.rows) < 3]
    all_titled = all(block.title for block in blocks)
    alike = len({(len(block.rows), block.width) for block in blocks}) == 1
    for block in blocks:
        last = sections[-1] if sections else None
        same = last is not None and block.width == last.width and not block.heading
        begins = block.after_blank or alike
        if short:
            begins = bool(block.title) and not all_titled
        if last is None or not same or begins:
            sections.append(Block(list(block.rows), block.heading, block.title))
        else:
            last.rows += block.rows
    return sections


def _names(block: Block, blocks: Sequence[Block]) -> list[str]:
    """Return the titles of rows that each have one."""
    titles = [each.title for each in blocks if each.rows[0] in block.rows]
    return titles if len(titles) == len(block.rows) > 1 and all(titles) else []


class _splitter:  # noqa: N801  a function with a memory
    """Splits lines at the mark that the first of them shows."""

    def __init__(self, lines: Sequence[str]) -> None:
        # Where blanks separate, every comma is a decimal one: "1,5 2,0 3,25".
        blanks = all(len(line.split()) > 2 and _plain(line) for line in lines[-3:])
        marks = ";\t" if blanks else ";\t,"
        shown = next(iter(lines), "")
        self.mark = next((m for m in marks if m in shown or m in "".join(lines[-1:])), " ")

    def __call__(self, line: str) -> tuple[str, ...]:
        if self.mark == " ":
            return tuple(line.strip("[](){}").replace(", ", " ").split())
        (cells,) = csv.reader([line], delimiter=self.mark, skipinitialspace=True)
        cells = [cell.strip(" []{}()") for cell in cells]
        # A mark at the line's end makes an empty last cell.
        return tuple(cells[:-1] if cells and not cells[-1] else cells)


def _plain(line: str) -> bool:
    """Return whether each word but the first, split at blanks, is a number by itself."""
    return all(number_of(word) is not None for word in line.split()[1:])
