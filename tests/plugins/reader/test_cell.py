"""Tables of a cell, however they are joined, hold the session they were written from."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from flangeye import StageError
from flangeye.files.yaml_lines import parse_yaml
from flangeye.maths.kinematics import Arm
from flangeye.maths.streams import joints_at, pose_at
from flangeye.plugin.registry import load_registry
from flangeye.types import ArchivePath, Source
from flangeye.types.geometry import rigid
from flangeye.workflow.log.read import read_run
from flangeye.workflow.recipe.load import load_recipe, parse_recipe
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.runner import Runner
from flangeye.workflow.run.session import Start, record_run
from flangeye.workflow.run.tables import write_tables
from flangeye_plugins.reader.cell import CellParams, cell
from tests.estimation.cells import ROBOT, moving, swinging

REGISTRY = load_registry()
RECIPES = Path(__file__).parents[3] / "recipes" / "configurations"
RAIL = RECIPES / "arm-on-rail_marker_most-likely_simulated.yaml"
FLANGE = RECIPES / "two-scanners_flange_most-likely_simulated.yaml"


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of an arm on a rail, and its tables."""
    path = tmp_path_factory.mktemp("cell") / "run"
    recipe = load_recipe(RAIL, REGISTRY, ["steps.0.sightings=16"])
    record_run(recipe, REGISTRY, RunFolder.create("run", path), Start(), report=False)
    write_tables(read_run(path), path / "tables", REGISTRY)
    return path


@pytest.fixture
def tables(run: Path, tmp_path: Path) -> Path:
    """The tables, to be spoilt."""
    for file in (run / "tables").iterdir():
        (tmp_path / file.name).write_text(file.read_text())
    return tmp_path


def seen_in(folder: Path, change: Any = None) -> Any:
    data = parse_yaml((folder / "recipe.yaml").read_text(), "recipe.yaml").data
    acquire = data["steps"][0]["acquire.samples"] | {"path": str(folder)}
    data["steps"][0] = {"acquire.samples": acquire}
    if change is not None:
        change(data)
    recipe = parse_recipe(yaml.safe_dump(data, sort_keys=False), "r", REGISTRY)
    return Runner(recipe, REGISTRY, ArchivePath(None)).take(None)


def reader_of(data: Any) -> Any:
    return data["steps"][0]["acquire.samples"]["reader"]["cell"]


def test_tables_hold_the_session_that_they_were_written_from(run: Path) -> None:
    found = {o.id: o for o in seen_in(run / "tables")}
    given = read_run(run).observations()
    assert set(found) == {o.id for o in given}
    for o in given:
        back = found[o.id]
        assert (back.camera, back.target) == (o.camera, o.target)
        for name in ("rail", "arm"):
            assert np.allclose(back.poses[name].matrix, o.poses[name].matrix, atol=1e-9)
        pose = back.feature.camera_T_target.matrix
        assert np.allclose(pose, o.feature.camera_T_target.matrix, atol=1e-9)
        assert np.allclose(back.feature.covariance, o.feature.covariance, rtol=1e-3)
        assert np.allclose(back.arm_joints["arm"], o.arm_joints["arm"], atol=1e-9)


def test_points_go_to_acquire_centres(tables: Path) -> None:
    def as_points(data: Any) -> None:
        for each in reader_of(data)["sightings"]:
            each |= {"rotation": "point", "columns": ["x", "y", "z"]}
        reader = data["steps"][0].pop("acquire.samples")["reader"]
        data["steps"][0]["acquire.centres"] = {"path": str(tables), "reader": reader}

    found = seen_in(tables, as_points)
    assert len(found) == 16
    assert all(o.feature.normal is None and set(o.poses) == {"rail", "arm"} for o in found)


