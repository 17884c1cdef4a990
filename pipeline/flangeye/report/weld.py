"""What the report shows of a weld: paths as in the paper's Fig. 13, deviations, contact, speeds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye.report.facts import Facts
from flangeye.report.plot import (
    CIRCLE,
    HELD_OUT,
    TRUTH,
    UNUSED,
    USED,
    Figure,
    curve,
    layout2d,
)
from flangeye.report.units import millimetres
from flangeye.types import Floats, WeldReport, WorkpieceScan

BANDS = {"seeking": "#8a8f98", "bridging": "#d98a00", "ending": "#3a7ebf", "stopped": "#d5451b"}
"""Colours of the controller's phases; following, the rule, has none."""


@dataclass(frozen=True)
class WeldDrawing:
    """The figures of one weld.

    Attributes:
        report: The weld.
        summary: In words.
        paths: In the plane of the work.
        offsets: From the plan, along it.
        deviation: Distance of the torch from the seam as felt, and in a simulation as it is.
        contact: Deflection over time, with the controller's phases.
        speeds: Over time.
        loop: How the loop kept time: name, value with unit.
    """

    report: WeldReport
    summary: str
    paths: Figure
    offsets: Figure
    deviation: Figure
    contact: Figure
    speeds: Figure
    loop: tuple[tuple[str, str], ...]


def weld_drawing(facts: Facts) -> WeldDrawing | None:
    """Return the figures of the run's weld, or None when it did not weld."""
    weld = facts.log.last(WeldReport)
    if weld is None or not len(weld.time):
        return None
    seen = _View(weld)
    return WeldDrawing(
        weld, _summary(facts, weld), _paths(seen), _offsets(seen), _deviation(seen, _truth(facts)),
        _contact(weld), _speeds(weld), tuple(_loop(weld)),
    )  # fmt: skip


class _View:
    """The paths in the plane: x along the plan as a whole, y to the left."""

    def __init__(self, weld: WeldReport) -> None:
        along = weld.planned[-1] - weld.planned[0]
        x = along - (along @ weld.opening) * weld.opening
        x /= np.linalg.norm(x)
        self._axes = np.stack([x, np.cross(weld.opening, x)], axis=1)
        self._origin = weld.planned[0]
        self.weld = weld
        self.planned = self.flat(weld.planned)

    def flat(self, points: Floats) -> Floats:
        """Return points (N, 3) in the plane, (N, 2) [m]."""
        return np.asarray((points - self._origin) @ self._axes)

    def off_plan(self, points: Floats) -> tuple[Floats, Floats]:
        """Return where along the plan points are, and how far to its left [m]."""
        return off_line(self.planned, self.flat(points))


def off_line(line: Floats, points: Floats) -> tuple[Floats, Floats]:
    """Return where along a line (M, 2) points (N, 2) are, and how far to its left [m].

    The line goes on straight beyond its ends.
    """
    start, step = line[:-1], np.diff(line, axis=0)
    length = np.linalg.norm(step, axis=1)
    unit = step / length[:, None]
    away = points[:, None] - start
    along = np.einsum("nmi,mi->nm", away, unit)
    inside = np.clip(along, 0.0, length)
    nearest = np.linalg.norm(away - inside[:, :, None] * unit, axis=2).argmin(axis=1)
    rows = np.arange(len(points))
    from_start, u = away[rows, nearest], unit[nearest]
    across = u[:, 0] * from_start[:, 1] - u[:, 1] * from_start[:, 0]
    before = np.concatenate([[0.0], np.cumsum(length)])[nearest]
    return before + along[rows, nearest], across


def _truth(facts: Facts) -> Floats | None:
    """Return the true seam (M, 3) of a simulation, where it has one."""
    scan = facts.log.last(WorkpieceScan)
    lines = list(scan.truth.values()) if scan else []
    return np.asarray(lines[0]) if len(lines) == 1 else None


def _summary(facts: Facts, weld: WeldReport) -> str:
    result = facts.result.weld
    text = f"Followed in mode {weld.mode} for {weld.time[-1]:.1f} s."
    if result and result.correction_rms is not None:
        text += f" The seam was felt {millimetres(result.correction_rms)} mm rms off the plan."
    if result and result.truth:
        text += (
            f" The torch was {millimetres(result.truth.rms)} mm rms off the true seam, "
            f"{millimetres(result.truth.max)} mm at most."
        )
    return text if weld.completed else f"{text} It was stopped: {weld.reason}."


def _paths(view: _View) -> Figure:
    weld = view.weld
    named: tuple[tuple[str, Floats, str, dict[str, Any]], ...] = (
        ("planned", weld.planned, HELD_OUT, {"dash": "dot"}),
        ("felt (refined)", weld.refined, TRUTH, {}),
        ("robot", weld.robot, UNUSED, {}),
        ("tip", weld.tip, USED, {}),
        ("torch", weld.torch, CIRCLE, {}),
    )
    traces = []
    for name, points, colour, rest in named:
        at = view.flat(points) * 1e3
        traces.append(curve(at[:, 0], at[:, 1], name, colour, **rest))
    layout = layout2d("along the seam [mm]", "across [mm]")
    layout["yaxis"]["scaleanchor"] = "x"
    return {"data": traces, "layout": layout}


