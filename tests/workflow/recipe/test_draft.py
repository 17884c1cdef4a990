"""``flangeye init``: from folders as newcomers have them to a recipe that passes check, or a line."""

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from scipy.io import savemat
from scipy.spatial.transform import Rotation
from typer.testing import CliRunner

from flangeye.cli import commands
from flangeye.errors import RecipeError, StageError
from flangeye.files.clouds import read_cloud, write_cloud
from flangeye.models.boards import Board, print_of
from flangeye.models.bodies import TargetBody
from flangeye.plugin.registry import load_registry
from flangeye.types import ArchivePath
from flangeye.types.geometry import rigid
from flangeye.workflow.recipe.draft.headings import frames_in
from flangeye.workflow.recipe.load import load_recipe
from tests.plugins.reader.bags import joint_state, point_cloud, stops, tf, write_bag

SAMPLE = Path(__file__).parents[3] / "data" / "samples" / "ur5_phoxi-m"
POSES = [(np.array([0.4, -0.1, 0.3]) + 0.05 * k * np.array([1, -1, (-1) ** k]),
          Rotation.from_rotvec([0.3 * k, 2.0 - 0.2 * k, 0.1])) for k in range(5)]  # fmt: skip


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rec").mkdir()
    return tmp_path / "rec"


def clouds(folder, count=5):
    for k in range(count):
        grid = np.stack(np.meshgrid(range(20), range(10)), axis=-1).reshape(-1, 2) * 10.0
        points = np.column_stack([grid, np.full(200, 800.0 + k)])
        np.savetxt(folder / f"scan_{k}.xyz", points)


def table(folder, heading, row, name="log.csv", separator=","):
    lines = [heading] * bool(heading)
    lines += [separator.join(map(str, row(k, *pose))) for k, pose in enumerate(POSES)]
    (folder / name).write_text("\n".join(lines) + "\n")


def init(*words, typed=None):
    line = ["init", "rec", *map(str, words)]
    if typed is None:
        line.append("--yes")
    done = CliRunner().invoke(commands(), line, input=typed)
    if done.exception and not isinstance(done.exception, SystemExit):
        raise done.exception
    return done.output


def recipe(folder):
    return load_recipe(folder.parent / "recipe.yaml", load_registry())


def read_poses(folder):
    first = recipe(folder).steps[0].params
    return np.array([r.base_T_flange for r in first.reader(first.path).recordings])


def kuka(k, place, turn):
    return [*(1e3 * place), *turn.as_euler("ZYX", degrees=True)]


def vector(k, place, turn):
    return [*(1e3 * place), *turn.as_rotvec()]


def quaternion(k, place, turn):
    return [*place, *turn.as_quat()]


def german(k, place, turn):
    return [f"scan_{k}.xyz", *(str(x).replace(".", ",") for x in kuka(k, place, turn))]


def matrix(k, place, turn):
    return np.vstack([np.column_stack([turn.as_matrix(), 1e3 * place]), [0, 0, 0, 1]]).ravel()


@pytest.mark.parametrize(
    ("heading", "row", "separator", "words"),
    [
        ("X,Y,Z,A,B,C", kuka, ",", []),
        ("Datei;X;Y;Z;A;B;C", german, ";", []),
        ("x_mm,y_mm,z_mm,rx_rad,ry_rad,rz_rad", vector, ",", ["--rotation", "vector"]),
        ("X Y Z Rx Ry Rz", vector, " ", ["--robot", "ur5"]),
        ("u,v,w,alpha,beta,gamma", kuka, ",", ["--columns", "u,v,w,4,5,6", "--rotation", "kuka"]),
        ("pose.position.x,pose.position.y,pose.position.z,pose.orientation.x,"
         "pose.orientation.y,pose.orientation.z,pose.orientation.w", quaternion, ",", []),
        ("", matrix, "\t", []),
    ],
)  # fmt: skip
def test_a_table_is_read_as_its_heading_says(
    folder: Path, heading: str, row: Any, separator: str, words: list[Any]
) -> None:
    clouds(folder)
    table(folder, heading, row, separator=separator)
    told = init(*words)
    expected = [np.block([[t.as_matrix(), p[:, None]], [np.zeros(3), 1]]) for p, t in POSES]
    np.testing.assert_allclose(read_poses(folder), expected, atol=1e-9)
    assert "clouds: 5 .xyz" in told
    assert "5 poses (table, log.csv), 5 with a cloud" in told
    assert "scan_0.xyz: 200 points, at 807.6 mm (median)" in told
    assert "recipe.yaml: ok, 5 steps; next: flangeye run recipe.yaml" in told


def test_a_tool_is_the_target_by_its_mesh(folder: Path) -> None:
    shutil.copytree(SAMPLE, folder, dirs_exist_ok=True)
    mesh = SAMPLE.parents[1] / "bodies" / "gripper.stl"
    shutil.copy(mesh, folder / "own.stl")
    told = init("--robot", "ur5", "--target", "body: rec/own.stl")
    assert "no scan shows the flange" not in told
    drafted = yaml.safe_load((folder.parent / "recipe.yaml").read_text())
    assert drafted["target"] == {"body": "rec/own.stl"}
    assert drafted["steps"][1:3] == ["segment.body", "fit.body"]
    assert recipe(folder).context[TargetBody].name == "own"


