"""The error over the workspace, in the frame of the camera's pose."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.types import Floats
from flangeye.types.geometry import covariance_at
from flangeye.workflow.report.facts import Facts
from flangeye.workflow.report.look import SERIES
from flangeye.workflow.report.plot import (
    Trace,
    box_edges,
    figure3d,
    lines,
    packed,
    plain,
    round_up,
    scatter3d,
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
    # Root of the trace: the rms length of the error vector
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
    """Return true errors at points as lines, the lines' exaggeration, and the largest error."""
    truth, found = facts.result.truth, facts.estimate
    if truth is None or found is None:
        raise ValueError("there is no truth to compare with")
    name, estimate = found
    true = truth.transforms.get(name) or truth.base_T_camera
    error = np.array(estimate.matrix) @ np.linalg.inv(np.array(true))
    shift = mapped(error, grid) - grid
    # Along unobservable directions the estimate is arbitrary, and its error says nothing
    free = np.reshape(estimate.unobservable or [], (-1, 6))[:, 3:]
    shift = shift - shift @ free.T @ free
    largest = float(np.linalg.norm(shift, axis=1).max())
    # The longest comes to about a fifth of the distance between neighbours and box edge.
    scale = 0.5 * round_up(0.2 * max(extent, 0.05) / max(largest, 1e-9))
    segments = [np.stack([p, p + scale * d]) for p, d in zip(grid, shift, strict=True)]
    trace = lines(segments, SERIES["truth"], 4, name=f"true error × {scale:g}")
    return trace, scale, millimetres(largest)
