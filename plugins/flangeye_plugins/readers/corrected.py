"""``reader.corrected``: an archive whose poses were recorded with a mistake that is now known.

``flangeye doctor`` names the mistake and gives the line to put into the recipe::

    - acquire.archive: {reader: {corrected: {reader: folder, inverted: true}}}
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator, model_validator

from flangeye import Choose, Chosen, Params, StageError, part
from flangeye.archive import Archive, Floats, Recording
from flangeye.conventions import EULER_ORDERS
from flangeye.mending import (
    Mask,
    delayed,
    inverted,
    reread,
    scaled,
    shifted,
    transposed,
    without_tool,
)
from flangeye.units import Duration, Length, param

ROTATIONS = ("xyzw", "wxyz", "vector", *EULER_ORDERS)

Selected = tuple[Sequence[Recording], Floats, Mask]


class CorrectedParams(Params):
    """What was wrong; one level undoes it in the order of this list."""

    reader: Annotated[Chosen, Choose("reader")] = param(
        description="Reads the archive as it was recorded."
    )
    read_as: str | None = Field(None, description="How that reader read the rotations.")
    written_as: str | None = Field(
        None, description=f"How they were written: one of {', '.join(ROTATIONS[:3])}, or axes."
    )
    transposed: bool = Field(False, description="The rotations' matrices were transposed.")
    scale: float = Field(1.0, gt=0, description="What the robot's positions are multiplied with.")
    target_scale: float = Field(
        1.0,
        gt=0,
        description="What positions of ready-made centres and markers are multiplied with.",
    )
    inverted: bool = Field(False, description="The poses are flange_T_base.")
    target_offset: tuple[Length, Length, Length] = param(
        ("0 mm", "0 mm", "0 mm"),
        description="What was seen, from the point whose poses were recorded, in its frame.",
    )
    shift: int = Field(0, description="A scan belongs to the pose recorded so many later.")
    shift_from: str | None = Field(None, description="Id of the first scan that is shifted.")
    delay: Duration = param("0 ms", description="The scans were taken so long after their poses.")

    @field_validator("read_as", "written_as")
    @classmethod
    def _known(cls, value: str | None) -> str | None:
        if value is not None and value not in ROTATIONS:
            raise ValueError(f"no rotation '{value}'; known: {', '.join(ROTATIONS)}")
        return value

    @model_validator(mode="after")
    def _both(self) -> CorrectedParams:
        if (self.read_as is None) != (self.written_as is None):
            raise ValueError("read_as and written_as go together")
        return self


@part("reader.corrected")
def corrected(path: Path, params: CorrectedParams) -> Archive:
    """Read an archive with another reader, and undo a mistake in its poses."""
    archive: Archive = params.reader(path)
    recordings = [_alone(recording, params) for recording in archive.recordings]
    if params.shift:
        recordings = _shift(archive, recordings, params)
    if params.delay:
        recordings = _delay(archive, recordings, params.delay)
    note = "poses corrected as the recipe says"
    return replace(archive, recordings=recordings, notes=(*archive.notes, note))


def _alone(recording: Recording, params: CorrectedParams) -> Recording:
    """Undo what concerns each pose by itself."""
    pose = recording.base_T_flange[None]
    if params.read_as and params.written_as:
        pose = reread(pose, params.read_as, params.written_as)
    if params.transposed:
        pose = transposed(pose)
    pose = scaled(pose, params.scale)
    if params.inverted:
        pose = inverted(pose)
    pose = without_tool(pose, -np.array(params.target_offset))
    centre = recording.centre_in_camera
    if centre is not None:
        centre = centre * params.target_scale
    target = recording.camera_T_target
    if target is not None:
        target = scaled(target, params.target_scale)
    return replace(
        recording, base_T_flange=pose[0], centre_in_camera=centre, camera_T_target=target
    )


def _shift(
    archive: Archive, recordings: Sequence[Recording], params: CorrectedParams
) -> list[Recording]:
    names = [r.id for r in recordings if r.role == "calibration"]
    if params.shift_from is not None and params.shift_from not in names:
        raise StageError(f"{archive.root}: shift_from: there is no pose '{params.shift_from}'")
    start = names.index(params.shift_from) if params.shift_from else 0
    return _replaced(recordings, lambda poses: shifted(poses, params.shift, start))


def _delay(archive: Archive, recordings: Sequence[Recording], delay: float) -> list[Recording]:
    times = np.array([r.time_ns for r in recordings if r.role == "calibration"]) * 1e-9
    if (np.diff(times) <= 0).any():
        raise StageError(f"{archive.root}: delay: the poses' times do not rise")
    return _replaced(recordings, lambda poses: delayed(poses, times, delay))


def _replaced(
    recordings: Sequence[Recording], change: Callable[[Floats], tuple[Floats, Mask]]
) -> list[Recording]:
    """Change the poses to calibrate with, in their order; those without a pose are left out."""
    calibration = [r for r in recordings if r.role == "calibration"]
    poses, known = change(np.array([r.base_T_flange for r in calibration]))
    changed = [
        replace(recording, base_T_flange=pose)
        for recording, pose, kept in zip(calibration, poses, known, strict=True)
        if kept
    ]
    return [r for r in recordings if r.role != "calibration"] + changed
