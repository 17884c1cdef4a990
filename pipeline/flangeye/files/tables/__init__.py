"""Tables of poses as people and programs write them: text, documents, arrays, robot programs.

To read a new kind of file, add a function and its row to :mod:`~flangeye.files.documents`, or a
pattern to :data:`~flangeye.types.pose_formats.CONVENTIONS`.

A name selects a table, or part of one.

``poses.csv`` is a file, and ``robot/*.txt`` are files with one row each. ``log.txt:2`` is the
second block of rows of a text, and ``log.txt:2/2`` the second half of its rows. ``log.csv:marker``
are the rows that have a cell ``marker``. ``poses.npz:arm`` are the arrays of a document that are as
long as ``arm``. Several names are tables side by side.
"""

import csv
import re
from bisect import bisect
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any

import numpy as np

from flangeye.errors import StageError
from flangeye.files.documents import DOCUMENT_READERS, document_of, stacked
from flangeye.files.recording import MIN_CAPTURES
from flangeye.files.regular import read_any_text
from flangeye.files.scans import natural, partners
from flangeye.files.tables.table import (
    CellValue,
    Column,
    Rows,
    Table,
    TableRow,
    entry_of_list,
    number_of,
    record_of,
    rows_of,
    table_of,
)
from flangeye.files.words import reason_of
from flangeye.types.pose_formats import CONVENTIONS

__all__ = [
    "DOCUMENT_READERS",
    "CellValue",
    "Column",
    "Table",
    "document_of",
    "entry_of_list",
    "files_at",
    "number_of",
    "read_table",
    "rows_together",
    "tables_in",
]


_COMMENT = re.compile(r"(?<!\s)\s*(?:[#%!]|//|;(?=[^;]*$))[#%!;/ ]*")
"""Mark at the beginning of a comment line; a semicolon separates cells if the line has more."""


def program_rows(file: Path, text: str) -> Rows | None:
    """Return the positions in a text, a row each, with the convention they are in; None if none."""
    for name, convention in CONVENTIONS.items():
        found = list(re.finditer(convention.program, text)) if convention.program else []
        if found:
            ends = [end.start() for end in re.finditer("\n", text)]
            rows = [
                (f"{file}:{bisect(ends, match.start()) + 1}", match.groups()) for match in found
            ]
            own = convention.in_units(convention.program_length, convention.angle)
            labels = zip(own.labels, own.units, strict=True)
            heading = tuple("_".join(filter(None, pair)).lower() for pair in labels)
            return Rows(heading, rows, convention=name)
    return None


def files_at(folder: Path, name: str) -> list[Path]:
    """Return the files that match a name or a pattern such as ``*/pose.json``, in natural order.

    Raises:
        StageError: No file can have such a name, or the pattern would look through all folders.
    """
    try:
        for whole in (name, name.partition(":")[0]):
            if (folder / whole).is_file():
                return [folder / whole]
        found = folder.glob(whole) if "*" in whole and not Path(whole).is_absolute() else ()
        if found and "**" in whole:
            raise ValueError("** is not known; write */ for each folder between")
        return sorted((p for p in found if p.is_file()), key=lambda path: natural(str(path)))
    except (OSError, ValueError, NotImplementedError) as error:
        raise StageError(f"{name[:80]!a}: is not a valid file name: {reason_of(error)}") from None


def read_table(folder: Path, name: str | Sequence[str]) -> Table:
    """Read a table by its name, or tables side by side by several.

    Raises:
        StageError: A file cannot be read; the part does not exist, or none is named of several; the
            columns of two files differ, or the lengths of tables side by side.
    """
    if not isinstance(name, str):
        return _beside([read_table(folder, each) for each in name])
    files = files_at(folder, name)
    if len(files) > 1 or "*" in name.partition(":")[0]:
        return _of_files(folder, name, files)
    file = files[0] if files else folder / name
    part = name.partition(":")[2] if not (folder / name).is_file() else ""
    return _table(name, file, _part(file, sources(file), part))