def test_scans_without_a_flange_bring_up_the_mesh(folder: Path) -> None:
    clouds(folder)
    table(folder, "X,Y,Z,A,B,C", kuka)
    assert "assumed: no scan shows the flange; which target they show ('body:" in init()
    (folder.parent / "recipe.yaml").unlink()
    said = init("--robot", "ur5", "--scanner", "none", "--camera", "base", "--rotation", "kuka",
                "--pose", "base_T_flange",
                typed="flange\nbody: gripper\n")  # fmt: skip
    assert "no scan shows the flange" in said
    assert recipe(folder).context[TargetBody].name == "gripper"


def test_clouds_in_centimetres_are_known_by_the_flange(folder: Path) -> None:
    shutil.copy(SAMPLE / "poses.csv", folder)
    for path in SAMPLE.glob("*.pcd"):
        write_cloud(folder / path.name, read_cloud(path), "cm")
    assert (
        "assumed: unit of the clouds: cm, because no scan shows the flange when read in m or mm"
        in init()
    )
    assert recipe(folder).steps[0].params.unit == "cm"


def test_defaults_are_told_and_answers_are_not(folder: Path) -> None:
    shutil.copytree(SAMPLE, folder, dirs_exist_ok=True)
    told = init("--robot", "ur5", "--scanner", "phoxi-m")
    assert (
        "assumed: where the camera is mounted (base or flange): base (--camera changes it)" in told
    )
    assert "--robot changes it" not in told
    assert recipe(folder).header.robot.model == "ur5"


def test_another_plate_than_the_arms_own_is_written(folder: Path) -> None:
    shutil.copytree(SAMPLE, folder, dirs_exist_ok=True)
    init("--robot", "ur5", "--scanner", "phoxi-m", "--plate", "ISO 9409-1-80-6-M8")
    assert recipe(folder).header.feature.standard == "ISO 9409-1-80-6-M8"


def test_it_asks_what_it_cannot_see(folder: Path) -> None:
    shutil.copytree(SAMPLE, folder, dirs_exist_ok=True)
    init(typed="ur5\nflange\nphoxi-m\nbase\n")
    assert recipe(folder).header.scanner.model == "phoxi-m"


@pytest.mark.parametrize(
    ("heading", "row", "words", "stage"),
    [
        ("x,y,z,qx,qy,qz,qw,marker_x,marker_y,marker_z,marker_qx,marker_qy,marker_qz,marker_qw",
         lambda k, p, t: [*p, *t.as_quat(), *p, *t.as_quat()], [], "acquire.samples"),
        ("x,y,z,qx,qy,qz,qw,u,v,w", lambda k, p, t: [*p, *t.as_quat(), *p],
         ["--target-columns", "u,v,w"], "acquire.centres"),
        ("x,y,z,qx,qy,qz,qw,cam x [mm],cam y [mm],cam z [mm]",
         lambda k, p, t: [*p, *t.as_quat(), *p], ["--camera", "flange"], "acquire.centres"),
    ],
)  # fmt: skip
def test_what_the_camera_measured_may_stand_in_the_table(
    folder: Path, heading: str, row: Callable[..., Any], words: list[Any], stage: str
) -> None:
    table(folder, heading, row)
    init(*words)
    checked = recipe(folder)
    assert checked.steps[0].stage.name == stage
    assert checked.header.configuration.place == "unknown"
    assert len(read_poses(folder)) == 5


def test_two_streams_are_joined_by_time(folder: Path) -> None:
    arm = "".join(f"{0.1 * k},{0.1 * (k // 10)},0,0.5,0,0,0,1\n" for k in range(60))
    seen = "".join(f"{0.5 + k},{0.1 * k},0,0.4,0,0,0,1\n" for k in range(6))
    (folder / "arm.csv").write_text("time,x,y,z,qx,qy,qz,qw\n" + arm)
    (folder / "seen.csv").write_text("t,target_x,target_y,target_z,target_qx,target_qy,target_qz,"
                                     "target_qw\n" + seen)  # fmt: skip
    init()
    assert recipe(folder).steps[0].params.reader.params.target.time == "t"


def test_images_need_to_know_the_target(folder: Path) -> None:
    table(folder, "x,y,z,qx,qy,qz,qw", quaternion)
    for k in range(5):
        cv2.imwrite(str(folder / f"{k}.png"), np.zeros((8, 8), np.uint8))
    init("--target", "charuco: {columns: 8, rows: 6, square: 30 mm, marker: 22 mm}")
    names = [step.stage.name for step in recipe(folder).steps]
    assert recipe(folder).steps[0].params.board.columns == 8  # it tells the camera too
    assert names == ["acquire.images", "fit.charuco", "solve.robust", "verify.holdout"]


def test_the_board_in_the_images_is_proposed(folder: Path) -> None:
    table(folder, "x,y,z,qx,qy,qz,qw", quaternion)
    page = np.pad(print_of(Board("charuco", 7, 5, 0.03, 0.022), 60), 60, constant_values=255)
    for k in range(5):
        cv2.imwrite(str(folder / f"{k}.png"), page)
    with pytest.raises(RecipeError, match="0.png shows a ChArUco board of 7 x 5 squares") as asked:
        init()
    line = str(asked.value).split("'")[1]
    assert line.endswith("square: 30 mm, marker: 22 mm}")
    init("--target", line)
    board = recipe(folder).steps[1].params
    assert (board.columns, board.rows, board.dictionary) == (7, 5, "4X4_250")


