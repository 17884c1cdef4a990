"""A ROS 2 bag, read without ROS, gives what was recorded."""

import json
import sqlite3
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from scipy.spatial.transform import Rotation

from flangeye import StageError
from flangeye.files.clouds import read_cloud
from flangeye.files.recording import NotThisLayout
from flangeye.maths.kinematics import Arm
from flangeye.maths.streams import joints_at
from flangeye.models.loading import load_model
from flangeye.models.urdf import robot_from_urdf
from flangeye.plugin.registry import load_registry
from flangeye.types import ArchivePath
from flangeye.types.geometry import rigid
from flangeye.workflow.log import records
from flangeye.workflow.recipe.load import load_recipe, parse_recipe
from flangeye.workflow.run.runner import Runner
from flangeye_plugins.reader.folder import FolderParams, folder
from flangeye_plugins.reader.ros2_bag import BagParams, ros2_bag
from flangeye_plugins.reader.ros2_messages import bag_files, messages
from flangeye_plugins.ros2.messages import cloud_of
from tests.plugins.reader.bags import (
    FIXED,
    START,
    camera_info,
    compressed,
    image,
    joint_state,
    point_cloud,
    pose_stamped,
    stops,
    tf,
    write_bag,
)
from tests.testing.test_builtins import SAMPLE

RNG = np.random.default_rng(8)
POSES = np.array(
    [
        rigid(Rotation.random(random_state=RNG).as_matrix(), RNG.uniform(-0.5, 0.5, 3))
        for _ in "12345"
    ]
)
CLOUDS = RNG.normal(0, 0.1, (5, 6, 7, 3)).astype(np.float32) + np.array([0, 0, 1], np.float32)


def read(path, **params):
    return ros2_bag(path, BagParams.model_validate(params))


def robot_in_tf(poses):
    """The flange by way of a link that moves and one that does not, in UR's two bases."""
    times, moving, middles = stops(poses)
    link_T_flange = rigid(Rotation.from_euler("x", 20, degrees=True).as_matrix(), [0, 0.05, 0.1])
    told = [("/tf_static", START, tf(START, ("base_link", "base", FIXED),
                                     ("wrist_3_link", "flange", link_T_flange)))]  # fmt: skip
    for t, pose in zip(times, moving, strict=True):
        link = FIXED @ pose @ np.linalg.inv(link_T_flange)
        told.append(("/tf", t, tf(t, ("base_link", "wrist_3_link", link))))
    return told, middles


@pytest.fixture(params=["mcap", "db3"])
def bag(request: pytest.FixtureRequest, tmp_path: Path) -> Callable[..., Any]:
    def write(told):
        return write_bag(tmp_path / "bag", request.param, told)

    return write


def test_clouds_are_paired_with_the_standstills(bag: Callable[..., Any]) -> None:
    told, middles = robot_in_tf(POSES)
    told += [("/scan", t, point_cloud(t, c)) for t, c in zip(middles, CLOUDS, strict=True)]
    found = read(bag(told))
    assert np.allclose([r.base_T_flange for r in found.recordings], POSES, atol=1e-9)
    clouds = [read_cloud(r.cloud).xyz for r in found.recordings]
    assert np.array_equal(clouds, CLOUDS)
    assert "the flange's poses from tf, base to flange; /scan" in found.notes[0]
    assert "stood still 5 times" in found.notes[1]
    assert [
        abs(r.time_ns * 1e-9 - m) < 0.05 for r, m in zip(found.recordings, middles, strict=True)
    ]


def test_a_cameras_clock_that_is_off_is_moved_into_the_standstills(bag: Callable[..., Any]) -> None:
    told, middles = robot_in_tf(POSES)
    late = middles + 0.7
    told += [("/scan", t, point_cloud(t, c)) for t, c in zip(late, CLOUDS, strict=True)]
    found = read(bag(told))
    assert np.allclose([r.base_T_flange for r in found.recordings], POSES, atol=1e-9)
    assert np.array_equal([read_cloud(r.cloud).xyz for r in found.recordings], CLOUDS)