def tables_in(folder: Path, name: str) -> list[Table]:
    """Return every table of a file, each named as :func:`read_table` expects it.

    Raises:
        StageError: It cannot be read.
    """
    file = folder / name
    found = sources(file)
    if len(found) == 1:
        return [_table(name, file, found[0])]
    parts = [f"{name}:{rows.part.split(',')[0]}" for rows in found]
    return [_table(n, file, rows) for n, rows in zip(parts, found, strict=True)]


def rows_together(
    table: Table, other: Table, column: Column | None = None
) -> tuple[list[int | None], list[str]]:
    """Return the index of the other table's row for each row, and notes on how they were paired.

    Rows are paired by name: that of their files, or the cell in a column that both tables have. A
    name that the other table lacks has None. Without names they are paired row by row.

    Raises:
        StageError: The names differ, or the numbers of rows.
    """
    if other is table:
        return list(range(len(table.rows))), []
    names, others = _row_names(table, column), _row_names(other, column)
    # Of numbers that are there on one side only, it is unknown whether both count from the same
    if set(others) < set(names) and len(others) >= MIN_CAPTURES and not "".join(others).isdecimal():
        at = {name: i for i, name in enumerate(others)}
        lacks = [name for name in names if name not in at]
        told = f"{', '.join(lacks[:3])}{', …' * (len(lacks) > 3)}"
        return [at.get(name) for name in names], [
            f"paired by name: {other.name} has {len(others)} of {len(names)} names, without {told}"
        ]
    if names and others:
        stems, other_stems = (
            [re.sub(r"\.[A-Za-z]\w*$", "", name) for name in each] for each in (names, others)
        )
        order, note = partners(str(table.file), stems, other_stems, f"rows of {other.name}")
        return list(order), [note]
    if len(other.rows) != len(table.rows):
        each, left = divmod(len(other.rows), max(len(table.rows), 1))
        of_others = (
            f", such as all but one of the {each} for each pose" if each and not left else ""
        )
        raise StageError(
            f"{other.file}: has {len(other.rows)} rows, {table.name} has {len(table.rows)}; "
            f"give each a column time to join them by it, or remove the surplus{of_others}"
        )
    return list(range(len(table.rows))), [f"paired row by row: {table.name} with {other.name}"]


def _row_names(table: Table, column: Column | None) -> Sequence[str]:
    """Return the names of a table's rows; empty where they have none, or two have the same.

    A file has its ending.
    """
    if table.names or column is None:
        return table.names
    known = column in table.heading or (isinstance(column, int) and column <= len(table.rows[0][1]))
    # Another table may call the column of its files otherwise
    columns = [table.index(column)] if known else range(len(table.heading))
    for cells in map(table.texts, columns):
        called = all(cell.isdecimal() or number_of(cell) is None for cell in cells)
        files = known or all(PurePath(cell).suffix for cell in cells)
        if called and files and len(set(cells)) == len(table.rows):
            return [PurePath(cell).name for cell in cells]
    return ()


def sources(file: Path) -> list[Rows]:
    """Return the tables of a file: of a document, of a robot program, or of a text's blocks.

    Raises:
        StageError: It cannot be read.
    """
    document = document_of(file)
    if document is not None:
        return rows_of(file, document)
    text = read_any_text(file)
    found = program_rows(file, text) or labelled_rows(file, text) or _of_images(file, text)
    return [found] if found else text_rows(file, text)


def _of_images(file: Path, text: str) -> Rows | None:
    """Return the poses of COLMAP's list of images, ``images.txt``; None for another file."""
    names = [f"camera_T_world_{axis}" for axis in ("qw", "qx", "qy", "qz", "x", "y", "z")]
    lines = [(n, line.split()) for n, line in enumerate(text.splitlines(), 1)]
    rows = [
        (f"{file}:{n}", tuple(words[1:8] + words[9:]))
        for n, words in lines
        # Between them stand the points that each image shows: x, y and a number
        if len(words) == 10 and words[0].isdecimal() and number_of(words[9]) is None
    ]
    return Rows((*names, "name"), rows) if rows and file.name == "images.txt" else None


