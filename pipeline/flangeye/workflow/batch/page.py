"""``summary.html``: all sessions side by side, in one self-contained file."""

import itertools
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any
from urllib.parse import quote

from flangeye.files.paths import VERSION, Storage
from flangeye.workflow import report as run_report
from flangeye.workflow.batch.dataset import Row
from flangeye.workflow.batch.progress import Tally
from flangeye.workflow.report.look import templates
from flangeye.workflow.report.page import packed_plotly
from flangeye.workflow.report.plot import layout2d
from flangeye.workflow.report.units import degrees, duration, millimetres

_HEADINGS: Mapping[str, str] = {
    "session": "Session",
    "archive": "Archive",
    "seed": "Seed",
    "status": "Status",
    "origin": "Origin",
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


PALETTE = (
    "#3a7ebf", "#d9822b", "#3f9b57", "#b8485f", "#7d62b5", "#8a6d3b", "#c06fa8", "#5b6474",
)  # fmt: skip
"""Colours, distinct on white and on black, for the values of a second varied parameter."""


@dataclass(frozen=True)
class TableCell:
    """One cell of the table.

    Attributes:
        text: Text shown.
        number: Value to sort by; None for text.
        link: Target of the cell's link; empty without one.
        kind: Kind of the column.
    """

    text: str
    number: float | None
    link: str | None
    kind: str


def write_page(tally: Tally, place: Storage) -> None:
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
    own, shared = Path(__file__).parent, Path(run_report.__file__).parent
    return templates(own, shared).get_template("summary.html.j2").render(
        title=tally.recipe,
        counts=[(s, n) for s, n in tally.counts.items() if n],
        total=tally.total,
        simulated=tally.simulated,
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
    """Return the row with the archives' common folder removed from its path."""
    if tally.common is None or row["archive"] is None:
        return row
    return row | {"archive": str(Path(row["archive"]).relative_to(tally.common))}


def _columns(tally: Tally) -> list[str]:
    """Return the non-empty columns in reading order."""
    order = ["session", "archive", *tally.varied, *list(_HEADINGS)[2:]]
    return [name for name in order if name in tally.told]


def _groups(tally: Tally) -> list[dict[str, Any]]:
    """Return one line for each repeated variant; empty without repetitions."""
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


Drawing = dict[str, Any]


@dataclass(frozen=True)
class Figure:
    """A column that is plotted.

    Attributes:
        column: Name of the column.
        title: Title of the plot.
        unit: Unit in which it is shown.
        scale: Factor from SI to that unit.
    """

    column: str
    title: str
    unit: str
    scale: float


def drawings_of(rows: Sequence[Row], varied: Sequence[str]) -> list[tuple[str, Drawing]]:
    """Return (title, plot) for every figure with values.

    Args:
        rows: Rows of the sessions to draw.
        varied: Columns that the grid sets.
    """
    x, colour = _axes(rows, varied)
    return [
        (figure.title, _drawing(with_it, figure, x, colour))
        for figure in (
            Figure("holdout_rms_m", "Held-out error, rms", "mm", 1e3),
            Figure("expected_p95_m", "Expected error, 95 %", "mm", 1e3),
            Figure("true_rms_m", "True error, rms", "mm", 1e3),
            Figure("seconds", "Time", "s", 1.0),
        )
        if (with_it := [row for row in rows if row[figure.column] is not None])
    ]


def _axes(rows: Sequence[Row], varied: Sequence[str]) -> tuple[str, str | None]:
    """Return the varied columns to plot: along the x axis and, if there is a second, by colour."""
    distinct = {name: len({row[name] for row in rows}) for name in (*varied, "archive")}
    varying = sorted((n for n in distinct if distinct[n] > 1), key=lambda n: -distinct[n])
    if not varying:
        return "seed", None
    second = varying[1] if len(varying) > 1 else None
    return varying[0], second if second and distinct[second] <= len(PALETTE) else None


def _drawing(rows: Sequence[Row], figure: Figure, x: str, colour: str | None) -> Drawing:
    places, unit = _places([row[x] for row in rows])
    groups: dict[str, list[int]] = {}
    for i, row in enumerate(rows):
        groups.setdefault(str(row[colour]) if colour else "", []).append(i)
    traces = []
    for (group, members), shade in zip(groups.items(), itertools.cycle(PALETTE), strict=False):
        at = [places[i] for i in members]
        y = [rows[i][figure.column] * figure.scale for i in members]
        names = [rows[i]["session"] for i in members]
        look = {
            "name": group,
            "marker": {"size": 6, "opacity": 0.6} | {"color": shade},
            "line": {"width": 2, "dash": "dot"} | {"color": shade},
        }
        drawn = [_points(at, y, names, figure.unit), *_medians(at, y)]
        traces += [trace | look for trace in drawn]
    label = _short(x) + (f" [{unit}]" if unit else "")
    return {"data": traces, "layout": _layout(label, unit is None, figure.unit, colour)}


def _layout(x: str, names: bool, y: str, colour: str | None) -> Drawing:
    layout = layout2d(x, y)
    layout["xaxis"] |= {"type": "category"} if names else {}
    layout["yaxis"]["rangemode"] = "tozero"
    layout["showlegend"] = colour is not None
    layout["legend"]["title"] = {"text": _short(colour or ""), "side": "top"}
    return layout


def _points(x: Sequence[Any], y: Sequence[float], names: Sequence[str], unit: str) -> Drawing:
    # From so many on, points are drawn by the graphics card
    return {
        "type": "scattergl" if len(x) > 2000 else "scatter",
        "mode": "markers",
        "x": list(x),
        "y": list(y),
        "text": list(names),
        "hovertemplate": f"%{{text}}<br>%{{x}}: %{{y:.4g}} {unit}<extra></extra>",
    }


def _medians(places: Sequence[Any], values: Sequence[float]) -> list[Drawing]:
    """Return a line through the medians, when places have several sessions each."""
    by_place: dict[Any, list[float]] = {}
    for place, value in zip(places, values, strict=True):
        by_place.setdefault(place, []).append(value)
    if len(by_place) < 2 or len(values) < 2 * len(by_place):
        return []
    ordered = sorted(by_place) if all(isinstance(p, float) for p in by_place) else list(by_place)
    return [
        {
            "type": "scatter", "mode": "lines", "x": ordered, "showlegend": False,
            "y": [median(by_place[place]) for place in ordered],
            "hovertemplate": "median %{y:.4g}<extra></extra>",
        }
    ]  # fmt: skip


def _places(values: Sequence[Any]) -> tuple[list[Any], str | None]:
    """Return values' positions on an axis, and its unit: None for names, "" for bare numbers."""
    matches = [
        re.fullmatch(r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S*)", str(value))
        for value in values
    ]
    found = [match.groups() for match in matches if match]
    units = {unit for _, unit in found}
    if len(found) < len(values) or len(units) != 1:
        return [str(value) for value in values], None
    return [float(number) for number, _ in found], units.pop()


def _short(path: str) -> str:
    """Return a path without the words that all have in common."""
    return re.sub(r"^steps\.", "step ", path)
