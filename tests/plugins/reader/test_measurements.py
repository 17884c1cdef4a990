"""Measurements in tables and arrays, however they are written, are the ones that were made."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pydantic import ValidationError
from scipy.io import savemat
from scipy.spatial.transform import Rotation

from flangeye import StageError
from flangeye.maths.kinematics import Arm
from flangeye.maths.streams import clock_offset, standstills, turning
from flangeye.models.loading import load_model
from flangeye.plugin.registry import load_registry
from flangeye.types.geometry import rigid
from flangeye_plugins.reader.corrected import CorrectedParams, corrected
from flangeye_plugins.reader.pairing import _ms
from flangeye_plugins.reader.samples import visp
from flangeye_plugins.reader.table import TableParams, table

RNG = np.random.default_rng(4)


def random_pose(rng=RNG):
    return rigid(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1, 1, 3))


ARM = np.array([random_pose() for _ in range(6)])
SEEN = np.array([random_pose() for _ in range(6)])
SECOND = np.array([random_pose() for _ in range(6)])


def quaternions(poses):
    xyzw = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
    return np.hstack([poses[:, :3, 3], xyzw])


def written(path, heading, rows, mark=",", decimal="."):
    cells = [[repr(float(x)).replace(".", decimal) for x in row] for row in rows]
    lines = ([mark.join(heading)] if heading else []) + [mark.join(row) for row in cells]
    path.write_text("\n".join(lines) + "\n")


def params(**more):
    return TableParams.model_validate(
        {"rotation": "xyzw", "length": "m", "pose": "base_T_flange", **more}
    )


def test_a_column_is_named_once() -> None:
    with pytest.raises(ValidationError, match="names the column x twice; each number of a pose"):
        params(columns=["x", "x", "z", "qx", "qy", "qz", "qw"])


@pytest.mark.parametrize(
    ("mark", "decimal", "name"),
    [(",", ".", "a.csv"), (";", ",", "a.dat"), ("\t", ",", "a.txt"), (" ", ",", "a.log"),
     (" ", ".", "a.poses"), (";", ".", "a.tsv")],
)  # fmt: skip
@pytest.mark.parametrize("heading", [True, False])
def test_separators_and_decimal_commas(
    tmp_path: Path, mark: str, decimal: str, name: str, heading: bool
) -> None:
    names = ["x", "y", "z", "qx", "qy", "qz", "qw", "u", "v", "w"]
    rows = np.hstack([quaternions(ARM), SEEN[:, :3, 3] * 1e3])
    written(tmp_path / name, names if heading else None, rows, mark, decimal)
    target = {"columns": ["u", "v", "w"] if heading else [8, 9, 10],
              "rotation": "point", "length": "mm"}  # fmt: skip
    found = table(tmp_path, params(file=name, target=target)).recordings
    assert np.allclose([r.base_T_flange for r in found], ARM, atol=1e-12)
    assert np.allclose([r.centre_in_camera for r in found], SEEN[:, :3, 3], atol=1e-12)


@pytest.mark.parametrize("count", [12, 16])
@pytest.mark.parametrize("turned", [True, False])
def test_columns_in_any_order_and_matrices_either_way_round(
    tmp_path: Path, count: int, turned: bool
) -> None:
    """Angles first, time last; the target as 12 or 16 numbers, or its inverse; a second arm."""
    angles = Rotation.from_matrix(ARM[:, :3, :3]).as_euler("ZYX", degrees=True)
    seen = np.linalg.inv(SEEN) if turned else SEEN
    seconds = quaternions(np.linalg.inv(SECOND))
    rows = np.hstack([angles, ARM[:, :3, 3] * 1e3, seen.reshape(6, 16)[:, :count], seconds,
                      np.arange(6)[:, None] * 1.5])  # fmt: skip
    names = [*"abcxyz", *(f"m{i}" for i in range(count)), *(f"s{i}" for i in range(7)), "t"]
    written(tmp_path / "all.csv", names, rows)
    found = table(tmp_path / "all.csv", TableParams.model_validate({
        "rotation": "kuka", "length": "mm", "angle": "deg", "pose": "base_T_flange",
        "columns": [*"xyzabc"], "time": "t",
        "target": {"columns": names[6 : 6 + count], "rotation": "matrix", "length": "m",
                   "pose": "target_T_camera" if turned else "camera_T_target"},
        "second": {"columns": [f"s{i}" for i in range(7)], "rotation": "xyzw", "length": "m",
                   "pose": "flange2_T_base2"},
    })).recordings  # fmt: skip
    assert np.allclose([r.base_T_flange for r in found], ARM, atol=1e-9)
    assert np.allclose([r.camera_T_target for r in found], SEEN, atol=1e-9)
    assert np.allclose([r.poses["flange2"] for r in found], SECOND, atol=1e-9)
    assert [r.time_ns for r in found] == [1_500_000_000 * i for i in range(6)]


def test_a_commented_heading_is_a_heading_and_empty_cells_are_no_target(tmp_path: Path) -> None:
    rows = np.hstack([quaternions(ARM), SEEN[:, :3, 3]])
    lines = [" ".join(repr(float(x)) for x in row) for row in rows]
    lines[2] = lines[2].rsplit(" ", 3)[0] + " nan nan nan"
    (tmp_path / "tum.txt").write_text("# x y z qx qy qz qw u v w\n" + "\n".join(lines))
    target = {"columns": ["u", "v", "w"], "rotation": "point", "length": "m"}
    found = table(tmp_path, params(file="tum.txt", target=target)).recordings
    assert [r.centre_in_camera is None for r in found] == [i == 2 for i in range(6)]


def moving(times, still):
    """A smooth motion that pauses, where ``still``, in six places for a second each."""
    phase = np.cumsum(np.gradient(times) * (0 if still is None else (times % 2 < 1) | ~still))
    turn = np.stack([0.9 * np.sin(phase), 0.7 * np.cos(1.3 * phase), 0.5 * np.sin(0.7 * phase)], 1)
    place = np.stack([0.2 * np.sin(phase), 0.3 * np.cos(phase), 0.1 * phase], 1)
    rotations = Rotation.from_rotvec(turn).as_matrix()
    return np.array([rigid(r, p) for r, p in zip(rotations, place, strict=True)])


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_joint_angles_stand_in_the_table(tmp_path: Path, unit: str) -> None:
    joints = np.random.default_rng(5).uniform(-3, 3, (6, 6))
    angles = joints if unit == "rad" else np.degrees(joints)
    names = ["x", "y", "z", "qx", "qy", "qz", "qw", "u", "v", "w", *(f"q{i}" for i in range(6))]
    written(tmp_path / "a.csv", names, np.hstack([quaternions(ARM), SEEN[:, :3, 3], angles]))
    target = {"columns": ["u", "v", "w"], "rotation": "point", "length": "m"}
    given = params(file="a.csv", target=target, joints=names[10:], joint_unit=unit)
    found = table(tmp_path, given).recordings
    assert np.allclose([r.base_T_flange for r in found], ARM, atol=1e-12)
    assert np.allclose([r.joints for r in found], joints, atol=1e-12)


@pytest.mark.parametrize("still", [True, False])
@pytest.mark.parametrize("offset", [0.0, 0.18, -0.43])
def test_two_streams_are_paired_and_their_clocks_compared(
    tmp_path: Path, still: bool, offset: float
) -> None:
    """The camera's clock is ahead by ``offset``; X of AX = XB comes out to the same pairs."""
    base_T_camera, flange_T_target = random_pose(), random_pose()
    times = np.arange(0, 14, 0.008)
    arm = moving(times, np.full(times.shape, still))
    seen_at = np.arange(0.5, 13.5, 0.033)
    which = np.searchsorted(times, seen_at)
    seen = np.linalg.inv(base_T_camera) @ arm[which] @ flange_T_target
    written(tmp_path / "arm.csv", ["t", *"xyzabcd"], np.hstack([times[:, None], quaternions(arm)]))
    written(tmp_path / "seen.csv", ["t", *"xyzabcd"],
            np.hstack([times[which][:, None] + offset, quaternions(seen)]))  # fmt: skip
    target = {"file": "seen.csv", "time": "t", "rotation": "xyzw", "length": "m"}
    archive = table(tmp_path, params(file="arm.csv", time="t", target=target))
    found = archive.recordings
    told = float(archive.notes[0].split("clock offset ")[1].split(" ms")[0])
    assert told == pytest.approx(-1e3 * offset, abs=5)
    assert "estimated from both motions" in archive.notes[0]
    wrong = [
        np.linalg.norm(
            (np.linalg.inv(base_T_camera) @ r.base_T_flange @ flange_T_target)[:3, 3]
            - r.camera_T_target[:3, 3]
        )
        for r in found
    ]
    assert len(found) == 7 if still else len(found) > 20
    assert max(wrong) < (1e-4 if still else 4e-3)


