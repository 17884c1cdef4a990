"""reader.ancorasir: all of the published layouts, made here in small, and the recordings."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import StageError
from flangeye.files.clouds import read_cloud, write_cloud
from flangeye.types import ArchivePath, PointCloud
from flangeye.types.geometry import quaternion_from_rotation, rotation_exp, rotation_from_rpy
from flangeye_plugins.acquire.archive import ArchiveParams, acquire_archive
from flangeye_plugins.reader.ancorasir import AncorasirParams, ancorasir

N = 5
POSITIONS = np.random.default_rng(5).uniform(-0.3, 0.6, (N, 3))
ROTATIONS = [rotation_from_rpy(0.1 * i, -0.2, 0.05) for i in range(N)]
CENTRES = np.random.default_rng(6).uniform(0.1, 0.5, (N, 3))
FITTED = [0, 2, 3]
"""Poses that have a centre."""


def read(path, robot=None):
    return ancorasir(path, AncorasirParams(robot=robot))


def refused(path, robot=None):
    with pytest.raises(StageError) as error:
        read(path, robot)
    assert "\n" not in str(error.value)
    return str(error.value)


def cloud(path, seed, unit="m"):
    points = np.random.default_rng(seed).uniform(0.40, 0.42, (9, 3))
    write_cloud(path, PointCloud("camera", points), unit)


def matrices(folder, unit):
    np.save(folder / "p_robot_mat.npy", POSITIONS[FITTED].T * unit)
    np.save(folder / "p_camera_mat.npy", (CENTRES[FITTED].T * unit).astype(np.float32))


def quaternions():
    return [quaternion_from_rotation(rotation).tolist() for rotation in ROTATIONS]


@pytest.fixture
def repository(tmp_path: Path) -> Path:
    """All six recordings as the repository has them, five poses each."""
    root = tmp_path / "flange_handeye_calibration"
    for name in ("data/aubo", "data/ur5", "data/ur10e", "data/franka", "Kinect_Result",
                 "calib_toolbox/data/2019-06-14-sample"):  # fmt: skip
        (root / name).mkdir(parents=True)
    aubo(root / "data/aubo")
    for name in ("ur5", "ur10e"):
        ur(root / "data" / name)
    franka(root / "data/franka")
    kinect(root / "Kinect_Result")
    sample(root / "calib_toolbox/data/2019-06-14-sample")
    return root


def aubo(folder):
    blocks = []
    for i, (position, q) in enumerate(zip(POSITIONS, quaternions(), strict=True)):
        blocks.append(
            f"criteria:plane\n19790\n\n \np_robot 6-DoF index:1545_{i}\n"
            f"{[*position.tolist(), *q]}\np_camera 3-DoF index:1545_{i}\n[0.1, 0.2, 0.3]\n"
        )
        if i != 1:
            cloud(folder / f"tool0_1545_{i}.pcd", i)
    (folder / "data.txt").write_text("\n".join(blocks))
    cloud(folder / "tool0_5.pcd", 99)
    matrices(folder, 1)


def ur(folder):
    poses = np.tile(np.eye(4), (N, 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = ROTATIONS, POSITIONS
    np.savez(folder / "calibration_robot_pose_data.npz", poses)
    matrices(folder, 1000)


def franka(folder):
    rows = np.column_stack([POSITIONS, quaternions()])
    np.save(folder / "calibration_robot_pose_data.npy", rows)
    np.savez(folder / "calibration_robot_pose_data.npz", np.vstack([rows, rows]))
    matrices(folder, 1000)


def kinect(folder):
    vectors = [np.array([0.1 * i, 0.2, -0.3]) for i in range(N)]
    np.savetxt(folder / "readRobot.txt", np.column_stack([POSITIONS * 1000, vectors]))
    np.savetxt(folder / "measureRobot.txt", CENTRES * 1000)
    (folder / "new.txt").write_text("-105 124 394\n-498.88\t-261.33\t895.64\t0.2\t0.8\t-2\n")
    cloud(folder / "flange.pcd", 98, "mm")


def sample(folder):
    entries = {}
    for i, (x, y, z, w) in enumerate(quaternions()):
        pose = [*POSITIONS[i].tolist(), w, x, y, z]
        centre = (CENTRES[i] * 1000).tolist() if i in FITTED else []
        entries[str(i)] = {"p_cam": centre, "p_robot": pose[:3], "robot_pose": pose}
        cloud(folder / f"0{2 * i + 1}_tool_valid.pcd", i, "mm")
    (folder / "calib_data.json").write_text(json.dumps(entries))


# --- what it gives -----------------------------------------------------------------------------

POSES = {"aubo": [f"1545_{i}" for i in range(N)]}
CLOUD_UNITS = {"aubo": "m"}


@pytest.mark.parametrize("robot", ["aubo", "ur5", "ur10e", "franka", "sample-2019"])
def test_poses_and_centres_come_out_in_metres(repository: Path, robot: str) -> None:
    archive = read(repository, robot)
    recordings = [r for r in archive.recordings if r.role == "calibration"]
    assert [r.id for r in recordings] == POSES.get(robot, [str(i) for i in range(N)])
    assert archive.cloud_unit == CLOUD_UNITS.get(robot, "mm")
    for i, recording in enumerate(recordings):
        np.testing.assert_allclose(recording.base_T_flange[:3, :3], ROTATIONS[i], atol=1e-12)
        np.testing.assert_allclose(recording.base_T_flange[:3, 3], POSITIONS[i], atol=1e-12)
        assert (recording.centre_in_camera is not None) == (i in FITTED)
        if i in FITTED:
            np.testing.assert_allclose(recording.centre_in_camera, CENTRES[i], rtol=1e-6)


def test_the_aubo_has_clouds_and_one_to_verify_with(repository: Path) -> None:
    archive = read(repository, "aubo")
    names = [r.cloud and r.cloud.name for r in archive.recordings]
    assert names == ["tool0_5.pcd", "tool0_1545_0.pcd", None, "tool0_1545_2.pcd",
                     "tool0_1545_3.pcd", "tool0_1545_4.pcd"]  # fmt: skip
    assert (archive.recordings[0].id, archive.recordings[0].role) == ("5", "verification")
    assert archive.recordings[0].base_T_flange[0, 3] == 0.27704067625331485


def test_the_kinect_has_millimetres_and_rotation_vectors(repository: Path) -> None:
    verification, *recordings = read(repository, "kinect").recordings
    for i, recording in enumerate(recordings):
        expected = rotation_exp(np.array([0.1 * i, 0.2, -0.3]))
        np.testing.assert_allclose(recording.base_T_flange[:3, :3], expected, atol=1e-12)
        np.testing.assert_allclose(recording.base_T_flange[:3, 3], POSITIONS[i], atol=1e-12)
        np.testing.assert_allclose(recording.centre_in_camera, CENTRES[i])
    assert (verification.role, verification.cloud.name) == ("verification", "flange.pcd")
    assert verification.base_T_flange[0, 3] == pytest.approx(-0.49888)


def test_the_i_th_cloud_of_the_sample_belongs_to_the_i_th_pose(repository: Path) -> None:
    names = [r.cloud.name for r in read(repository, "sample-2019").recordings]
    assert names == [f"0{2 * i + 1}_tool_valid.pcd" for i in range(N)]


@pytest.mark.parametrize(
    ("path", "robot", "layout"),
    [
        (".", "aubo", "ancorasir aubo"),
        ("data", "ur10e", "ancorasir ur10e"),
        ("data/ur10e", "ur10e", "ancorasir ur10e"),
        ("data/ur10e", None, "ancorasir ur10e"),
        ("data/franka", None, "ancorasir franka"),
        ("Kinect_Result", None, "ancorasir kinect"),
        ("calib_toolbox", None, "ancorasir sample-2019"),
        ("calib_toolbox/data/2019-06-14-sample", "sample-2019", "ancorasir sample-2019"),
    ],
)
def test_the_path_may_be_the_whole_or_a_part(
    repository: Path, path: str, robot: str | None, layout: str
) -> None:
    assert read(repository / path, robot).layout == layout


def test_a_recording_moved_away_is_known_by_its_files(repository: Path) -> None:
    moved = repository / "data/aubo"
    moved = moved.rename(repository.parent / "monday")
    assert read(moved).layout == "ancorasir aubo"


# --- what it refuses ---------------------------------------------------------------------------


def test_several_recordings_are_not_guessed_between(repository: Path) -> None:
    assert refused(repository) == (
        f"{repository}: holds the recordings aubo, ur5, ur10e, franka, kinect, sample-2019; "
        "choose one, for example reader: {ancorasir: {robot: aubo}}"
    )


def test_a_recording_that_is_not_there(repository: Path) -> None:
    folder = repository / "data/aubo"
    assert refused(folder, "ur5") == (
        f"{folder}: no recording 'ur5' (no data/ur5/calibration_robot_pose_data.npz); found: aubo"
    )


def spoil(folder, robot, file, old, new):
    path = folder / file
    text = path.read_text()
    assert re.search(old, text)
    path.write_text(re.sub(old, new, text, count=1))
    return refused(folder, robot)


def test_spoilt_poses_of_the_aubo(repository: Path) -> None:
    folder = repository / "data/aubo"
    file = folder / "data.txt"
    whole = file.read_text()

    def spoilt(old, new):
        file.write_text(whole)
        return spoil(folder, "aubo", "data.txt", old, new)

    assert spoilt("index:1545_1", "index:1545_0") == f"{file}:14: pose '1545_0' is given twice"
    assert spoilt("index:1545_3\n.*", "index:1545_3\n[1, 2]") == (
        f"{file}:33: expected [x, y, z, qx, qy, qz, qw], found '[1, 2]'"
    )
    assert spoilt("index:1545_3\n.*", "index:1545_3\n[1,2,3,0,0,0,nan]") == (
        f"{file}: pose '1545_3': has values that are not finite"
    )
    assert spoilt("index:1545_3\n.*", "index:1545_3\n[1,2,3,0,0,1,1]") == (
        f"{file}: pose '1545_3': the quaternion's norm is 1.414; it must be 1 (within 0.001)"
    )
    file.write_text("criteria:plane\n")
    assert refused(folder) == f"{file}: holds no poses (no line 'p_robot 6-DoF index:<id>')"


def test_a_cloud_whose_pose_is_missing(repository: Path) -> None:
    folder = repository / "data/aubo"
    cloud(folder / "tool0_77.pcd", 77)
    assert refused(folder) == (
        f"{folder}/tool0_77.pcd: data.txt has no pose '77'; add it, or move the cloud away"
    )


def test_centres_and_poses_that_do_not_belong_together(repository: Path) -> None:
    folder = repository / "data/ur5"
    np.save(folder / "p_camera_mat.npy", CENTRES[:2].T)
    assert refused(folder) == (
        f"{folder}/p_robot_mat.npy: counts differ: p_robot_mat.npy has 3, p_camera_mat.npy has 2"
    )
    np.save(folder / "p_camera_mat.npy", np.full((3, 3), np.nan))
    assert refused(folder) == f"{folder}/p_camera_mat.npy: column 0 is not finite"
    np.save(folder / "p_robot_mat.npy", POSITIONS[FITTED].T)
    assert refused(folder) == (
        f"{folder}/p_robot_mat.npy: column 0 is at the position of no pose, or of one already taken"
    )
    np.save(folder / "p_robot_mat.npy", POSITIONS)
    assert refused(folder) == (
        f"{folder}/p_robot_mat.npy: has shape (5, 3), expected (3, n) numbers"
    )


def test_poses_that_are_no_poses(repository: Path) -> None:
    folder = repository / "data/ur5"
    file = folder / "calibration_robot_pose_data.npz"
    poses = np.tile(np.eye(4), (N, 1, 1))
    poses[2, 0, 0] = 1.5
    np.savez(file, poses)
    assert refused(folder) == (
        f"{file}: pose 2: is not a rigid transform (its rotation is 1.2 from orthonormal, at most "
        "0.001 is allowed)"
    )
    np.savez(file, other=poses)
    assert refused(folder) == f"{file}: holds no array 'arr_0'"
    np.savez(file, poses[0])
    assert refused(folder) == f"{file}: has shape (4, 4), expected (n, 4, 4) numbers"
    file.write_bytes(file.read_bytes()[:100])
    assert refused(folder) == f"{file}: is not a NumPy .npz file: File is not a zip file"


def test_counts_that_differ(repository: Path) -> None:
    folder = repository / "Kinect_Result"
    text = (folder / "measureRobot.txt").read_text()
    (folder / "measureRobot.txt").write_text(text.partition("\n")[2])
    assert refused(folder) == (
        f"{folder}/readRobot.txt: counts differ: readRobot.txt has 5, measureRobot.txt has 4"
    )
    folder = repository / "calib_toolbox/data/2019-06-14-sample"
    (folder / "03_tool_valid.pcd").unlink()
    assert refused(folder) == (
        f"{folder}/calib_data.json: counts differ: calib_data.json has 5, NN_tool.ply has 4"
    )


def test_spoilt_text(repository: Path) -> None:
    folder = repository / "Kinect_Result"
    (folder / "measureRobot.txt").write_text("1 2 3\n4 5\n")
    assert refused(folder) == (
        f"{folder}/measureRobot.txt:2: has 2 numbers, expected 3 finite numbers"
    )
    (folder / "measureRobot.txt").write_text("1 2 x\n")
    assert refused(folder) == (
        f"{folder}/measureRobot.txt:1: could not convert string to float: 'x'"
    )
    (folder / "measureRobot.txt").write_text("\n")
    assert refused(folder) == f"{folder}/measureRobot.txt: holds no numbers"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "is not JSON: Expecting property name enclosed in double quotes: line 1 column 2 "
              "(char 1)"),
        ("[]", 'expected an object of numbered poses, {"0": {…}, …}'),
    ],
)  # fmt: skip
def test_spoilt_json(repository: Path, text: str, message: str) -> None:
    folder = repository / "calib_toolbox/data/2019-06-14-sample"
    file = folder / "calib_data.json"
    file.write_text(text)
    assert refused(folder) == f"{file}: {message}"


def test_a_spoilt_entry(repository: Path) -> None:
    folder = repository / "calib_toolbox/data/2019-06-14-sample"
    file = folder / "calib_data.json"
    whole = json.loads(file.read_text())
    file.write_text(json.dumps(whole | {"1": {"p_cam": [1, 2, 3]}}))
    assert refused(folder) == (
        f"{file}: '1': robot_pose or p_cam is missing or wrong ('robot_pose')"
    )
    file.write_text(json.dumps(whole | {"1": {"p_cam": [1, 2, 3], "robot_pose": [1, 2]}}))
    assert refused(folder) == f"{file}: '1': robot_pose has 2 numbers, not 7; p_cam 3"


# --- the recordings themselves -----------------------------------------------------------------


def acquire(path, robot, scanner, **params):
    reader = ancorasir.bind(AncorasirParams(robot=robot))
    return acquire_archive(scanner, ArchivePath(path), ArchiveParams(reader=reader, **params))


def test_the_published_aubo_recording(ancorasir_folder: Any, scanner: Any) -> None:
    stream = acquire(ancorasir_folder, "aubo", scanner)
    captures = list(stream)
    assert captures[0].role == "verification"
    assert (
        len(captures)
        == stream.total
        == 1 + sum(1 for _ in (ancorasir_folder / "data/aubo").glob("tool0_1*.pcd"))
    )
    for capture in captures[1:]:
        # The flange's face looks at the scanner, and its middle is near the published centre.
        assert np.isfinite(capture.cloud.xyz).all()
    assert stream.source.notes[-1].startswith("clouds in m (as the layout states): the first has")


def test_the_whole_published_folder_says_which_nine_poses_it_skips(
    ancorasir_folder: Any, scanner: Any, tmp_path: Path
) -> None:
    """Clouds stand in for the 24 that this copy lacks; poses and centres are the real ones."""
    original = ancorasir_folder / "data/aubo"
    for name in ("data.txt", "p_robot_mat.npy", "p_camera_mat.npy"):
        (tmp_path / name).write_bytes((original / name).read_bytes())
    fitted = [r for r in read(original).recordings if r.centre_in_camera is not None]
    for i, recording in enumerate(fitted):
        cloud(tmp_path / f"tool0_{recording.id}.pcd", i)
    cloud(tmp_path / "tool0_5.pcd", 99)
    stream = acquire(tmp_path, "aubo", scanner)
    assert stream.total == 55
    (skipped,) = [note for note in stream.source.notes if note.startswith("skipped")]
    assert re.fullmatch(r"skipped 9 of 63 poses, without a cloud: (\d+_\d+, ){8}\d+_\d+", skipped)


def test_metres_of_the_aubo_declared_as_millimetres(ancorasir_folder: Any, scanner: Any) -> None:
    with pytest.raises(StageError, match=r"these look like metres: set unit: m$"):
        acquire(ancorasir_folder, "aubo", scanner, unit="mm")


def test_clouds_of_the_sample_lie_around_the_published_centres(ancorasir_folder: Any) -> None:
    for recording in read(ancorasir_folder, "sample-2019").recordings:
        points = read_cloud(recording.cloud, "mm").points()
        middle = (points.min(axis=0) + points.max(axis=0)) / 2
        assert np.linalg.norm(middle - recording.centre_in_camera) < 3e-3


@pytest.mark.parametrize("robot", ["ur5", "franka", "kinect"])
def test_recordings_without_clouds_name_the_other_way(
    ancorasir_folder: Any, robot: str, scanner: Any
) -> None:
    with pytest.raises(StageError, match=r"; acquire\.centres can use its \d\d "):
        acquire(ancorasir_folder, robot, scanner)


@pytest.fixture
def ancorasir_folder(request: pytest.FixtureRequest) -> Any:
    return request.getfixturevalue("ancorasir")
