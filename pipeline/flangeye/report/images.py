"""One image of a printed target, with the corners that were detected and what the pose misses."""

from __future__ import annotations

from base64 import b64encode
from dataclasses import dataclass

import numpy as np

from flangeye import types as t
from flangeye.maths.statistics import rms
from flangeye.report.facts import Facts
from flangeye.report.plot import round_up
from flangeye.types import Floats


@dataclass(frozen=True)
class ImageView:
    """An image, cut around the target.

    Attributes:
        id: Identifier of the capture.
        data: The picture, a data URI.
        box: (x, y, width, height) of what is shown, in the image [px].
        corners: Where each corner was detected, x and y [px].
        misses: (x1, y1, x2, y2) of the line for each corner [px].
        radius: Radius of the circles about the corners [px].
        summary: What it shows in words.
    """

    id: str
    data: str
    box: tuple[float, float, float, float]
    corners: list[tuple[float, float]]
    misses: list[tuple[float, ...]]
    radius: float
    summary: str


def missed_view(facts: Facts) -> ImageView | None:
    """Return the first image in which no target was found, and why; None where there is none."""
    why = {x.id: x.reason for x in facts.log.rejections if x.stage.startswith("fit.")}
    for capture in facts.log.captures() if why else ():
        if capture.id in why and capture.image is not None:
            height, width = capture.image.pixels.shape[:2]
            more = f" So it is with {len(why) - 1} more." if len(why) > 1 else ""
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
        f"Capture {name}: {len(at)} corners; where the pose has them is {rms(misses):.3f} px off "
        f"(rms of a coordinate, the lines are {scale:g} times too long), at most "
        f"{sizes.max():.3f} px. Over the {len(of_each)} images: {np.median(of_each):.3f} px in the "
        f"median, at most {max(of_each):.3f} px."
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
    """Return (x, y, width, height) of what is to be shown [px]."""
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