def _of_files(folder: Path, name: str, files: Sequence[Path]) -> Table:
    """Return files with a row each as one table."""
    tables = [_single(file) for file in files]
    for file, rows in zip(files, tables, strict=True):
        if rows.heading != tables[0].heading:
            raise StageError(f"{file}: its columns are not those of {files[0].name}")
    joined = [row for rows in tables for row in rows.rows]
    apart = len({file.parent for file in files}) == len(files)
    names = [file.parent.name if apart else file.stem for file in files]
    named = names if len(joined) == len(files) else []
    first = tables[0] if tables else Rows((), [])
    rows = first._replace(rows=joined, part="", names=named)
    return _table(name, folder / name, rows, files)


def _single(file: Path) -> Rows:
    document = document_of(file)
    if document is not None:
        return record_of(file, document)
    text = read_any_text(file)
    return (
        program_rows(file, text) or labelled_rows(file, text, 1) or row_of(file, text)
        or Rows((), [])
    )  # fmt: skip


def _table(name: str, file: Path, rows: Rows, files: Sequence[Path] = ()) -> Table:
    return Table(
        name, file, rows.heading, tuple(rows.rows), tuple(files or (file,)), tuple(rows.names),
        rows.convention,
    )  # fmt: skip


def _part(file: Path, found: Sequence[Rows], part: str) -> Rows:
    if not found:
        return Rows((), [])
    # The first of so many equal parts
    share = re.fullmatch(r"([1-9]\d?)/([1-9]\d?)", part)
    if share is not None and len(found) == 1:
        return _share(file, found[0], int(share[1]), int(share[2]))
    if not part and len(found) == 1:
        return found[0]
    for rows in found:
        if part and part in (rows.part, *rows.part.split(",")):
            return rows
    if len(found) == 1 and found[0].part == "":
        named = [row for row in found[0].rows if part in row[1]]
        if named:
            return found[0]._replace(rows=named, names=())
        raise StageError(f"{file}: has one table only, not '{part}'; write {file.name}")
    known = ", ".join(f"{file.name}:{rows.part.split(',')[0]}" for rows in found)
    what = f"has no part '{part}'" if part else f"holds {len(found)} tables"
    raise StageError(f"{file}: {what}; name one of {known}")


def _share(file: Path, rows: Rows, which: int, of: int) -> Rows:
    count = len(rows.rows)
    if count % of or which > of:
        raise StageError(f"{file}: has {count} rows, which are not {of} parts of equal length")
    size = count // of
    kept = slice((which - 1) * size, which * size)
    return rows._replace(rows=rows.rows[kept], names=rows.names[kept])


def _beside(tables: Sequence[Table]) -> Table:
    """Return tables of one length as one; columns without names are called as their file."""
    counts = {len(table.rows) for table in tables}
    if len(counts) > 1:
        told = ", ".join(f"{table.name} {len(table.rows)}" for table in tables)
        raise StageError(
            f"{tables[0].file}: tables side by side have different numbers of rows: {told}"
        )
    headings = [table.heading or _counted(table) for table in tables]
    known = Counter(name for heading in headings for name in heading)
    names = [
        name if known[name] == 1 else f"{table.files[0].stem}.{name}"
        for table, heading in zip(tables, headings, strict=True)
        for name in heading
    ]
    rows: list[TableRow] = [
        (each[0][0], tuple(cell for _, cells in each for cell in cells))
        for each in zip(*(table.rows for table in tables), strict=True)
    ]
    files = dict.fromkeys(file for table in tables for file in table.files)
    name = ", ".join(table.name for table in tables)
    return Table(name, tables[0].file, tuple(names), tuple(rows), tuple(files), tables[0].names)


