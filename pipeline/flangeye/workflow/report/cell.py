"""3D drawing of the calibrated cell: arm, camera, clouds and fitted circles."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Any, NamedTuple

import numpy as np

from flangeye import types as t
from flangeye.errors import FlangeyeError
from flangeye.maths.statistics import rms
from flangeye.models.cell import Cell
from flangeye.models.loading import load_model
from flangeye.types import Floats
from flangeye.types.geometry import basis_of_plane, each_applied
from flangeye.workflow.log.foxglove import circle_lines
from flangeye.workflow.recipe.cell import cell_of
from flangeye.workflow.recipe.context import body_of
from flangeye.workflow.recipe.header import CellSection, Header, TargetSection
from flangeye.workflow.recipe.own_models import carried_files
from flangeye.workflow.report.facts import Facts
from flangeye.workflow.report.look import SERIES
from flangeye.workflow.report.plot import (
    DIVERGING,
    Trace,
    box_edges,
    figure3d,
    frame,
    lines,
    packed,
    plain,
    points,
    scatter3d,
    thinned,
)
from flangeye.workflow.report.space import PlotlyFigure, in_words, mapped, target_centres
from flangeye.workflow.report.units import millimetres, percent

AXES_LENGTH = 0.2
"""Length of the axes of base and camera [m]."""


def cell_drawing(facts: Facts) -> PlotlyFigure | None:
    """Return a drawing of clouds, workspace and frames; None if a pose is missing.

    Of a camera on the flange and of cells it is in the base, with each capture at its camera's
    pose; static objects must then coincide. For a camera on a link, whose pose is not in the log,
    it is in the link's frame.
    """
    seen, found = facts.log.observations(), facts.estimate
    if facts.of_cell:
        cell = _cell_of(facts)
        places = {n: t.Transform.named(n, x.matrix) for n, x in facts.result.transforms.items()}
        if cell is None or not {*cell.unknowns} <= {*places}:
            return None
        return _from_each(facts, cell.ends(places, seen).camera, "the cell's base")
    carrier = found[0].partition("_T_")[0] if found else t.BASE
    pose = np.array(found[1].matrix) if found else None
    if carrier == t.FLANGE and pose is not None:
        poses = np.array([o.base_T_flange.matrix @ pose for o in seen])
        return _from_each(facts, poses, in_words(t.BASE)) if seen else None
    traces = target_centres(facts, carrier, pose, size=2.5)
    saw = "as the robot reports it" if carrier == t.BASE else "as the camera saw it"
    shown = [f"the {'flange' if carrier == t.BASE else 'target'}'s centre {saw}"] if traces else []
    if pose is not None:
        body = found_body(facts)
        drawn = [
            *_flanges(facts, pose),
            *_scans(facts, {o.id: pose for o in seen}, body and body.capture),
            *_circles(facts, pose),
            *_targets([pose @ m for m in _marker_poses(facts).values()]),
            *(_body(body, pose) if body else ()),
        ]
        traces += drawn
        shown += list(dict.fromkeys(str(x["name"]) for x in drawn))
    if not traces:
        return None
    if box := facts.result.workspace:
        edges = box_edges(np.array(box.centre), np.array(box.size))
        traces.append(lines(edges, SERIES["held_out"], 2, name="workspace"))
    traces += frame(np.eye(4), carrier, AXES_LENGTH)
    if pose is not None:
        traces += frame(pose, t.CAMERA, AXES_LENGTH)
    return _drawing(traces, shown, in_words(carrier))


def _cell_of(facts: Facts) -> Cell | None:
    """Return the cell of a run's recipe, with the user-defined models from the log.

    None if it cannot be read, for example from another version; the rest of the page is drawn.
    """
    with suppress(FlangeyeError, ValueError), carried_files(facts.log.models) as folder:
        section = CellSection.model_validate(facts.header.get("cell"))
        header = Header.model_construct(title="", steps=[], cell=section)
        return cell_of(header, partial(load_model, "robots", near=folder), lambda *_: None)
    return None


def _from_each(facts: Facts, poses: Floats, words: str) -> PlotlyFigure:
    """Return a drawing of what was seen from (N, 4, 4) camera poses, one for each observation."""
    seen, body = facts.log.observations(), found_body(facts)
    centres = each_applied(poses, np.array([o.feature.centre for o in seen]))
    by_camera, by_target = (_rows([getattr(o, end) for o in seen]) for end in ("camera", "target"))
    at = {o.id: pose for o, pose in zip(seen, poses, strict=True)}
    drawn = [
        *(
            points(poses[rows, :3, 3], SERIES["used"], 3, name=f"{plain(x, 40)} at every sighting")
            for x, rows in by_camera.items()
            if np.ptp(poses[rows, :3, 3], axis=0).max() > 0
        ),
        *(
            points(centres[rows], SERIES["circle"], 3, name=f"{plain(x, 40)} where it was seen")
            for x, rows in by_target.items()
        ),
        *_targets([at[k] @ m for k, m in _marker_poses(facts).items()]),
        *_scans(facts, at, body and body.capture),
        *(_body(body, at[body.capture]) if body else ()),
    ]
    first = {x: at[body.capture] if body else poses[rows[0]] for x, rows in by_camera.items()}
    axes = [trace for name, pose in first.items() for trace in frame(pose, name, AXES_LENGTH / 2)]
    shown = list(dict.fromkeys(str(x["name"]) for x in drawn))
    return _drawing([*drawn, *frame(np.eye(4), t.BASE, AXES_LENGTH), *axes], shown, words)


def _rows(names: list[str]) -> dict[str, list[int]]:
    """Return the indices at which each name occurs."""
    return {name: [i for i, each in enumerate(names) if each == name] for name in names}


def _drawing(traces: list[Trace], shown: list[str], words: str) -> PlotlyFigure:
    axes = "Axes are x red, y green, z blue."
    return PlotlyFigure(figure3d(traces), words, f"In {words}: {', '.join(shown)}. {axes}")


def _marker_poses(facts: Facts) -> dict[str, Floats]:
    """Return camera_T_target (4, 4) of each capture whose target has a whole pose."""
    return {
        o.id: o.feature.camera_T_target.matrix
        for o in facts.log.observations()
        if isinstance(o.feature, t.PoseFeature)
    }


def _targets(poses: list[Floats]) -> list[Trace]:
    """Return the axes of a target at every pose, small; the first axis names them."""
    # Of those of a marker, drawn at every pose [m]
    axes = [[np.stack([m[:3, 3], m[:3, 3] + 0.06 * m[:3, i]]) for m in poses] for i in range(3)]
    named = [
        lines(parts, SERIES[axis], 2, name="its axes", showlegend=i == 0)
        for i, (parts, axis) in enumerate(zip(axes, "xyz", strict=True))
    ]
    return named if poses else []


def _body(body: FoundBody, camera: Floats) -> list[Trace]:
    name = f"{plain(body.name, 40)} where it was found"
    return [lines(list(mapped(camera, body.edges)), SERIES["circle"], 2, name=name)]


class FoundBody(NamedTuple):
    """A body that is the target, as one capture showed it.

    Attributes:
        name: Shown in messages and reports.
        capture: Id of the capture.
        edges: (E, 2, 3) the ends of its edges in the camera [m].
    """

    name: str
    capture: str
    edges: Floats


def found_body(facts: Facts) -> FoundBody | None:
    """Return the body used as target, at its first detection; None without one.

    None too if it cannot be read, for example from another version; the rest of the page is drawn.
    """
    poses, found = _marker_poses(facts), {o.id: o for o in facts.log.observations()}
    section = facts.section("target")
    if not section.get("body") or not poses:
        return None
    capture, pose = next(iter(poses.items()))
    with suppress(FlangeyeError, ValueError), carried_files(facts.log.models) as folder:
        target = TargetSection.model_validate(section)
        model = facts.section("robot").get("model")
        robot = load_model("robots", model, folder) if model else None
        body = body_of(target, robot, folder).at(found[capture].joints)
        return FoundBody(body.name, capture, mapped(pose, body.edges(600)))
    return None


def _circles(facts: Facts, pose: Floats) -> list[Trace]:
    fitted = [e.value for e in facts.log.of_kind("fit") if isinstance(e.value, t.CircleFeature)]
    rings = [mapped(pose, line) for circle in fitted for line in circle_lines(circle, 36)]
    return [lines(rings, SERIES["circle"], 2, name="fitted circles")] if rings else []


def _flanges(facts: Facts, pose: Floats) -> list[Trace]:
    entries = [e.value for e in facts.log.of_kind("segment") if isinstance(e.value, t.FlangeCloud)]
    if not entries:
        return []
    each = max(1, 3_000 // len(entries))
    xyz = np.concatenate([thinned(flange.cloud.xyz, each) for flange in entries])
    name = "flange clouds" if entries[0].camera_T_target is None else "the body's clouds"
    return [points(mapped(pose, xyz), SERIES["used"], 1.5, name=name)]


def _scans(facts: Facts, at: Mapping[str, Floats], only: str | None) -> list[Trace]:
    """Return a scan of each camera, by default its first, to see its place in the cell.

    Args:
        facts: Facts of the run.
        at: (4, 4) pose of the camera at each observation.
        only: The capture to show.
    """
    found: dict[str, Trace] = {}
    cameras = len({o.camera for o in facts.log.observations()})
    for each in facts.log.captures():
        if each.id in at and only in (None, each.id):
            xyz = mapped(at[each.id], thinned(each.cloud.points(), 3_000))
            name = f"scan {plain(each.id, 40)}"
            found.setdefault(each.camera, points(xyz, SERIES["held_out"], 1.2, name=name))
            if len(found) == cameras or only:
                break
    return [trace for trace in found.values() if len(trace["xyz"])]


@dataclass(frozen=True)
class Panel:
    """One capture's cloud and fit.

    Attributes:
        id: Identifier of the capture.
        why: Why this one is shown.
        facts: Name and value, for the caption.
        figure: Plotly figure in the circle's own axes.
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
        """Points (N, 3) of the cloud in these axes, from the circle's centre [m]."""
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
    """Return every capture that has a flange cloud and a circle on its face.

    The axis of a round body has no circle, and the body no face.
    """
    log = facts.log
    flanges = {e.capture: e.value for e in log.of_kind("segment")}
    fits = []
    for entry in log.of_kind("fit"):
        flange, circle = flanges.get(entry.capture), entry.value
        if isinstance(flange, t.FlangeCloud) and isinstance(circle, t.CircleFeature):
            if circle.normal is None or not circle.radii or len(flange.cloud.xyz) == 0:
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
    return [lines(drawn, SERIES["circle"], 5, name="fitted circles and normal")]


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
