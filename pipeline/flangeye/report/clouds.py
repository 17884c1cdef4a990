"""The segmented flange and the fitted circle, drawn for a few captures of interest."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.log.foxglove import circle_lines
from flangeye.maths.geometry import basis_of_plane
from flangeye.maths.statistics import rms
from flangeye.report.facts import Facts
from flangeye.report.plot import (
    CIRCLE,
    DIVERGING,
    Trace,
    figure3d,
    lines,
    packed,
    scatter3d,
    thinned,
)
from flangeye.report.units import millimetres, percent
from flangeye.types import Floats


@dataclass(frozen=True)
class Panel:
    """One capture's cloud and fit.

    Attributes:
        id: Identifier of the capture.
        why: Why this one is shown.
        facts: Name and value, for the caption.
        figure: For plotly, in the circle's own axes.
    """

    id: str
    why: str
    facts: list[tuple[str, str]]
    figure: dict[str, Any]


@dataclass(frozen=True)
class FittedFeature:
    """One capture's cloud, its circle, and (3, 3) the circle's axes, z along the normal."""

    id: str
    cloud: t.PointCloud
    circle: t.CircleFeature
    axes: Floats

    @cached_property
    def xyz(self) -> Floats:
        """(N, 3) the cloud in these axes, from the circle's centre [m]; few are asked for."""
        return (self.cloud.xyz.astype(np.float64) - self.circle.centre) @ self.axes.T

    @property
    def plane_rms(self) -> float:
        """Root mean square distance of the points from the fitted plane [m]."""
        return rms(self.xyz[:, 2])


def cloud_panels(facts: Facts) -> list[Panel]:
    """Return the captures with the smallest, the median and the largest error."""
    fits = fits_of(facts)
    residuals = facts.residuals
    if residuals:
        seen = [fit for fit in fits if fit.id in residuals]
        chosen = _telling(sorted(seen, key=lambda fit: residuals[fit.id]), "residual")
    else:
        ranked = sorted(fits, key=lambda fit: fit.plane_rms)
        chosen = _telling(ranked, "distance from the plane")
    if not chosen:
        return []
    limit = _colour_limit([fit for fit, _ in chosen])
    return [_panel(fit, why, limit, facts) for fit, why in chosen]


def _colour_limit(fits: list[FittedFeature]) -> float:
    """Return the distance [m] at the ends of the common colours.

    The median of the panels: one fit that is far off shows as plain colour and leaves the
    others readable.
    """
    extremes = [float(np.quantile(np.abs(fit.xyz[:, 2]), 0.98)) for fit in fits]
    return max(float(np.median(extremes)), 1e-5)


def fits_of(facts: Facts) -> list[FittedFeature]:
    """Return every capture that has both a flange cloud and a circle with a normal."""
    log = facts.log
    flanges = {e.capture: e.value for e in log.of_kind("segment")}
    fits = []
    for entry in log.of_kind("fit"):
        flange, circle = flanges.get(entry.capture), entry.value
        if isinstance(flange, t.FlangeCloud) and isinstance(circle, t.CircleFeature):
            if circle.normal is None or len(flange.cloud.xyz) == 0:
                continue
            axes = basis_of_plane(circle.normal)
            fits.append(FittedFeature(str(entry.capture), flange.cloud, circle, axes))
    return fits


def _telling(ranked: list[FittedFeature], name: str) -> list[tuple[FittedFeature, str]]:
    if not ranked:
        return []
    places = {0: f"smallest {name}", len(ranked) // 2: f"median {name}"}
    places[len(ranked) - 1] = f"largest {name}" if len(ranked) > 1 else "the only capture"
    return [(ranked[place], why) for place, why in sorted(places.items())]


def _panel(fit: FittedFeature, why: str, limit: float, facts: Facts) -> Panel:
    # Points of one panel; three panels and the cell together stay below 20,000
    shown = thinned(fit.xyz, 4_000)
    figure = figure3d([_cloud(shown, limit), *_fitted(fit)], eye=(1.1, -1.3, 1.3))
    figure["layout"]["showlegend"] = False
    figure["layout"]["scene"]["domain"] = {"y": [0.2, 1.0]}  # room for the colour bar
    return Panel(fit.id, why, _caption(fit, len(shown), facts), figure)


def _cloud(xyz: Floats, limit: float) -> Trace:
    bar = {
        "orientation": "h", "thickness": 8, "len": 0.8, "y": 0, "yanchor": "bottom",
        "title": {"text": "distance from the plane [mm]", "side": "bottom", "font": {"size": 12}},
        "tickfont": {"size": 11},
    }  # fmt: skip
    marker = {
        "size": 1.8, "color": packed(xyz[:, 2] * 1e3), "colorscale": DIVERGING,
        "cmin": -limit * 1e3, "cmax": limit * 1e3, "colorbar": bar,
    }  # fmt: skip
    return scatter3d(xyz, "markers", marker=marker, name="flange")


def _fitted(fit: FittedFeature) -> list[Trace]:
    drawn = [(line - fit.circle.centre) @ fit.axes.T for line in circle_lines(fit.circle)]
    return [lines(drawn, CIRCLE, 5, name="fitted circles and normal")]


def _caption(fit: FittedFeature, shown: int, facts: Facts) -> list[tuple[str, str]]:
    observation = next((o for o in facts.measured if o.id == fit.id), None)
    rows = []
    if fit.id in facts.residuals:
        used = "used" if observation and observation.used else "not used"
        rows.append(("Residual", f"{millimetres(facts.residuals[fit.id])} mm ({used})"))
    rows.append(("Points", f"{len(fit.xyz):,} ({shown:,} shown)".replace(",", "\u202f")))
    rows.append(("From the plane", f"{millimetres(fit.plane_rms)} mm rms"))
    rows += [(f"Radius, {name}", f"{millimetres(x)} mm") for name, x in fit.circle.radii.items()]
    return [*rows, ("Rim seen", percent(fit.circle.arc_coverage))]
