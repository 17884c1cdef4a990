"""Small plots that compare sessions: one for each figure, over what was varied."""

from __future__ import annotations

import itertools
import re
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import Any

from flangeye.batch.dataset import Row

Drawing = dict[str, Any]

COLOURS = (
    "#3a7ebf", "#d9822b", "#3f9b57", "#b8485f", "#7d62b5", "#8a6d3b", "#c06fa8", "#5b6474",
)  # fmt: skip
"""Told apart on white and on black; a second thing that varies has at most so many values."""

MARKER = {"size": 6, "opacity": 0.6}
LINE = {"width": 2, "dash": "dot"}

_QUANTITY = re.compile(r"([-+]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][-+]?\d+)?)\s*(\S*)")


@dataclass(frozen=True)
class Figure:
    """A column worth a plot.

    Attributes:
        column: Its name.
        title: For people.
        unit: What it is shown in.
        scale: From SI to that unit.
    """

    column: str
    title: str
    unit: str
    scale: float


FIGURES = (
    Figure("holdout_rms_m", "Held-out error, rms", "mm", 1e3),
    Figure("expected_p95_m", "Expected error, 95 %", "mm", 1e3),
    Figure("true_rms_m", "True error, rms", "mm", 1e3),
    Figure("seconds", "Time", "s", 1.0),
)


def drawings_of(rows: Sequence[Row], varied: Sequence[str]) -> list[tuple[str, Drawing]]:
    """Return (title, plot) for every figure that some session has.

    Args:
        rows: Of the sessions to draw.
        varied: Columns that the grid sets.
    """
    x, colour = _axes(rows, varied)
    return [
        (figure.title, _drawing(with_it, figure, x, colour))
        for figure in FIGURES
        if (with_it := [row for row in rows if row[figure.column] is not None])
    ]


def _axes(rows: Sequence[Row], varied: Sequence[str]) -> tuple[str, str | None]:
    """Return the columns that say where a session stands and, if there is a second, its colour."""
    distinct = {name: len({row[name] for row in rows}) for name in (*varied, "archive")}
    varying = sorted((n for n in distinct if distinct[n] > 1), key=lambda n: -distinct[n])
    if not varying:
        return "seed", None
    second = varying[1] if len(varying) > 1 else None
    return varying[0], second if second and distinct[second] <= len(COLOURS) else None


def _drawing(rows: Sequence[Row], figure: Figure, x: str, colour: str | None) -> Drawing:
    places, unit = _places([row[x] for row in rows])
    groups: dict[str, list[int]] = {}
    for i, row in enumerate(rows):
        groups.setdefault(str(row[colour]) if colour else "", []).append(i)
    traces = []
    for (group, members), shade in zip(groups.items(), itertools.cycle(COLOURS), strict=False):
        at = [places[i] for i in members]
        y = [rows[i][figure.column] * figure.scale for i in members]
        names = [rows[i]["session"] for i in members]
        look = {"name": group, "marker": MARKER | {"color": shade}, "line": LINE | {"color": shade}}
        drawn = [_points(at, y, names, figure.unit), *_medians(at, y)]
        traces += [trace | look for trace in drawn]
    label = _short(x) + (f" [{unit}]" if unit else "")
    return {"data": traces, "layout": _layout(label, unit is None, figure.unit, colour)}


def _layout(x: str, names: bool, y: str, colour: str | None) -> Drawing:
    return {
        "xaxis": {"title": {"text": x}} | ({"type": "category"} if names else {}),
        "yaxis": {"title": {"text": y}, "rangemode": "tozero"},
        "margin": {"l": 55, "r": 10, "t": 10, "b": 50},
        "showlegend": colour is not None,
        "legend": {
            "orientation": "h", "yanchor": "bottom", "y": 1.02, "x": 0,
            "title": {"text": _short(colour or ""), "side": "top"},
        },
    }  # fmt: skip


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
    """Return where values stand on an axis, and its unit; None for names, "" for bare numbers."""
    matches = [_QUANTITY.fullmatch(str(value)) for value in values]
    found = [match.groups() for match in matches if match]
    units = {unit for _, unit in found}
    if len(found) < len(values) or len(units) != 1:
        return [str(value) for value in values], None
    return [float(number) for number, _ in found], units.pop()


def _short(path: str) -> str:
    """Return a path without the words that all have in common."""
    return re.sub(r"^steps\.", "step ", path)
