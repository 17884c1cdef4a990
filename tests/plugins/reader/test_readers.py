"""What other tools saved, and tables of poses in any convention, become the same archive."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from flangeye import StageError
from flangeye.files.clouds import write_cloud
from flangeye.files.recording import NotThisLayout
from flangeye.plugin.registry import load_registry
from flangeye.types import ArchivePath, PointCloud
from flangeye.types.geometry import quaternion_from_rotation, rigid, rotation_exp
from flangeye.types.pose_formats import CONVENTIONS, EULER_ORDERS, PoseConvention
from flangeye.workflow.recipe.load import load_recipe
from flangeye.workflow.run.runner import Runner
from flangeye_plugins.reader.samples import (
    EasyHandeyeParams,
    ZividSamplesParams,
    easy_handeye,
    moveit,
    zivid,
)
from flangeye_plugins.reader.table import TableParams, table

RNG = np.random.default_rng(4)


def a_pose():
    return rigid(rotation_exp(RNG.normal(0, 0.7, 3)), RNG.uniform(-0.5, 0.5, 3))


POSES = np.array([a_pose() for _ in range(5)])
SEEN = np.array([a_pose() for _ in range(5)])


def transform_text(pose, indent):
    x, y, z = pose[:3, 3]
    q = quaternion_from_rotation(pose[:3, :3])
    pad = " " * indent
    lines = ["translation:", f"  x: {x}", f"  y: {y}", f"  z: {z}", "rotation:"]
    lines += [f"  {n}: {v}" for n, v in zip("xyzw", q, strict=True)]
    return "\n".join(pad + line for line in lines)


def samples_text(robot, kind=""):
    """As easy_handeye2's handeye_server writes it."""
    text = f"parameters:\n  name: ''\n  calibration_type: '{kind}'\n  move_group_namespace: /\nsamples:\n"
    for pose, seen in zip(robot, SEEN, strict=True):
        text += f"- robot:\n{transform_text(pose, 4)}\n  tracking:\n{transform_text(seen, 4)}\n"
    return text


def both(archive):
    recordings = archive.recordings
    return [r.base_T_flange for r in recordings], [r.camera_T_target for r in recordings]


@pytest.mark.parametrize("kind", ["eye_in_hand", "eye_on_base"])
def test_easy_handeye2_writes_the_robot_inverted_for_eye_on_base(tmp_path: Path, kind: str) -> None:
    file = tmp_path / "cell.samples"
    written = POSES if kind == "eye_in_hand" else np.linalg.inv(POSES)
    file.write_text(samples_text(written, kind))
    robot, seen = both(easy_handeye(file, EasyHandeyeParams(calibration=kind)))
    assert np.allclose(robot, POSES, atol=1e-12)
    assert np.allclose(seen, SEEN, atol=1e-12)


def test_a_dump_of_easy_handeyes_sample_list(tmp_path: Path) -> None:
    lists = {"hand_world_samples": POSES, "camera_marker_samples": SEEN}
    data = {
        name: {"transforms": [
            {"translation": dict(zip("xyz", p[:3, 3].tolist(), strict=True)),
             "rotation": dict(zip("xyzw", quaternion_from_rotation(p[:3, :3]).tolist(), strict=True))}
            for p in poses
        ]}
        for name, poses in lists.items()
    }  # fmt: skip
    (tmp_path / "samples.yaml").write_text(json.dumps(data))
    robot, seen = both(easy_handeye(tmp_path, EasyHandeyeParams(calibration="eye_in_hand")))
    assert np.allclose(robot, POSES)
    assert np.allclose(seen, SEEN)


def test_moveit_writes_matrices_row_by_row(tmp_path: Path) -> None:
    text = "".join(
        f"- effector_wrt_world: {p.ravel().tolist()}\n  object_wrt_sensor: {s.ravel().tolist()}\n"
        for p, s in zip(POSES, SEEN, strict=True)
    )
    (tmp_path / "samples.yaml").write_text(text)
    robot, seen = both(moveit(tmp_path))
    assert np.allclose(robot, POSES)
    assert np.allclose(seen, SEEN)