def test_a_delay_is_undone_by_the_stream_of_an_arm_that_moved(tmp_path: Path) -> None:
    """Between the poses taken, 5 mm and more apart, nothing but the stream tells where it was."""
    times = np.arange(0, 8, 0.008)
    arm = moving(times, np.full(times.shape, False))
    which = np.arange(100, 900, 50)
    written(tmp_path / "arm.csv", ["t", *"xyzabcd"], np.hstack([times[:, None], quaternions(arm)]))
    written(tmp_path / "seen.csv", ["t", *"xyzabcd"],
            np.hstack([times[which][:, None] - 0.08, quaternions(np.linalg.inv(arm[which]))]))  # fmt: skip
    target = {"file": "seen.csv", "time": "t", "rotation": "xyzw", "length": "m"}
    read = {"rotation": "xyzw", "length": "m", "pose": "base_T_flange", "file": "arm.csv",
            "time": "t", "target": target, "join": {"clock_offset": "0 s"}}  # fmt: skip
    late = table(tmp_path, params(**read)).recordings
    assert all(recording.motion is not None for recording in late)
    reader = load_registry().part("reader.table").bind(params(**read))
    mended = corrected(
        tmp_path, CorrectedParams.model_validate({"reader": reader, "delay": "80 ms"})
    ).recordings
    assert len(mended) == len(late) == len(which)
    wrong = [np.linalg.norm((r.base_T_flange @ r.camera_T_target)[:3, 3]) for r in (*late, *mended)]
    assert min(wrong[: len(late)]) > 5e-3
    assert max(wrong[len(late) :]) < 1e-4


