"""Put the page together: sections and figures into the template, plotly.js and all inside."""

import os
from base64 import b64encode
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from flangeye import types as t
from flangeye.errors import StageError
from flangeye.files.paths import VERSION
from flangeye.files.regular import write_whole
from flangeye.maths.statistics import rms
from flangeye.types import Floats
from flangeye.workflow.log.read import JournalEntry, RunLog, read_notes
from flangeye.workflow.report.cell import cell_drawing, cloud_panels
from flangeye.workflow.report.facts import (
    Facts,
    facts_of,
    idle_of,
    provenance_of,
    set_aside_of,
    timings_of,
)
from flangeye.workflow.report.look import LOGO, SERIES, templates
from flangeye.workflow.report.plot import FigureData, layout2d, plain, round_up
from flangeye.workflow.report.residuals import errors_of, residual_figure
from flangeye.workflow.report.space import workspace_drawing
from flangeye.workflow.report.still import scene_of, still
from flangeye.workflow.report.summary import (
    TransformText,
    banner_of,
    evidence_of,
    next_steps_of,
    tiles_of,
    transform_text,
)
from flangeye.workflow.report.units import degrees, figure, figure_name, millimetres, percent
from flangeye.workflow.report.weld import seam_view, weld_drawing


def write_report(log: RunLog, path: Path, library: Path | None = None) -> None:
    """Write the report of a run, finished or not, as one self-contained HTML file.

    Args:
        log: The log from :func:`flangeye.workflow.log.read.read_run`.
        path: Path of the file to write.
        library: Path of a copy of plotly.js shared by several reports, written if missing; None
            embeds a copy in the page.

    Raises:
        StageError: The file cannot be written.
    """
    shared = None if library is None else os.path.relpath(library, path.parent)
    if library is not None and not library.exists():
        write_whole(library, plotly_js())
    write_whole(path, render(log, shared))


def render(log: RunLog, library: str | None = None) -> str:
    """Return the page as text; see :func:`write_report`."""
    content = _content(facts_of(log))
    content |= {"library": library, "plotly_js": "" if library else packed_plotly()}
    environment = templates(Path(__file__).parent)
    environment.filters |= {"mm": millimetres, "deg": degrees, "percent": percent}
    environment.filters |= {"figure": figure, "words": figure_name}
    return environment.get_template("report.html.j2").render(content)


def plotly_js() -> bytes:
    """Return the installed plotly.js as text."""
    import plotly

    return (Path(plotly.__file__).parent / "package_data" / "plotly.min.js").read_bytes()


@cache
def packed_plotly() -> str:
    """Return plotly.js for a page, gzip in base64: the page unpacks it."""
    import gzip

    # Level 6 takes half the time of the best, for a file 0.2 % larger.
    return b64encode(gzip.compress(plotly_js(), 6, mtime=0)).decode()


def _still(facts: Facts) -> str:
    """Return a static picture of the cell, without script; empty if the cell is unknown."""
    scene = scene_of(facts)
    return still(scene, "The cell: arm, scanner and poses") if scene else ""


def _corrected(facts: Facts) -> list[TransformText]:
    """Return the poses for the corrected arm, where an error of it was found."""
    answers = facts.result.answers
    if answers is None or answers.corrected is None:
        return []
    return [transform_text(*item) for item in answers.corrected.transforms.items()]


def _content(facts: Facts) -> dict[str, Any]:
    """Return the template's values, in reading order."""
    errors = errors_of(facts)
    return {
        "facts": facts,
        "result": facts.result,
        "verdict": banner_of(facts),
        "tiles": tiles_of(facts),
        "evidence": evidence_of(facts),
        "next_steps": next_steps_of(facts),
        "logo": LOGO,
        "transforms": [transform_text(*item) for item in facts.result.transforms.items()],
        "corrected": _corrected(facts),
        "errors": errors,
        "residuals": residual_figure(errors),
        "workspace": workspace_drawing(facts),
        "panels": cloud_panels(facts),
        "image": image_view(facts),
        "missed": missed_view(facts),
        "still": _still(facts),
        "cell": cell_drawing(facts),
        "drawings": drawings_of(facts),
        "seam": seam_view(facts),
        "weld": weld_drawing(facts),
        "set_aside": set_aside_of(facts),
        "timings": timings_of(facts),
        "idle": idle_of(facts),
        "provenance": provenance_of(facts),
        "version": VERSION,
    }


@dataclass(frozen=True)
class CheckDrawing:
    """One drawing of a check.

    Attributes:
        step: The verify step, such as ``4.verify.stitch``.
        summary: The step's summary text.
        picture: Picture as a data URI; empty for a figure.
        figure: Plotly figure; None for a picture.
    """

    step: str
    summary: str
    picture: str = ""
    figure: FigureData | None = None


def drawings_of(facts: Facts) -> list[CheckDrawing]:
    """Return the drawings of a run's verify steps; none if the log is damaged."""
    found = facts.log.of_kind("verify")
    judged = {e.step: e.value.reason for e in found if e.step in facts.log.noted}
    if not judged:
        return []
    try:
        return list(_drawn(facts, judged))
    except StageError:
        return []  # the report says of the damage already


def _drawn(facts: Facts, judged: dict[str, str]) -> Iterator[CheckDrawing]:
    for note in read_notes(facts.log.path, set(judged)):
        summary = judged[note.step]
        if note.name == "comparison":
            yield CheckDrawing(note.step, summary, figure=_figure(note))
        elif not isinstance(note.value, dict):
            yield CheckDrawing(note.step, summary, data_uri(note.value))


