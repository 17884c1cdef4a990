"""The recordings that the paper's authors published (github.com/ancorasir).

Six recordings in one repository, each in a layout of its own::

    data/aubo/          data.txt (poses, m), tool0_<id>.pcd (m), p_*_mat.npy (m)
    data/ur5/ ur10e/    calibration_robot_pose_data.npz (4x4, m), p_*_mat.npy (mm)
    data/franka/        calibration_robot_pose_data.npy (xyz in m, quaternion), p_*_mat.npy (mm)
    Kinect_Result/      readRobot.txt, measureRobot.txt (mm), flange.pcd and new.txt
    calib_toolbox/data/2019-06-14-sample/    NN_tool.ply (mm), calib_data.json (m, centres mm)
"""

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath
from typing import Any, Literal, get_args

import numpy as np
from pydantic import Field

from flangeye import Params, StageError, part
from flangeye.files.arrays import read_npy, read_npz, read_table
from flangeye.files.recording import Archive, NotThisLayout, Recording
from flangeye.files.regular import read_text
from flangeye.types import FLANGE, Floats
from flangeye_plugins.reader.poses import (
    pose_from_matrix,
    pose_from_quaternion,
    pose_from_rotation_vector,
)

MM = 1e-3

_AUBO_VERIFICATION = "5"

FlangePoses = Mapping[str, Floats]

_POSE_FILE = "calibration_robot_pose_data"


def read_aubo(folder: Path) -> Archive:
    """Read the Aubo i5 before a PhoXi S: ``data.txt``, and a cloud for most of its poses."""
    poses_file = folder / "data.txt"
    poses = _aubo_poses(poses_file)
    clouds = _clouds(folder)
    recordings = _with_centres(folder, poses, clouds, unit=1.0)
    if _AUBO_VERIFICATION in clouds and _AUBO_VERIFICATION not in poses:
        # Hard-coded in the authors' calibration_ransac_circle_aubo.py: position [m],
        # quaternion xyzw
        pose = pose_from_quaternion(
            "tool0_5.pcd",
            (0.27704067625331485, -0.573055166920657, 0.26205388882758757),
            (-0.08580920098798522, -0.3893105864494028, 0.9148593368686363, 0.06408152657751885),
        )
        cloud = clouds.pop(_AUBO_VERIFICATION)
        recordings = [
            Recording(_AUBO_VERIFICATION, {FLANGE: pose}, cloud, role="verification"),
            *recordings,
        ]
    _refuse_unpaired(clouds, poses, poses_file)
    files = [poses_file, *_centre_files(folder)]
    return Archive("ancorasir aubo", folder, recordings, files, cloud_unit="m")


def read_ur(folder: Path) -> Archive:
    """Read the UR5 or UR10e before a PhoXi M: poses as matrices, centres in millimetres."""
    poses_file = folder / "calibration_robot_pose_data.npz"
    matrices = read_npz(poses_file, "arr_0", (None, 4, 4))
    poses = {
        str(i): pose_from_matrix(f"{poses_file}: pose {i}", matrix)
        for i, matrix in enumerate(matrices)
    }
    return _in_millimetres(folder, poses_file, poses)


def read_franka(folder: Path) -> Archive:
    """Read the Franka before a PhoXi M: commanded poses, centres in millimetres."""
    poses_file = folder / "calibration_robot_pose_data.npy"
    rows = read_npy(poses_file, (None, 7))
    poses = {
        str(i): pose_from_quaternion(f"{poses_file}: pose {i}", row[:3], row[3:])
        for i, row in enumerate(rows)
    }
    archive = _in_millimetres(folder, poses_file, poses)
    notes = ["the Franka's poses are commanded, not measured"]
    return replace(archive, layout="ancorasir franka", notes=notes)


def _in_millimetres(folder: Path, poses_file: Path, poses: FlangePoses) -> Archive:
    """Return the archive of poses with the clouds and centres of their numbers, in millimetres."""
    clouds = _clouds(folder)
    _refuse_unpaired(clouds, poses, poses_file)
    recordings = _with_centres(folder, poses, clouds, MM)
    files = [poses_file, *_centre_files(folder)]
    return Archive(f"ancorasir {folder.name}", folder, recordings, files, cloud_unit="mm")


def read_kinect(folder: Path) -> Archive:
    """Read the UR10e before an Azure Kinect: centres and TCPs row by row, all in millimetres."""
    poses_file, centres_file = folder / "readRobot.txt", folder / "measureRobot.txt"
    rows, centres = read_table(poses_file, 6), read_table(centres_file, 3)
    _same_count(poses_file, len(rows), centres_file, len(centres))
    recordings = [
        Recording(
            str(i),
            {FLANGE: pose_from_rotation_vector(f"{poses_file}: row {i}", row[:3] * MM, row[3:])},
            centre_in_camera=centre * MM,
        )
        for i, (row, centre) in enumerate(zip(rows, centres, strict=True))
    ]
    files = [poses_file, centres_file]
    verification = folder / "new.txt"
    if verification.is_file():
        recordings.insert(0, _kinect_verification(verification, folder / "flange.pcd"))
        files.append(verification)
    return Archive("ancorasir kinect", folder, recordings, files, cloud_unit="mm")


