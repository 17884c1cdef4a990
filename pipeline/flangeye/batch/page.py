"""``summary.html``: all sessions side by side, in one file that needs nothing else."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from flangeye import report as run_report
from flangeye.batch.figures import drawings_of
from flangeye.batch.outcome import ACCEPTED, STATUSES
from flangeye.batch.request import BatchError
from flangeye.batch.tables import Row, Table
from flangeye.files.bundled import VERSION
from flangeye.files.elsewhere import is_url
from flangeye.files.written import write_whole
from flangeye.report.units import degrees, duration, millimetres

if TYPE_CHECKING:
    from jinja2 import Environment

_HERE = Path(__file__).parent
_REPORT = Path(run_report.__file__).parent

MOST = 1000
"""Sessions in the page's table, and about as many in its plots; the files have all."""

_HEADINGS: Mapping[str, str] = {
    "session": "Session",
    "archive": "Archive",
    "seed": "Seed",
    "status": "Status",
    "reason": "Reason",
    "used": "Used",
    "captures": "Captures",
    "holdout_rms_m": "Held-out rms [mm]",
    "holdout_median_m": "Held-out median [mm]",
    "holdout_p95_m": "Held-out 95 % [mm]",
    "predicted_rms_m": "Predicted rms [mm]",
    "predicted_p95_m": "Predicted 95 % [mm]",
    "true_rms_m": "True rms [mm]",
    "true_centre_m": "True, centre [mm]",
    "true_rotation_rad": "True rotation [°]",
    "seconds": "Seconds",
}


@dataclass(frozen=True)
class Cell:
    """One place of the table.

    Attributes:
        text: What people read.
        number: What it is sorted by; None for text.
        link: Where it leads, if anywhere.
        kind: The column.
    """

    text: str
    number: float | None
    link: str | None
    kind: str


def write_page(table: Table, path: Path) -> None:
    """Write the summary of a batch.

    Raises:
        BatchError: The file cannot be written.
    """
    write_whole(path, render(table), BatchError)


def render(table: Table) -> str:
    """Return the page as text."""
    from plotly.offline import get_plotlyjs

    table = _with_short_archives(table)
    columns = _columns(table)
    drawings = drawings_of(replace(table, rows=table.rows[:: 1 + len(table.rows) // MOST]))
    return _environment().get_template("summary.html.j2").render(
        title=table.rows[0]["recipe"] if table.rows else "nothing",
        counts=[(s, n) for s, n in _counts(table.rows).items() if n],
        total=len(table.rows),
        headings=[(name, _HEADINGS.get(name, name)) for name in columns],
        rows=[[_cell(row, name) for name in columns] for row in _worst(table.rows)],
        groups=_groups(table),
        varied=_varied(table),
        drawings=drawings,
        seconds=duration(sum(row["seconds"] for row in table.rows)),
        plotly_js=get_plotlyjs() if drawings else "",
        version=VERSION,
    )  # fmt: skip


def _worst(rows: Sequence[Row]) -> Sequence[Row]:
    """Return as many rows as a browser bears: without a calibration first, then the worst."""
    if len(rows) <= MOST:
        return rows

    def goodness(row: Row) -> tuple[bool, float]:
        return row["status"] in ACCEPTED, -(row["holdout_rms_m"] or 0.0)

    return sorted(rows, key=goodness)[:MOST]


def _with_short_archives(table: Table) -> Table:
    """Return the table with what archives have in common left out of their paths."""
    paths = {row["archive"] for row in table.rows if row["archive"]}
    if not paths or any(map(is_url, paths)):
        return table
    common = Path(os.path.commonpath([Path(path).parent for path in paths]))
    rows = [row | {"archive": str(Path(row["archive"]).relative_to(common))} for row in table.rows]
    return replace(table, rows=rows)


def _columns(table: Table) -> list[str]:
    """Return the columns that say anything, in the order people read them."""
    order = ["session", "archive", *table.varied, *list(_HEADINGS)[2:]]
    return [n for n in order if any(row[n] is not None for row in table.rows)]


def _cell(row: Row, name: str) -> Cell:
    value = row[name]
    number = float(value) if isinstance(value, (int, float)) else None
    link = quote(row["report"]) if name == "session" and row["report"] else None
    return Cell(_text(name, value), number, link, name)


def _text(name: str, value: Any) -> str:
    if value is None:
        return ""
    if name.endswith("_m") and isinstance(value, float):
        return millimetres(value)
    if name == "true_rotation_rad":
        return degrees(value)
    return f"{value:.2f}" if name == "seconds" else str(value)


def _varied(table: Table) -> list[str]:
    archives = {row["archive"] for row in table.rows}
    return [*(["archive"] if len(archives) > 1 else []), *table.varied]


def _groups(table: Table) -> list[dict[str, Any]]:
    """Return one line for each variant that was repeated; none where nothing was."""
    varied = _varied(table)
    grouped: dict[tuple[Any, ...], list[Row]] = {}
    for row in table.rows:
        grouped.setdefault(tuple(row[name] for name in varied), []).append(row)
    if len(grouped) == len(table.rows):
        return []
    return [
        {"names": names, "n": len(rows), "counts": _counts(rows), **_middle(rows)}
        for names, rows in grouped.items()
    ]


def _middle(rows: Sequence[Row]) -> dict[str, str]:
    """Return the medians of the accepted sessions, as text."""
    accepted = [row for row in rows if row["status"] in ACCEPTED]
    found = {}
    for name in ("holdout_rms_m", "predicted_p95_m", "true_rms_m"):
        values = [row[name] for row in accepted if row[name] is not None]
        found[name] = millimetres(median(values)) if values else ""
    return found


def _counts(rows: Sequence[Row]) -> dict[str, int]:
    counts = Counter(row["status"] for row in rows)
    return {status: counts[status] for status in STATUSES}


def _environment() -> Environment:
    """Return templates that escape everything; the look is that of a run's report."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    environment = Environment(
        loader=FileSystemLoader([_HERE, _REPORT]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False}
    return environment