@pytest.mark.parametrize("printed", [True, False])
def test_colour_beside_depth_is_meant_where_it_shows_a_board(folder: Path, printed: bool) -> None:
    """A folder of an RGB-D camera: depth images, that are clouds, and colour of one number."""
    table(folder, "x,y,z,qx,qy,qz,qw", quaternion)
    page = np.pad(print_of(Board("charuco", 7, 5, 0.03, 0.022), 60), 60, constant_values=255)
    for name, pixels in (
        ("depth", np.full((480, 640), 600, np.uint16)),
        ("color", page if printed else np.full((480, 640), 90, np.uint8)),
    ):
        (folder / name).mkdir()
        for k in range(5):
            cv2.imwrite(str(folder / name / f"{k}.png"), pixels)
    (folder / "depth_camera.yaml").write_text("{fx: 600, fy: 600, cx: 320, cy: 240}")
    if printed:
        with pytest.raises(RecipeError, match="0.png shows a ChArUco board of 7 x 5 squares"):
            init()
        init("--target", "charuco: {columns: 7, rows: 5, square: 30 mm, marker: 22 mm}")
    else:
        assert "0.png: 640 x 480 points, at 639.4 mm (median); camera of " in init()
    stage = "acquire.images" if printed else "acquire.archive"
    assert recipe(folder).steps[0].stage.name == stage


@pytest.mark.parametrize(
    ("scan", "heading", "separator"),
    [
        ("scans/S{}.csv", "x_mm,y_mm,z_mm,intensity", ","),
        ("cloud_{}.csv", "X [mm];Y [mm];Z [mm]", ";"),
        ("scans/points{}.txt", "", " "),
        ("{}.asc", "# exported", " "),
    ],
)
def test_texts_of_points_are_scans(folder: Path, scan: str, heading: str, separator: str) -> None:
    table(folder, "X;Y;Z;A;B;C", kuka, name="arm.csv", separator=";")
    (folder / "scans").mkdir()
    for k in range(5):
        rows = 1e3 * np.random.default_rng(k).uniform(0.4, 0.6, (200, heading.count(separator) + 1))
        rows = rows if rows.shape[1] > 2 else np.column_stack([rows[:, :1]] * 3)
        lines = [separator.join(f"{x:.3f}" for x in row) for row in rows]
        text = "\n".join([heading, *lines] if heading else lines)
        decimals = text.replace(".", ",") if separator == ";" else text
        (folder / scan.format(k + 1)).write_text(decimals + "\n")
    assert f"clouds: 5 {Path(scan).suffix}" in init()
    first = recipe(folder).steps[0].params
    names = [r.cloud.name for r in first.reader(first.path).recordings]
    assert names == [Path(scan.format(k + 1)).name for k in range(5)]


def test_columns_that_are_named_keep_what_their_names_say(folder: Path) -> None:
    clouds(folder)
    heading = "flange_T_base.x,flange_T_base.y,flange_T_base.z," + ",".join(
        f"flange_T_base.q{axis}" for axis in "xyzw"
    )
    table(folder, heading, quaternion)
    init("--columns", heading)
    assert recipe(folder).steps[0].params.reader.params.pose == "flange_T_base"


@pytest.mark.parametrize("suffix", [".yml", ".npz", ".npy"])
def test_intrinsics_beside_images_are_used(folder: Path, suffix: str) -> None:
    camera = np.array([[900.0, 0, 320], [0, 901, 240], [0, 0, 1]])
    for name in ("images", "poses"):
        (folder / name).mkdir()
    for k, pose in enumerate(ARM):
        cv2.imwrite(str(folder / "images" / f"img_{k}.png"), np.zeros((8, 8), np.uint8))
        np.savetxt(folder / "poses" / f"pose_{k}.txt", pose)
    if suffix == ".npz":
        np.savez(folder / "calib.npz", mtx=camera, dist=np.zeros((1, 5)))
    elif suffix == ".npy":
        np.save(folder / "calib.npy", camera)
        np.save(folder / "dist_coeffs.npy", np.zeros((1, 5)))
    else:
        storage = cv2.FileStorage(str(folder / "calib.yml"), cv2.FILE_STORAGE_WRITE)
        storage.write("camera_matrix", camera)
        storage.release()
    target = "charuco: {columns: 8, rows: 6, square: 30 mm, marker: 22 mm}"
    with pytest.raises(RecipeError, match="no capture can be used; the 5 were rejected by fit.ch"):
        init("--target", target)  # black images show no board, so nothing says who carries it
    told = init("--target", target, "--camera", "flange")
    assert f"assumed: camera of rec/calib{suffix}: focal length 900.0, 901.0 px" in told
    first = recipe(folder).steps[0]
    assert (first.params.camera_file, first.params.board) == (f"calib{suffix}", None)
    captures = list(first.stage.function(archive=ArchivePath(None), params=first.params))
    assert all(np.allclose(c.image.camera_matrix, camera) for c in captures)


def test_zivids_folder_is_known(folder: Path) -> None:
    clouds(folder)
    for k in range(5):
        (folder / f"scan_{k}.xyz").rename(folder / f"img{k}.xyz")
        rows = matrix(k, *POSES[k]).reshape(4, 4).tolist()
        (folder / f"pos{k}.yaml").write_text(f"FloatMatrix: {{Data: {rows}}}\n")
    init()
    assert np.abs(read_poses(folder)[:, :3, 3]).max() < 1


def test_the_samples_poses_as_a_kuka_shows_them_are_the_samples(folder: Path) -> None:
    shutil.copytree(SAMPLE, folder, dirs_exist_ok=True)
    init("--out", "of_sample.yaml")
    of_sample = load_recipe(folder.parent / "of_sample.yaml", load_registry()).steps[0].params
    recorded = of_sample.reader(folder).recordings
    poses = np.array([r.base_T_flange for r in recorded])
    (folder / "poses.csv").unlink()
    turns = Rotation.from_matrix(poses[:, :3, :3]).as_euler("ZYX", degrees=True)
    rows = np.hstack([1e3 * poses[:, :3, 3], turns])
    np.savetxt(folder / "pendant.txt", rows, delimiter=",", header="X,Y,Z,A,B,C", comments="")
    init()
    np.testing.assert_allclose(read_poses(folder), poses, atol=1e-9)