def test_scans_go_to_acquire_archive(tmp_path: Path) -> None:
    """The flange that is found in a cell's recorded scans is the one that was found in the run."""
    recipe = load_recipe(FLANGE, REGISTRY, [
        "steps.0.sightings=6", "steps.0.resolution=0.2", "log.clouds=full"])  # fmt: skip
    path = tmp_path / "run"
    record_run(recipe, REGISTRY, RunFolder.create("run", path), Start(), report=False)
    *_, written = write_tables(read_run(path), path / "tables", REGISTRY)
    again = load_recipe(written, REGISTRY)
    assert [step.stage.name for step in again.steps][:3] == [
        "acquire.archive", "segment.flange", "fit.rim"]  # fmt: skip
    found = {o.id: o for o in Runner(again, REGISTRY, ArchivePath(None)).take(None)}
    given = read_run(path).observations()
    assert {o.id for o in given} == set(found)
    for o in given:
        assert (found[o.id].camera, found[o.id].target) == (o.camera, "flange")
        assert np.allclose(found[o.id].feature.centre, o.feature.centre, atol=1e-6)
        assert np.allclose(found[o.id].poses["arm"].matrix, o.poses["arm"].matrix, atol=1e-9)


def _without(group: str, name: str) -> Any:
    def change(data: Any) -> None:
        del reader_of(data)[group][name]

    return change


def _without_joints(data: Any) -> None:
    del reader_of(data)["arms"]["arm"]["joints"]
    reader_of(data)["arms"]["arm"]["columns"] = ["x", "y", "z", "qx", "qy", "qz", "qw"]


def _on_a_link(data: Any) -> None:
    data["cell"]["cameras"]["first"] = {"on": "arm", "link": 3}
    _without_joints(data)


def _five_joints(data: Any) -> None:
    arm = reader_of(data)["arms"]["arm"]
    arm["columns"] = ["x", "y", "z", "qx", "qy", "qz", "qw"]
    arm["joints"].pop()


def _renamed(data: Any) -> None:
    reader_of(data)["sightings"][1]["camera"] = "secnd"


def _alone(data: Any) -> None:
    del reader_of(data)["sightings"][1]


def _timed(data: Any) -> None:
    del reader_of(data)["arms"]["arm"]["number"]
    reader_of(data)["arms"]["arm"]["time"] = "number"


def _as_axis(data: Any) -> None:
    axes = reader_of(data)["axes"]
    axes["arm"] = dict(axes["rail"])
    del reader_of(data)["arms"]


def _of_one_camera(data: Any) -> None:
    del data["cell"]
    data["steps"][1] = "solve.robust"


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (_renamed, "{}: has recordings of 'secnd', which is not a camera of the recipe's cell; it has "
         "first, second"),
        (_alone, "{}: 'second' sees nothing; add its table to the reader, or leave it out of the "
         "cell"),
        (_without("axes", "rail"), "{}: has no poses of 'rail', which moves in this cell; add its "
         "table to the reader"),
        (_timed, "{}/arm.csv: has times, and first_marker.csv has none; join all tables by time, "
         "or all by number"),
        (_as_axis, "{}: 'arm' is an arm, but its table has one value a row, as an axis has; give "
         "its poses under the reader's arms"),
        (_on_a_link, "{}: where link 3 of 'arm' is computed from its joint angles, which are "
         "missing: give their columns in the reader, arms: {{arm: {{joints: …}}}}"),
        (_five_joints, "{}: 'arm' has 5 joint angles, and a ur5 has 6 joints"),
        (_of_one_camera, "{}: holds recordings of a cell; describe it in the recipe: cell: "
         "{{arms: …}}"),
    ],
)  # fmt: skip
def test_what_is_not_of_the_cell_is_named(tables: Path, change: Any, told: str) -> None:
    with pytest.raises(StageError) as error:
        seen_in(tables, change)
    assert str(error.value) == told.format(tables)