ZIVID = "__version__:\n  serializer: 1\n  data: 1\nFloatMatrix:\n  Data:\n    [\n{rows}\n    ]\n"
OPENCV = "%YAML:1.0\n---\nPoseState: !!opencv-matrix\n   rows: 4\n   cols: 4\n   dt: d\n   data: [ {all} ]\n"


@pytest.mark.parametrize("style", ["zivid", "opencv"])
@pytest.mark.parametrize(("unit", "factor"), [("mm", 1e3), ("m", 1.0)])
def test_a_folder_as_zivid_writes_it(tmp_path: Path, style: str, unit: str, factor: float) -> None:
    cloud = PointCloud("camera", np.ones((4, 3)))
    for i, pose in enumerate(POSES, 1):
        scaled = pose.copy()
        scaled[:3, 3] *= factor
        rows = ",\n".join("      [" + ", ".join(f"{x:.12f}" for x in row) + "]" for row in scaled)
        text = (
            ZIVID.format(rows=rows)
            if style == "zivid"
            else OPENCV.format(all=", ".join(f"{x:.16e}" for x in scaled.ravel()))
        )
        (tmp_path / f"pos{i:02}.yaml").write_text(text)
        write_cloud(tmp_path / f"img{i:02}.ply", cloud)
    archive = zivid(tmp_path, ZividSamplesParams(length=unit))
    assert np.allclose([r.base_T_flange for r in archive.recordings], POSES, atol=1e-9)
    assert [r.cloud.name for r in archive.recordings] == [f"img{i:02}.ply" for i in range(1, 6)]


def test_zivids_own_scans_need_its_sdk(tmp_path: Path) -> None:
    (tmp_path / "pos01.yaml").write_text(
        ZIVID.format(rows=",\n".join(f"      {row}" for row in np.eye(4).tolist()))
    )
    (tmp_path / "img01.zdf").write_bytes(b"zdf")
    with pytest.raises(StageError, match="img01.zdf: only Zivid's SDK reads it; export it as .ply"):
        zivid(tmp_path, ZividSamplesParams(length="mm"))


def write_images(folder, count=5):
    for i in range(count):
        cv2.imwrite(str(folder / f"s{i}.png"), np.full((4, 4), i, np.uint8))


def convention_of(rotation, length, angle):
    known = CONVENTIONS.get(rotation)
    name = known.rotation if known else rotation
    labels = tuple("abcdefg"[: 7 if name in ("xyzw", "wxyz") else 6])
    return PoseConvention(name, labels, name, length, angle)


CASES = [
    (rotation, length, angle)
    for rotation in ("xyzw", "wxyz", "vector", "kuka", "fanuc", "abb", "ur", *EULER_ORDERS)
    for length, angle in (("mm", "deg"), ("m", "rad"))
]


@pytest.mark.parametrize("suffix", ["csv", "yaml"])
@pytest.mark.parametrize(("rotation", "length", "angle"), CASES)
def test_a_table_in_every_convention(
    tmp_path: Path, rotation: Any, length: Any, angle: Any, suffix: str
) -> None:
    write_images(tmp_path)
    convention = convention_of(rotation, length, angle)
    rows = [convention.numbers(pose).tolist() for pose in POSES]
    if suffix == "csv":
        text = "scan,...\n" + "".join(
            f"s{i}.png," + ",".join(map(repr, row)) + "\n" for i, row in enumerate(rows)
        )
    else:
        text = json.dumps({f"s{i}.png": row for i, row in enumerate(rows)})
    (tmp_path / f"poses.{suffix}").write_text(text)
    params = TableParams(file=f"poses.{suffix}", rotation=rotation, length=length, angle=angle,
                         pose="base_T_flange")  # fmt: skip
    archive = table(tmp_path, params)
    assert np.allclose([r.base_T_flange for r in archive.recordings], POSES, atol=1e-9)
    assert [r.image.name for r in archive.recordings] == [f"s{i}.png" for i in range(5)]


