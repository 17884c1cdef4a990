"""Plots of a weld: paths as in the paper's Fig. 13, deviations, contact, speeds."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from flangeye import types as t
from flangeye.maths.seam_geometry import WeldPlane, distances_to_line, tube_radii, tube_rings
from flangeye.types import Floats, WeldReport, WorkpieceScan
from flangeye.types.geometry import arc_lengths
from flangeye.workflow.report.facts import Facts
from flangeye.workflow.report.look import SERIES
from flangeye.workflow.report.plot import (
    FigureData,
    Trace,
    curve,
    figure3d,
    layout2d,
    lines,
    points,
    round_up,
    scatter3d,
    thinned,
)
from flangeye.workflow.report.units import figure_name, millimetres

BANDS = {
    "seeking": SERIES["held_out"], "bridging": SERIES["unused"], "ending": SERIES["used"],
    "stopped": SERIES["circle"],
}  # fmt: skip
"""Colours of the controller's phases; following, the rule, has none."""


@dataclass(frozen=True)
class WeldDrawing:
    """The figures of one weld.

    Attributes:
        report: Report of the weld.
        summary: Text that describes the figures.
        paths: Paths in the plane of the work.
        offsets: Offsets from the plan, along the seam.
        deviation: Distance of the torch from the felt seam, and from the true one in a simulation.
        contact: Deflection over time, with the controller's phases.
        speeds: Speeds over time.
        loop: Timing of the control loop: name, value with unit.
    """

    report: WeldReport
    summary: str
    paths: FigureData
    offsets: FigureData
    deviation: FigureData
    contact: FigureData
    speeds: FigureData
    loop: tuple[tuple[str, str], ...]


def weld_drawing(facts: Facts) -> WeldDrawing | None:
    """Return the figures of the run's weld, or None when it did not weld."""
    weld = facts.log.last(WeldReport)
    if weld is None or not len(weld.time):
        return None
    plane = WeldPlane(weld.planned, weld.opening)
    return WeldDrawing(
        weld, _summary(facts, weld), _paths(weld, plane), _offsets(weld, plane),
        _deviation(weld, plane, _truth(facts)), _contact(weld), _speeds(weld), tuple(_loop(weld)),
    )  # fmt: skip


def _truth(facts: Facts) -> Floats | None:
    """Return the true seam (M, 3) of a simulation; empty without one."""
    scan = facts.log.last(WorkpieceScan)
    lines = list(scan.truth.values()) if scan else []
    return np.asarray(lines[0]) if len(lines) == 1 else None


def _summary(facts: Facts, weld: WeldReport) -> str:
    result = facts.result.weld
    text = f"Followed in mode {weld.mode} for {weld.time[-1]:.1f} s."
    if result and result.correction_rms is not None:
        text += f" The seam was measured {millimetres(result.correction_rms)} mm rms off the plan."
    if result and result.truth:
        text += (
            f" The torch was {millimetres(result.truth.rms)} mm rms off the true seam, "
            f"{millimetres(result.truth.max)} mm at most."
        )
    return text if weld.completed else f"{text} It was stopped: {weld.reason}."


def _measured(weld: WeldReport) -> tuple[tuple[str, Floats, str], ...]:
    """Return the names, places (N, 3) and colours of what was measured."""
    return (
        ("felt (refined)", weld.refined, SERIES["truth"]),
        ("robot", weld.robot, SERIES["unused"]),
        ("tip", weld.tip, SERIES["used"]),
        ("torch", weld.torch, SERIES["circle"]),
    )


def _paths(weld: WeldReport, plane: WeldPlane) -> FigureData:
    x, y = plane.flat(weld.planned).T * 1e3
    traces = [curve(x, y, "planned", SERIES["held_out"], dash="dot")]
    for name, places, colour in _measured(weld):
        x, y = plane.flat(places).T * 1e3
        traces.append(curve(x, y, name, colour))
    layout = layout2d("along the seam [mm]", "across [mm]")
    layout["yaxis"]["scaleanchor"] = "x"
    return {"data": traces, "layout": layout}


def _offsets(weld: WeldReport, plane: WeldPlane) -> FigureData:
    traces = []
    for name, places, colour in _measured(weld):
        beside = plane.beside(weld.planned, places) if len(places) else np.zeros((2, 0))
        along, across = np.multiply(beside, 1e3)
        traces.append(curve(along, across, name, colour))
    layout = layout2d("along the plan [mm]", "left of the plan [mm]")
    return {"data": traces, "layout": layout}