@pytest.mark.parametrize(
    ("stated", "cure"),
    [
        ({"joint_unit": "deg"}, "write joint_unit: rad"),
        ({"pose": "flange_T_base"}, "invert the direction stated as pose:"),
        ({"length": "mm"}, "write length: m"),
        ({"joints": [f"j{i}_rad" for i in (2, 1, 3, 4, 5, 6)]},
         "check their order and the model, or leave out joints"),
    ],
)  # fmt: skip
def test_joint_angles_that_are_not_those_of_the_poses_are_refused(
    tables: Path, stated: Any, cure: str
) -> None:
    with pytest.raises(StageError) as error:
        seen_in(tables, lambda data: reader_of(data)["arms"]["arm"].update(stated))
    told = r": the joint angles of 'arm' put the flange of a ur5 [\d.e+]+ mm from its pose; "
    assert re.search(told + re.escape(cure) + "$", str(error.value))


def test_an_arm_whose_joints_are_not_recorded_has_none(tables: Path) -> None:
    assert all(not o.arm_joints for o in seen_in(tables, _without_joints))


def _rows(path: Path, change: Any) -> None:
    heading, *rows = path.read_text().splitlines()
    path.write_text("\n".join([heading, *change(rows)]) + "\n")


@pytest.mark.parametrize(
    ("file", "change", "told"),
    [
        ("arm.csv", lambda rows, key: [r for r in rows if r[:4] != key], "first_marker.csv:2: pose {0} is not in arm.csv; every "
         "pose needs its row of 'arm'"),
        ("rail.csv", lambda rows, key: [*rows, f"{key},0"], "rail.csv:18: pose {0} is there twice"),
        ("arm.csv", lambda rows, _: [rows[0][:4] + "," * 7, *rows[1:]],
         "arm.csv:2: has no pose of 'arm'"),
    ],
)  # fmt: skip
def test_rows_that_do_not_join_are_named(tables: Path, file: str, change: Any, told: str) -> None:
    first = (tables / "first_marker.csv").read_text().splitlines()[1].split(",")[0]
    _rows(tables / file, lambda rows: change(rows, first))
    with pytest.raises(StageError) as error:
        seen_in(tables)
    assert str(error.value) == f"{tables}/" + told.format(first)


def test_millimetres_read_as_metres_and_arms_that_rest_are_named(tables: Path) -> None:
    def scaled(rows: list[str]) -> list[str]:
        cells = [row.split(",") for row in rows]
        return [",".join([c[0], *(str(float(x) * 1e3) for x in c[1:4]), *c[4:]]) for c in cells]

    text = (tables / "arm.csv").read_text()
    _rows(tables / "arm.csv", scaled)
    with pytest.raises(StageError, match="has 'arm' .* m from its base, beyond any arm; are the"):
        seen_in(tables)
    (tables / "arm.csv").write_text(text)
    for name in ("arm", "rail"):
        _rows(tables / f"{name}.csv", lambda rows: [
            ",".join([row.split(",")[0], *rows[0].split(",")[1:]]) for row in rows])  # fmt: skip
    with pytest.raises(StageError, match="nothing moves in all 16 sightings; move the arms"):
        seen_in(tables)


# --- by time