def _counted(table: Table) -> tuple[str, ...]:
    stem = re.sub(r"\W*\*\W*", "", table.files[0].stem if len(table.files) == 1 else
                  str(Path(table.name).with_suffix("")).replace("/", "_"))  # fmt: skip
    return tuple(f"{stem}.{i}" for i in range(len(table.rows[0][1]) if table.rows else 0))


def labelled_rows(file: Path, text: str, fewest: int = MIN_CAPTURES) -> Rows | None:
    """Return labelled numbers as rows, a new row each time the labels repeat; None if too few.

    Examples are ``robot: x=0.1 y=0.2 …`` and ``[INFO] [17.2]: marker pose: [0.3, …]``. Several
    numbers behind a label form a list. A label that is followed by other labels is put before their
    names.
    """
    one = r"(?<![\w.])[-+]?(?:\d+\.?\d*|\.\d+)(?:[eEdD][-+]?\d+)?(?![\w.:])"
    # Over several lines, until another label
    several = rf"{one}(?:[ \t,;|\[\](){{}}]+{one}|[\s,;\[\](){{}}]+{one}(?!\]?[ \t]*[A-Za-z]))*"
    pattern = rf"([A-Za-z_][\w ./-]{{0,60}}?)[ \d]{{0,9}}[:=][\s\[({{]{{0,9}}((?:{several})?)"
    records: list[dict[str, Any]] = [{}]
    before, counted = "", 0
    for label, numbers in re.findall(pattern, text):
        found = [n for word in re.findall(one, numbers) if (n := number_of(word)) is not None]
        if not found:
            before = label
            continue
        counted += len(found)
        name = f"{before} {label}".strip() if len(found) == 1 else label
        if name in records[-1]:
            records.append({})
        records[-1][name] = found if len(found) > 1 else found[0]
    usual = Counter(tuple(record) for record in records).most_common(1)[0][0]
    alike = [record for record in records if tuple(record) == usual]
    few = len(alike) < fewest or sum(np.size(value) for value in alike[0].values()) < 6
    if few or counted < 0.7 * len(re.findall(one, text)):
        return None
    where = [f"{file}: {i}" for i in range(1, len(alike) + 1)]
    bare = [next(iter(r.values())) if len(usual) == 1 else r for r in alike]
    return table_of(list(zip(where, bare, strict=True)))


@dataclass
class TextBlock:
    """Rows without a blank line, a comment or a title between them.

    Attributes:
        rows: Location and cells of each row.
        heading: Names of its columns.
        title: The last line of words above it.
        above: The line of words above that.
        after_blank: Whether a blank line or a title stands above it, not a comment alone.
        marked: Whether a mark, not blanks, stands between the cells.
    """

    rows: list[TableRow] = field(default_factory=list)
    heading: tuple[str, ...] = ()
    title: str = ""
    above: str = ""
    after_blank: bool = False
    marked: bool = False

    @property
    def width(self) -> int:
        """Number of columns of the first row."""
        return len(self.rows[0][1])


def text_rows(file: Path, text: str) -> list[Rows]:
    """Return the blocks of a text, mostly one.

    ``#``, ``%``, ``!``, ``;`` and ``//`` begin a comment; the last one before the numbers may be
    the heading. Blocks of three rows or more are separated by blank lines and titles, and blocks of
    equal length by comments. A matrix written over several lines becomes one row.
    """
    blocks = [_with_matrices(_unfolded(block)) for block in _blocks(file, text.splitlines())]
    merged = _in_turn(blocks) or _merged(blocks)
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


