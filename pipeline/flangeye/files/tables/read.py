"""Choose how a table is read: by its file's ending, or by the positions in its text."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

from flangeye.errors import StageError
from flangeye.files.pairs import natural
from flangeye.files.regular import read_text
from flangeye.files.tables.documents import json_lines_rows, json_rows, yaml_rows
from flangeye.files.tables.positions import position_rows
from flangeye.files.tables.table import Row, Table
from flangeye.files.tables.text import text_rows

Rows = tuple[tuple[str, ...], list[Row]]
KINDS: Mapping[str, Callable[[Path, str, bool], Rows]] = {
    ".json": json_rows,
    ".jsonl": json_lines_rows,
    ".ndjson": json_lines_rows,
    ".yaml": yaml_rows,
    ".yml": yaml_rows,
}
"""Documents by their ending; everything else is text."""


def files_at(folder: Path, name: str) -> list[Path]:
    """Return the file of a name, or those of a pattern, ``*.json`` or ``*/pose.json``, in order."""
    if (folder / name).is_file():
        return [folder / name]
    found = folder.glob(name) if "*" in name and not Path(name).is_absolute() else ()
    return sorted((p for p in found if p.is_file()), key=lambda path: natural(str(path)))


def read_table(folder: Path, name: str) -> Table:
    """Read a table, or the one that the files of a pattern are together: a row or more of each.

    Raises:
        StageError: A file cannot be read, or the columns of two differ.
    """
    files = files_at(folder, name)
    if len(files) < 2:
        file = files[0] if files else folder / name
        heading, rows = _rows(file, single="*" in name)
        return Table(name, file, heading, tuple(rows), (file,))
    tables = [_rows(file, single=True) for file in files]
    for file, (heading, _) in zip(files, tables, strict=True):
        if heading != tables[0][0]:
            raise StageError(f"{file}: its columns are not those of {files[0].name}")
    rows = [row for _, found in tables for row in found]
    return Table(name, folder / name, tables[0][0], tuple(rows), tuple(files))


def _rows(file: Path, single: bool) -> Rows:
    text = read_text(file)
    document = KINDS.get(file.suffix.lower())
    if document is not None:
        return document(file, text, single)
    heading, rows = position_rows(file, text)
    return (heading, rows) if rows else text_rows(file, text)