@pytest.mark.parametrize("order", ["xyz", "ZYX", "quaternion_wxyz"])
def test_scans_decide_what_numbers_of_a_rotation_mean(folder: Path, order: str) -> None:
    """The face turns in the scans as the arm does, in one convention only."""
    shutil.copytree(SAMPLE, folder, dirs_exist_ok=True)
    init("--out", "of_sample.yaml")
    of_sample = load_recipe(folder.parent / "of_sample.yaml", load_registry()).steps[0].params
    poses = np.array([r.base_T_flange for r in of_sample.reader(folder).recordings])
    (folder / "poses.csv").unlink()
    whole = Rotation.from_matrix(poses[:, :3, :3])
    named = order.startswith("quaternion")
    turns = whole.as_quat()[:, [3, 0, 1, 2]] if named else whole.as_euler(order, degrees=True)
    np.savetxt(folder / "pendant.txt", np.hstack([1e3 * poses[:, :3, 3], turns]), fmt="%.9g")
    assert f"of pendant.txt: {order} (rotations of arm and target agree to 0." in init()
    np.testing.assert_allclose(read_poses(folder), poses, atol=1e-6)


ARM = np.array([np.block([[t.as_matrix(), p[:, None]], [np.zeros(3), 1]]) for p, t in POSES])
SEEN = ARM[::-1] @ ARM[1]


def opencv_names(folder):
    np.savez(folder / "handeye.npz", R_gripper2base=ARM[:, :3, :3], t_gripper2base=ARM[:, :3, 3:],
             R_target2cam=SEEN[:, :3, :3], t_target2cam=SEEN[:, :3, 3:])  # fmt: skip


def opencv_vectors(folder):
    vectors = Rotation.from_matrix(SEEN[:, :3, :3]).as_rotvec()
    np.savez(folder / "detections.npz", rvecs=vectors, tvecs=SEEN[:, :3, 3])
    np.save(folder / "gripper2base.npy", ARM)


def matlab_names(folder):
    world_t_camera = np.moveaxis(np.linalg.inv(SEEN), 0, 2)
    savemat(folder / "data.mat", {"bHg": np.moveaxis(ARM, 0, 2), "wHc": world_t_camera})


def frames_in_names(folder):
    np.savez(folder / "poses.npz", T_flange_base=np.linalg.inv(ARM), T_cam_board=SEEN)


def opencv_file(folder):
    storage = cv2.FileStorage(str(folder / "pairs.yml"), cv2.FILE_STORAGE_WRITE)
    for name, poses in (("cam", SEEN), ("robot", ARM)):
        for k, pose in enumerate(poses):
            storage.write(f"{name}_{k}", pose)
    storage.release()


def folders_of_texts(folder):
    for name, poses in (("camera", SEEN), ("robot", ARM)):
        (folder / name).mkdir()
        for k, pose in enumerate(poses):
            np.savetxt(folder / name / f"{k}.txt", pose)


def files_side_by_side(folder):
    for name, poses in (("board_in_cam", SEEN), ("flange", ARM)):
        for k, pose in enumerate(poses):
            np.savetxt(folder / f"{name}_{k}.txt", pose)


def json_objects(folder):
    rows = [{"robot": a.tolist(), "marker": s.tolist(), "ids": [1] * k}
            for k, (a, s) in enumerate(zip(ARM, SEEN, strict=True))]  # fmt: skip
    (folder / "samples.json").write_text(json.dumps(rows))


def rows_in_millimetres(folder):
    def rows(poses):
        turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        return np.hstack([1e3 * poses[:, :3, 3], turns])

    np.savez(folder / "rows.npz", robot=rows(ARM), target=rows(SEEN))


@pytest.mark.parametrize(
    "made",
    [
        opencv_names, opencv_vectors, matlab_names, frames_in_names, opencv_file, folders_of_texts,
        files_side_by_side, json_objects, rows_in_millimetres,
    ],
)  # fmt: skip
def test_arrays_are_read_as_their_names_say(folder: Path, made: Callable[[Path], None]) -> None:
    made(folder)
    init("--camera", "flange")
    first = recipe(folder).steps[0].params
    recorded = first.reader(first.path).recordings
    assert np.allclose([r.base_T_flange for r in recorded], ARM, atol=1e-9)
    assert np.allclose([r.camera_T_target for r in recorded], SEEN, atol=1e-9)


def transform(pose):
    turn = Rotation.from_matrix(pose[:3, :3]).as_quat()
    return {"translation": dict(zip("xyz", map(float, pose[:3, 3]), strict=True)),
            "rotation": dict(zip("xyzw", map(float, turn), strict=True))}  # fmt: skip


def rows_of(poses, kind):
    turns = Rotation.from_matrix(poses[:, :3, :3])
    turns = {"vector": turns.as_rotvec, "kuka": lambda: turns.as_euler("ZYX", degrees=True)}[kind]()
    return np.hstack([(1.0 if kind == "vector" else 1e3) * poses[:, :3, 3], turns])


def yaml_of_two_transforms(folder):
    pairs = [{"optical": transform(s), "robot": transform(a)}
             for a, s in zip(ARM, SEEN, strict=True)]  # fmt: skip
    (folder / "samples.yaml").write_text(yaml.safe_dump(pairs))