@pytest.mark.parametrize("message", [image, compressed])
def test_an_offset_is_estimated_by_how_images_change(
    bag: Callable[..., Any], message: Callable[..., Any]
) -> None:
    """Images at 20 Hz of something that moves with the arm, their clock 0.35 s behind."""
    told, _ = robot_in_tf(POSES)
    times, moving, _ = stops(POSES)
    columns = np.arange(128)
    for t, pose in list(zip(times, moving, strict=True))[::2]:
        shift = 300 * np.linalg.norm(Rotation.from_matrix(pose[:3, :3]).as_rotvec())
        row = 127 + 120 * np.sin((columns + shift) / 15)
        pixels = np.tile(row, (96, 1)).astype(np.uint8)
        told.append(("/image", t - 0.35, message(t - 0.35, pixels)))
    told.append(("/camera_info", START, camera_info(START, np.diag([900.0, 901, 1]), (96, 128))))
    found = read(bag(told))
    offset = float(found.notes[1].split("clock offset ")[1].split(" ms")[0])
    assert offset == pytest.approx(350, abs=30)
    assert len(found.recordings) == 5
    assert found.recordings[0].image.is_file()
    assert found.recordings[0].camera[0][1, 1] == 901


def test_the_files_of_a_bag_are_read_in_the_order_of_their_numbers(tmp_path: Path) -> None:
    for number in (0, 2, 10):
        (tmp_path / f"bag_{number}.mcap").touch()
    assert [p.stem for p in bag_files(tmp_path)] == ["bag_0", "bag_2", "bag_10"]


@pytest.mark.parametrize(
    ("topic", "message"), [("/wrist/image_raw", image), ("/wrist/image_raw/compressed", compressed)]
)
def test_of_several_cameras_the_one_beside_the_images_is_taken(
    tmp_path: Path, topic: str, message: Callable[..., Any]
) -> None:
    told, middles = robot_in_tf(POSES)
    told += [(topic, t, message(t, np.zeros((4, 6), np.uint8))) for t in middles]
    for name, focal in (("bench", 700.0), ("wrist", 900.0)):
        info = camera_info(START, np.diag([focal, focal, 1]), (4, 6))
        told.append((f"/{name}/camera_info", START, info))
    path = write_bag(tmp_path / "bag", "mcap", told)
    assert read(path, images=topic).recordings[0].camera[0][0, 0] == 900


def test_of_several_cameras_the_one_in_the_frame_of_the_images_is_taken(tmp_path: Path) -> None:
    told, middles = robot_in_tf(POSES)
    told += [("/pictures", t, image(t, np.zeros((4, 6), np.uint8))) for t in middles]
    for frame, focal in (("bench", 700.0), ("camera", 900.0), ("other", 800.0)):
        info = camera_info(START, np.diag([focal, focal, 1]), (4, 6), frame)
        told.append((f"/info/{frame}", START, info))
    path = write_bag(tmp_path / "bag", "mcap", told)
    assert read(path).recordings[0].camera[0][0, 0] == 900


def damage(file, topic, number):
    """Cut a message of a bag short, by its number on its topic."""
    with closing(sqlite3.connect(file)) as database, database:
        rows = database.execute(
            "SELECT messages.id, data FROM messages JOIN topics ON topic_id = topics.id "
            "WHERE topics.name = ? ORDER BY timestamp",
            (topic,),
        ).fetchall()
        one, data = rows[number]
        cut = data[:40] + bytes(len(data) - 40)
        database.execute("UPDATE messages SET data = ? WHERE id = ?", (cut, one))


def test_a_damaged_cloud_is_set_aside_with_its_pose(tmp_path: Path) -> None:
    told, middles = robot_in_tf(POSES)
    told += [("/scan", t, point_cloud(t, c)) for t, c in zip(middles, CLOUDS, strict=True)]
    file = next(write_bag(tmp_path / "bag", "db3", told).glob("*.db3"))
    damage(file, "/scan", 1)
    found = read(file)
    assert np.allclose([r.base_T_flange for r in found.recordings], POSES[[0, 2, 3, 4]], atol=1e-9)
    clouds = [read_cloud(r.cloud).xyz for r in found.recordings]
    assert np.array_equal(clouds, CLOUDS[[0, 2, 3, 4]])
    assert found.notes[-1].startswith(
        "set aside 1 of 5 messages of /scan, the first of them number 1: "
    )
    for number in (0, 2, 3, 4):
        damage(file, "/scan", number)
    with pytest.raises(StageError, match=r"\.db3: a message of /scan is damaged: "):
        read(file)