def _deviation(weld: WeldReport, plane: WeldPlane, truth: Floats | None) -> FigureData:
    """Return a plot of the estimated torch with its 95 % band, and the true one if known."""
    true_torch = weld.true_torch if len(weld.true_torch) else weld.torch
    traces = []
    for name, line, torch, colour in (
        ("estimated torch, from the estimated seam", weld.refined, weld.torch, SERIES["circle"]),
        ("true torch, from the true seam", truth, true_torch, SERIES["truth"]),
    ):
        if line is not None and len(line) > 1:
            along, across, _ = _beside(plane, line, torch)
            traces.append(curve(along * 1e3, across * 1e3, name, colour))
    if len(weld.refined) > 1 and len(weld.band) == len(weld.torch):
        along, _, beside = _beside(plane, weld.refined, weld.torch)
        for sign, name in ((1.0, "95 % band"), (-1.0, "95 % band, right")):
            # The band is drawn up to 5 mm to each side: a wider one means that nothing is known
            edge = sign * np.minimum(weld.band[beside], 5e-3) * 1e3
            traces.append(curve(along * 1e3, edge, name, SERIES["unused"], dash="dot"))
    return {"data": traces, "layout": layout2d("along the seam [mm]", "torch to the left [mm]")}


def _beside(
    plane: WeldPlane, line: Floats, torch: Floats
) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Return the torch's arc lengths and left offsets (N,) [m], and the mask beside the seam."""
    along, across = plane.beside(line, torch)
    beside = (along >= 0.0) & (along <= arc_lengths(plane.flat(line))[-1])
    return along[beside], across[beside], beside


def _contact(weld: WeldReport) -> FigureData:
    traces = [
        curve(weld.time, weld.deflection * 1e3, "deflection", SERIES["used"]),
        curve(weld.time, weld.wanted * 1e3, "wanted", SERIES["circle"], dash="dot"),
    ]
    layout = layout2d("time [s]", "deflection [mm]")
    layout["shapes"] = [_band(*span) for span in _spans(weld) if span[2] in BANDS]
    layout["annotations"] = [_label(*span) for span in _spans(weld) if span[2] in BANDS]
    return {"data": traces, "layout": layout}