def a_json_file_each(folder):
    for k, (a, s) in enumerate(zip(ARM, SEEN, strict=True)):
        text = json.dumps({"robot": transform(a), "marker2camera": s.tolist(), "timestamp": k})
        (folder / f"{k:03}.json").write_text(text)


def json_lines_with_opencv_vectors(folder):
    seen = Rotation.from_matrix(SEEN[:, :3, :3]).as_rotvec()
    lines = [json.dumps({"pose": a.ravel().tolist(), "rvec": r.tolist(), "tvec": s[:3, 3].tolist()})
             for a, r, s in zip(ARM, seen, SEEN, strict=True)]  # fmt: skip
    (folder / "log.jsonl").write_text("\n".join(lines))


def a_kukas_program(folder):
    text = ["DECL E6POS XP={{X {},Y {},Z {},A {},B {},C {}}}".format(*row)
            for row in rows_of(ARM, "kuka")]  # fmt: skip
    (folder / "targets.dat").write_text("\n".join(text))
    np.savetxt(folder / "seen.csv", SEEN.reshape(-1, 16), delimiter=",")


def what_a_ur_prints(folder):
    text = [f"p[{', '.join(map(repr, row.tolist()))}]" for row in rows_of(ARM, "vector")]
    (folder / "a.txt").write_text("\n".join(text))
    np.savetxt(folder / "b.csv", SEEN.reshape(-1, 16), delimiter=",")


@pytest.mark.parametrize(
    "made",
    [yaml_of_two_transforms, a_json_file_each, json_lines_with_opencv_vectors, a_kukas_program,
     what_a_ur_prints],
)  # fmt: skip
def test_records_and_programs_are_read_as_they_say(
    folder: Path, made: Callable[[Path], None]
) -> None:
    made(folder)
    init("--camera", "flange")
    first = recipe(folder).steps[0].params
    recorded = first.reader(first.path).recordings
    assert np.allclose([r.base_T_flange for r in recorded], ARM, atol=1e-9)
    assert np.allclose([r.camera_T_target for r in recorded], SEEN, atol=1e-9)


def test_each_capture_may_have_a_folder_of_its_own(folder: Path) -> None:
    clouds(folder)
    for k, pose in enumerate(ARM):
        (folder / f"capture_{k}").mkdir()
        (folder / f"scan_{k}.xyz").rename(folder / f"capture_{k}" / "points.xyz")
        np.savetxt(folder / f"capture_{k}" / "pose.txt", pose)
    told = init()
    assert "clouds: 5 .xyz" in told
    recorded = recipe(folder).steps[0].params.reader(folder).recordings
    assert [r.id for r in recorded] == [f"capture_{k}" for k in range(5)]
    assert [r.cloud.parent.name for r in recorded] == [r.id for r in recorded]
    assert np.allclose([r.base_T_flange for r in recorded], ARM, atol=1e-9)


def test_arrays_without_names_are_asked_for(folder: Path) -> None:
    arrays_of_nobody(folder)
    init(typed="none\nposes.npz:B\nbase_T_flange\ncamera_T_target\nnone\nflange\n")
    assert np.allclose(read_poses(folder), SEEN, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "frames"),
    [
        ("gripper2base", ("base", "flange")), ("R_base2gripper", ("flange", "base")),
        ("target_to_camera", ("camera", "target")), ("base_T_flange", ("base", "flange")),
        ("wTc", ("world", "camera")), ("T_b_e", ("base", "flange")), ("bTo", None),
        ("samples", None), ("T1_*", None),
    ],
)  # fmt: skip
def test_two_frames_in_a_name(name: str, frames: tuple[str, str] | None) -> None:
    assert frames_in(name) == frames


@pytest.mark.parametrize("names", [("arm.tum", "board.tum"), ("robot.csv", "camera.csv")])
def test_trajectories_are_told_apart_by_their_names(folder: Path, names: tuple[str, str]) -> None:
    stops = np.repeat(np.arange(5), 20)
    for name, poses, times in (
        (names[0], ARM[stops], 0.1 * np.arange(100)),
        (names[1], SEEN, 1.0 + 2 * np.arange(5)),
    ):
        turns = Rotation.from_matrix(poses[:, :3, :3]).as_quat()
        heading = "" if name.endswith("tum") else "t x y z qx qy qz qw"
        rows = np.column_stack([times, poses[:, :3, 3], turns])
        np.savetxt(folder / name, rows, header=heading, comments="")
        text = (folder / name).read_text().lstrip("\n")
        (folder / name).write_text(text)
    init("--camera", "flange")
    assert np.allclose(read_poses(folder), ARM, atol=1e-6)


def odd_heading(folder):
    clouds(folder)
    table(folder, "u,v,w,alpha,beta,gamma", kuka)


def arm_of_unknown_words(folder):
    names = ",".join(f"marker_{name}" for name in ("x", "y", "z", "qx", "qy", "qz", "qw"))
    heading = f"X Kipp,Y Kipp,Z Kipp,Kipp 1,Kipp 2,Kipp 3,{names}"
    table(folder, heading, lambda *pose: [*kuka(*pose), *quaternion(*pose)])


def orientations_of_three(folder):
    clouds(folder)
    rows = [kuka(0, *pose) for pose in POSES]
    told = [{"position_mm": row[:3], "orientation_zyx_deg": row[3:]} for row in rows]
    (folder / "log.json").write_text(json.dumps(told))


def tables_of_other_lengths(folder):
    for name in ("robot.csv", "marker.csv"):
        table(folder, "", quaternion, name=name)
    rows = (folder / "marker.csv").read_text().splitlines()
    (folder / "marker.csv").write_text("\n".join(rows[:-1]))