def test_a_bags_numbers_name_file_and_topic_and_its_tables_are_tables(tmp_path: Path) -> None:
    times, moving, _ = stops(POSES)
    told = [("/tool", t, pose_stamped(t, pose)) for t, pose in zip(times, moving, strict=True)]
    for _, _, message in told:
        for axis in "xyzw":
            setattr(message.pose.orientation, axis, 0.0)
    file = next(write_bag(tmp_path / "bag", "db3", told).glob("*.db3"))
    with pytest.raises(StageError) as wrong:
        read(file)
    assert str(wrong.value).startswith(f"{file}: a message of /tool: its pose: the quaternion's no")
    with closing(sqlite3.connect(file)) as database, database:  # a query that never ends
        database.execute("ALTER TABLE messages RENAME TO kept")
        database.execute(
            "CREATE VIEW messages AS WITH RECURSIVE r(n) AS (SELECT 1 UNION ALL SELECT n + 1 "
            "FROM r) SELECT n AS id, 1 AS topic_id, n AS timestamp, x'00' AS data FROM r"
        )
    with pytest.raises(
        StageError, match=r"is not a ROS 2 bag: it has no tables topics and messages"
    ):
        read(file)


def test_a_damaged_image_is_set_aside_where_the_clocks_are_compared(tmp_path: Path) -> None:
    """Of a standstill's other images one is taken."""
    told, _ = robot_in_tf(POSES)
    times, _, middles = stops(POSES)
    noise = [RNG.integers(0, 255, (32, 32)).astype(np.uint8) for _ in times[::4]]
    told += [("/image", t, compressed(t, n)) for t, n in zip(times[::4], noise, strict=True)]
    told.append(("/camera_info", START, camera_info(START, np.diag([900.0, 900, 1]), (32, 32))))
    file = next(write_bag(tmp_path / "bag", "db3", told).glob("*.db3"))
    middle = int(np.argmin(np.abs(times[::4] - middles[2])))
    damage(file, "/image", middle)
    found = read(file, join={"clock_offset": "0 s"})
    assert len(found.recordings) == 5
    assert found.notes[-1].startswith(
        f"set aside 1 of {len(noise)} messages of /image, the first of them number {middle}: "
    )


def test_a_cloud_whose_row_step_is_left_zero_is_read() -> None:
    message = point_cloud(START, CLOUDS[0].reshape(-1, 3))
    whole = replace(message, data=message.data[:-7], row_step=0)
    assert np.array_equal(cloud_of(whole), CLOUDS[0].reshape(-1, 3))


