"""The recordings that the paper's authors published (github.com/ancorasir).

Six recordings in one repository, each in a layout of its own::

    data/aubo/          data.txt (poses, m), tool0_<id>.pcd (m), p_*_mat.npy (m)
    data/ur5/ ur10e/    calibration_robot_pose_data.npz (4x4, m), p_*_mat.npy (mm)
    data/franka/        calibration_robot_pose_data.npy (xyz in m, quaternion), p_*_mat.npy (mm)
    Kinect_Result/      readRobot.txt, measureRobot.txt (mm), flange.pcd and new.txt
    calib_toolbox/data/2019-06-14-sample/    NN_tool.ply (mm), calib_data.json (m, centres mm)
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal, get_args

from pydantic import Field

from flangeye import Params, StageError, part
from flangeye.files.recording import Archive, NotThisLayout
from flangeye_plugins.reader.ancorasir_recordings import (
    read_aubo,
    read_franka,
    read_kinect,
    read_sample_2019,
    read_ur,
)

Robot = Literal["aubo", "ur5", "ur10e", "franka", "kinect", "sample-2019"]


@dataclass(frozen=True)
class _Place:
    """Where a recording is in the repository, and the file that gives it away."""

    folder: PurePosixPath
    marker: str
    read: Callable[[Path], Archive]


_POSES = "calibration_robot_pose_data"
_PLACES: Mapping[str, _Place] = {
    "aubo": _Place(PurePosixPath("data/aubo"), "data.txt", read_aubo),
    "ur5": _Place(PurePosixPath("data/ur5"), f"{_POSES}.npz", read_ur),
    "ur10e": _Place(PurePosixPath("data/ur10e"), f"{_POSES}.npz", read_ur),
    "franka": _Place(PurePosixPath("data/franka"), f"{_POSES}.npy", read_franka),
    "kinect": _Place(PurePosixPath("Kinect_Result"), "readRobot.txt", read_kinect),
    "sample-2019": _Place(
        PurePosixPath("calib_toolbox/data/2019-06-14-sample"), "calib_data.json", read_sample_2019
    ),
}


class AncorasirParams(Params):
    """Which of the recordings."""

    robot: Robot | None = Field(
        None,
        description="Recording to read; may be left out where the path holds only one. "
        f"One of {', '.join(get_args(Robot))}.",
    )


@part("reader.ancorasir")
def ancorasir(path: Path, params: AncorasirParams) -> Archive:
    """Read the recordings published with the paper; the path is the whole folder or a part."""
    found = _recordings_in(path)
    if params.robot is not None:
        return _PLACES[params.robot].read(_chosen(path, params.robot, found))
    if not found:
        markers = sorted({place.marker for place in _PLACES.values()})
        raise NotThisLayout(f"{path}: holds none of {', '.join(markers)}")
    if len(found) > 1:
        raise StageError(
            f"{path}: holds the recordings {', '.join(found)}; choose one, for example "
            f"reader: {{ancorasir: {{robot: {next(iter(found))}}}}}"
        )
    ((robot, folder),) = found.items()
    return _PLACES[robot].read(folder)


def _chosen(path: Path, robot: str, found: Mapping[str, Path]) -> Path:
    folder = _locate(path, robot)
    if folder is None:
        place = _PLACES[robot]
        raise StageError(
            f"{path}: no recording '{robot}' (no {place.folder / place.marker}); "
            f"found: {', '.join(found) or 'none'}"
        )
    return folder


def _recordings_in(path: Path) -> dict[str, Path]:
    """Return every recording at or below ``path``; a folder counts once, by its own name."""
    found: dict[str, Path] = {}
    for robot in _PLACES:
        folder = _locate(path, robot)
        if folder is not None and folder not in found.values():
            found[robot] = folder
    return found


def _locate(path: Path, robot: str) -> Path | None:
    """Return the recording's folder when ``path`` is the repository or a folder on the way."""
    place = _PLACES[robot]
    parts = place.folder.parts
    others = {p.folder.name for p in _PLACES.values()} - {place.folder.name}
    tails = [path.joinpath(*parts[i:]) for i in range(len(parts) + 1)]
    for folder in tails:
        if folder.name not in others and _is_recording(folder, place.marker):
            return folder
    return None


def _is_recording(folder: Path, marker: str) -> bool:
    # The Franka's folder holds an .npz too, of everything the arm was sent to.
    shadowed = marker.endswith(".npz") and (folder / f"{_POSES}.npy").exists()
    return (folder / marker).is_file() and not shadowed
