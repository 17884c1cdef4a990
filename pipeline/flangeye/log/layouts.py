"""Layouts of other viewers for our logs: what stands where when a run is opened."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from flangeye.errors import StageError

CLOUDS = ("/capture/cloud", "/circle", "/base/flanges")
APPLICATION = "run"
"""Rerun keeps one layout for each application; that of a log is its file's name, ``run.mcap``."""


def foxglove_layout() -> str:
    """Return a layout for Foxglove or Lichtblick, as ``Import from file`` reads it."""
    panels: dict[str, Any] = {
        "3D!cell": {
            "followTf": "base",
            "topics": {topic: {"visible": True, "pointSize": 2} for topic in CLOUDS}
            | {"/scene": {"visible": True}, "/seam": {"visible": True}, "/pose": {"visible": True}},
        },
        "Image!camera": {"imageMode": {"imageTopic": "/capture/image"}},
        "RosOut!log": {"minLogLevel": 2},
        "RawMessages!rejected": {"topicPath": "/rejection"},
    }
    right = {
        "direction": "column",
        "first": "Image!camera",
        "second": {
            "direction": "column", "first": "RosOut!log", "second": "RawMessages!rejected",
        },
        "splitPercentage": 45,
    }  # fmt: skip
    layout = {"direction": "row", "first": "3D!cell", "second": right, "splitPercentage": 65}
    document = {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": layout,
    }
    return json.dumps(document, indent=2) + "\n"


def write_rerun_blueprint(path: Path) -> None:
    """Write a blueprint for Rerun: ``rerun run.mcap layout.rbl`` opens a run with it.

    Raises:
        StageError: The extra ``rerun`` is not installed.
    """
    try:
        import rerun.blueprint as rrb
    except ModuleNotFoundError:
        raise StageError(
            "a blueprint is written by Rerun itself: pip install 'flangeye[rerun]'"
        ) from None
    cell = rrb.Spatial3DView(name="Cell", origin="/", contents=["+ /**", "- /capture/image/**"])
    image = rrb.Spatial2DView(name="Camera", origin="/capture/image")
    log = rrb.TextLogView(name="Log", origin="/log")
    columns = rrb.Horizontal(cell, rrb.Vertical(image, log), column_shares=[2, 1])
    rrb.Blueprint(columns, collapse_panels=True).save(APPLICATION, str(path))
