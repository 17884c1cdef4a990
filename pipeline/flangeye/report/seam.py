"""The planned seam: on the cloud it was found in, inside its tube of uncertainty."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.maths.seam_geometry import distances_to_line, tube_radii, tube_rings
from flangeye.report.facts import Facts
from flangeye.report.plot import (
    CIRCLE,
    NEUTRAL,
    TRUTH,
    USED,
    Trace,
    curve,
    figure3d,
    lines,
    points,
    round_up,
    scatter3d,
    thinned,
)
from flangeye.report.units import millimetres
from flangeye.types import Floats

RINGS, WIDE = 60, 0.01
"""Circles of the tube, and roughly how wide the tube is drawn [m]."""


@dataclass(frozen=True)
class SeamView:
    """What the page shows of a seam.

    Attributes:
        space: The seam on the cloud, for plotly.
        profile: Its tube along its length, for plotly.
        summary: What it is, in words.
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
    true_seams = [lines(truth, TRUTH, 3, name="true seam")] if truth else []
    space = figure3d([*_cloud(seam), *_drawn(seam), *true_seams], eye=(0.9, -1.0, 1.1))
    return SeamView(space, _profile(seam, truth), summary, _facts(seam, facts))


def _cloud(seam: t.Seam) -> list[Trace]:
    if seam.cloud is None or not len(seam.cloud.points()):
        return []
    return [points(thinned(seam.cloud.points(), 8_000), NEUTRAL, 1.4, name="scan")]


def _drawn(seam: t.Seam) -> list[Trace]:
    line, openings = seam.points_in_base, seam.openings_in_base
    at = np.linspace(0, len(line) - 1, 9).round().astype(int)
    scale = 0.5 * round_up(WIDE / max(float(tube_radii(seam).max()), 1e-9))
    # Length of the lines that point at the torch [m]
    arrows = [np.stack([line[i], line[i] + 0.03 * openings[i]]) for i in at]
    return [
        lines(_widened(seam, scale), USED, 2, name=f"tube, 95 % × {scale:g}"),
        lines([line], CIRCLE, 5, name="planned seam"),
        lines(arrows, CIRCLE, 2, name="towards the torch"),
        scatter3d(
            line[:1], "markers", marker={"size": 5, "color": CIRCLE, "symbol": "diamond"},
            name="start",
        ),
    ]  # fmt: skip


def _widened(seam: t.Seam, scale: float) -> list[Floats]:
    """Return the tube's rings, drawn too wide: it would not be seen beside the part."""
    rings = tube_rings(seam, RINGS)
    middles = rings[:, :-1].mean(axis=1, keepdims=True)
    return list(middles + scale * (rings - middles))


def _profile(seam: t.Seam, truth: list[Floats]) -> dict[str, Any]:
    """Return the tube's radius along the seam, and the true error where it is known."""
    along = seam.arc_length * 1e3
    traces = [curve(along, tube_radii(seam) * 1e3, "tube, 95 %", USED, width=2)]
    if truth:
        errors = [distances_to_line(seam.points_in_base, line) for line in truth]
        nearest = min(errors, key=lambda each: float(each.max()))
        traces.append(curve(along, nearest * 1e3, "true error", TRUTH, width=2))
    layout = {
        "xaxis": {"title": {"text": "along the seam [mm]"}},
        "yaxis": {"title": {"text": "across it [mm]"}, "rangemode": "tozero"},
        "legend": {"orientation": "h", "x": 0, "y": 1, "yanchor": "bottom"},
        "margin": {"l": 60, "r": 10, "t": 10, "b": 50},
        "showlegend": True,
    }
    return {"data": traces, "layout": layout}


def _facts(seam: t.Seam, facts: Facts) -> list[tuple[str, str]]:
    rows = [("From", seam.source), ("Length", f"{millimetres(float(seam.arc_length[-1]))} mm")]
    if seam.half_angle is not None:
        rows.append(("Half angle of the groove", f"{np.degrees(seam.half_angle):.1f}°"))
    if seam.half_width is not None:
        rows.append(("Half width of the groove", f"{millimetres(seam.half_width)} mm"))
    rows += [(name, f"{value:.4g}") for name, value in seam.figures.items()]
    told = facts.result.seam
    if told and told.truth:
        error = f"{millimetres(told.truth.rms)} mm rms, {millimetres(told.truth.max)} mm at most"
        rows.append(("True error, of the simulation", error))
        rows.append(("Points whose tube holds the true seam", f"{told.truth.inside:.0%}"))
    return rows