def meshes(folder):
    table(folder, "X,Y,Z,A,B,C", kuka)
    for k in range(5):
        (folder / f"scan_{k}.stl").write_text("solid")


def angles_of_nobody(folder):
    clouds(folder)
    table(folder, "x,y,z,rx,ry,rz", vector)


def deep(folder):
    for name in ("a/1", "b/2"):
        (folder / name).mkdir(parents=True)
        (folder / name / "robot.csv").write_text("x,y,z\n")


def alone(folder):
    table(folder, "", quaternion, "board.csv")


def images(folder):
    table(folder, "x,y,z,qx,qy,qz,qw", quaternion)
    for k in range(5):
        cv2.imwrite(str(folder / f"{k}.png"), np.zeros((8, 8), np.uint8))


def sample(folder):
    shutil.copytree(SAMPLE, folder, dirs_exist_ok=True)


def arrays_of_nobody(folder):
    np.savez(folder / "poses.npz", A=ARM, B=SEEN)


def arrays_of_the_arm(folder):
    np.save(folder / "robot.npy", ARM)


def two_markers_for_each_pose(folder):
    table(folder, "x,y,z,qx,qy,qz,qw", quaternion, "robot.csv")
    heading = "frame,id,x,y,z,qx,qy,qz,qw"
    rows = [f"{k},{tag},{','.join(map(str, quaternion(k, *pose)))}"
            for k, pose in enumerate(POSES) for tag in (3, 5)]  # fmt: skip
    (folder / "marker.csv").write_text("\n".join([heading, *rows]))


def two_tables_of_nobody(folder):
    for name in ("a.csv", "b.csv"):
        table(folder, "x,y,z,qx,qy,qz,qw", quaternion, name)


def pointers(folder: Path) -> None:
    for name in ("poses.csv", "scan_0.ply"):
        (folder / name).write_text("version https://git-lfs.github.com/spec/v1\noid sha256:0\n")


def two_poses_of_nobody(folder):
    names = ("x", "y", "z", "qx", "qy", "qz", "qw")
    heading = ",".join(f"{group}_{name}" for group in "ab" for name in names)
    table(folder, heading, lambda *pose: quaternion(*pose) * 2)