def _kinect_verification(file: Path, cloud: Path) -> Recording:
    # new.txt has the centre in its first line and the TCP in its second
    centre = read_table(file, 3, slice(0, 1))[0]
    row = read_table(file, 6, slice(1, 2))[0]
    pose = pose_from_rotation_vector(f"{file}: row 2", row[:3] * MM, row[3:])
    return Recording(
        "new", {FLANGE: pose}, cloud if cloud.is_file() else None, centre * MM, role="verification"
    )


def read_sample_2019(folder: Path) -> Archive:
    """Read the sample of 2019: a Franka's six segmented clouds, the i-th at the i-th pose."""
    poses_file = folder / "calib_data.json"
    entries = _json_object(poses_file)
    clouds = _sample_clouds(folder)
    _same_count(poses_file, len(entries), folder / "NN_tool.ply", len(clouds))
    recordings = [
        _sample_recording(f"{poses_file}: '{key}'", key, entries[key], cloud)
        for key, cloud in zip(sorted(entries, key=int), clouds, strict=True)
    ]
    return Archive("ancorasir sample-2019", folder, recordings, [poses_file], cloud_unit="mm")


def _sample_recording(where: str, key: str, entry: Any, cloud: Path) -> Recording:
    try:
        pose = np.array(entry["robot_pose"], dtype=np.float64)
        centre = np.array(entry["p_cam"], dtype=np.float64) * MM
    except (KeyError, TypeError, ValueError) as error:
        raise StageError(f"{where}: robot_pose or p_cam is missing or wrong ({error})") from None
    if pose.shape != (7,) or centre.shape not in ((0,), (3,)):
        raise StageError(f"{where}: robot_pose has {pose.size} numbers, not 7; p_cam {centre.size}")
    # The sample's quaternions are w x y z, those of the other recordings x y z w
    w, *xyz = pose[3:]
    matrix = pose_from_quaternion(where, pose[:3], [*xyz, w])
    return Recording(key, {FLANGE: matrix}, cloud, centre if centre.size else None)


def _sample_clouds(folder: Path) -> list[Path]:
    """Return one cloud per number; coloured copies have the same points in another order."""
    chosen: dict[str, Path] = {}
    # In order of preference, as setdefault keeps the first
    for ending in ("_tool.ply", "_tool_valid.pcd", "_tool_valid.ply"):
        for path in folder.glob(f"*{ending}"):
            chosen.setdefault(path.name.removesuffix(ending), path)
    return [chosen[number] for number in sorted(chosen)]