def test_streams_are_joined_by_time_where_everything_stands_still(tmp_path: Path) -> None:
    """The camera's clock is 0.2 s behind; at the last stop the rail has not come to rest."""
    rng = np.random.default_rng(5)
    stops = [rigid(Rotation.random(random_state=rng).as_matrix(), rng.uniform(-1, 1, 3))
             for _ in range(8)]  # fmt: skip
    times = np.arange(0, 8.0, 0.01)
    held = np.minimum((times / 1.0).astype(int), 7)
    moving = times % 1.0 < 0.3
    poses = np.array([stops[i] for i in held])
    poses[moving, :3, 3] += 0.05 * rng.standard_normal((moving.sum(), 3))
    rail = np.where(held == 7, times, 0.1 * held)
    _written(tmp_path / "arm.csv", "t,x,y,z,qx,qy,qz,qw", times, _quaternions(poses))
    _written(tmp_path / "rail.csv", "t,value", times, rail[:, None] * 1e3)
    at = np.array([i + 0.4 + 0.02 * k for i in range(8) for k in range(20)])
    seen = np.array([[i, 0.0, 1.0] for i in range(8) for _ in range(20)])
    _written(tmp_path / "left.csv", "t,u,v,w", at - 0.2, seen)
    params = CellParams.model_validate({
        "arms": {"arm": {"file": "arm.csv", "time": "t", "rotation": "xyzw", "length": "m"}},
        "axes": {"rail": {"file": "rail.csv", "time": "t", "column": "value", "unit": "mm"}},
        "sightings": [{"camera": "left", "target": "ball", "file": "left.csv", "time": "t",
                       "rotation": "point", "length": "m"}],
        "join": {"clock_offset": "200 ms"},
    })  # fmt: skip
    archive = cell(tmp_path, params)
    assert len(archive.recordings) == 7
    assert "left out 1 poses at which another arm or axis of the cell moved" in " ".join(
        archive.notes
    )
    for i, recording in enumerate(archive.recordings):
        assert np.allclose(recording.poses["arm"], stops[i], atol=1e-6)
        assert recording.axes["rail"] == pytest.approx(0.1 * i, abs=1e-9)
        assert np.allclose(recording.centre_in_camera, [i, 0, 1])
        assert (recording.seen_by, recording.saw) == ("left", "ball")


@pytest.mark.parametrize("slide", [0.0, 0.05])
def test_arms_that_pass_are_told_with_how_they_and_a_rail_passed(
    tmp_path: Path, slide: float
) -> None:
    times = np.arange(0, 12.0, 0.01)
    for name, phase in (("one", 0.0), ("two", 1.0)):
        poses = np.array([rigid(Rotation.from_rotvec([0.5 * np.sin(t + phase), 0, 0]).as_matrix(),
                                [0.2 * np.sin(t + phase), 0.2 * np.cos(t), 0]) for t in times])  # fmt: skip
        _written(tmp_path / f"{name}.csv", "t,x,y,z,qx,qy,qz,qw", times, _quaternions(poses))
    _written(tmp_path / "rail.csv", "t,value", times, slide * times[:, None])
    at = np.arange(1.0, 11.0, 0.5)
    _written(tmp_path / "left.csv", "t,u,v,w", at, np.ones((len(at), 3)))
    arm = {"time": "t", "rotation": "xyzw", "length": "m"}
    params = CellParams.model_validate({
        "arms": {name: {"file": f"{name}.csv", **arm} for name in ("one", "two")},
        "axes": {"rail": {"file": "rail.csv", "time": "t", "column": "value", "unit": "m"}},
        "sightings": [{"camera": "left", "target": "ball", "file": "left.csv", "time": "t",
                       "rotation": "point", "length": "m"}],
        "join": {"clock_offset": "0 ms"},
    })  # fmt: skip
    recordings = cell(tmp_path, params).recordings
    assert len(recordings) > 10
    for recording in recordings:
        motion = recording.motion
        assert {*motion.others} == {"one", "two"}
        assert np.allclose(pose_at(motion, 0.0, "two"), recording.poses["two"], atol=1e-6)
        assert joints_at(motion, 0.0, "rail") == pytest.approx(recording.axes["rail"])
        assert joints_at(motion, 0.1, "rail") == pytest.approx(recording.axes["rail"] + 0.1 * slide)


