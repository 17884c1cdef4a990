"""The error over the workspace, and cells of many cameras and targets, each in its root frame."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.errors import FlangeyeError
from flangeye.models.cell import Cell
from flangeye.models.configuration import Ends
from flangeye.models.loading import load_model
from flangeye.types import BASE, Floats, Observation, Transform
from flangeye.types.geometry import covariance_at, each_applied
from flangeye.workflow.recipe.cell import cell_of
from flangeye.workflow.recipe.header import CellSection, Header
from flangeye.workflow.recipe.own_models import carried_files
from flangeye.workflow.report.facts import Facts
from flangeye.workflow.report.look import SERIES
from flangeye.workflow.report.plot import (
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
from flangeye.workflow.report.units import millimetres


@dataclass(frozen=True)
class PlotlyFigure:
    """A plotly figure, its frame, and a summary in words."""

    figure: dict[str, Any]
    frame: str
    summary: str


def workspace_drawing(facts: Facts) -> PlotlyFigure | None:
    """Return the error to expect at every place of the workspace, and the true one if known."""
    box, found = facts.result.workspace, facts.estimate
    if box is None or found is None:
        return None
    name, estimate = found
    frame = name.partition("_T_")[0]
    # Points along each edge of the workspace box
    grid = t.Box(box.centre, box.size).grid(5)  # type: ignore[arg-type]
    covariances = covariance_at(np.array(estimate.covariance), np.array(estimate.about), grid)
    sigma = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    traces = [
        _predicted(grid, sigma),
        lines(
            box_edges(np.array(box.centre), np.array(box.size)),
            SERIES["held_out"],
            2,
            name="workspace",
        ),
        *target_centres(facts, frame, np.array(estimate.matrix), size=4),
    ]
    low, high = millimetres(float(sigma.min())), millimetres(float(sigma.max()))
    summary = (
        f"Over the workspace box it is {low} to {high} mm (one standard deviation); the expected "
        "error at the work includes arm and scan as well."
    )
    if facts.result.truth:
        arrows, scale, size = _true_errors(facts, grid, max(box.size))
        traces.append(arrows)
        summary += f" The true error, drawn {scale:g} times as long, is at most {size} mm there."
    return PlotlyFigure(figure3d(traces), in_words(frame), summary)


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
        grid, "markers", marker=marker, name="pose alone", hoverinfo="text",
        hovertext=[f"predicted {millimetres(float(s))} mm" for s in sigma],
    )  # fmt: skip


def in_words(frame: str) -> str:
    """Return a frame's name as the report writes it."""
    return "the robot's base" if frame == t.BASE else f"the frame {frame}"


def target_centres(facts: Facts, frame: str, pose: Floats | None, size: float) -> list[Trace]:
    """Return the target's positions, used and unused ones separately.

    In the base they are the reported flange positions, in other frames those measured by the
    camera.

    Args:
        facts: Facts of the run.
        frame: Frame of the drawing.
        pose: (4, 4) pose of the camera in it.
        size: Diameter of the symbols.
    """
    what = "flange" if frame == t.BASE else "target"
    groups = []
    unused = f"{what}, not used" if facts.estimate else what
    for used, colour, name in (
        (True, SERIES["circle"], f"{what}, used"),
        (False, SERIES["unused"], unused),
    ):
        group = [o for o in facts.measured if o.used is used and o.tcp_in_base]
        if not group:
            continue
        at = np.array([o.tcp_in_base for o in group])
        if frame != t.BASE and pose is not None:
            at = mapped(pose, [o.centre_in_camera for o in group])
        label = [plain(o.id, 60) for o in group]
        marker = {"size": size, "color": colour, "symbol": "diamond"}
        groups.append(
            scatter3d(at, "markers", marker=marker, hoverinfo="text", hovertext=label, name=name)
        )
    return groups


def mapped(pose: Floats, xyz: Any) -> Floats:
    """Return positions (..., 3) in the parent of a (4, 4) pose."""
    return np.asarray(np.asarray(xyz, dtype=np.float64) @ pose[:3, :3].T + pose[:3, 3])