def _figure(note: JournalEntry) -> FigureData:
    """Return a scatter plot of the series of points that a verify step logged."""
    value: dict[str, Any] = note.value
    series = value["series"].items()
    colours = [SERIES[name] for name in ("x", "y", "z", "used", "held_out")]
    traces = [
        {
            "type": "scatter", "mode": "markers", "name": plain(name),
            "x": [x for x, _ in points], "y": [y for _, y in points],
            "marker": {"color": colour, "size": 8},
        }
        for (name, points), colour in zip(series, colours, strict=False)
    ]  # fmt: skip
    layout = {**layout2d(plain(value["x"]), plain(value["y"])), "showlegend": len(traces) > 1}
    layout["yaxis"]["zeroline"] = True
    return {"data": traces, "layout": layout}


@dataclass(frozen=True)
class ImageView:
    """An image, cut around the target.

    Attributes:
        id: Identifier of the capture.
        data: The picture as a data URI.
        box: Shown window (x, y, width, height) of the image [px].
        corners: Detected corners (x, y) [px].
        misses: Ends (x1, y1, x2, y2) of the line drawn for each corner [px].
        radius: Radius of the circles about the corners [px].
        summary: The figure's content in words.
    """

    id: str
    data: str
    box: tuple[float, float, float, float]
    corners: list[tuple[float, float]]
    misses: list[tuple[float, ...]]
    radius: float
    summary: str


def missed_view(facts: Facts) -> ImageView | None:
    """Return the first image without a detected target, with the reason; None without one."""
    why = {x.id: x.reason for x in facts.log.rejections if x.stage.startswith("fit.")}
    for capture in facts.log.captures() if why else ():
        if capture.id in why and capture.image is not None:
            height, width = capture.image.pixels.shape[:2]
            more = (
                f" {len(why) - 1} more captures were rejected by the fit." if len(why) > 1 else ""
            )
            summary = f"Capture {capture.id}, set aside: {why[capture.id]}.{more}"
            box = (-0.5, -0.5, float(width), float(height))
            return ImageView(
                capture.id, data_uri(capture.image.pixels), box, [], [], width / 110, summary
            )
    return None


def image_view(facts: Facts) -> ImageView | None:
    """Return the first image whose target was used, or any; None without images."""
    found = {
        str(e.capture): e.value
        for e in facts.log.of_kind("fit")
        if isinstance(e.value, t.PoseFeature) and len(e.value.corners)
    }
    used = [o.id for o in facts.result.observations if o.used and o.id in found]
    wanted = next(iter([*used, *found]), None)
    for capture in facts.log.captures() if wanted else ():
        if capture.id == wanted and capture.image is not None:
            return _view(capture.id, capture.image, found)
    return None


def _view(name: str, image: t.Image, found: dict[str, t.PoseFeature]) -> ImageView:
    corners = found[name].corners
    at, misses = corners[:, :2], corners[:, 2:]
    x, y, width, height = _around(at, image)
    sizes = np.hypot(*misses.T)
    # Of the lines drawn for what the pose misses, over the width of the view
    scale = round_up(0.1 * width / max(float(sizes.max()), 1e-6)) / 2
    ends = at + scale * misses
    of_each = [rms(f.corners[:, 2:]) for f in found.values()]
    summary = (
        f"Capture {name}: {len(at)} corners, {rms(misses):.3f} px rms of a coordinate and at most "
        f"{sizes.max():.3f} px from where the pose puts them; lines are {scale:g} times as long. "
        f"Over the {len(of_each)} images: {np.median(of_each):.3f} px in the median, at most "
        f"{max(of_each):.3f} px."
    )
    # The middle of the first pixel is (0, 0), and its corner that of the picture.
    return ImageView(
        name,
        data_uri(image.pixels[y : y + height, x : x + width]),
        (x - 0.5, y - 0.5, width, height),
        [(float(u), float(v)) for u, v in at],
        [tuple(line) for line in np.hstack([at, ends]).tolist()],
        width / 110,
        summary,
    )


def _around(at: Floats, image: t.Image) -> tuple[int, int, int, int]:
    """Return the window to show (x, y, width, height) [px]."""
    low, high = at.min(axis=0), at.max(axis=0)
    # Around the corners, over their extent
    margin = 0.25 * float((high - low).max()) + 10
    size = np.array(image.pixels.shape[1::-1])
    start = np.clip(np.floor(low - margin), 0, size - 1).astype(int)
    stop = np.clip(np.ceil(high + margin), start + 1, size).astype(int)
    (x, y), (width, height) = start.tolist(), (stop - start).tolist()
    return x, y, width, height


def data_uri(pixels: t.Pixels) -> str:
    """Return a picture as a data URI, not wider than a page."""
    import cv2

    # Columns of the picture in the page [px]
    step = min(1.0, 900 / pixels.shape[1])
    small = cv2.resize(pixels, None, fx=step, fy=step, interpolation=cv2.INTER_AREA)
    colour = small[..., ::-1] if small.ndim == 3 else small
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(colour), [cv2.IMWRITE_JPEG_QUALITY, 88])
    return f"data:image/jpeg;base64,{b64encode(data.tobytes()).decode('ascii')}"