def test_joints_of_an_arm_that_passes_are_told_with_how_they_passed(tmp_path: Path) -> None:
    times = np.arange(0, 12.0, 0.01)
    at = np.arange(1.0, 11.0, 0.5)
    joints, poses = swinging(times), Arm(ROBOT).flange(swinging(times))
    rows = np.hstack([_quaternions(poses), np.degrees(joints)])
    heading = "t,x,y,z,qx,qy,qz,qw," + ",".join(f"q.{i}" for i in range(6))
    _written(tmp_path / "arm.csv", heading, times, rows)
    _written(tmp_path / "left.csv", "t,u,v,w", at, np.ones((len(at), 3)))
    params = CellParams.model_validate({
        "arms": {"arm": {"file": "arm.csv", "time": "t", "rotation": "xyzw", "length": "m",
                         "joints": ["q"], "joint_unit": "deg"}},
        "sightings": [{"camera": "left", "target": "ball", "file": "left.csv", "time": "t",
                       "rotation": "point", "length": "m"}],
        "join": {"clock_offset": "0 ms"},
    })  # fmt: skip
    recordings = cell(tmp_path, params).recordings
    assert len(recordings) > 10
    for recording in recordings:
        when = recording.time_ns * 1e-9
        told = recording.arm_joints["arm"]
        assert told == pytest.approx(swinging(np.array([when]))[0], abs=1e-4)
        assert joints_at(recording.motion, 0.0, "arm") == pytest.approx(told)
        later = swinging(np.array([when + 0.1]))[0]
        assert joints_at(recording.motion, 0.1, "arm") == pytest.approx(later, abs=1e-4)


SLIDING = """\
title: An arm that passes on a rail that slides
cell:
  rails: {rail: {axis: [0, 1, 0], travel: [-1 m, 1 m]}}
  arms: {arm: {model: ur5, on: rail}}
  cameras: {left: base}
  targets: {marker: arm}
steps:
  - acquire.samples:
      path: FOLDER
      reader:
        cell:
          arms: {arm: {file: arm.csv, time: t, rotation: xyzw, length: m}}
          axes: {rail: {file: rail.csv, time: t, column: value, unit: m}}
          sightings:
            - {camera: left, target: marker, file: left.csv, time: t, rotation: xyzw, length: m}
          join: {clock_offset: 0 ms}
  - solve.robust
"""


def test_tables_of_an_arm_that_passed_while_its_rail_slid_give_the_time_between_the_clocks(
    tmp_path: Path,
) -> None:
    """The camera's clock is 60 ms behind."""
    times, rng = np.arange(0, 26.0, 0.01), np.random.default_rng(0)
    left = rigid(Rotation.from_rotvec([3.0, 0.1, 0.0]).as_matrix(), [0.4, 0.6, 1.1])
    marker = rigid(Rotation.from_rotvec([0.0, 0.1, 0.2]).as_matrix(), [0.01, 0.02, 0.05])
    at = np.arange(1.0, 25.0, 0.4)
    actual = moving(at)
    actual[:, 1, 3] += 0.3 * np.sin(at)
    seen = np.linalg.inv(left) @ actual @ marker
    seen[:, :3, 3] += 1e-4 * rng.standard_normal((len(at), 3))
    _written(tmp_path / "arm.csv", "t,x,y,z,qx,qy,qz,qw", times, _quaternions(moving(times)))
    _written(tmp_path / "rail.csv", "t,value", times, 0.3 * np.sin(times)[:, None])
    _written(tmp_path / "left.csv", "t,x,y,z,qx,qy,qz,qw", at - 0.06, _quaternions(seen))
    recipe = parse_recipe(SLIDING.replace("FOLDER", str(tmp_path)), "r", REGISTRY)
    runner = Runner(recipe, REGISTRY, ArchivePath(None))
    found = runner.solve(runner.take(None), Source("tables"))
    (told,) = [note for note in found.notes if "the arms reached the recorded poses" in note]
    assert re.search(
        "the arms reached the recorded poses (59.[5-9]|60.[0-5]) .* after the times that left", told
    )
    assert found.camera.transform.matrix == pytest.approx(left, abs=1e-3)


def _quaternions(poses: Any) -> Any:
    return np.hstack([poses[:, :3, 3], Rotation.from_matrix(poses[:, :3, :3]).as_quat()])


def _written(path: Path, heading: str, times: Any, rows: Any) -> None:
    lines = [
        ",".join(repr(float(x)) for x in (t, *row)) for t, row in zip(times, rows, strict=True)
    ]
    path.write_text("\n".join([heading, *lines]) + "\n")