def _offsets(view: _View) -> Figure:
    weld = view.weld
    traces = []
    for name, points, colour in (
        ("felt (refined)", weld.refined, TRUTH),
        ("tip", weld.tip, USED),
        ("torch", weld.torch, CIRCLE),
        ("robot", weld.robot, UNUSED),
    ):
        along, across = view.off_plan(points) if len(points) else (np.zeros(0), np.zeros(0))
        traces.append(curve(along * 1e3, across * 1e3, name, colour))
    layout = layout2d("along the plan [mm]", "left of the plan [mm]")
    return {"data": traces, "layout": layout}


def _deviation(view: _View, truth: Floats | None) -> Figure:
    """Show the torch as believed, with its 95 % band, and as it truly was, where that is known."""
    weld = view.weld
    true_torch = weld.true_torch if len(weld.true_torch) else weld.torch
    traces = []
    for name, line, torch, colour in (
        ("believed, from the seam as felt", weld.refined, weld.torch, CIRCLE),
        ("true, from the true seam", truth, true_torch, TRUTH),
    ):
        if line is not None and len(line) > 1:
            along, across, _ = _beside(view, line, torch)
            traces.append(curve(along * 1e3, across * 1e3, name, colour))
    if len(weld.refined) > 1 and len(weld.band) == len(weld.torch):
        along, _, beside = _beside(view, weld.refined, weld.torch)
        for sign, name in ((1.0, "95 % band"), (-1.0, "95 % band, right")):
            # A band that is wider is drawn so wide: it says that nothing is known [m]
            edge = sign * np.minimum(weld.band[beside], 5e-3) * 1e3
            traces.append(curve(along * 1e3, edge, name, UNUSED, dash="dot"))
    return {"data": traces, "layout": layout2d("along the seam [mm]", "torch to the left [mm]")}


def _beside(view: _View, line: Floats, torch: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return where a torch (N, 3) is along a seam and to its left [m], and the (N,) beside it."""
    seam = view.flat(line)
    length = float(np.linalg.norm(np.diff(seam, axis=0), axis=1).sum())
    along, across = off_line(seam, view.flat(torch))
    beside = (along >= 0.0) & (along <= length)
    return along[beside], across[beside], beside


def _contact(weld: WeldReport) -> Figure:
    traces = [
        curve(weld.time, weld.deflection * 1e3, "deflection", USED),
        curve(weld.time, weld.wanted * 1e3, "wanted", CIRCLE, dash="dot"),
    ]
    layout = layout2d("time [s]", "deflection [mm]")
    layout["shapes"] = [_band(*span) for span in _spans(weld) if span[2] in BANDS]
    layout["annotations"] = [_label(*span) for span in _spans(weld) if span[2] in BANDS]
    return {"data": traces, "layout": layout}


def _speeds(weld: WeldReport) -> Figure:
    traces = [
        curve(weld.time, weld.speed * 1e3, "robot [mm/s]", USED),
        curve(weld.time, np.degrees(weld.turn), "turning [deg/s]", CIRCLE),
    ]
    return {"data": traces, "layout": layout2d("time [s]", "mm/s, deg/s")}


def _spans(weld: WeldReport) -> list[tuple[float, float, str]]:
    """Return (start, end, phase) of each stretch of one phase [s]."""
    names = np.array(weld.phases)
    starts = np.flatnonzero(np.r_[True, names[1:] != names[:-1]])
    ends = np.r_[starts[1:], len(names) - 1]
    return [
        (float(weld.time[a]), float(weld.time[b]), str(names[a]))
        for a, b in zip(starts, ends, strict=True)
    ]


def _band(start: float, end: float, phase: str) -> dict[str, Any]:
    return {
        "type": "rect", "xref": "x", "yref": "paper", "x0": start, "x1": end, "y0": 0, "y1": 1,
        "fillcolor": BANDS[phase], "opacity": 0.18, "line": {"width": 0},
    }  # fmt: skip


def _label(start: float, end: float, phase: str) -> dict[str, Any]:
    return {"x": (start + end) / 2, "y": 1, "yref": "paper", "yanchor": "bottom", "text": phase,
            "showarrow": False}  # fmt: skip


def _loop(weld: WeldReport) -> list[tuple[str, str]]:
    """Return the loop's figures for people."""
    loop = weld.loop
    rows = [
        ("cycles", f"{loop.get('cycles', 0):.0f}"),
        ("computing, median", f"{loop.get('computing_median', 0) * 1e3:.2f} ms"),
        ("computing, 99 % below", f"{loop.get('computing_p99', 0) * 1e3:.2f} ms"),
        ("answering by the clock, median", f"{loop.get('answering_median', 0) * 1e3:.2f} ms"),
        ("answering by the clock, 99 % below", f"{loop.get('answering_p99', 0) * 1e3:.2f} ms"),
        ("period, median", f"{loop.get('period_median', 0) * 1e3:.2f} ms"),
        ("period, 99 % below", f"{loop.get('period_p99', 0) * 1e3:.2f} ms"),
        ("images read", f"{weld.figures.get('images', 0):.0f}"),
        ("with the tag", f"{weld.figures.get('images_with_tag', 0):.0f}"),
    ]
    return rows if loop else rows[-2:]
