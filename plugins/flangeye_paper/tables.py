"""Read what ``flangeye batch`` left, write what the page shows."""

from __future__ import annotations

import csv
import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from flangeye import FlangeyeError
from flangeye.batch.outcome import ACCEPTED

Row = Mapping[str, Any]


@dataclass(frozen=True)
class SessionRow:
    """One session of a batch.

    Attributes:
        row: Its row of ``sessions.csv``.
        folder: Where its ``result.json`` is.
    """

    row: Mapping[str, str]
    folder: Path

    @property
    def accepted(self) -> bool:
        """Whether it gave a calibration."""
        return self.row["status"] in ACCEPTED

    def result(self) -> dict[str, Any]:
        """Return the document ``result.json``.

        Raises:
            FlangeyeError: It is not there.
        """
        path = self.folder / "result.json"
        try:
            document: dict[str, Any] = json.loads(path.read_text("utf-8"))
        except (OSError, ValueError) as error:
            raise FlangeyeError(f"{path}: cannot be read: {error}") from None
        return document

    def figures(self, stage: str) -> dict[str, float]:
        """Return the figures of a verify step, by the stage's name."""
        for label, verification in self.result()["verifications"].items():
            if label.endswith(stage):
                figures: dict[str, float] = verification["figures"]
                return figures
        raise FlangeyeError(f"{self.folder}: has no step {stage}")

    def number(self, path: str) -> float:
        """Return a varied parameter as a number, its unit left out."""
        return float(self.row[path].partition(" ")[0])


def read_sessions(batch: Path) -> list[SessionRow]:
    """Return the sessions of a batch in the order of its table.

    Raises:
        FlangeyeError: The folder is none of ``flangeye batch``.
    """
    table = batch / "sessions.csv"
    try:
        with table.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as error:
        raise FlangeyeError(
            f"{table}: cannot be read ({error.strerror}); recipes/paper/reproduce.sh shows the "
            "command that makes it"
        ) from None
    return [SessionRow(row, batch / row["session"]) for row in rows]


def write_csv(path: Path, rows: Sequence[Row]) -> None:
    """Write rows with the columns of the first; numbers with four significant digits or more."""
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _text(value) for name, value in row.items()} for row in rows)


def read_csv(path: Path) -> list[dict[str, str]]:
    """Return the rows of a table that :func:`write_csv` wrote."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def columns(rows: Iterable[Row], *names: str) -> list[list[float]]:
    """Return named columns of rows as numbers."""
    listed = list(rows)
    return [[float(row[name]) for row in listed] for name in names]


def _text(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.3f}" if abs(value) >= 1e-3 or value == 0 else f"{value:.3g}"
    return "" if value is None else str(value)
