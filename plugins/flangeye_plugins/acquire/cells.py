"""Recordings of a cell, checked against the cell that the recipe describes."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from flangeye import StageError
from flangeye.files.recording import MAX_REACH, MIN_CAPTURES, MIN_SPREAD, Recording
from flangeye.maths.pose_corrections import inverted, scaled
from flangeye.models.cell import Axis, Cell
from flangeye.types import Floats, Poses, Transform

if TYPE_CHECKING:
    from flangeye.maths.kinematics import Arm


def cell_poses(recording: Recording, cell: Cell) -> Poses:
    """Return where a recording has everything that moves in the cell."""
    return {
        name: Transform(f"{name}_base", name, _place(recording, name, cell))
        for name in cell.movers
        if name in recording.poses or name in recording.axes
    }


def _place(recording: Recording, name: str, cell: Cell) -> Floats:
    mover = cell.movers[name]
    if isinstance(mover, Axis) and name in recording.axes:
        return mover.place(recording.axes[name])
    return recording.poses[name]


def check_cell(root: Path, recordings: Sequence[Recording], cell: Cell) -> None:
    """Refuse recordings that are not of this cell, or that nothing can be found from.

    Raises:
        StageError: A camera, a target or something that moves is unknown or lacks its recordings,
            an arm is out of any arm's reach, or its joints do not lead to its poses, or nothing
            moves.
    """
    _require_known(root, "camera", (r.seen_by for r in recordings), cell.cameras)
    _require_known(root, "target", (r.saw for r in recordings), cell.targets)
    moved = {name for r in recordings for name in (*r.poses, *r.axes, *r.arm_joints)}
    _require_known(root, "arm, rail or positioner", moved, tuple(cell.movers))
    _require_all(root, recordings, cell)
    _require_kinds(root, recordings, cell)
    for name in cell.arms:
        _require_joints(root, recordings, name, cell)
    if len(recordings) < MIN_CAPTURES:
        raise StageError(
            f"{root}: {len(recordings)} sightings; at least {MIN_CAPTURES} of each camera are "
            "needed, at different poses"
        )
    _require_motion(root, recordings)


def _require_known(root: Path, what: str, given: Iterable[str], known: tuple[str, ...]) -> None:
    for name in dict.fromkeys(given):
        if name not in known:
            raise StageError(
                f"{root}: has recordings of '{name}', which is no {what} of the recipe's cell; it "
                f"has {', '.join(known) or 'none'}"
            )


def _require_all(root: Path, recordings: Sequence[Recording], cell: Cell) -> None:
    seen = {end for r in recordings for end in (r.seen_by, r.saw)}
    for end in (*cell.cameras, *cell.targets):
        if end not in seen:
            what = "sees nothing" if end in cell.cameras else "is seen by no camera"
            raise StageError(
                f"{root}: '{end}' {what}; add its table to the reader, or leave it out of the cell"
            )
    for name in cell.movers:
        if any(name not in r.poses and name not in r.axes for r in recordings):
            raise StageError(
                f"{root}: has no poses of '{name}', which moves in this cell; add its table to the "
                "reader"
            )


def _require_kinds(root: Path, recordings: Sequence[Recording], cell: Cell) -> None:
    for recording in recordings:
        for name in recording.axes:
            if not isinstance(cell.movers[name], Axis):
                raise StageError(
                    f"{root}: '{name}' is an arm, and has one value a pose; give its poses in the "
                    "reader's arms"
                )
        for name, pose in recording.poses.items():
            distance = float(np.linalg.norm(pose[:3, 3]))
            if distance > MAX_REACH:
                raise StageError(
                    f"{root}: pose '{recording.id}' has '{name}' {distance:.4g} m from its base, "
                    "beyond any arm; are the positions in millimetres?"
                )


def _require_joints(root: Path, recordings: Sequence[Recording], name: str, cell: Cell) -> None:
    """Refuse joints of an arm that are not those of its poses, and a link's place without any."""
    from flangeye.estimation.sightings import REACHED
    from flangeye.maths.kinematics import Arm

    arm, told = Arm(cell.arms[name]), [r for r in recordings if name in r.arm_joints]
    links = [link for link in cell.links.values() if link.arm == name]
    if links and len(told) < len(recordings):
        raise StageError(
            f"{root}: where link {links[0].number} of '{name}' is follows from its joint angles, "
            f"and there are none: give their columns in the reader, arms: {{{name}: {{joints: …}}}}"
        )
    for recording in told:
        joints = recording.arm_joints[name]
        if len(joints) != arm.n:
            raise StageError(
                f"{root}: '{name}' has {len(joints)} joint angles, and a "
                f"{cell.arms[name].model} has {arm.n} joints"
            )
        away = float(np.linalg.norm((arm.flange(joints) - recording.poses[name])[:3, 3]))
        if away > REACHED:
            raise StageError(
                f"{root}: pose '{recording.id}': the joint angles of '{name}' put the flange of a "
                f"{cell.arms[name].model} {away * 1e3:.3g} mm from its pose; "
                f"{_cure(arm, joints, recording.poses[name])}"
            )


def _cure(arm: Arm, joints: Floats, pose: Floats) -> str:
    """Return what would make joints and pose of an arm agree."""
    from flangeye.estimation.sightings import REACHED

    cures = {
        "write joint_unit: deg": (np.radians(joints), pose),
        "write joint_unit: rad": (np.degrees(joints), pose),
        "write pose: the other way round": (joints, inverted(pose)),
        "write length: mm": (joints, scaled(pose, 1e-3)),
        "write length: m": (joints, scaled(pose, 1e3)),
    }
    for cure, (angles, place) in cures.items():
        if np.linalg.norm((arm.flange(angles) - place)[:3, 3]) < REACHED:
            return cure
    return "check their order and the model, or leave out joints"


def _require_motion(root: Path, recordings: Sequence[Recording]) -> None:
    first = recordings[0]
    for recording in recordings:
        if any(abs(x - first.axes[name]) > MIN_SPREAD for name, x in recording.axes.items()):
            return
        if any(np.abs(p - first.poses[n]).max() > MIN_SPREAD for n, p in recording.poses.items()):
            return
    raise StageError(f"{root}: nothing moves in all {len(recordings)} sightings; move the arms")
