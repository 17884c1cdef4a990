"""reader.folder and reader.auto: the forms a file of poses may have, and what is refused."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import Field

from flangeye import Params, StageError, part
from flangeye.files.recording import Archive, NotThisLayout, check_ids
from flangeye.plugin.registry import load_registry
from flangeye.types.geometry import rotation_exp
from flangeye.workflow.recipe.load import load_recipe
from flangeye_plugins.reader.auto import auto
from flangeye_plugins.reader.folder import FolderParams, folder

HEADING = "cloud,x_mm,y_mm,z_mm,qx,qy,qz,qw\n"
ROW = "a.pcd,412.5,-120,310.25,0,1,0,0\n"


def read(path, text=None, name="poses.csv", **params):
    if text is not None:
        (path / name).write_text(text)
    return folder(path, FolderParams(**params))


def refused(*args, **kwargs):
    with pytest.raises(StageError) as error:
        read(*args, **kwargs)
    assert "\n" not in str(error.value)
    return str(error.value)


def test_the_smallest_csv(tmp_path: Path) -> None:
    archive = read(tmp_path, HEADING + ROW)
    (recording,) = archive.recordings
    assert (recording.id, recording.cloud) == ("a", tmp_path / "a.pcd")
    assert recording.base_T_flange[:3, 3].tolist() == [0.4125, -0.12, 0.31025]
    assert np.allclose(recording.base_T_flange[:3, :3], np.diag([-1, 1, -1]))
    assert (recording.joints, recording.role, recording.time_ns) == (None, "calibration", 0)
    assert archive.files == [tmp_path / "poses.csv"]


def test_the_same_in_yaml_and_json_and_with_semicolons(tmp_path: Path) -> None:
    pose = {"cloud": "a.pcd", "position": [412.5, -120.0, 310.25], "quaternion_xyzw": [0, 1, 0, 0]}
    expected = read(tmp_path, HEADING + ROW).recordings[0].base_T_flange
    texts = {
        "poses.json": json.dumps({"unit": "mm", "poses": [pose]}),
        "poses.yaml": "unit: mm\nposes:\n  - cloud: a.pcd\n    position: [412.5, -120.0, 310.25]\n"
        "    quaternion_xyzw: [0, 1, 0, 0]\n",
        "poses.csv": "\ufeff" + (HEADING + ROW).replace(",", " ; "),
    }
    for name, text in texts.items():
        (tmp_path / "poses.csv").unlink(missing_ok=True)
        assert np.array_equal(read(tmp_path, text, name).recordings[0].base_T_flange, expected)
        (tmp_path / name).unlink()


def test_rotation_vectors_joints_roles_and_times(tmp_path: Path) -> None:
    text = (
        "id,cloud,role,time_ns,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad,j2_rad,j1_rad\n"
        "v,sub/a.pcd,verification,17,0.1,0.2,0.3,0.1,-0.2,0.3,2,1\n"
    )
    (recording,) = read(tmp_path, text).recordings
    assert np.allclose(recording.base_T_flange[:3, :3], rotation_exp(np.array([0.1, -0.2, 0.3])))
    assert recording.joints.tolist() == [1.0, 2.0]
    assert (recording.id, recording.role, recording.time_ns) == ("v", "verification", 17)


def test_the_unit_may_come_from_the_recipe(tmp_path: Path) -> None:
    text = HEADING.replace("_mm", "") + ROW
    assert read(tmp_path, text, unit="mm").recordings[0].base_T_flange[0, 3] == 0.4125
    assert refused(tmp_path) == (
        f"{tmp_path}/poses.csv: its positions have no unit; name the columns x_mm, y_mm, z_mm (or "
        "x_m, …), write 'unit: mm' in YAML, or set reader: {folder: {unit: mm}}"
    )


def test_a_unit_said_twice_must_agree(tmp_path: Path) -> None:
    assert refused(tmp_path, HEADING + ROW, unit="m") == (
        f"{tmp_path}/poses.csv: positions are in mm, but the recipe states unit: m"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", ": is empty"),
        (HEADING.replace("z_mm,", "") + ROW,
         ":1: the columns x_m, y_m, z_m (or x_mm, y_mm, z_mm) are missing"),
        (HEADING.replace("qw", "w") + ROW,
         ":1: column 'w' is not known; known: cloud, image, id, role, time_ns, x_m, y_m, z_m, x_mm, y_mm, "
         "z_mm, x, y, z, qx, qy, qz, qw, rx_rad, ry_rad, rz_rad, j1_rad, …, second_x_m, …; 'flangeye init FOLDER' "
         "writes a recipe for other columns"),
        (HEADING.replace("qw", "qx") + ROW, ":1: column 'qx' comes twice"),
        (HEADING.replace("cloud", "cloud,j1_rad,j2_rad") + ROW.replace(".pcd,", ".pcd,1,,"),
         ":2: poses.0.joints_rad.1: Input should be a valid number, unable to parse string as a "
         "number"),
        (HEADING + "\n" + ROW.replace(",0\n", "\n"),
         ":3: has 7 cells, but the heading has 8"),
        (HEADING + ROW.replace("412.5", "4l2.5"),
         ":2: poses.0.position.0: Input should be a valid number, unable to parse string as a "
         "number"),
        (HEADING + ROW.replace("412.5", "nan"),
         ":2: poses.0.position.0: Input should be a finite number"),
        (HEADING + ROW.replace("a.pcd", ""), ":2: poses.0: names no scan; it needs 'cloud' or 'image', "
         "a file beside this one"),
        (HEADING.replace("qx,qy,qz,qw", "id") + "a.pcd,1,2,3,x\n",
         ":2: poses.0: needs a quaternion or a rotation vector, one of the two"),
        (HEADING + ROW.replace("0,1,0,0", "0,1,0.5,0"),
         ":2: pose 'a': the quaternion's norm is 1.118; it must be 1 (within 0.001)"),
        (HEADING + ROW.replace("0,1,0,0", "0,0,0,0"),
         ":2: pose 'a': the quaternion's norm is 0; it must be 1 (within 0.001)"),
    ],
)  # fmt: skip
def test_a_csv_that_says_no_poses_is_refused(tmp_path: Path, text: Any, message: str) -> None:
    assert refused(tmp_path, text) == f"{tmp_path}/poses.csv{message}"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("unit: ft\nposes: []\n", ":1: unit: Input should be 'm', 'mm', 'cm' or 'in'"),
        ("unit: mm\n", ":1: poses: Field required"),
        ("unit: mm\nposes:\n  - {cloud: a.pcd, position: [1, 2], quaternion_xyzw: [0, 0, 0, 1]}\n",
         ":3: poses.0.position.2: Field required"),
        ("unit: mm\nposes:\n  - cloud: a.pcd\n    pos: [1, 2, 3]\n",
         ":3: poses.0.position: Field required"),
        ("- 1\n", ":1: Input should be a valid dictionary or instance of PosesFile"),
        ("unit: mm\nunit: m\n", ":2: duplicate key 'unit', first given on line 1"),
    ],
)  # fmt: skip
def test_a_yaml_that_says_no_poses_is_refused(tmp_path: Path, text: str, message: str) -> None:
    assert refused(tmp_path, text, "poses.yaml") == f"{tmp_path}/poses.yaml{message}"


def test_a_heading_alone_is_an_archive_without_poses(tmp_path: Path) -> None:
    archive = read(tmp_path, HEADING)
    with pytest.raises(StageError) as error:
        check_ids(archive)
    assert str(error.value) == f"{tmp_path}: holds no poses"


def test_scans_stand_in_the_only_folder_that_has_their_name(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text("image,x_m,y_m,z_m,qx,qy,qz,qw\n7.png,0,0,1,0,0,0,1\n")
    for name in ("rgb", "others"):
        (tmp_path / name).mkdir()
    (tmp_path / "rgb" / "7.png").touch()
    assert read(tmp_path).recordings[0].image == tmp_path / "rgb" / "7.png"
    (tmp_path / "others" / "7.png").touch()
    assert read(tmp_path).recordings[0].image == tmp_path / "7.png"  # which is not there


def test_a_folder_of_an_endless_name_is_refused(tmp_path: Path) -> None:
    said = refused(tmp_path, HEADING + ROW.replace("a.pcd", "a" * 256 + "/b.pcd"))
    assert said.startswith(f"{tmp_path}/aaa")
    assert said.endswith("File name too long")


@pytest.mark.parametrize("column", ["cloud", "image", "cloud,image"])
def test_images_may_stand_in_place_of_clouds(tmp_path: Path, column: str) -> None:
    """A cloud of an image's name is its companion, not one that somebody forgot."""
    (tmp_path / "a.png").touch()
    (tmp_path / "a.ply").touch()
    cells = {"cloud,image": "a.ply,a.png"}.get(column, "a.png")
    text = HEADING.replace("cloud", column) + ROW.replace("a.pcd", cells)
    (tmp_path / "poses.csv").write_text(text)
    (recording,) = folder(tmp_path, FolderParams()).recordings
    assert (recording.id, recording.image) == ("a", tmp_path / "a.png")
    assert recording.cloud in (None, tmp_path / "a.ply")


