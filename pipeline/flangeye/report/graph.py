"""A cell of many cameras and targets as its calibration has it, in the root of its frames."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from functools import partial

import numpy as np

from flangeye.errors import FlangeyeError
from flangeye.files.yaml_lines import parse_yaml
from flangeye.log.read import RunLog
from flangeye.maths.geometry import each_applied
from flangeye.models.cell import Cell
from flangeye.models.configuration import Ends
from flangeye.models.loading import load_model
from flangeye.recipe.cell import cell_of
from flangeye.recipe.header import CellSection, Header
from flangeye.recipe.own_models import carried_files
from flangeye.report.facts import Facts
from flangeye.report.plot import (
    CIRCLE,
    NEUTRAL,
    USED,
    Trace,
    figure3d,
    frame,
    plain,
    points,
    thinned,
)
from flangeye.report.space import PlotlyFigure, mapped
from flangeye.types import BASE, Floats, Observation, Transform


def graph_drawing(facts: Facts) -> PlotlyFigure | None:
    """Return where cameras were, and where they saw targets; None where not all of it was found."""
    cell, seen = _cell_of(facts.log, facts.recipe), facts.log.observations()
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


def _cell_of(log: RunLog, recipe: str) -> Cell | None:
    """Return the cell of a run's recipe, with the models of its own that the log carries.

    None where it cannot be read here, as one of another version: the rest of the page stands.
    """
    with suppress(FlangeyeError, ValueError), carried_files(log.models) as folder:
        data = parse_yaml(recipe, "recipe").data or {}
        section = CellSection.model_validate(data.get("cell"))
        header = Header.model_construct(title="", steps=[], cell=section)
        return cell_of(header, partial(load_model, "robots", near=folder), lambda *_: None)
    return None


def _of(camera: str, seen: Sequence[Observation], ends: Ends) -> Floats:
    """Return (N, 4, 4) where a camera was at what it saw."""
    return ends.camera[[o.camera == camera for o in seen]]


def _cameras(cell: Cell, seen: Sequence[Observation], ends: Ends) -> list[Trace]:
    at = {camera: _of(camera, seen, ends)[:, :3, 3] for camera in cell.cameras}
    return [
        points(places, USED, 3, name=f"{plain(camera, 40)} at every sighting")
        for camera, places in at.items()
        if len(places) and np.ptp(places, axis=0).max() > 0
    ]


def _targets(cell: Cell, seen: Sequence[Observation], ends: Ends) -> list[Trace]:
    centres = each_applied(ends.camera, np.array([o.feature.centre for o in seen]))
    at = {target: centres[[o.target == target for o in seen]] for target in cell.targets}
    return [
        points(places, CIRCLE, 3, name=f"{plain(target, 40)} where it was seen")
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
            first[capture.camera] = points(xyz, NEUTRAL, 1.2, name=name)
    return [*first.values()]