def _blocks(file: Path, lines: Sequence[str]) -> Iterator[TextBlock]:
    split = _splitter([line for line in lines if line.strip() and not _COMMENT.match(line)])
    block = TextBlock(after_blank=True, marked=split.mark != " ")
    for n, line in _unbroken(lines):
        comment = bool(_COMMENT.match(line))
        # What stands behind the numbers of a line is a remark
        words = re.split(r"\s(?:[#!]|//)", line)[0] if re.match(r"[-+.\d]", line) else line
        plain = _COMMENT.sub("", words, count=1) if comment else words
        cells = split(plain) if plain else ()
        counts = split.wide and len(cells) < 3  # rows, or what stands below: robot 7
        numbers = any(number_of(cell) is not None or _list_in(cell) for cell in cells)
        if numbers and not comment and not counts:
            block.rows.append((f"{file}:{n}", cells))
            continue
        if block.rows:
            yield block
            block = TextBlock(marked=block.marked)
        block.after_blank |= not comment
        if any(cells) and any(map(str.isalnum, plain)):  # no rule of a printed table
            known = {"m", "cm", "mm", "rad", "deg", "°", "s", "ms", "us", "ns", "-", "1"}
            units = {word.strip("[]()") for word in cells}
            if units <= known and len(cells) == len(block.heading):  # units under names
                cells = tuple(map("{} {}".format, block.heading, cells))
            block.heading, block.above = cells, block.title
            block.title = re.split(r"[,(]", plain)[0].rstrip(" :")
    if block.rows:
        yield block


def _unbroken(lines: Sequence[str]) -> Iterator[tuple[int, str]]:
    """Yield line numbers and lines; a list of numbers over several lines is joined into one."""
    begun, first = "", 0
    for n, line in enumerate(map(str.strip, lines), 1):
        begun, first = (f"{begun} {line}", first) if begun else (line, n)
        last = begun.rpartition("[")[2] if "[" in begun else "]"
        open_list = "]" not in last and any(map(str.isdigit, last))
        # A pose has at most 16 numbers
        if not open_list or n - first == 16 or n == len(lines):
            yield first, begun
            begun = ""


def _list_in(cell: CellValue) -> tuple[str, ...]:
    """Return the numbers of a list in one cell; empty if the cell holds no list."""
    text = str(cell).strip()
    words = re.split(r"[\s,;\[\]()]+", text.strip("[]() ")) if text[:1] in ("[", "(") else []
    return tuple(words) if words[2:] and all(number_of(word) is not None for word in words) else ()


def _unfolded(block: TextBlock) -> TextBlock:
    """Return a block in which each number of a list has its own column."""
    columns = zip(*(cells for _, cells in block.rows), strict=False)
    sizes = [max(len(_list_in(cell)) for cell in column) for column in columns]
    if any(sizes):
        for at, (where, cells) in enumerate(block.rows):
            parts = (_list_in(cell) or (cell,) for cell in cells)
            # An empty cell stands for as many empty entries
            full = (part * (size or 1) if len(part) == 1 else part
                    for part, size in zip(parts, sizes, strict=False))  # fmt: skip
            block.rows[at] = where, tuple(cell for part in full for cell in part)
        if len(block.heading) == len(sizes):
            block.heading = tuple(
                f"{name}.{i}" if size else name
                for name, size in zip(block.heading, sizes, strict=True)
                for i in range(size or 1)
            )
    return block


def _with_matrices(block: TextBlock) -> TextBlock:
    """Return a block in which each matrix over several lines is one row."""
    widths = {len(cells) for _, cells in block.rows}
    if not (len(block.heading) in widths or (block.marked and len(block.heading) > 2)):
        block.heading = ()
    else:
        block.title = block.above
    if not block.heading and len(widths) == 1:
        stack = stacked(np.array([[_or_nan(cell) for cell in cells] for _, cells in block.rows]))
        lines = stack.shape[1] if stack is not None else 1
        rows = [block.rows[i : i + lines] for i in range(0, len(block.rows), lines)]
        block.rows = [(r[0][0], tuple(c for _, cells in r for c in cells)) for r in rows]
    return block


def _or_nan(cell: str | float) -> float:
    number = number_of(cell)
    return float("nan") if number is None else number


