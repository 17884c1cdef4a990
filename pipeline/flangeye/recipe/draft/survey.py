"""What a folder holds: kinds of files, how many, and tables with their headings."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from flangeye.errors import FlangeyeError, RecipeError
from flangeye.files.scans import CLOUDS, IMAGES, VENDOR
from flangeye.files.tables import KINDS, Table, number_of, read_table
from flangeye.recipe.draft.arrays import PoseArrays, places, pose_arrays
from flangeye.recipe.draft.headings import list_name, list_sizes

TABLES = (".csv", ".txt", ".dat", ".tsv", ".tum", ".mod", ".src", ".ls", ".script", *KINDS)
FEWEST_ROWS, FEWEST_COLUMNS = 3, 6


@dataclass(frozen=True)
class FolderSurvey:
    """What was seen.

    Attributes:
        folder: Where.
        files: All files of the folder, and of the folders in it.
        tables: Those that are tables of numbers.
        arrays: What ``reader.matrices`` may read.
    """

    folder: Path
    files: Sequence[Path]
    tables: Sequence[Table]
    arrays: Sequence[PoseArrays]

    def of(self, suffixes: Sequence[str]) -> list[Path]:
        """Return the files that end so; arrays of poses are no clouds."""
        named = {array.at.partition(":")[0] for array in self.arrays}
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
    files = sorted(p for p in (*folder.glob("*"), *folder.glob("*/*")) if p.is_file())
    if not any(folder.iterdir()):
        raise RecipeError(f"{folder}: is empty; put the clouds or images and their poses there")
    found = (_table(folder, place, len(of)) for place, of in places(folder, TABLES))
    tables = [table for table in found if table is not None]
    return FolderSurvey(folder, files, tables, pose_arrays(folder))


def _table(folder: Path, place: str, files: int) -> Table | None:
    """Return a table of poses, or the one that files with a pose each are together."""
    try:
        table = read_table(folder, place)
    except FlangeyeError:
        return None
    if files > 1 and len(table.rows) != files:
        return None
    wide = bool(table.rows) and len(table.rows[0][1]) >= FEWEST_COLUMNS
    target = bool(table.heading) and len(table.heading) >= 3
    if len(table.rows) < FEWEST_ROWS or not (wide or target):
        return None
    numbers = sum(number_of(cell) is not None for cell in table.rows[0][1])
    return table if numbers >= 3 else None


def _of_table(table: Table) -> str:
    sizes = list_sizes(table.heading)
    names = dict.fromkeys(list_name(name) or name for name in table.heading)
    shown = [f"{name} ({sizes[name]} numbers)" if name in sizes else name for name in names]
    heading = ", ".join(shown) or f"no heading, {len(table.rows[0][1])} columns"
    return f"{table.name}, {len(table.rows)} rows: {heading}"
