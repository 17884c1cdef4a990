"""``export.*``: the camera pose as another program takes it.

Add a format: a row of ``controllers.CONTROLLERS``, or a writer in ``documents`` where names have to
be quoted. ``export.robot`` writes the arm, and is none of the formats.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from flangeye import stage
from flangeye.models.configuration import CELL
from flangeye.plugin.stage import Stage
from flangeye.types import CalibratedPose, ExportedFile
from flangeye_plugins.export import documents
from flangeye_plugins.export.controllers import CONTROLLERS
from flangeye_plugins.export.documents import UrdfParams, urdf
from flangeye_plugins.export.writing import (
    FramesParams,
    LengthParams,
    NamedParams,
    ZividExportParams,
)


def _declared(
    name: str, write: Callable[..., ExportedFile], params: type[NamedParams], meaning: str
) -> Stage:
    def export(pose: CalibratedPose, params: Any) -> ExportedFile:
        params.require_unnamed(pose)
        return write(pose, params)

    export.__doc__ = meaning
    export.__annotations__["params"] = params
    # Only these formats can hold several transforms, as a cell has
    serves = (CELL,) if name in ("ros2_command", "ros2_launch", "urdf") else ()
    return stage(f"export.{name}", serves=serves)(export)


EXPORTS = (
    *(
        _declared(write.__name__, write, params, write.__doc__ or "")
        for write, params in (
            (documents.ros2_command, FramesParams),
            (documents.ros2_launch, FramesParams),
            (urdf, UrdfParams),
            (documents.moveit, FramesParams),
            (documents.easy_handeye2, FramesParams),
            (documents.opencv, LengthParams),
            (documents.zivid, ZividExportParams),
            (documents.robodk, NamedParams),
            (documents.matrix, LengthParams),
        )
    ),
    *(_declared(name, row.write, row.params, row.meaning) for name, row in CONTROLLERS.items()),
)
"""The formats of the camera's pose."""
