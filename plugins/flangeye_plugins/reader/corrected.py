"""``reader.corrected``: read an archive and correct a known mistake of its poses.

``flangeye doctor`` names the mistake and gives the line to put into the recipe::

    - acquire.archive: {reader: {corrected: {reader: folder, robot: {inverted: true}}}}
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, field_validator

from flangeye import BoundPart, Choose, Params, StageError, part
from flangeye.estimation.session.readings import Axes, optical
from flangeye.files.recording import Archive, Recording
from flangeye.maths.pose_corrections import (
    delayed,
    inverted,
    reread,
    scaled,
    sources,
    transposed,
    without_tool,
)
from flangeye.maths.streams import later, pose_at
from flangeye.types import FLANGE, FLANGE2, Floats, Mask
from flangeye.types.geometry import rigid, rows_at
from flangeye.types.pose_formats import PLAIN
from flangeye.units import Duration, Length, param
from flangeye.workflow.doctor.diagnosis import Arms


class PoseMistake(Params):
    """Mistakes in recorded poses; several are corrected in the order of these fields."""

    axes: Axes | None = None
    """Axes of the camera's frame, where z is not forward: opengl or ros."""
    rotation: tuple[str, str] | None = Field(
        None, description="Conventions of the rotations: the one in which that reader read them, "
        f"then the one in which they were written; {', '.join(PLAIN[:3])}, or axes.",
    )  # fmt: skip
    transposed: bool = False
    """The rotations' matrices were transposed."""
    inverted: bool = False
    """The poses are flange_T_base; of markers, target_T_camera."""
    scale: float = Field(1.0, gt=0)
    """Factor for the positions."""
    mirrored: Literal["x", "y", "z"] | None = None
    """Axis along which the positions have the wrong sign."""

    @field_validator("rotation")
    @classmethod
    def _known(cls, value: tuple[str, str] | None) -> tuple[str, str] | None:
        for each in value or ():
            if each not in PLAIN:
                raise ValueError(f"no rotation '{each}'; known: {', '.join(PLAIN)}")
        return value

    @property
    def factors(self) -> Floats:
        """Factors (3,) of the positions."""
        return self.scale * np.array([-1.0 if axis == self.mirrored else 1.0 for axis in "xyz"])

    def undone(self, poses: Floats) -> Floats:
        """Return corrected poses (N, 4, 4)."""
        # In the order in which numbers become poses: axes and rotation first, the inverse of the
        # whole pose after them, so that its position is in the right frame when it is scaled
        if self.axes:
            poses = rigid(optical(self.axes), np.zeros(3)) @ poses
        if self.rotation:
            poses = reread(poses, *self.rotation)
        if self.transposed:
            poses = transposed(poses)
        if self.inverted:
            poses = inverted(poses)
        return scaled(poses, self.factors)


class CorrectedParams(Params):
    """Mistakes of an archive, corrected in the order of this list."""

    reader: Annotated[BoundPart, Choose("reader")]
    """Reader of the archive as it was recorded."""
    arms: Arms = "both"
    """Arm whose poses are corrected if there are two; 'both' with one arm."""
    robot: PoseMistake = Field(default_factory=PoseMistake)
    """Mistake in the robot's poses."""
    target: PoseMistake = Field(default_factory=PoseMistake)
    """Mistake in ready-made markers and centres."""
    exchanged: bool = False
    """The robot's and the markers' poses were exchanged."""
    offset: tuple[Length, Length, Length] = param(("0 mm", "0 mm", "0 mm"))
    """Offset of the seen target from the recorded point, in the frame of that point."""
    shift: int = 0
    """Number of rows by which each scan's own pose was recorded later."""
    shift_from: str | None = None
    """Id of the first scan that is shifted."""
    backwards: bool = False
    """Whether the poses are in the opposite order of the scans."""
    delay: Duration = param("0 ms")
    """Time from a pose to its scan."""


@part("reader.corrected")
def corrected(path: Path, params: CorrectedParams) -> Archive:
    """Read an archive with another reader, and correct a mistake of its poses."""
    archive: Archive = params.reader(path)
    recordings = [_alone(recording, params) for recording in archive.recordings]
    if params.shift:
        recordings = _shift(archive, recordings, params)
    if params.backwards:
        # Poses for verification were recorded apart, so they are in no such order
        count = sum(recording.role == "calibration" for recording in recordings)
        every = np.ones(count, dtype=bool)
        recordings = _replaced(recordings, lambda rows: rows[::-1], every, params.arms)
    if params.delay:
        recordings = _delay(archive, recordings, params)
    note = "poses corrected as the recipe states"
    return replace(archive, recordings=recordings, notes=(*archive.notes, note))