def test_standstills_are_found_and_noise_does_not_break_them() -> None:
    times = np.arange(0, 12, 0.008)
    arm = moving(times, np.full(times.shape, True))
    arm[:, :3, 3] += RNG.normal(0, 5e-5, (len(times), 3))
    spans = standstills(times, arm)
    assert len(spans) == 6
    assert all(0.9 < s.end - s.start < 1.1 for s in spans)


def test_signals_that_are_not_alike_give_no_offset() -> None:
    times = np.arange(0, 10, 0.02)
    arm = turning(times, moving(times, np.full(times.shape, False)))
    assert clock_offset(arm, (arm[0], RNG.normal(size=len(arm[0])))) == (0.0, 0.0)


def test_streams_without_a_common_time_are_refused(tmp_path: Path) -> None:
    rows = np.hstack([np.arange(6)[:, None], quaternions(ARM)])
    written(tmp_path / "arm.csv", ["t", *"xyzabcd"], rows)
    rows[:, 0] += 1000
    written(tmp_path / "seen.csv", ["t", *"xyzabcd"], rows)
    target = {"file": "seen.csv", "time": "t", "rotation": "xyzw", "length": "m"}
    with pytest.raises(StageError) as error:
        table(tmp_path, params(file="arm.csv", time="t", target=target))
    assert str(error.value) == (
        f"{tmp_path / 'seen.csv'}: the arm's poses are from 0.000 to 5.000 s, the measurements from "
        "1000.000 to 1005.000 s: they have no time in common; set clock_offset"
    )


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"target": {"rotation": "point", "length": "m", "columns": ["uu", "v"]}},
         "a.csv: has no column 'uu'; known: u"),
        ({"target": {"rotation": "point", "length": "m", "columns": ["u", "v"]}, "columns": [1]},
         "a.csv:2: xyzw has 7 numbers (x y z a b c d), not 1"),
        ({"target": {"rotation": "point", "length": "m", "columns": ["u", "v"]}},
         "a.csv:2: a point has 3 finite numbers, not 2"),
        ({"columns": [99]}, "a.csv: has no column 99; they are 1 to 9"),
        ({"time": "v"}, "a.csv:3: its time is not after the row before it"),
        ({"columns": [*"xyzabcd"], "target": {"rotation": "point", "length": "m", "file": "b.csv"}},
         "b.csv: has 1 rows, a.csv has 6; give each a column time to join them by it, or remove the "
         "surplus"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_table_is_one_line(
    tmp_path: Path, given: dict[str, Any], message: str
) -> None:
    rows = np.hstack([quaternions(ARM), np.ones((6, 2))])
    written(tmp_path / "a.csv", [*"xyzabcd", "u", "v"], rows)
    (tmp_path / "b.csv").write_text("1,2,3\n")
    if "time" in given:
        for i in range(6):
            cv2.imwrite(str(tmp_path / f"{i}.png"), np.full((4, 4), i, np.uint8))
        given |= {"columns": [*"xyzabcd"]}
    with pytest.raises(StageError) as error:
        table(tmp_path, params(file="a.csv", **given))
    assert str(error.value).removeprefix(f"{tmp_path}/") == message


def test_a_target_in_the_same_table_needs_its_columns() -> None:
    with pytest.raises(ValidationError, match="give its columns, as names or numbers from 1, or"):
        params(target={"rotation": "point", "length": "m"})


def opencv_file(path):
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for i, (arm, seen) in enumerate(zip(ARM, SEEN, strict=True)):
        storage.write(f"T1_{i}", arm)
        storage.write(f"T2_{i}", seen)
    storage.write("frameCount", 6)
    storage.release()


def saved(folder, sort):
    """Write ARM and SEEN in one of the ways; return how the recipe names each."""
    if sort == "npy":
        np.save(folder / "arm.npy", ARM)
        np.save(folder / "seen.npy", SEEN)
        return {"file": "arm.npy"}, {"file": "seen.npy"}
    if sort == "npz":
        np.savez(folder / "both.npz", arm=ARM, seen=SEEN, name="x")
        return {"file": "both.npz", "columns": ["arm"]}, {"columns": ["seen"]}
    if sort == "mat":
        savemat(folder / "b.mat", {"arm": np.moveaxis(ARM, 0, 2), "seen": np.moveaxis(SEEN, 0, 2)})
        return {"file": "b.mat", "columns": ["arm"]}, {"columns": ["seen"]}
    if sort in ("yml", "xml"):
        opencv_file(folder / f"data.{sort}")
        return {"file": f"data.{sort}", "columns": ["T1"]}, {"columns": ["T2"]}
    for name, poses in (("arm", ARM), ("seen", SEEN)):
        (folder / name).mkdir()
        for i, pose in enumerate(poses, 8):  # pose_10 comes after pose_9
            np.savetxt(folder / name / f"pose_{i}.txt", pose, delimiter="," if i % 2 else " ")
    return {"file": "arm/*.txt"}, {"file": "seen/*.txt"}


@pytest.mark.parametrize("sort", ["npy", "npz", "mat", "yml", "xml", "text"])
def test_arrays_of_every_program(tmp_path: Path, sort: str) -> None:
    arm, seen = saved(tmp_path, sort)
    target = seen | {"rotation": "matrix", "length": "m"}
    found = table(tmp_path, params(**arm, rotation="matrix", target=target)).recordings
    assert np.allclose([r.base_T_flange for r in found], ARM, atol=1e-9)
    assert np.allclose([r.camera_T_target for r in found], SEEN, atol=1e-9)


def test_rows_of_numbers_in_an_array_and_the_other_way_round(tmp_path: Path) -> None:
    np.savez(tmp_path / "r.npz", arm=quaternions(np.linalg.inv(ARM)), seen=1e3 * SEEN[:, :3, 3],
             second=quaternions(SECOND))  # fmt: skip
    found = table(tmp_path, TableParams.model_validate({
        "file": "r.npz", "columns": ["arm"], "rotation": "xyzw", "length": "m",
        "pose": "flange_T_base",
        "target": {"columns": ["seen"], "rotation": "point", "length": "mm"},
        "second": {"columns": ["second"], "rotation": "xyzw", "length": "m"},
    })).recordings  # fmt: skip
    assert np.allclose([r.base_T_flange for r in found], ARM, atol=1e-9)
    assert np.allclose([r.centre_in_camera for r in found], SEEN[:, :3, 3], atol=1e-9)
    assert np.allclose([r.poses["flange2"] for r in found], SECOND, atol=1e-9)


def visp_text(pose):
    vector = [*pose[:3, 3], *Rotation.from_matrix(pose[:3, :3]).as_rotvec()]
    rows = "".join(f"  - [{x:.15g}]\n" for x in vector)
    return f"# Pose vector with 3 translations in meters\nrows: 6\ncols: 1\ndata:\n{rows}"


def test_visps_pose_files(tmp_path: Path) -> None:
    for i, (arm, seen) in enumerate(zip(ARM, SEEN, strict=True), 1):
        (tmp_path / f"pose_rPe_{i}.yaml").write_text(visp_text(arm))
        (tmp_path / f"pose_cPo_{i}.yaml").write_text(visp_text(seen))
    found = visp(tmp_path).recordings
    assert np.allclose([r.base_T_flange for r in found], ARM, atol=1e-9)
    assert np.allclose([r.camera_T_target for r in found], SEEN, atol=1e-9)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"file": "none.npy"}, "holds no none.npy"),
        ({"file": "both.npz", "columns": ["arms"]}, "both.npz: has no column 'arms'; known: arm."),
        ({"file": "two.npz"}, "two.npz: holds 2 tables; name one of two.npz:arm, two.npz:time"),
        ({"file": "two.npz:b"}, "two.npz: has no part 'b'; name one of two.npz:arm, two.npz:time"),
        ({"file": "odd.npy"}, "odd.npy: row 1: a matrix has 12 or 16 numbers, not 20"),
        ({"file": "rows.txt"}, "rows.txt:1: a matrix has 12 or 16 numbers, not 7"),
        ({"file": "rows.txt:1/4"}, "rows.txt: has 6 rows, which are not 4 parts of equal length"),
        ({"file": ["rows.txt", "two.npz:time"]},
         "rows.txt: tables side by side have different numbers of rows: rows.txt 6, two.npz:time 9"),
        ({"file": "broken.npz"}, "broken.npz: is not a NumPy .npz file: "),
        ({"file": "words.txt"}, "words.txt: holds no poses"),
    ],
)  # fmt: skip
def test_a_mistake_in_arrays_is_one_line(
    tmp_path: Path, given: dict[str, Any], message: str
) -> None:
    saved(tmp_path, "npz")
    np.savez(tmp_path / "two.npz", arm=ARM, time=np.ones((9, 2)))
    np.save(tmp_path / "odd.npy", np.ones((6, 5, 4)))
    np.savetxt(tmp_path / "rows.txt", quaternions(ARM))
    (tmp_path / "broken.npz").write_bytes(b"PK\x03\x04")
    (tmp_path / "words.txt").write_text("no numbers here\n")
    with pytest.raises(StageError) as error:
        table(tmp_path, params(**given, rotation="matrix"))
    assert message in str(error.value)
    assert "\n" not in str(error.value)