@pytest.mark.parametrize(
    ("made", "words", "line"),
    [
        (clouds, [], "rec: holds 5 scans, but nothing that says where the flange was; put "
         "poses.csv beside them, its first line: cloud,x_mm,y_mm,z_mm,rx_rad,ry_rad,rz_rad; then "
         "a line for each, scan_0.xyz,412.1,-33.0,501.7,2.91,0.12,-0.03"),
        (lambda folder: (folder / "a.png").touch(), [], "rec: holds 1 scans, but nothing that says "
         "where the flange was; put poses.csv beside them, its first line: image,x_mm,"),
        (lambda folder: (folder / "poses.mat").write_bytes(b"MATLAB 7.3 MAT-file"), [],
         "rec/poses.mat: is a MATLAB 7.3 file (HDF5), which is not read; in MATLAB, write it anew"),
        (odd_heading, [], "rec/log.csv: it is not clear from u, v, w, alpha, beta, "
         "gamma which columns are the arm's pose; add --columns with names or numbers from 1, position "
         "first: --columns x,y,z,a,b,c --rotation kuka; or those of the joint angles: --columns "
         "1,2,3,4,5,6 --rotation joints"),
        (odd_heading, ["--columns", "u,v,ww,4,5,6"],
         "rec/log.csv: has no column 'ww'; known: w"),
        (angles_of_nobody, [], "not known: rotation convention of columns rx, ry, rz of log.csv (ur, "
         "kuka, fanuc, abb, yaskawa, mitsubishi, epson, staubli, kawasaki, doosan, halcon, rpy, "
         "quaternion_xyzw, quaternion_wxyz, vector, xyz, ZYX, …); add --rotation vector, or --rotation xyz for roll, "
         "pitch, yaw; or name the arm with --robot: the maker's convention is then used"),
        (images, [], "not known: which printed target is seen; add --target 'charuco: "
         "{columns: 8, rows: 6, square: 30 mm, marker: 22 mm}'"),
        (arrays_of_nobody, [], "not known: which poses are the arm's (poses.npz:A, poses.npz:B); "
         "add --table poses.npz:A"),
        (arrays_of_nobody, ["--table", "A"],
         "--table A: is not a table of poses; known: poses.npz:A, poses.npz:B"),
        (arrays_of_the_arm, [], "rec/robot.npy: has poses of the arm, but there are no scans beside "
         "it, and no columns of what the camera saw; add --target-columns NAMES, or put the scans"),
        (lambda folder: table(folder, "x,y,z,qx,qy,qz,qw", quaternion), [],
         "rec/log.csv: has poses of the arm, but there are no scans beside it, and no "
         "columns of what the camera saw; add --target-columns NAMES, or put the scans there"),
        (lambda folder: (folder / "poses.xlsx").write_text("x"), [],
         "rec: poses.xlsx is a table that is not read; save it as .csv"),
        (lambda folder: (folder / "demo.bag").write_text("x"), [],
         "rec/demo.bag: is a ROS 1 bag; convert it: pip install rosbags && rosbags-convert --src "
         "rec/demo.bag --dst rec/demo; then flangeye init rec again"),
        (meshes, [], "rec/scan_0.stl: is a mesh, not a scan; sample it to points as .ply: "),
        (lambda folder: (folder / "scan_0.obj").write_text("v 1 2 3\n"), [],
         "rec/scan_0.obj: is a mesh or a cloud that is not read; take its points: awk '$1 == "
         "\"v\" {print $2, $3, $4}' rec/scan_0.obj > rec/scan_0.xyz; then flangeye init rec again"),
        (lambda folder: (folder / "log.csv").write_text("1,2,3,4,5,6\n" * 900_000), [],
         "rec/log.csv: is larger than 10 MB, so it was not looked into for poses; keep the rows "
         "that belong to scans or markers, or state how it is read: --reader 'table: {file: …}'"),
        (lambda folder: (folder / "poses\x1b[31m.csv").write_text("1,2,3,4,5,6\n"), [],
         r"rec: the name of 'poses\x1b[31m.csv' has control characters or is not UTF-8, so no "
         "recipe can name it; rename the file"),
        (lambda folder: os.mkfifo(folder / "poses.csv"), [],
         "rec: holds no files that can be read; put clouds or images there"),
        (orientations_of_three, [], "not known: rotation convention of columns "
         "orientation_zyx_deg.0, orientation_zyx_deg.1, orientation_zyx_deg.2 of log.json ("),
        (lambda folder: (folder / "s.zip").write_text("x"), [],
         "rec/s.zip: is an archive; unpack it: unzip rec/s.zip -d rec/s; then flangeye init rec"),
        (lambda folder: (folder / "scan.e57").write_text("x"), [],
         "rec/scan.e57: is an E57 scan, which is not read; save it as .ply"),
        (deep, [], "rec: its files are in nested folders, such as a/1/robot.csv; name the folder "
         "of one session: flangeye init rec/a"),
        (alone, [], "rec/board.csv: has what the camera measured, but no poses of the arm; put its poses or joint angles beside it as .csv, a row each, or add --columns NAMES"),
        (arm_of_unknown_words, [], "rec/log.csv: has what the camera measured, but no poses of the arm; put its poses or joint angles beside it as .csv, a row each, or add --columns NAMES"),
        (tables_of_other_lengths, [], "rec/marker.csv: has 4 rows, robot.csv has 5; give each "
         "a column time to join them by it, or remove the surplus"),
        (two_markers_for_each_pose, [], "rec/marker.csv: has 10 rows, robot.csv has 5; give each "
         "a column time to join them by it, or remove the surplus, such as all but one of the 2 for each pose"),
        (two_tables_of_nobody, [], "not known: which poses are the arm's (a.csv, b.csv); add "
         "--table a.csv"),
        (two_poses_of_nobody, [], "not known: which poses are the arm's (log.csv:a, log.csv:b); "
         "add --table log.csv:a"),
        (lambda folder: (folder / "notes.md").write_text("x"), [],
         "rec: no scans and no table of poses in notes.md; write the poses as .csv, a row each, or "
         "name the reader that knows them: --reader NAME ('flangeye stages reader' lists them)"),
        (pointers, [], "rec: 2 of 2 files are Git LFS pointers, not the files themselves, such as "
         "poses.csv; fetch them: git lfs pull"),
        (lambda folder: None, [],
         "rec: is empty; put the clouds or images and their poses there"),
        (lambda folder: folder.rmdir(), [],
         "rec: is not a folder; name the one that holds the recordings"),
        (sample, ["--camera", "wrist"], "--camera wrist: is neither base nor flange"),
        (sample, ["--target", "cube"],
         "--target cube: is not one of flange, body, sphere, charuco, checkerboard, circles, aruco, "
         "with parameters"),
        (sample, ["--target", "charuco: {columns: 8}"],
         "--target charuco.rows: is missing\n--target charuco.square: is missing\n"),
        (sample, ["--reader", "table"], "--reader table: rotation and length: is missing"),
        (odd_heading, ["--table", "a.csv"],
         "--table a.csv: is not a table of poses; known: log.csv"),
        (sample, ["--out", "rec/poses.yaml", "--robot", "ur55"], "--robot model: no robot 'ur55'"),
    ],
)  # fmt: skip
def test_what_is_missing_is_one_line_with_what_to_add(
    folder: Path, made: Any, words: list[Any], line: str
) -> None:
    made(folder)
    done = CliRunner().invoke(commands(), ["init", "rec", "--yes", *words])
    assert str(done.exception).startswith(line)
    assert getattr(done.exception, "exit_code", None) == 2
    assert not (folder.parent / "recipe.yaml").exists()


def test_a_bag_of_unknown_frames_is_answered_with_the_readers_line(folder: Path) -> None:
    times, moving, middles = stops(np.array([rigid(r.as_matrix(), p) for p, r in POSES]))
    told = [("/tf", t, tf(t, ("map", "end", pose))) for t, pose in zip(times, moving, strict=True)]
    told += [("/scan", t, point_cloud(t, np.ones((9, 3)))) for t in middles]
    write_bag(folder / "bag", "mcap", told)
    (folder / "bag" / "metadata.yaml").unlink()
    next((folder / "bag").glob("*.mcap")).rename(folder / "bag.mcap")
    (folder / "bag").rmdir()
    with pytest.raises(StageError) as refused:
        init()
    assert str(refused.value) == (
        "rec: no topic gives the flange's pose; write reader: {ros2_bag: {base: …, flange: "
        "…}} (frames of tf: end, map); flangeye init takes such lines as --reader '{…}' and "
        "--robot NAME"
    )
    answer = init("--reader", "{ros2_bag: {base: map, flange: end}}")
    assert "5 poses (ROS 2 bag, rec), 5 with a cloud" in answer