def _alone(recording: Recording, params: CorrectedParams) -> Recording:
    """Return a recording with the mistakes of single poses corrected."""
    if params.exchanged:
        recording = _exchanged(recording)
    spared = {"first": FLANGE2, "second": FLANGE}.get(params.arms)
    poses = {
        frame: pose if frame == spared else _corrected(pose[None], params)[0]
        for frame, pose in recording.poses.items()
    }
    centre, target = recording.centre_in_camera, recording.camera_T_target
    if target is not None:
        target = params.target.undone(target[None])[0]
    motion = recording.motion
    if motion is not None:
        first = motion.poses if spared == FLANGE else _corrected(motion.poses, params)
        others = {
            name: poses if name == spared else _corrected(poses, params)
            for name, poses in motion.others.items()
        }
        motion = replace(motion, poses=first, others=others)
    return replace(
        recording,
        motion=motion,
        poses=poses,
        centre_in_camera=None if centre is None else centre * params.target.factors,
        camera_T_target=target,
    )


def _exchanged(recording: Recording) -> Recording:
    """Return a recording with robot's and marker's pose exchanged.

    Raises:
        StageError: One of the two poses is missing.
    """
    marker = recording.camera_T_target
    if marker is None or FLANGE not in recording.poses:
        raise StageError(f"{recording.id}: exchanged: there is no marker's pose beside the robot's")
    poses = {**recording.poses, FLANGE: marker}
    seen = recording.poses[FLANGE]
    # Motion and joints belong to the arm, whose pose is now that of the target
    return replace(recording, poses=poses, camera_T_target=seen, motion=None, joints=None)


def _corrected(poses: Floats, params: CorrectedParams) -> Floats:
    """Return one arm's corrected poses (N, 4, 4)."""
    # The offset leads from the recorded point to the target, so it is added
    return without_tool(params.robot.undone(poses), -np.array(params.offset))


def _shift(
    archive: Archive, recordings: Sequence[Recording], params: CorrectedParams
) -> list[Recording]:
    names = [r.id for r in recordings if r.role == "calibration"]
    if params.shift_from is not None and params.shift_from not in names:
        raise StageError(f"{archive.root}: shift_from: there is no pose '{params.shift_from}'")
    start = names.index(params.shift_from) if params.shift_from else 0
    source, kept = sources(len(names), params.shift, start)
    return _replaced(recordings, lambda rows: rows[source], kept, params.arms)


def _delay(
    archive: Archive, recordings: Sequence[Recording], params: CorrectedParams
) -> list[Recording]:
    if params.arms == "both" and all(r.passes_alone for r in recordings):
        return [found for r in recordings if (found := _passing_later(r, params.delay))]
    times = np.array([r.time_ns for r in recordings if r.role == "calibration"]) * 1e-9
    if (np.diff(times) <= 0).any():
        raise StageError(f"{archive.root}: delay: the poses' times do not rise")
    wanted = times + params.delay
    # Poses are interpolated between recorded ones, never extrapolated beyond them
    kept = (wanted >= times[0]) & (wanted <= times[-1])

    def moved(rows: Floats) -> Floats:
        if rows.ndim == 3:
            return delayed(rows, times, params.delay)[0]
        return rows_at(wanted, times, rows)

    return _replaced(recordings, moved, kept, params.arms)


def _passing_later(recording: Recording, delay: float) -> Recording | None:
    """Return a recording with a later flange pose; None beyond the recorded motion."""
    motion = recording.motion and later(recording.motion, delay)
    if motion is None:
        return None
    poses = {**recording.poses, FLANGE: pose_at(motion, 0.0)}
    return replace(recording, poses=poses, motion=motion)


def _replaced(
    recordings: Sequence[Recording], change: Callable[[Floats], Floats], kept: Mask, arms: Arms
) -> list[Recording]:
    """Return recordings with changed robot poses; samples without one are left out.

    Args:
        recordings: Recordings, of which those for calibration are changed.
        change: Returns poses (N, 4, 4), or joint angles (N, n), of other moments.
        kept: (N,) mask of samples that have one.
        arms: Names of the arms.
    """
    calibration = [r for r in recordings if r.role == "calibration"]
    changed = calibration
    for frame in {"both": (FLANGE, FLANGE2), "first": (FLANGE,), "second": (FLANGE2,)}[arms]:
        if all(frame in recording.poses for recording in calibration):
            moved = change(np.array([recording.poses[frame] for recording in calibration]))
            changed = [
                replace(r, poses={**r.poses, frame: m}) for r, m in zip(changed, moved, strict=True)
            ]
    if arms != "second" and all(recording.joints is not None for recording in calibration):
        turned = change(np.array([recording.joints for recording in calibration]))
        changed = [replace(r, joints=m) for r, m in zip(changed, turned, strict=True)]
    changed = [replace(r, motion=None) for r in changed]  # of its own moment, not of this
    return [r for r in recordings if r.role != "calibration"] + [
        recording for recording, has in zip(changed, kept, strict=True) if has
    ]