def _true_errors(facts: Facts, grid: Floats, extent: float) -> tuple[Trace, float, str]:
    """Return the true error at each point as lines, how much too long, and the largest."""
    truth, found = facts.result.truth, facts.estimate
    if truth is None or found is None:
        raise ValueError("there is no truth to compare with")
    name, estimate = found
    true = truth.transforms.get(name) or truth.base_T_camera
    error = np.array(estimate.matrix) @ np.linalg.inv(np.array(true))
    shift = mapped(error, grid) - grid
    free = np.reshape(estimate.unobservable or [], (-1, 6))[:, 3:]
    shift = shift - shift @ free.T @ free
    largest = float(np.linalg.norm(shift, axis=1).max())
    # The longest comes to about a fifth of the distance between neighbours and box edge.
    scale = 0.5 * round_up(0.2 * max(extent, 0.05) / max(largest, 1e-9))
    segments = [np.stack([p, p + scale * d]) for p, d in zip(grid, shift, strict=True)]
    trace = lines(segments, SERIES["truth"], 4, name=f"true error × {scale:g}")
    return trace, scale, millimetres(largest)


def graph_drawing(facts: Facts) -> PlotlyFigure | None:
    """Return a drawing of camera poses and sighted targets; None if a pose is missing."""
    cell, seen = _cell_of(facts), facts.log.observations()
    found = {name: Transform.named(name, x.matrix) for name, x in facts.result.transforms.items()}
    if cell is None or not seen or not {*cell.unknowns} <= {*found}:
        return None
    ends = cell.ends(found, seen)
    drawn = [*_cameras(cell, seen, ends), *_targets(cell, seen, ends), *_scans(facts, seen, ends)]
    shown = ", ".join(str(trace["name"]) for trace in drawn)
    axes = 0.2  # length of the axes of the root and of cameras [m]
    traces = [*drawn, *frame(np.eye(4), BASE, axes)]
    for camera in cell.cameras:
        traces += [t for pose in _of(camera, seen, ends)[:1] for t in frame(pose, camera, axes / 2)]
    words = "the cell's base"
    summary = (
        f"In {words}: {shown}. Axes are x red, y green, z blue, of cameras at their first sighting."
    )
    return PlotlyFigure(figure3d(traces), words, summary)


def _cell_of(facts: Facts) -> Cell | None:
    """Return the cell of a run's recipe, with the user-defined models from the log.

    None if it cannot be read, for example from another version; the rest of the page is drawn.
    """
    with suppress(FlangeyeError, ValueError), carried_files(facts.log.models) as folder:
        section = CellSection.model_validate(facts.header.get("cell"))
        header = Header.model_construct(title="", steps=[], cell=section)
        return cell_of(header, partial(load_model, "robots", near=folder), lambda *_: None)
    return None


def _of(camera: str, seen: Sequence[Observation], ends: Ends) -> Floats:
    """Return a camera's poses (N, 4, 4) at its observations."""
    return ends.camera[[o.camera == camera for o in seen]]


def _cameras(cell: Cell, seen: Sequence[Observation], ends: Ends) -> list[Trace]:
    at = {camera: _of(camera, seen, ends)[:, :3, 3] for camera in cell.cameras}
    return [
        points(places, SERIES["used"], 3, name=f"{plain(camera, 40)} at every sighting")
        for camera, places in at.items()
        if len(places) and np.ptp(places, axis=0).max() > 0
    ]


def _targets(cell: Cell, seen: Sequence[Observation], ends: Ends) -> list[Trace]:
    centres = each_applied(ends.camera, np.array([o.feature.centre for o in seen]))
    at = {target: centres[[o.target == target for o in seen]] for target in cell.targets}
    return [
        points(places, SERIES["circle"], 3, name=f"{plain(target, 40)} where it was seen")
        for target, places in at.items()
        if len(places)
    ]


def _scans(facts: Facts, seen: Sequence[Observation], ends: Ends) -> list[Trace]:
    """Return the first scan of each camera, thinned."""
    at = {o.id: pose for o, pose in zip(seen, ends.camera, strict=True)}
    first: dict[str, Trace] = {}
    for capture in facts.log.captures():
        if capture.id in at and capture.camera not in first:
            # Of a scan that is drawn
            xyz = mapped(at[capture.id], thinned(capture.cloud.points(), 3_000))
            name = f"scan {plain(capture.id, 40)}"
            first[capture.camera] = points(xyz, SERIES["held_out"], 1.2, name=name)
    return [*first.values()]
