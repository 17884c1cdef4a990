"""The two views of the whole cell: the error over the workspace, and everything in the base."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.foxglove import circle_lines
from flangeye.geometry import covariance_at
from flangeye.report.facts import Facts
from flangeye.report.plot import (
    CIRCLE,
    NEUTRAL,
    TRUTH,
    UNUSED,
    USED,
    Floats,
    Trace,
    box_edges,
    figure3d,
    frame,
    lines,
    packed,
    plain,
    points,
    round_up,
    scatter3d,
    thinned,
)
from flangeye.report.units import millimetres

FLANGE_POINTS = 3_000
SCAN_POINTS = 3_000
GRID = 5
"""Points along each edge of the workspace box."""


@dataclass(frozen=True)
class Drawing:
    """A figure for plotly and what it shows in words."""

    figure: dict[str, Any]
    summary: str


def workspace_drawing(facts: Facts) -> Drawing | None:
    """Return the error to expect at every place of the workspace, and the true one if known."""
    box, estimate = facts.result.workspace, facts.result.transforms.get("base_T_camera")
    if box is None or estimate is None:
        return None
    grid = t.Box(box.centre, box.size).grid(GRID)  # type: ignore[arg-type]
    covariances = covariance_at(np.array(estimate.covariance), np.array(estimate.about), grid)
    sigma = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    traces = [
        _predicted(grid, sigma),
        lines(box_edges(np.array(box.centre), np.array(box.size)), NEUTRAL, 2, name="workspace"),
        *_flange_centres(facts, size=4),
    ]
    low, high = millimetres(float(sigma.min())), millimetres(float(sigma.max()))
    summary = (
        f"Over the workspace box the error to expect (one standard deviation of the mapped point) "
        f"is {low} to {high} mm."
    )
    if facts.result.truth:
        arrows, scale, size = _true_errors(facts, grid, max(box.size))
        traces.append(arrows)
        summary += f" The true error, drawn {scale:g} times too long, is at most {size} mm there."
    return Drawing(figure3d(traces), summary)


def _predicted(grid: Floats, sigma: Floats) -> Trace:
    bar = {
        "title": {"text": "mm", "side": "top"},
        "thickness": 12,
        "len": 0.7,
        "tickformat": ".3~f",
    }
    marker = {
        "size": 5, "color": packed(sigma * 1e3), "colorscale": "Viridis", "colorbar": bar,
    }  # fmt: skip
    return scatter3d(
        grid, "markers", marker=marker, name="predicted error", hoverinfo="text",
        hovertext=[f"predicted {millimetres(float(s))} mm" for s in sigma],
    )  # fmt: skip


def _flange_centres(facts: Facts, size: float) -> list[Trace]:
    groups = []
    unused = "flange, not used" if facts.estimate else "flange"
    for used, colour, name in ((True, CIRCLE, "flange, used"), (False, UNUSED, unused)):
        group = [o for o in facts.measured if o.used is used and o.tcp_in_base]
        if group:
            at = np.array([o.tcp_in_base for o in group])
            label = [plain(o.id, 60) for o in group]
            marker = {"size": size, "color": colour, "symbol": "diamond"}
            groups.append(
                scatter3d(
                    at, "markers", marker=marker, hoverinfo="text", hovertext=label, name=name
                )
            )
    return groups


def _true_errors(facts: Facts, grid: Floats, extent: float) -> tuple[Trace, float, str]:
    """Return the true error at each point as lines, how much too long, and the largest."""
    truth, estimate = facts.result.truth, facts.base_T_camera
    if truth is None or estimate is None:
        raise ValueError("there is no truth to compare with")
    error = estimate @ np.linalg.inv(np.array(truth.base_T_camera))
    shift = grid @ error[:3, :3].T + error[:3, 3] - grid
    largest = float(np.linalg.norm(shift, axis=1).max())
    # The longest comes to about a fifth of the distance between neighbours and box edge.
    scale = 0.5 * round_up(0.2 * max(extent, 0.05) / max(largest, 1e-9))
    segments = [np.stack([p, p + scale * d]) for p, d in zip(grid, shift, strict=True)]
    trace = lines(segments, TRUTH, 4, name=f"true error × {scale:g}")
    return trace, scale, millimetres(largest)


def cell_drawing(facts: Facts) -> Drawing | None:
    """Return the flanges, the first scan, the workspace and both frames, all in the base."""
    traces = _flange_centres(facts, size=2.5)
    shown = ["the flange's centre as the robot reports it"] if traces else []
    pose = facts.base_T_camera
    if pose is not None:
        circles = _circles(facts, pose)
        clouds = _flanges(facts, pose) + _first_scan(facts, pose)
        traces += [*clouds, *circles]
        shown += [str(x["name"]) for x in clouds + circles]
    if not traces:
        return None
    if box := facts.result.workspace:
        edges = box_edges(np.array(box.centre), np.array(box.size))
        traces.append(lines(edges, NEUTRAL, 2, name="workspace"))
    traces += frame(np.eye(4), t.BASE, 0.2)
    if pose is not None:
        traces += frame(pose, t.CAMERA, 0.2)
    axes = "Axes are 200 mm long, x red, y green, z blue."
    summary = f"In the robot's base: {', '.join(shown)}. {axes}"
    return Drawing(figure3d(traces), summary)


def _circles(facts: Facts, pose: Floats) -> list[Trace]:
    fitted = [e.value for e in facts.log.of_kind("fit") if isinstance(e.value, t.CircleFeature)]
    rings = [_mapped(pose, line) for circle in fitted for line in circle_lines(circle, 36)]
    return [lines(rings, CIRCLE, 2, name="fitted circles")] if rings else []


def _flanges(facts: Facts, pose: Floats) -> list[Trace]:
    entries = [e.value for e in facts.log.of_kind("segment") if isinstance(e.value, t.FlangeCloud)]
    if not entries:
        return []
    each = max(1, FLANGE_POINTS // len(entries))
    xyz = np.concatenate([thinned(flange.cloud.xyz, each) for flange in entries])
    return [points(_mapped(pose, xyz), USED, 1.5, name="flange clouds")]


def _first_scan(facts: Facts, pose: Floats) -> list[Trace]:
    """Return the first scan, thinned: the arm must be where the arm is, the table level."""
    first = next(facts.log.captures(), None)
    if first is None:
        return []
    xyz = thinned(first.cloud.points(), SCAN_POINTS)
    name = f"scan {plain(first.id, 40)}"
    return [points(_mapped(pose, xyz), NEUTRAL, 1.2, name=name)] if len(xyz) else []


def _mapped(pose: Floats, xyz: Any) -> Floats:
    return np.asarray(np.asarray(xyz, dtype=np.float64) @ pose[:3, :3].T + pose[:3, 3])