def test_rotations_and_positions_stand_side_by_side(tmp_path: Path) -> None:
    """In two files, in two arrays of one, and matrices line by line in a text."""
    np.save(tmp_path / "t.npy", ARM[:, :3, 3:])
    np.savetxt(tmp_path / "R.txt", ARM[:, :3, :3].reshape(-1, 3))
    np.savez(tmp_path / "seen.npz", R=SEEN[:, :3, :3], t=SEEN[:, :3, 3])
    target = {"file": "seen.npz", "columns": ["t", "R"], "rotation": "3x3", "length": "m"}
    found = table(
        tmp_path, params(file=["t.npy", "R.txt"], rotation="3x3", target=target)
    ).recordings
    assert np.allclose([r.base_T_flange for r in found], ARM, atol=1e-9)
    assert np.allclose([r.camera_T_target for r in found], SEEN, atol=1e-9)


def blocks(folder, between, heading=""):
    text = [heading + "\n".join(" ".join(map(repr, row)) for row in quaternions(p).tolist())
            for p in (ARM, SEEN)]  # fmt: skip
    (folder / "both.txt").write_text(between.join(text) + "\n")


@pytest.mark.parametrize(
    ("between", "heading", "parts"),
    [("\n\n", "", ("1", "2")), ("\n# then the marker\n", "", ("1", "2")), ("\n", "", ("1/2", "2/2")),
     ("\n\nmarker\n", "", ("1", "2")), ("\n\n", "x y z qx qy qz qw\n", ("1", "2"))],
)  # fmt: skip
def test_two_blocks_in_one_text(
    tmp_path: Path, between: str, heading: str, parts: tuple[str, str]
) -> None:
    blocks(tmp_path, between, heading)
    arm, seen = (f"both.txt:{part}" for part in parts)
    target = {"file": seen, "rotation": "xyzw", "length": "m"}
    found = table(tmp_path, params(file=arm, target=target)).recordings
    assert np.allclose([r.base_T_flange for r in found], ARM, atol=1e-9)
    assert np.allclose([r.camera_T_target for r in found], SEEN, atol=1e-9)


