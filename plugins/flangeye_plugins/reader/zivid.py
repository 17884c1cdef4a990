"""A folder as Zivid's samples write it: ``pos01.yaml`` with ``img01.ply`` and so on.

``posNN.yaml`` is a 4x4 matrix of the flange in the base, written by Zivid's SDK (``FloatMatrix:
Data:``) or, by older samples, by OpenCV (``PoseState: !!opencv-matrix``). Lengths are millimetres
in Zivid's own samples; the recipe says.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from flangeye import Params, RecipeError, StageError, part
from flangeye.files.clouds import LengthUnit
from flangeye.files.pairs import natural
from flangeye.files.recording import Archive, NotThisLayout, Recording
from flangeye.files.regular import read_text
from flangeye.files.scans import recording_of, scans_in
from flangeye.files.yaml_lines import parse_yaml
from flangeye.maths.pose_corrections import scaled
from flangeye.types import Floats
from flangeye_plugins.reader.yaml_poses import pose_of_matrix

_POSE = re.compile(r"pos(\d+)\.ya?ml")
_OPENCV = re.compile(r"^%YAML[^\n]*\n---|!!opencv-matrix", re.MULTILINE)


class ZividParams(Params):
    """How the poses are written."""

    length: Literal["m", "mm"] = Field(description="Unit of the positions; Zivid's own are mm.")
    cloud_unit: LengthUnit | None = Field(
        None, description="Unit of the exported clouds; found by the scanner's range if not given."
    )


@part("reader.zivid")
def zivid(path: Path, params: ZividParams) -> Archive:
    """Read a folder of posNN.yaml with clouds or images imgNN beside them."""
    found = sorted(path.glob("pos*.y*ml"), key=lambda file: natural(file.name))
    files = {m[1]: file for file in found if (m := _POSE.fullmatch(file.name))}
    if not files:
        raise NotThisLayout(f"{path}: holds no pos01.yaml")
    factor = 1e-3 if params.length == "mm" else 1.0
    recordings = [_recording(path, number, file, factor) for number, file in files.items()]
    return Archive("Zivid", path, recordings, list(files.values()), cloud_unit=params.cloud_unit)


def _recording(folder: Path, number: str, file: Path, factor: float) -> Recording:
    pose = scaled(_pose(file), factor)
    return recording_of(number, pose, scans_in(folder, f"img{number}"))


def _pose(file: Path) -> Floats:
    try:
        text = _OPENCV.sub("", read_text(file))
        data = parse_yaml(text.replace("dt: d", "dt: double"), str(file)).data
    except RecipeError as error:
        raise StageError(str(error)) from None
    return pose_of_matrix(str(file), _matrix(file, data))


def _matrix(file: Path, data: Any) -> Any:
    for keys in (("FloatMatrix", "Data"), ("PoseState", "data")):
        found = data
        for key in keys:
            found = found.get(key) if isinstance(found, dict) else None
        if found is not None:
            return found
    raise StageError(f"{file}: holds neither FloatMatrix.Data nor PoseState.data")