def test_records_name_their_scan_wherever_it_stands(tmp_path: Path) -> None:
    write_images(tmp_path)
    rows = [convention_of("xyzw", "m", "rad").numbers(pose).tolist() for pose in POSES]
    records = [{"pose": row, "scan": f"s{4 - i}.png"} for i, row in enumerate(rows)]
    (tmp_path / "poses.json").write_text(json.dumps(records))
    params = TableParams(file="poses.json", rotation="xyzw", length="m", pose="base_T_flange")
    archive = table(tmp_path, params)
    assert [r.image.name for r in archive.recordings] == [f"s{4 - i}.png" for i in range(5)]
    assert np.allclose([r.base_T_flange for r in archive.recordings], POSES, atol=1e-9)


def test_a_table_of_the_inverse_without_names_goes_by_the_scans_order(tmp_path: Path) -> None:
    write_images(tmp_path)
    convention = convention_of("wxyz", "m", "rad")
    rows = [convention.numbers(np.linalg.inv(pose)).tolist() for pose in POSES]
    (tmp_path / "poses.csv").write_text("".join(";".join(map(repr, row)) + "\n" for row in rows))
    params = TableParams(rotation="wxyz", length="m", pose="flange_T_base")
    archive = table(tmp_path, params)
    assert np.allclose([r.base_T_flange for r in archive.recordings], POSES, atol=1e-9)


KUKA = TableParams(rotation="kuka", length="mm", angle="deg", pose="base_T_flange")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("s0.png,1,2,3,4,5\n", "poses.csv:1: kuka has 6 numbers (x y z a b c), not 5"),
        ("s0.png,1,2,x,4,5,6\n", "poses.csv:1: 'x' is not a number"),
        ("no.png,1,2,3,4,5,6\n", "poses.csv:1: its scan 'no.png' does not exist; put it there, or remove the row"),
        ("1,2,3,4,5,6\n", "poses.csv: has 1 poses, but the folder has 5 scans; name the scan of each "
         "pose in a column called scan, or remove the surplus"),
        ("s0.png,1,2,3,4,5,nan\n", "poses.csv:1: kuka: a number is not finite"),
    ],
)  # fmt: skip
def test_a_mistake_in_a_table_is_named_with_its_line(
    tmp_path: Path, text: str, message: str
) -> None:
    write_images(tmp_path)
    (tmp_path / "poses.csv").write_text(text)
    with pytest.raises(StageError) as error:
        table(tmp_path, KUKA)
    assert str(error.value).removeprefix(f"{tmp_path}/") == message


@pytest.mark.parametrize("names", ["P{0}", "s{0}.tif", "pose_{0:03}"])
def test_rows_whose_names_are_no_files_belong_to_scans_by_their_numbers(
    tmp_path: Path, names: str
) -> None:
    write_images(tmp_path)
    numbers = [3, 1, 4, 0, 2]
    rows = [f"{names.format(n)},{n},0,0,0,0,0\n" for n in numbers]
    (tmp_path / "poses.csv").write_text("".join(rows))
    archive = table(tmp_path, KUKA)
    seen = [(r.image.name, round(1e3 * r.base_T_flange[0, 3])) for r in archive.recordings]
    assert seen == [(f"s{n}.png", n) for n in numbers]
    assert archive.notes[0].startswith("paired by n")


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"rotation": "vector", "length": "m"}, "rotation: vector needs angle: deg or angle: rad"),
        ({"rotation": "xzz", "length": "m"}, "no rotation 'xzz'; known: ur, kuka"),
        ({"rotation": "xyzw"}, "length: is missing"),
    ],
)
def test_nothing_of_a_convention_is_guessed(values: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError) as error:
        TableParams(**values, pose="base_T_flange")
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("read", "params", "text", "message"),
    [
        (easy_handeye, EasyHandeyeParams(calibration="eye_on_base"),
         samples_text(POSES, "eye_in_hand"),
         "x.yaml: was sampled for eye_in_hand, but the recipe states eye_on_base"),
        (easy_handeye, EasyHandeyeParams(calibration="eye_on_base"),
         "samples:\n- robot: {translation: {x: 1, y: 2}}\n  tracking: {}\n",
         "x.yaml: has no column 'robot.translation.z'; known: robot.translation.y, robot.translation.x"),
        (moveit, None, "- effector_wrt_world: [1, 2]\n  object_wrt_sensor: [1]\n",
         "x.yaml:1: a matrix has 12 or 16 numbers, not 2"),
        (moveit, None, "- effector_wrt_world: nothing\n",
         "x.yaml:1: 'nothing' is not a number"),
    ],
)  # fmt: skip
def test_a_mistake_in_samples_is_named(
    tmp_path: Path, read: Any, params: Any, text: Any, message: str
) -> None:
    (tmp_path / "x.yaml").write_text(text)
    with pytest.raises(StageError) as error:
        read(tmp_path, *([params] if params else []))
    assert str(error.value).removeprefix(f"{tmp_path}/") == message


