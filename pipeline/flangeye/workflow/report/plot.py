"""Plotly figures as plain data, without plotly's slow Python objects.

The page's script sets the theme: text, grid and background.
"""

from base64 import b64encode
from html import escape
from itertools import combinations, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.types import Floats
from flangeye.workflow.report.look import SERIES

Trace = dict[str, Any]
FigureData = dict[str, Any]

DIVERGING = [
    [0.0, "#2166ac"],
    [0.35, "#75a9d1"],
    [0.5, "#b9bdc2"],
    [0.65, "#e08a6d"],
    [1.0, "#b2182b"],
]
"""Colours from below the plane to above; the grey in the middle shows on white and on black."""


def packed(values: Any) -> dict[str, str]:
    """Return numbers as a float32 typed array: a third of the size of decimal text."""
    raw = np.ascontiguousarray(values, dtype="<f4")
    return {"dtype": "f4", "bdata": b64encode(raw.tobytes()).decode("ascii")}


def plain(text: str, width: int = 200) -> str:
    """Return text from data with plotly's markup escaped, and elided in the middle if long."""
    if len(text) > width:
        text = f"{text[: width // 2]}…{text[-(width // 2 - 1) :]}"
    return escape(text)


def scatter3d(metres: Any, mode: str, **rest: Any) -> Trace:
    """Return a 3D trace of (N, 3) positions [m], for :func:`figure3d`."""
    xyz = np.asarray(metres, dtype=np.float64).reshape(-1, 3)
    return {"type": "scatter3d", "mode": mode, "hoverinfo": "skip", "xyz": xyz, **rest}


def points(metres: Any, colour: Any, size: float, **rest: Any) -> Trace:
    """Return (N, 3) positions [m] as dots of one colour."""
    return scatter3d(metres, "markers", marker={"size": size, "color": colour}, **rest)


def lines(parts: list[Floats], colour: str, width: float, **rest: Any) -> Trace:
    """Return polylines (N, 3) [m] as one trace."""
    return scatter3d(joined(parts), "lines", line={"color": colour, "width": width}, **rest)


def joined(parts: list[Floats]) -> Floats:
    """Return polylines as one array, separated by rows of NaN, at which plotly breaks the line."""
    gap = np.full((1, 3), np.nan)
    rows = [row for part in parts for row in (np.asarray(part, dtype=np.float64), gap)]
    return np.concatenate(rows) if rows else np.zeros((0, 3))


def frame(matrix: Floats, name: str, length: float) -> list[Trace]:
    """Return the three axes of a frame at pose ``matrix`` (4, 4), with its name."""
    origin = matrix[:3, 3]
    axes = [
        lines([np.stack([origin, origin + length * along])], SERIES[axis], 6, showlegend=False)
        for axis, along in zip("xyz", matrix[:3, :3].T, strict=True)
    ]
    behind = origin - 0.25 * length * matrix[:3, 2]  # where no axis is
    label = scatter3d(
        behind, "text", text=[plain(name)], textposition="middle center", showlegend=False
    )
    return [*axes, label]


def box_edges(centre: Floats, size: Floats) -> list[Floats]:
    """Return the twelve edges (2, 3) of an axis-aligned box [m]."""
    signs = np.array(list(product([-0.5, 0.5], repeat=3)))
    pairs = [(a, b) for a, b in combinations(signs, 2) if np.count_nonzero(a != b) == 1]
    return [np.asarray(centre) + np.stack(pair) * np.asarray(size) for pair in pairs]


def figure3d(traces: list[Trace], eye: tuple[float, float, float] = (1.7, 0.92, 0.7)) -> FigureData:
    """Return a 3D figure of traces from :func:`scatter3d`, in mm, with equal scales.

    The ranges are set here, so that the longest side always fills the same part of the view:
    left to itself, plotly.js fixes the volume, and a tall scene grows out of the picture.
    """
    every = np.concatenate([trace["xyz"] for trace in traces]) * 1e3
    low, high = np.nanmin(every, axis=0), np.nanmax(every, axis=0)
    longest = max(float((high - low).max()), 1.0)
    half = np.maximum(0.54 * (high - low), 0.05 * longest)
    middle = 0.5 * (low + high)
    axes = {
        f"{axis}axis": {
            "title": {"text": f"{axis} [mm]"},
            "range": [float(middle[i] - half[i]), float(middle[i] + half[i])],
        }
        for i, axis in enumerate("xyz")
    }
    ratio = dict(zip("xyz", (1.25 * half / half.max()).tolist(), strict=True))
    # Looking at a place below the middle leaves room for the labels of the axes.
    camera = {"eye": dict(zip("xyz", eye, strict=True)), "center": {"x": 0, "y": 0, "z": -0.1}}
    legend = {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom", "itemsizing": "constant"}
    layout = {
        "scene": {"aspectmode": "manual", "aspectratio": ratio, "camera": camera, **axes},
        "margin": {"l": 0, "r": 0, "t": 0, "b": 0},
        "legend": legend,
    }
    return {"data": [_as_columns(trace) for trace in traces], "layout": layout}


def _as_columns(trace: Trace) -> Trace:
    # The only place where traces change from metres to millimetres
    columns = {axis: packed(trace["xyz"][:, i] * 1e3) for i, axis in enumerate("xyz")}
    return {**{key: value for key, value in trace.items() if key != "xyz"}, **columns}


def thinned(rows: NDArray[Any], limit: int) -> NDArray[Any]:
    """Return at most ``limit`` random rows; the choice is deterministic."""
    if len(rows) <= limit:
        return rows
    chosen = np.random.default_rng(0).choice(len(rows), limit, replace=False)
    return rows[np.sort(chosen)]


def round_up(value: float) -> float:
    """Return the next of 1, 2, 5, 10, … that is not below ``value`` > 0."""
    power = 10.0 ** np.floor(np.log10(value))
    # The factor absorbs rounding, or 2.0000001 would become 5
    return float(next(step * power for step in (1, 2, 5, 10) if step * power >= value * 0.999999))


def curve(x: Floats, y: Floats, name: str, colour: str, **line: Any) -> Trace:
    """Return a line through points (N,), (N,) of the plane."""
    drawn = {"color": colour, "width": 1.5, **line}
    trace = {"type": "scatter", "mode": "lines", "name": name, "line": drawn}
    return {**trace, "x": packed(x), "y": packed(y)}


def layout2d(x: str, y: str) -> dict[str, Any]:
    """Return the layout of a figure in the plane by the titles of its axes."""
    return {
        "xaxis": {"title": {"text": x}},
        "yaxis": {"title": {"text": y}, "automargin": True},
        "legend": {"orientation": "h", "x": 0, "y": 1.08, "yanchor": "bottom"},
        "margin": {"l": 56, "r": 8, "t": 24, "b": 44},
        "showlegend": True,
    }