def test_a_file_for_each_pose_is_paired_by_its_number(tmp_path: Path) -> None:
    numbers = [1, 2, 10, 11, 3, 20]
    for k, (arm, seen) in enumerate(zip(ARM, SEEN, strict=True)):
        np.savetxt(tmp_path / f"arm_{numbers[k]}.txt", arm)
        np.savetxt(tmp_path / f"cam_{numbers[k]:03}.txt", seen)
    target = {"file": "cam_*.txt", "rotation": "matrix", "length": "m"}
    archive = table(tmp_path, params(file="arm_*.txt", rotation="matrix", target=target))
    order = np.argsort(numbers)
    assert np.allclose([r.base_T_flange for r in archive.recordings], ARM[order], atol=1e-9)
    assert np.allclose([r.camera_T_target for r in archive.recordings], SEEN[order], atol=1e-9)
    assert archive.notes == ["paired by number: arm_1 with cam_001, …, arm_20 with cam_020"]
    (tmp_path / "cam_003.txt").rename(tmp_path / "cam_004.txt")
    with pytest.raises(StageError, match=r"no partner for arm_3, and no partner for cam_004"):
        table(tmp_path, params(file="arm_*.txt", rotation="matrix", target=target))


def test_joint_angles_alone_are_poses_by_the_robots_kinematics(tmp_path: Path) -> None:
    robot = load_model("robots", "ur5e")
    joints = np.random.default_rng(1).uniform(-2, 2, (6, 6))
    np.savetxt(tmp_path / "j.csv", np.hstack([np.degrees(joints), SEEN[:, :3, 3]]), delimiter=",")
    given = TableParams.model_validate({
        "file": "j.csv", "joints": [1, 2, 3, 4, 5, 6], "joint_unit": "deg",
        "target": {"columns": [7, 8, 9], "rotation": "point", "length": "m"},
    })  # fmt: skip
    found = table(tmp_path, given, robot).recordings
    assert np.allclose([r.base_T_flange for r in found], Arm(robot).flange(joints), atol=1e-9)
    assert np.allclose([r.joints for r in found], joints)
    with pytest.raises(StageError, match=r"joint angles become poses by the arm's kinematics; wri"):
        table(tmp_path, given)


def test_a_clock_offset_of_nothing_has_no_sign() -> None:
    assert [_ms(x) for x in (-4e-5, 0.0, -0.2)] == ["0.0 ms", "0.0 ms", "-200.0 ms"]