def test_a_bag_of_joint_angles_is_read_by_the_arm_that_is_named(folder: Path) -> None:
    angles = np.linspace([0, -1, 1, 0, 1, 0], [1, -0.5, 0.5, 1, 0.5, 2], 5)
    times, _, middles = stops(np.array([rigid(r.as_matrix(), p) for p, r in POSES]))
    held = np.clip(((times - times[0]) // 1.8).astype(int), 0, 4)
    told = [("/joint_states", t, joint_state(t, angles[i]))
            for t, i in zip(times, held, strict=True)]  # fmt: skip
    told += [("/scan", t, point_cloud(t, np.ones((9, 3)))) for t in middles]
    write_bag(folder / "bag", "mcap", told)
    next((folder / "bag").glob("*.mcap")).rename(folder / "bag.mcap")
    assert "5 poses (ROS 2 bag, rec), 5 with a cloud" in init("--robot", "ur5e")


def test_a_recipe_is_not_written_over(folder: Path) -> None:
    sample(folder)
    init("--robot", "ur5")
    done = CliRunner().invoke(commands(), ["init", "rec", "--yes"])
    assert str(done.exception) == "recipe.yaml: exists already; choose another name with --out"


def test_a_folder_of_one_bag_is_refused_before_a_question(folder: Path) -> None:
    (folder / "demo.bag").write_text("x")
    with pytest.raises(RecipeError, match="is a ROS 1 bag; convert it"):
        init(typed="")


def test_a_question_without_an_answer_names_the_option(folder: Path) -> None:
    sample(folder)
    done = CliRunner().invoke(commands(), ["init", "rec"], input="")
    assert str(done.exception) == (
        "which arm ('flangeye robots', or a .urdf) (--robot): was not answered; give the option, "
        "or --yes for the defaults"
    )


def test_a_bad_answer_is_asked_again(folder: Path) -> None:
    shutil.copytree(SAMPLE, folder, dirs_exist_ok=True)
    said = init(typed="ur55\nur5\nflangee\nflange\nphoxi-m\nwall\nbase\n")
    assert "ur55" in said
    assert "wall: is not one of base, flange" in said
    assert recipe(folder).header.robot.model == "ur5"


@pytest.mark.parametrize("encoding", ["utf-16", "latin-1", "utf-8-sig"])
def test_a_table_may_be_in_the_encoding_of_a_spreadsheet(folder: Path, encoding: str) -> None:
    clouds(folder)
    table(folder, "# Länge in mm\nX,Y,Z,A,B,C", kuka)
    written = (folder / "log.csv").read_text("utf-8")
    (folder / "log.csv").write_bytes(written.encode(encoding))
    init()
    assert np.allclose(read_poses(folder)[1][:3, 3], POSES[1][0])


@pytest.mark.parametrize("mounted", ["base", "flange"])
def test_images_tell_where_the_camera_is(
    folder: Path, monkeypatch: pytest.MonkeyPatch, mounted: str
) -> None:
    """A board of 8 x 6 squares, 1 m before a pinhole camera, seen at twelve turns of the arm."""
    rng = np.random.default_rng(5)
    matrix = np.array([[900.0, 0.0, 320.0], [0.0, 900.0, 240.0], [0.0, 0.0, 1.0]])
    page = np.pad(print_of(Board("charuco", 8, 6, 0.03, 0.022), 60), 60, constant_values=255)
    to_metres = np.array([[5e-4, 0, -0.15], [0, 5e-4, -0.12], [0, 0, 1]])
    turn = Rotation.from_euler("x", 1.1).as_matrix()
    held, stood = rigid(turn, np.array([0.05, 0.02, 0.08])), rigid(turn, np.array([0.4, 0.1, 0.2]))
    poses = []
    for k in range(12):
        seen = rigid(
            Rotation.from_rotvec(rng.uniform(-0.35, 0.35, 3)).as_matrix(),
            np.append(rng.uniform(-0.05, 0.05, 2), 0.7),
        )
        flat = matrix @ np.column_stack([seen[:3, :2], seen[:3, 3]]) @ to_metres
        image = cv2.warpPerspective(page, flat, (640, 480), borderValue=128)
        cv2.imwrite(str(folder / f"{k}.png"), image)
        inverse = np.linalg.inv(held @ seen) if mounted == "flange" else seen @ np.linalg.inv(held)
        poses.append(stood @ inverse)
    np.save(folder / "robot.npy", poses)
    np.savez(folder / "camera.npz", mtx=matrix, dist=np.zeros(5))
    told = init("--target", "charuco: {columns: 8, rows: 6, square: 30 mm, marker: 22 mm}")
    assert f"where the camera is mounted (base or flange): {mounted} (fits to 0." in told


@pytest.mark.parametrize(
    "records",
    [
        [{"tcp": [k, 1, 2, 0, 0, 0, 1], "tag": [0, 0, 0, 0, 0, 0, 0]} for k in range(6)],
        [{"tcp": [k, 10**400, 2, 0, 0, 0, 1], "tag": [0, 0, 1, 0, 0, 0, 1]} for k in range(6)],
        {"tcp": [[]], "tag": []},
    ],
)
def test_numbers_that_are_no_poses_end_in_one_line(folder: Path, records: Any) -> None:
    (folder / "log.json").write_text(json.dumps(records))
    with pytest.raises((RecipeError, StageError)):
        init("--camera", "base")


def test_a_heading_above_shorter_rows_ends_in_one_line(folder: Path) -> None:
    rows = ["1,2,3", "4,5,6", "7,8,9", "1"]
    (folder / "log.csv").write_text("x,y,z,image\n" + "\n".join(rows) + "\n")
    with pytest.raises((RecipeError, StageError)):
        init()