def driven(angles):
    """Joint angles of an arm that stops at each of them, and a cloud at each stop."""
    times, _, middles = stops(POSES)
    held = np.clip(((times - START) // 1.8).astype(int), 0, 4)
    told = [("/joint_states", t, joint_state(t, angles[i]))
            for t, i in zip(times, held, strict=True)]  # fmt: skip
    return told + [("/scan", t, point_cloud(t, c)) for t, c in zip(middles, CLOUDS, strict=True)]


def reader_of(folder, robot, reader="auto"):
    """The reader of a recipe with this arm, as the recipe's stage calls it."""
    file = folder / "recipe.yaml"
    steps = [{"acquire.archive": {"reader": reader}}, "segment.flange", "fit.rim", "solve.svd"]
    plate = {"standard": "ISO 9409-1-50-4-M6"}
    data = {"title": "A bag", "scanner": "phoxi-m", "robot": robot, "feature": plate}
    file.write_text(json.dumps(data | {"steps": steps}))
    return load_recipe(file, load_registry()).steps[0].params.reader


@pytest.mark.parametrize("reader", ["auto", {"ros2_bag": {"robot": "/joint_states"}}])
def test_joint_angles_give_poses_by_the_recipes_robot(
    bag: Callable[..., Any], tmp_path: Path, reader: Any
) -> None:
    angles = RNG.uniform(-1, 1, (5, 6))
    found = reader_of(tmp_path, "ur5e", reader)(bag(driven(angles)))
    poses = Arm(load_model("robots", "ur5e")).flange(angles)
    assert np.allclose([r.base_T_flange for r in found.recordings], poses, atol=1e-9)
    assert np.allclose([r.joints for r in found.recordings], angles, atol=1e-9)
    assert any("the flange's poses by the joints of ur5e" in note for note in found.notes)


def test_the_joints_of_an_arm_that_passed_are_told_beside_its_poses(
    bag: Callable[..., Any], tmp_path: Path
) -> None:
    times = START + np.arange(0, 8.0, 0.02)
    angles = 0.4 * np.sin(np.outer(times - START, [0.7, 1.1, 0.9, 1.3, 0.8, 1.0])) - 0.5
    told = [("/joint_states", t, joint_state(t, q)) for t, q in zip(times, angles, strict=True)]
    told += [("/marker", t, pose_stamped(t, POSES[1])) for t in times[20:-20:10] + 0.007]
    reader = {"ros2_bag": {"robot": "/joint_states", "target": "/marker"}}
    recordings = reader_of(tmp_path, "ur5e", reader)(bag(told)).recordings
    assert len(recordings) > 10
    arm = Arm(load_model("robots", "ur5e"))
    for recording in recordings:
        motion = recording.motion
        assert joints_at(motion, 0.0, "flange") == pytest.approx(recording.joints)
        assert np.allclose(arm.flange(motion.joints["flange"]), motion.poses, atol=1e-3)


OWN = {"urdf": "own.urdf", "base": "l0", "flange": "l6"}


def write_urdf(file):
    turns = "".join(
        f'<joint name="j{i}" type="revolute"><parent link="l{i - 1}"/><child link="l{i}"/>'
        f'<origin xyz="0 0.1 0.2"/><axis xyz="{axis}"/><limit lower="-3" upper="3" velocity="1"/>'
        "</joint>"
        for i, axis in enumerate(["0 0 1", "0 1 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0"], 1)
    )
    links = "".join(f'<link name="l{i}"/>' for i in range(7))
    file.write_text(f'<robot name="own">{links}{turns}</robot>')


def test_the_robot_whose_joints_were_recorded_is_a_urdf_beside_the_recipe(tmp_path: Path) -> None:
    write_urdf(tmp_path / "own.urdf")
    angles = RNG.uniform(-1, 1, (5, 6))
    path = write_bag(tmp_path / "bag", "mcap", driven(angles))
    found = reader_of(tmp_path, OWN)(path)
    wanted = Arm(robot_from_urdf(tmp_path / "own.urdf", "l0", "l6")).flange(angles)
    assert np.allclose([r.base_T_flange for r in found.recordings], wanted, atol=1e-9)


def test_a_run_of_joint_angles_by_a_urdf_is_read_where_that_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The arm of a bag is the recipe's, so its log carries it."""
    (tmp_path / "here").mkdir()
    write_urdf(tmp_path / "here" / "own.urdf")
    reader = reader_of(tmp_path / "here", OWN, {"ros2_bag": {"robot": "/joint_states"}})
    recipe = load_recipe(tmp_path / "here" / "recipe.yaml", load_registry())
    files = recipe.files
    carried = {name: text.encode() for name, text in files.items() if name.startswith("models/")}
    (tmp_path / "here" / "own.urdf").unlink()
    monkeypatch.chdir(tmp_path)
    again = parse_recipe(files["recipe.resolved.yaml"], "log", load_registry(), models=carried)
    path = write_bag(tmp_path / "bag", "mcap", driven(RNG.uniform(-1, 1, (5, 6))))
    first, second = (r(path).recordings for r in (reader, again.steps[0].params.reader))
    for one, other in zip(first, second, strict=True):
        assert np.allclose(one.base_T_flange, other.base_T_flange, atol=1e-12)


@pytest.mark.parametrize(
    ("robot", "params", "message"),
    [
        (None, {"robot": "/joint_states"}, "joint angles become poses by the arm's kinematics; write "
         "robot: NAME ('flangeye robots' lists them) or robot: {urdf: arm.urdf} in the recipe"),
        ("kuka-iiwa14-r820", {}, "which joint angles are the 7 of kuka-iiwa14-r820 is not known; write "
         "reader: {ros2_bag: {robot: TOPIC, joints: [NAME, …]}}, from base to flange; there are "
         "/joint_states: elbow_joint, shoulder_lift_joint, shoulder_pan_joint, wrist_1_joint, "
         "wrist_2_joint, wrist_3_joint"),
    ],
)  # fmt: skip
def test_joint_angles_of_no_known_arm_are_one_line(
    tmp_path: Path, robot: str | None, params: dict[str, Any], message: str
) -> None:
    path = write_bag(tmp_path / "bag", "mcap", driven(RNG.uniform(-1, 1, (5, 6))))
    model = load_model("robots", robot) if robot else None
    with pytest.raises(StageError) as error:
        ros2_bag(path, BagParams.model_validate(params), model)
    assert str(error.value) == f"{path}: {message}"


@pytest.mark.parametrize("way", ["topic", "frame"])
def test_a_target_that_somebody_has_measured(bag: Callable[..., Any], way: str) -> None:
    told, _ = robot_in_tf(POSES)
    times, moving, _ = stops(POSES)
    base_T_camera, flange_T_target = POSES[2], POSES[3]
    seen = np.linalg.inv(base_T_camera) @ moving @ flange_T_target
    for t, pose in list(zip(times, seen, strict=True))[::2]:
        told.append(("/tf", t, tf(t, ("eye", "marker", pose))) if way == "frame"
                    else ("/marker", t, pose_stamped(t, pose)))  # fmt: skip
    params = {"target": "marker", "camera": "eye"} if way == "frame" else {"target": "/marker"}
    found = read(bag(told), **params)
    wanted = np.linalg.inv(base_T_camera) @ POSES @ flange_T_target
    assert np.allclose([r.camera_T_target for r in found.recordings], wanted, atol=1e-3)
    assert np.allclose([r.base_T_flange for r in found.recordings], POSES, atol=1e-3)


RECIPE = """\
title: A bag
robot: {model: ur5}
scanner: {model: phoxi-m}
steps:
  - acquire.archive
  - segment.flange
  - fit.rim
  - solve.svd
"""


def test_a_bag_of_a_simulated_session_gives_the_same_matrix(bag: Callable[..., Any]) -> None:
    """The recipe on the sample's folder and on a bag made of it, reader and all found out."""
    recorded = folder(SAMPLE, FolderParams()).recordings
    told, middles = robot_in_tf(np.array([r.base_T_flange for r in recorded]))
    for t, recording in zip(middles, recorded, strict=True):
        told.append(("/phoxi/cloud", t, point_cloud(t, read_cloud(recording.cloud).xyz)))
    registry = load_registry()
    recipe = parse_recipe(RECIPE, "bag", registry)
    results = [Runner(recipe, registry, ArchivePath(path)).run() for path in (SAMPLE, bag(told))]
    one, other = (result.transforms["base_T_camera"].matrix for result in results)
    assert np.allclose(one, other, rtol=0, atol=1e-9)
    assert "reader: ros2_bag, chosen by" in results[1].provenance.notes[1]


@pytest.mark.parametrize(
    ("topics", "params", "message"),
    [
        ("tf", {}, "holds neither clouds nor images; name the recorded poses of the "
         "target (a PoseStamped topic, or a frame of tf)"),
        ("tf two", {}, "clouds: name one of /a, /b, for example reader: {ros2_bag: {clouds: /a}}"),
        ("tf two", {"clouds": "/c"}, "clouds: no topic '/c'; of this type: /a, /b"),
        ("two", {"clouds": "/a"}, "no topic gives the flange's pose; it has neither tf nor "
         "PoseStamped nor JointState"),
        ("two joints odd", {"clouds": "/a"}, "no topic gives the flange's pose; write reader: "
         "{ros2_bag: {base: …, flange: …}} (frames of tf: end, map) or robot: NAME ('flangeye "
         "robots' lists them) or robot: {urdf: arm.urdf} in the recipe (for the angles of "
         "/joints)"),
        ("tf two", {"target": "marker"}, "target: 'marker' is not a PoseStamped topic; as a frame of "
         "tf it needs the camera's frame, camera: NAME"),
        ("tf late", {}, "the arm's poses are from 1700000000.000 to 1700000008.200 s, the "
         "measurements from 1700001000.000 to 1700001000.000 s: they have no time in common; set "
         "clock_offset"),
    ],
)  # fmt: skip
def test_what_a_bag_does_not_tell_is_one_line(
    tmp_path: Path, topics: str, params: dict[str, Any], message: str
) -> None:
    told = robot_in_tf(POSES)[0] if "tf" in topics else []
    told += [(f"/{name}", START, point_cloud(START, CLOUDS[0])) for name in "ab" if "two" in topics]
    told += [("/joints", START, joint_state(START, np.zeros(6)))] if "joints" in topics else []
    told += [("/tf", START, tf(START, ("map", "end", FIXED)))] if "odd" in topics else []
    late = START + 1000
    told += [("/a", late, point_cloud(late, CLOUDS[0]))] if "late" in topics else []
    path = write_bag(tmp_path / "bag", "mcap", told)
    with pytest.raises(StageError) as error:
        read(path, **params)
    assert str(error.value) == f"{path}: {message}"


def test_what_is_no_bag_is_said(tmp_path: Path) -> None:
    with pytest.raises(NotThisLayout, match="holds no ROS 2 bag"):
        read(tmp_path)
    (tmp_path / "x.mcap").write_bytes(b"\x89MCAP0\r\n" + b"\0" * 40)
    with pytest.raises(StageError, match=r"x\.mcap: cannot be read as a ROS 2 bag"):
        read(tmp_path)


def test_a_bag_that_expands_too_far_is_refused_before_it_does(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "bag.mcap"
    with file.open("wb") as out:
        writer = Writer(out, chunk_size=1, compression=CompressionType.ZSTD)
        writer.start()
        schema = writer.register_schema("geometry_msgs/msg/PoseStamped", "ros2msg", b"")
        writer.add_message(writer.register_channel("/pose", "cdr", schema), 0, bytes(1 << 20), 0)
        writer.finish()
    assert file.stat().st_size < 1 << 11
    monkeypatch.setattr(records, "MAX_CHUNK", 1 << 19)
    with pytest.raises(
        StageError, match=r"bag.mcap: damaged: .* a chunk says that it expands to 10"
    ):
        list(messages([file], ["/pose"]))


def test_a_message_that_is_damaged_is_one_line(tmp_path: Path) -> None:
    times, held, _ = stops(np.tile(np.eye(4), (3, 1, 1)))
    told = [("/pose", t, pose_stamped(t, pose)) for t, pose in zip(times, held, strict=True)]
    file = next(write_bag(tmp_path / "bag", "db3", told).glob("*.db3"))
    with closing(sqlite3.connect(file)) as database, database:
        database.execute("UPDATE messages SET data = x'00010000ffff' WHERE id = 2")
    with pytest.raises(StageError) as refused:
        ros2_bag(file, BagParams())
    assert str(refused.value).startswith(f"{file}: a message of /pose is damaged: Could not ")
    assert "\n" not in str(refused.value)


def test_a_topic_that_lost_its_messages_is_none(tmp_path: Path) -> None:
    times, held, middles = stops(np.tile(np.eye(4), (3, 1, 1)))
    told = [("/pose", t, pose_stamped(t, pose)) for t, pose in zip(times, held, strict=True)]
    told.append(("/scan", middles[0], point_cloud(middles[0], CLOUDS[0])))
    file = next(write_bag(tmp_path / "bag", "db3", told).glob("*.db3"))
    with closing(sqlite3.connect(file)) as database, database:
        lost = "SELECT id FROM topics WHERE name = '/scan'"
        database.execute(f"DELETE FROM messages WHERE topic_id = ({lost})")
    with pytest.raises(StageError) as refused:
        ros2_bag(file, BagParams())
    assert str(refused.value).startswith(
        f"{file}: holds neither clouds nor images; name the recorded poses"
    )


def test_standstills_of_two_samples_each(bag: Callable[..., Any]) -> None:
    times, held, middles = stops(POSES, hold=0.5, way=0.5, rate=2.0)
    told = [("/pose", t, pose_stamped(t, pose)) for t, pose in zip(times, held, strict=True)]
    told += [("/scan", t, point_cloud(t, c)) for t, c in zip(middles, CLOUDS, strict=True)]
    found = read(bag(told)).recordings
    assert np.allclose([r.base_T_flange for r in found], POSES[: len(found)], atol=1e-6)
    assert len(found) >= 4  # whether the last one is a standstill, its one sample does not tell
