"""Charts of a run: residuals by pose, coverage of the workspace, path of the flange."""

from collections.abc import Mapping, Sequence, Set
from typing import Any

import numpy as np

from flangeye.models.workspace import LEAST_TURN, Coverage
from flangeye.workflow.report.look import LIGHT


def residual_chart(
    sizes: Mapping[str, float], aside: Mapping[str, str], limit: float | None = None
) -> dict[str, Any]:
    """Return a bar chart of the poses' errors [m] with the limit; unused poses are marked."""
    names = sorted({*sizes, *aside})
    bars = [round(1e3 * sizes[n], 4) if n in sizes else None for n in names]
    series: dict[str, Any] = {
        "type": "bar", "name": "mm", "data": bars, "color": LIGHT["verified"], "barMaxWidth": 60,
    }  # fmt: skip
    if limit is not None:
        line = {"yAxis": 1e3 * limit, "lineStyle": {"color": LIGHT["refused"]}}
        label = {"formatter": "limit", "color": LIGHT["axis"], "position": "insideEndTop"}
        series["markLine"] = {"symbol": "none", "data": [line], "label": label}
    crosses = [[n, 0] for n in sorted(aside)]
    marks = {
        "type": "scatter", "name": "set aside", "data": crosses, "color": LIGHT["refused"],
        "symbol": "diamond", "symbolSize": 12,
    }  # fmt: skip
    chart = bar_chart(names, [series, marks])
    chart["yAxis"]["axisLabel"] = {"color": LIGHT["axis"], "showMaxLabel": not limit}
    if limit:
        chart["yAxis"]["max"] = float(f"{1.1e3 * max(limit, *sizes.values()):.2g}")
    return chart


def bar_chart(names: Sequence[str], series: Sequence[Any]) -> dict[str, Any]:
    """Return bars [mm], a group for each name."""
    words = {"color": LIGHT["axis"]}
    return {
        "animation": False, "series": series, "tooltip": {"trigger": "axis"},
        "grid": {"left": 45, "right": 10, "top": 25, "bottom": 25},
        "xAxis": {"type": "category", "data": names, "axisLabel": words},
        "yAxis": {"type": "value", "name": "mm", "nameTextStyle": words, "axisLabel": words,
                  "splitLine": {"lineStyle": {"opacity": 0.3}}},
    }  # fmt: skip


def place_chart(places: Mapping[str, list[float]], aside: Set[str]) -> dict[str, Any]:
    """Return a chart of the flange's positions from above: used ones green, unused ones red."""
    axis = {"type": "value", "scale": True, "axisLabel": {"color": LIGHT["axis"]}}
    axis["splitLine"] = {"lineStyle": {"opacity": 0.3}}
    series = []
    for name, colour, wanted in (
        ("used", LIGHT["verified"], False),
        ("set aside", LIGHT["refused"], True),
    ):
        at = [[1e3 * p[0], 1e3 * p[1]] for k, p in places.items() if (k in aside) is wanted]
        series.append({"type": "scatter", "name": name, "data": at, "color": colour})
    grid = {"left": 50, "right": 10, "top": 10, "bottom": 30}
    return {"xAxis": axis, "yAxis": axis, "grid": grid, "series": series, "animation": False}


def coverage_drawing(found: Coverage) -> str:
    """Return an SVG: the workspace's cells, layer by layer from above, and the rotations."""
    layers = "".join(_layer(found, i) for i in range(3))
    turns = "".join(_turn(found, i) for i in range(3))
    return (
        f'<svg viewBox="0 0 360 118" width="100%" role="img" fill="currentColor" font-size="9" '
        f'style="max-width:30rem"><title>{found}</title>{layers}{turns}</svg>'
    )


def _layer(found: Coverage, z: int) -> str:
    """Return the cells of one height, base x to the right and y up."""
    cells, left = [], 4 + 82 * z
    for (x, y), count in np.ndenumerate(found.places[:, :, z]):
        at = f'x="{left + 24 * x}" y="{50 - 24 * y + 2}" width="22" height="22" rx="3"'
        cells.append(
            f'<rect {at} fill="{LIGHT["verified"]}" '
            f'fill-opacity="{min(0.25 + 0.2 * count, 1.0):.2f}"/>'
            f'<text x="{left + 24 * x + 11}" y="{50 - 24 * y + 16}" text-anchor="middle">{count}'
            "</text>"
            if count
            else f'<rect {at} fill="none" stroke="{LIGHT["axis"]}" stroke-dasharray="2 2"/>'
        )
    label = (
        f'<text x="{left + 35}" y="90" text-anchor="middle">{("low", "middle", "high")[z]}</text>'
    )
    return "".join(cells) + label


def _turn(found: Coverage, axis: int) -> str:
    """Return a bar to either side for the turns about one axis; 30 deg is its whole length."""
    y, middle = 10 + 26 * axis, 305
    parts = [f'<text x="{middle - 52}" y="{y + 4}">{"xyz"[axis]}</text>']
    for sign, size in zip((-1, 1), found.turns[axis], strict=True):
        length = min(float(np.degrees(size)), 30.0) * 40 / 30
        colour = LIGHT["verified"] if size >= LEAST_TURN else LIGHT["refused"]
        x = middle - length if sign < 0 else middle
        parts.append(
            f'<rect x="{x:.1f}" y="{y - 5}" width="{length:.1f}" height="10" fill="{colour}"/>'
        )
    parts.append(
        f'<line x1="{middle}" x2="{middle}" y1="{y - 8}" y2="{y + 8}" stroke="{LIGHT["axis"]}"/>'
    )
    label = f'<text x="{middle}" y="90" text-anchor="middle">turned about, ±30°</text>'
    return "".join(parts) + (label if axis == 2 else "")
