"""What a folder holds: kinds of files, how many, and tables with their headings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flangeye.errors import FlangeyeError, RecipeError
from flangeye.files.arrays import read_arrays
from flangeye.files.scans import CLOUDS, IMAGES, VENDOR
from flangeye.files.tables import TextTable, number_of, read_text_table

TABLES = (".csv", ".txt", ".dat", ".tsv")
ARRAYS = (".npz", ".npy", ".mat", ".xml")
LARGEST = 10_000_000
"""A file of arrays that is larger [bytes] holds scans, and is not looked into."""
FEWEST_ROWS, FEWEST_COLUMNS = 3, 6


@dataclass(frozen=True)
class FolderSurvey:
    """What was seen.

    Attributes:
        folder: Where.
        files: All files of the folder, by name.
        tables: Those that are tables of numbers.
        arrays: What ``reader.matrices`` may read, as a recipe names it, with its shape.
    """

    folder: Path
    files: Sequence[Path]
    tables: Sequence[TextTable]
    arrays: Sequence[str]

    def of(self, suffixes: Sequence[str]) -> list[Path]:
        """Return the files that end so; arrays of poses are no clouds."""
        named = {array.partition(":")[0].partition(" ")[0] for array in self.arrays}
        return [p for p in self.files if p.suffix.lower() in suffixes and p.name not in named]

    def lines(self) -> list[str]:
        """Return what was seen, a line each for people."""
        told = [
            f"{what}: {', '.join(f'{n} {suffix}' for suffix, n in sorted(kinds.items()))}"
            for what, suffixes in (
                ("clouds", CLOUDS),
                ("images", IMAGES),
                ("closed", tuple(VENDOR)),
            )
            if (kinds := Counter(p.suffix.lower() for p in self.of(suffixes)))
        ]
        told += [f"table: {_of_table(table)}" for table in self.tables]
        return [*told, *(f"array: {array}" for array in self.arrays)]


def look(folder: Path) -> FolderSurvey:
    """Return what a folder holds.

    Raises:
        RecipeError: There is none, or it is empty.
    """
    if not folder.is_dir():
        raise RecipeError(f"{folder}: is no folder; name the one that holds the recordings")
    files = sorted(p for p in folder.iterdir() if p.is_file())
    if not any(folder.iterdir()):
        raise RecipeError(f"{folder}: is empty; put the clouds or images and their poses there")
    tables = [table for p in files if (table := _table(p)) is not None]
    return FolderSurvey(folder, files, tables, [name for p in files for name in _arrays(p)])


def _table(file: Path) -> TextTable | None:
    if file.suffix.lower() not in TABLES:
        return None
    try:
        table = read_text_table(file)
    except FlangeyeError:
        return None
    wide = bool(table.rows) and len(table.rows[0][1]) >= FEWEST_COLUMNS
    target = bool(table.heading) and len(table.heading) >= 3
    if len(table.rows) < FEWEST_ROWS or not (wide or target):
        return None
    return table if number_of(table.rows[0][1][-1]) is not None else None


def _of_table(table: TextTable) -> str:
    heading = ", ".join(table.heading) or f"no heading, {len(table.rows[0][1])} columns"
    return f"{table.file.name}, {len(table.rows)} rows: {heading}"


def _arrays(file: Path) -> list[str]:
    """Return the arrays of a file that may be poses; of MATLAB and XML the file alone."""
    if file.suffix.lower() not in ARRAYS or file.stat().st_size > LARGEST:
        return []
    if file.suffix.lower() in (".mat", ".xml"):
        return [file.name]
    try:
        arrays = read_arrays(file)
    except FlangeyeError:
        return []
    return [
        f"{file.name}{':' if name else ''}{name} ({' x '.join(map(str, array.shape))})"
        for name, array in arrays.items()
        if array.shape[-2:] in ((4, 4), (3, 4)) or array.shape[:2] in ((4, 4), (3, 4))
    ]