def _json_object(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(read_text(path))
    except (ValueError, RecursionError) as error:
        raise StageError(f"{path}: is not JSON: {error}") from None
    if not isinstance(data, dict) or not data or not all(key.isdigit() for key in data):
        raise StageError(f'{path}: expected an object of numbered poses, {{"0": {{…}}, …}}')
    return data


def _aubo_poses(path: Path) -> dict[str, Floats]:
    """Parse the blocks ``p_robot 6-DoF index:<id>`` and the list of seven numbers after each."""
    lines = read_text(path).splitlines()
    poses: dict[str, Floats] = {}
    heading = "p_robot 6-DoF index:"
    for number, (line, following) in enumerate(zip(lines, [*lines[1:], ""], strict=True), 1):
        if not line.startswith(heading):
            continue
        name = line.removeprefix(heading).strip()
        if name in poses:
            raise StageError(f"{path}:{number}: pose '{name}' is given twice")
        values = _seven(f"{path}:{number + 1}", following)
        poses[name] = pose_from_quaternion(f"{path}: pose '{name}'", values[:3], values[3:])
    if not poses:
        raise StageError(f"{path}: holds no poses (no line '{heading}<id>')")
    return poses


def _seven(where: str, text: str) -> list[float]:
    try:
        values = [float(word) for word in text.strip().strip("[]").split(",")]
    except ValueError:
        values = []
    if len(values) != 7:
        raise StageError(f"{where}: expected [x, y, z, qx, qy, qz, qw], found '{text[:60]}'")
    return values


def _clouds(folder: Path) -> dict[str, Path]:
    return {p.stem.removeprefix("tool0_"): p for p in sorted(folder.glob("tool0_*.pcd"))}


def _refuse_unpaired(clouds: Mapping[str, Path], poses: FlangePoses, poses_file: Path) -> None:
    for name, cloud in clouds.items():
        if name not in poses:
            raise StageError(
                f"{cloud}: {poses_file.name} has no pose '{name}'; add it, or move the cloud away"
            )


def _centre_files(folder: Path) -> list[Path]:
    names = ("p_robot_mat.npy", "p_camera_mat.npy")
    return [folder / name for name in names if (folder / name).is_file()]


def _with_centres(
    folder: Path, poses: FlangePoses, clouds: Mapping[str, Path], unit: float
) -> list[Recording]:
    centres = _centres(folder, poses, unit)
    return [
        Recording(name, {FLANGE: pose}, clouds.get(name), centres.get(name))
        for name, pose in poses.items()
    ]


def _centres(folder: Path, poses: FlangePoses, unit: float) -> dict[str, Floats]:
    """Return the published centres [m] by pose: the pose a column's TCP was copied from."""
    files = _centre_files(folder)
    if len(files) < 2:
        return {}
    tcps, centres = (read_npy(file, (3, None)).T * unit for file in files)
    _same_count(files[0], len(tcps), files[1], len(centres))
    names, places = list(poses), np.array([pose[:3, 3] for pose in poses.values()])
    found: dict[str, Floats] = {}
    for column, (tcp, centre) in enumerate(zip(tcps, centres, strict=True)):
        distances = np.linalg.norm(places - tcp, axis=1)
        nearest = int(np.argmin(distances))
        # A centre belongs to the pose whose position [m] its column of p_robot_mat repeats this
        # well
        if not distances[nearest] < 1e-6:
            raise StageError(
                f"{files[0]}: column {column} is at the position of no pose, or of one already "
                f"taken"
            )
        if not np.isfinite(centre).all():
            raise StageError(f"{files[1]}: column {column} is not finite")
        found[names[nearest]] = centre
        places[nearest] = np.inf  # each pose once
    return found


def _same_count(one: Path, n: int, other: Path, m: int) -> None:
    if n != m:
        raise StageError(f"{one}: counts differ: {one.name} has {n}, {other.name} has {m}")


DatasetArm = Literal["aubo", "ur5", "ur10e", "franka", "kinect", "sample-2019"]


@dataclass(frozen=True)
class _Location:
    """Location of a recording in the repository, and the file by which it is recognised."""

    folder: PurePosixPath
    marker: str
    read: Callable[[Path], Archive]


_DATASETS: Mapping[str, _Location] = {
    "aubo": _Location(PurePosixPath("data/aubo"), "data.txt", read_aubo),
    "ur5": _Location(PurePosixPath("data/ur5"), f"{_POSE_FILE}.npz", read_ur),
    "ur10e": _Location(PurePosixPath("data/ur10e"), f"{_POSE_FILE}.npz", read_ur),
    "franka": _Location(PurePosixPath("data/franka"), f"{_POSE_FILE}.npy", read_franka),
    "kinect": _Location(PurePosixPath("Kinect_Result"), "readRobot.txt", read_kinect),
    "sample-2019": _Location(
        PurePosixPath("calib_toolbox/data/2019-06-14-sample"), "calib_data.json", read_sample_2019
    ),
}


class AncorasirParams(Params):
    """Selection of a recording."""

    robot: DatasetArm | None = Field(
        None,
        description="Recording to read; may be left out where the path holds only one. "
        f"One of {', '.join(get_args(DatasetArm))}.",
    )


@part("reader.ancorasir")
def ancorasir(path: Path, params: AncorasirParams) -> Archive:
    """Read the recordings published with the paper; the path is the whole folder or a part."""
    found = _recordings_in(path)
    if params.robot is not None:
        return _DATASETS[params.robot].read(_chosen(path, params.robot, found))
    if not found:
        markers = sorted({place.marker for place in _DATASETS.values()})
        raise NotThisLayout(f"{path}: holds none of {', '.join(markers)}")
    if len(found) > 1:
        raise StageError(
            f"{path}: holds the recordings {', '.join(found)}; choose one, for example "
            f"reader: {{ancorasir: {{robot: {next(iter(found))}}}}}"
        )
    ((robot, folder),) = found.items()
    return _DATASETS[robot].read(folder)


def _chosen(path: Path, robot: str, found: Mapping[str, Path]) -> Path:
    folder = _locate(path, robot)
    if folder is None:
        place = _DATASETS[robot]
        raise StageError(
            f"{path}: no recording '{robot}' (no {place.folder / place.marker}); "
            f"found: {', '.join(found) or 'none'}"
        )
    return folder


def _recordings_in(path: Path) -> dict[str, Path]:
    """Return the recordings at or below ``path``, by name, one for each folder."""
    found: dict[str, Path] = {}
    for robot in _DATASETS:
        folder = _locate(path, robot)
        if folder is not None and folder not in found.values():
            found[robot] = folder
    return found


def _locate(path: Path, robot: str) -> Path | None:
    """Return a recording's folder, given the repository or a folder between; else None."""
    place = _DATASETS[robot]
    parts = place.folder.parts
    others = {p.folder.name for p in _DATASETS.values()} - {place.folder.name}
    tails = [path.joinpath(*parts[i:]) for i in range(len(parts) + 1)]
    for folder in tails:
        if folder.name not in others and _is_recording(folder, place.marker):
            return folder
    return None


def _is_recording(folder: Path, marker: str) -> bool:
    # The Franka's folder holds an .npz too, of everything the arm was sent to.
    shadowed = marker.endswith(".npz") and (folder / f"{_POSE_FILE}.npy").exists()
    return (folder / marker).is_file() and not shadowed