def test_a_cloud_without_a_pose_is_refused(tmp_path: Path) -> None:
    for name in ("a.pcd", "b.ply"):
        (tmp_path / name).touch()
    assert refused(tmp_path, HEADING + ROW) == (
        f"{tmp_path}/b.ply: poses.csv has no pose for it; add it, or move the cloud away"
    )


def test_two_files_of_poses_are_refused(tmp_path: Path) -> None:
    (tmp_path / "poses.json").write_text("{}")
    assert refused(tmp_path, HEADING + ROW) == (
        f"{tmp_path}: holds poses.csv and poses.json; keep one of them"
    )


def test_clouds_without_poses_are_refused(tmp_path: Path) -> None:
    (tmp_path / "a.pcd").touch()
    assert refused(tmp_path) == (
        f"{tmp_path}: holds clouds (1), but none of poses.csv, poses.yaml, poses.yml, poses.json; "
        f"'flangeye init {tmp_path}' writes a recipe for other layouts"
    )


def test_auto_says_what_it_took(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(HEADING + ROW)
    assert auto(tmp_path).notes == (f"reader: folder, chosen by what {tmp_path} holds",)
    assert auto(tmp_path / "poses.csv").root == tmp_path


def test_auto_refuses_what_nobody_knows_and_what_two_know(tmp_path: Path) -> None:
    with pytest.raises(StageError) as error:
        auto(tmp_path)
    assert str(error.value) == (
        f"{tmp_path}: no reader knows this layout; 'flangeye init {tmp_path}' writes a recipe for "
        "other layouts; tried: ancorasir (holds none of calib_data.json, "
        "calibration_robot_pose_data.npy, calibration_robot_pose_data.npz, data.txt, "
        "readRobot.txt); folder (holds none of poses.csv, poses.yaml, poses.yml, poses.json)"
    )
    (tmp_path / "poses.csv").write_text(HEADING + ROW)
    (tmp_path / "data.txt").write_text("p_robot 6-DoF index:a\n[1, 2, 3, 0, 0, 0, 1]\n")
    with pytest.raises(StageError) as error:
        auto(tmp_path)
    assert str(error.value) == (
        f"{tmp_path}: could be read by ancorasir and folder; choose one, for example "
        "reader: ancorasir"
    )


def test_auto_asks_the_readers_of_plugins_too(tmp_path: Path) -> None:
    class StrangeParams(Params):
        house: str = Field(description="Whose; there is no default.")

    @part("reader.acme")
    def acme(path: Path) -> Archive:
        """Read a maker's own layout."""
        if not (path / "scans.acme").exists():
            raise NotThisLayout(f"{path}: holds no scans.acme")
        return Archive("acme", path, (), ())

    @part("reader.strange")
    def strange(path: Path, params: StrangeParams) -> Archive:
        """Read a layout that says nothing of itself."""
        raise AssertionError("asked without its parameter")

    registry = load_registry()
    for reader in (acme, strange):
        registry.parts[reader.name] = reader
    (tmp_path / "scans.acme").touch()
    recipe = tmp_path / "recipe.yaml"
    recipe.write_text(
        "title: auto\nrobot: {model: ur5}\nscanner: {model: phoxi-m}\n"
        "steps: [acquire.archive, segment.flange, fit.rim, solve.svd]\n"
    )
    chosen = load_recipe(recipe, registry).steps[0].params.reader
    assert chosen(tmp_path).notes == (f"reader: acme, chosen by what {tmp_path} holds",)
    (tmp_path / "scans.acme").unlink()
    with pytest.raises(StageError) as error:
        chosen(tmp_path)
    assert str(error.value).startswith(
        f"{tmp_path}: no reader knows this layout; 'flangeye init {tmp_path}' writes a recipe for "
        "other layouts; tried: acme (holds no scans.acme); ancorasir (holds "
    )
    untried = str(error.value).partition(
        "; not tried, because a recipe must give their parameters: "
    )[2]
    assert "strange" in untried.split(", ")