@pytest.mark.parametrize(
    ("read", "params"),
    [(easy_handeye, EasyHandeyeParams(calibration="eye_on_base")), (moveit, None), (table, KUKA),
     (zivid, ZividSamplesParams(length="mm"))],
)  # fmt: skip
def test_another_layout_is_not_taken(tmp_path: Path, read: Any, params: Any) -> None:
    (tmp_path / "notes.yaml").write_text("hello: world\n")
    (tmp_path / "broken.yaml").write_text("a: [1,\n")
    with pytest.raises(NotThisLayout):
        read(tmp_path, *([params] if params else []))


RECIPE = """\
title: Samples
robot: {model: ur5e}
configuration: {name: eye-in-hand, place: unknown}
steps:
  - acquire.samples: {reader: moveit}
  - solve.robust
"""


def observed(tmp_path, recipe):
    path = tmp_path / "recipe.yaml"
    path.write_text(recipe)
    registry = load_registry()
    runner = Runner(load_recipe(path, registry), registry, ArchivePath(tmp_path))
    return list(runner.observe())


def test_samples_become_observations_with_the_stated_noise(tmp_path: Path) -> None:
    text = "".join(
        f"- effector_wrt_world: {p.ravel().tolist()}\n  object_wrt_sensor: {s.ravel().tolist()}\n"
        for p, s in zip(POSES, SEEN, strict=True)
    )
    (tmp_path / "samples.yaml").write_text(text)
    found = observed(tmp_path, RECIPE.replace("moveit", "moveit, position_noise: 1 mm"))
    assert np.allclose([o.base_T_flange.matrix for o in found], POSES)
    assert np.allclose([o.feature.camera_T_target.matrix for o in found], SEEN)
    assert np.sqrt(found[0].feature.covariance[3, 3]) == pytest.approx(1e-3)


def test_images_come_with_the_cameras_matrix(tmp_path: Path) -> None:
    write_images(tmp_path)
    convention = convention_of("kuka", "mm", "deg")
    rows = [convention.numbers(pose).tolist() for pose in POSES]
    write_cloud(tmp_path / "s0.pcd", PointCloud("camera", np.ones((1, 3))))
    (tmp_path / "poses.csv").write_text(
        "".join(f"s{i}.png," + ",".join(map(repr, r)) + "\n" for i, r in enumerate(rows))
    )
    path = tmp_path / "recipe.yaml"
    path.write_text(
        "title: Images\nrobot: {model: ur5e}\nconfiguration: {name: eye-in-hand, place: unknown}\n"
        "steps:\n  - acquire.images:\n"
        "      reader: {table: {rotation: kuka, length: mm, angle: deg, pose: base_T_flange}}\n"
        "      focal_length: [1000, 1001]\n      principal_point: [2, 3]\n"
        "      distortion: [0.1, 0, 0, 0]\n"
        "  - fit.aruco: {size: 40 mm}\n  - solve.robust\n"
    )
    registry = load_registry()
    recipe = load_recipe(path, registry)
    step = recipe.steps[0]
    captures = list(step.stage.function(archive=ArchivePath(tmp_path), params=step.params))
    assert [int(c.image.pixels[0, 0]) for c in captures] == [0, 1, 2, 3, 4]
    assert captures[0].image.camera_matrix[1, 1] == 1001
    assert len(captures[0].image.distortion) == 4
    assert len(captures[0].cloud.points()) == 1  # that of its name
    assert len(captures[1].cloud.points()) == 0
