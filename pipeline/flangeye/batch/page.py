"""``summary.html``: all sessions side by side, in one file that needs nothing else."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from flangeye import report as run_report
from flangeye.batch.dataset import Row
from flangeye.batch.figures import drawings_of
from flangeye.batch.tally import Tally
from flangeye.files.bundled import VERSION
from flangeye.files.place import Place
from flangeye.report.look import css
from flangeye.report.page import packed_plotly
from flangeye.report.units import degrees, duration, millimetres

if TYPE_CHECKING:
    from jinja2 import Environment

_HERE = Path(__file__).parent
_REPORT = Path(run_report.__file__).parent

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
    "expected_rms_m": "Expected rms [mm]",
    "expected_p95_m": "Expected 95 % [mm]",
    "true_rms_m": "True rms [mm]",
    "true_centre_m": "True, centre [mm]",
    "true_rotation_rad": "True rotation [°]",
    "seconds": "Seconds",
}


@dataclass(frozen=True)
class TableCell:
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


def write_page(tally: Tally, place: Place) -> None:
    """Write the summary of a batch into its folder.

    Raises:
        StageError: The file cannot be written.
    """
    place.write("summary.html", render(tally).encode("utf-8", "replace"))


def render(tally: Tally) -> str:
    """Return the page as text."""
    shown = [_with_short_archive(row, tally) for row in tally.shown()]
    sample = [_with_short_archive(row, tally) for row in tally.sample]
    drawings = drawings_of(sample, tally.varied)
    return _environment().get_template("summary.html.j2").render(
        title=tally.recipe,
        counts=[(s, n) for s, n in tally.counts.items() if n],
        total=tally.total,
        headings=[(name, _HEADINGS.get(name, name)) for name in _columns(tally)],
        rows=[[_cell(row, name) for name in _columns(tally)] for row in shown],
        groups=_groups(tally),
        varied=tally.by(),
        drawings=drawings,
        seconds=duration(tally.seconds),
        plotly_js=packed_plotly() if drawings else "",
        version=VERSION,
    )  # fmt: skip


def _with_short_archive(row: Row, tally: Tally) -> Row:
    """Return the row with what archives have in common left out of its path."""
    if tally.common is None or row["archive"] is None:
        return row
    return row | {"archive": str(Path(row["archive"]).relative_to(tally.common))}


def _columns(tally: Tally) -> list[str]:
    """Return the columns that say anything, in the order people read them."""
    order = ["session", "archive", *tally.varied, *list(_HEADINGS)[2:]]
    return [name for name in order if name in tally.told]


def _groups(tally: Tally) -> list[dict[str, Any]]:
    """Return one line for each variant that was repeated; none where nothing was."""
    return [
        {
            "names": _with_short_archive(
                dict.fromkeys(["archive"]) | dict(zip(tally.by(), told.names, strict=True)), tally
            ),
            "n": sum(told.counts.values()),
            "counts": told.counts,
            **{n: "" if m is None else millimetres(m) for n, m in told.medians.items()},
        }
        for told in tally.variants()
    ]


def _cell(row: Row, name: str) -> TableCell:
    value = row[name]
    number = float(value) if isinstance(value, (int, float)) else None
    link = quote(row["report"]) if name == "session" and row["report"] else None
    return TableCell(_text(name, value), number, link, name)


def _text(name: str, value: Any) -> str:
    if value is None:
        return ""
    if name.endswith("_m") and isinstance(value, float):
        return millimetres(value)
    if name == "true_rotation_rad":
        return degrees(value)
    return f"{value:.2f}" if name == "seconds" else str(value)


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
    environment.globals["look"] = css
    environment.policies["json.dumps_kwargs"] = {"allow_nan": False}
    return environment