def _speeds(weld: WeldReport) -> FigureData:
    traces = [
        curve(weld.time, weld.speed * 1e3, "robot [mm/s]", SERIES["used"]),
        curve(weld.time, np.degrees(weld.turn), "turning [deg/s]", SERIES["circle"]),
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
    """Return the loop's figures as text."""
    rows = [
        ("images read", f"{weld.figures.get('images', 0):.0f}"),
        ("with the tag", f"{weld.figures.get('images_with_tag', 0):.0f}"),
    ]
    if not weld.loop:
        return rows
    times = [
        (f"{words}, {share}", f"{weld.loop.get(f'{name}_{key}', 0) * 1e3:.2f} ms")
        for name, words in (
            ("computing", "computing"),
            ("answering", "cycle start to command sent"),
            ("period", "period"),
        )
        for key, share in (("median", "median"), ("p99", "99 % below"))
    ]
    return [("cycles", f"{weld.loop.get('cycles', 0):.0f}"), *times, *rows]


@dataclass(frozen=True)
class SeamView:
    """Content of the page about a seam.

    Attributes:
        space: The seam on the cloud, for plotly.
        profile: Its tube along its length, for plotly.
        summary: The figure's content in words.
        facts: Name and value.
    """

    space: dict[str, Any]
    profile: dict[str, Any]
    summary: str
    facts: list[tuple[str, str]]


def seam_view(facts: Facts) -> SeamView | None:
    """Return the view of the planned seam, if the run came so far."""
    seam = facts.log.last(t.Seam)
    if seam is None:
        return None
    scan = facts.log.last(t.WorkpieceScan)
    truth = list(scan.truth.values()) if scan else []
    widest = float(tube_radii(seam).max())
    summary = (
        f"{seam.source}: {millimetres(float(seam.arc_length[-1]))} mm long. With 95 % probability "
        f"the true seam passes within {millimetres(widest)} mm of every point of the plan: the "
        "registration and the hand-eye pose together."
    )
    true_seams = [lines(truth, SERIES["truth"], 3, name="true seam")] if truth else []
    space = figure3d([*_cloud(seam), *_drawn(seam), *true_seams], eye=(0.9, -1.0, 1.1))
    return SeamView(space, _profile(seam, truth), summary, _facts(seam, facts))


def _cloud(seam: t.Seam) -> list[Trace]:
    if seam.cloud is None or not len(seam.cloud.points()):
        return []
    return [points(thinned(seam.cloud.points(), 8_000), SERIES["held_out"], 1.4, name="scan")]


def _drawn(seam: t.Seam) -> list[Trace]:
    line, openings = seam.points_in_base, seam.openings_in_base
    at = np.linspace(0, len(line) - 1, 9).round().astype(int)
    # Roughly how wide the tube is drawn [m]
    scale = 0.5 * round_up(0.01 / max(float(tube_radii(seam).max()), 1e-9))
    # Length of the lines that point at the torch [m]
    arrows = [np.stack([line[i], line[i] + 0.03 * openings[i]]) for i in at]
    return [
        lines(_widened(seam, scale), SERIES["used"], 2, name=f"tube, 95 % × {scale:g}"),
        lines([line], SERIES["circle"], 5, name="planned seam"),
        lines(arrows, SERIES["circle"], 2, name="towards the torch"),
        scatter3d(
            line[:1], "markers", marker={"size": 5, "color": SERIES["circle"], "symbol": "diamond"},
            name="start",
        ),
    ]  # fmt: skip


def _widened(seam: t.Seam, scale: float) -> list[Floats]:
    """Return the tube's rings, exaggerated to be visible beside the part."""
    # Circles of the tube
    rings = tube_rings(seam, 60)
    middles = rings[:, :-1].mean(axis=1, keepdims=True)
    return list(middles + scale * (rings - middles))


def _profile(seam: t.Seam, truth: list[Floats]) -> dict[str, Any]:
    """Return a plot of the tube's radius along the seam, and the true error if known."""
    along = seam.arc_length * 1e3
    traces = [curve(along, tube_radii(seam) * 1e3, "tube, 95 %", SERIES["used"], width=2)]
    if truth:
        errors = [distances_to_line(seam.points_in_base, line) for line in truth]
        nearest = min(errors, key=lambda each: float(each.max()))
        traces.append(curve(along, nearest * 1e3, "true error", SERIES["truth"], width=2))
    layout = layout2d("along the seam [mm]", "across it [mm]")
    layout["yaxis"]["rangemode"] = "tozero"
    return {"data": traces, "layout": layout}


def _facts(seam: t.Seam, facts: Facts) -> list[tuple[str, str]]:
    rows = [("From", seam.source), ("Length", f"{millimetres(float(seam.arc_length[-1]))} mm")]
    if seam.half_angle is not None:
        rows.append(("Half angle of the groove", f"{np.degrees(seam.half_angle):.1f}°"))
    if seam.half_width is not None:
        rows.append(("Half width of the groove", f"{millimetres(seam.half_width)} mm"))
    rows += [_figure(name, value) for name, value in seam.figures.items()]
    told = facts.result.seam
    if told and told.truth:
        error = f"{millimetres(told.truth.rms)} mm rms, {millimetres(told.truth.max)} mm at most"
        rows.append(("True error, known in simulation", error))
        rows.append(
            ("Points at which the true seam is inside the stated tube", f"{told.truth.inside:.0%}")
        )
    return rows


def _figure(name: str, value: float) -> tuple[str, str]:
    """Return a figure in words, and its value with its unit; a plugin's own figure is in SI."""
    words, unit = {
        "seen": ("Visible share of the part's broadest side", "%"),
        "refuted": ("Share of the part that the scanner sees through", "%"),
        "second": ("Score of the second best pose, relative to the best", "%"),
        "explained": ("Share of points on the joint", "%"),
        "coverage": ("Visible share of the seam's length", "%"),
        "residual": ("Distance of the scan from the surface", "mm"),
        "registration": ("Line in the scan, one sigma", "mm"),
        "start": ("Start along the seam, one sigma", "mm"),
        "end": ("End along the seam, one sigma", "mm"),
        "apart": ("Distance between neighbouring clouds", "mm"),
        "points": ("Points on the surface", ""),
        "edges": ("Points on its edges", ""),
    }.get(name, (f"{figure_name(name)} (SI units)", ""))
    told = {"mm": f"{millimetres(value)} mm", "%": f"{value:.0%}"}
    return words, told.get(unit, f"{value:.4g}")