def _merged(blocks: list[TextBlock]) -> list[TextBlock]:
    """Return the blocks, after merging those that belong to one table."""
    sections: list[TextBlock] = []
    # Rows of a block; fewer between blank lines are a pose each
    short = [block for block in blocks if len(block.rows) < 3]
    all_titled = all(block.title for block in blocks)
    alike = len({(len(block.rows), block.width) for block in blocks}) == 1
    for block in blocks:
        last = sections[-1] if sections else None
        same = last is not None and block.width == last.width and not block.heading
        # Under a heading, rows behind a blank line go on; a second table would be as long
        goes_on = last is not None and bool(last.heading) and len(block.rows) != len(last.rows)
        begins = (block.after_blank and not goes_on) or alike
        if short:
            begins = bool(block.title) and not all_titled
        if last is None or not same or begins:
            sections.append(TextBlock(list(block.rows), block.heading, block.title))
        else:
            last.rows += block.rows
    return sections


def _in_turn(blocks: Sequence[TextBlock]) -> list[TextBlock]:
    """Return a table for each title, if titles alternate: robot 0, marker 0, robot 1, …."""
    sections: dict[str, TextBlock] = {}
    for block in blocks:
        title = re.sub(r"\W*\d+\W*$", "", block.title)
        sections.setdefault(title, TextBlock(title=title)).rows += block.rows
    alone = "" not in sections and all(len(block.rows) == 1 for block in blocks)
    turns = len({len(block.rows) for block in sections.values()}) == 1 < len(sections)
    return list(sections.values()) if alone and turns and len(blocks) > len(sections) else []


def _names(block: TextBlock, blocks: Sequence[TextBlock]) -> list[str]:
    """Return the titles of a block's rows; empty unless each row has one."""
    titles = [each.title for each in blocks if each.rows[0] in block.rows]
    return titles if len(titles) == len(block.rows) > 1 and all(titles) else []


class _splitter:  # noqa: N801  a function with a memory
    """Splits lines at the separator found in the first of them."""

    def __init__(self, lines: Sequence[str]) -> None:
        # Where blanks separate, every comma is a decimal one: "1,5 2,0 3,25".
        blanks = all(len(line.split()) > 2 and _plain(line) for line in lines[-3:])
        marks = ";\t|" if blanks else ";\t|,"
        shown = next(iter(lines), "")
        self.mark = next((m for m in marks if m in shown or m in "".join(lines[-1:])), " ")
        self.ended = all(line.rstrip().endswith(self.mark) for line in lines)
        self.wide = any(len(self(line)) > 2 for line in lines[:9])

    def __call__(self, line: str) -> tuple[str, ...]:
        # Python prints arrays as array([[…]], dtype=float32): drop all but the numbers
        line = re.sub(r"^\s*[\w.]+\((?=[-\s\[(.\d])|,\s*dtype=\w+(?=\)+\s*$)", "", line).strip()
        line = line.removeprefix("|").removesuffix("|").strip() if self.mark == "|" else line
        line = line.rstrip(", ") if line.startswith(("[", "(")) else line  # a list in a list
        if self.mark == " ":
            return tuple(line.strip("[](){}").replace(", ", " ").split())
        (cells,) = csv.reader([line], delimiter=self.mark, skipinitialspace=True)
        cells = [_bare(cell) for cell in cells]
        # A mark at the end of each line makes an empty last cell.
        return tuple(cells[:-1] if self.ended and cells[-1:] == [""] else cells)


def _bare(cell: str) -> str:
    """Return a cell without the brackets of a list; a name keeps those of its unit."""
    bare = cell.strip(" []{}()")
    return (
        bare if number_of(bare) is not None or cell.count("[") != cell.count("]") else cell.strip()
    )


def _plain(line: str) -> bool:
    """Return whether each word but the first, split at blanks, is a number by itself."""
    return all(number_of(word) is not None for word in line.split()[1:])
