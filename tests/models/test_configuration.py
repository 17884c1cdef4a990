"""A recipe names camera, target and their carriers; what is unknown follows."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye import StageError, hookimpl, stage
from flangeye.errors import RecipeError
from flangeye.maths.kinematics import Arm
from flangeye.models.cell import cell_of
from flangeye.models.configuration import EVERY, Configuration, mapped_and_expected
from flangeye.models.robots import RobotModel
from flangeye.plugin.registry import Registry
from flangeye.types import (
    BASE,
    BASE2,
    CAMERA,
    FLANGE,
    FLANGE2,
    TARGET,
    Capture,
    CircleFeature,
    HandEye,
    Observation,
    Observations,
    PoseFeature,
    Rejected,
    Transform,
    by_frame,
)
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.workflow.log.read import read_run
from flangeye.workflow.recipe.load import parse_recipe
from flangeye.workflow.run.folder import RunFolder
from flangeye.workflow.run.restart import restart_at
from flangeye.workflow.run.session import Start, record_run
from flangeye_plugins.solve.svd import solve_svd
from tests import toy


@stage("fit.toy_marker")
def fit_marker(capture: Capture) -> PoseFeature | Rejected:
    """Read a marker's pose from a scan, without a segment step."""
    if not len(capture.cloud.points()):
        return Rejected("no finite point")
    pose = Transform(CAMERA, TARGET, rigid(np.eye(3), capture.cloud.points().mean(axis=0)))
    return PoseFeature(pose, 1e-8 * np.eye(6), {"reprojection": 0.1})


@stage("solve.toy_loop", serves=EVERY)
def solve_loop(
    observations: Observations, configuration: Configuration, params: toy.SolveParams
) -> HandEye:
    """Solve whatever the configuration is."""
    return toy.solve(observations, params)


@pytest.fixture
def registry(toy_registry: Registry) -> Any:
    class Module:
        @hookimpl
        def flangeye_stages(self):
            return [fit_marker, solve_loop, solve_svd]

    toy_registry.register("marker", Module())
    return toy_registry


def recipe(registry, configuration, solve="solve.toy_loop", fit="fit.toy"):
    text = (
        f"title: T\nrobot: {{model: ur5}}\nconfiguration: {configuration}\nsteps:\n"
        f"  - acquire.toy\n  - segment.toy\n  - {fit}\n  - {solve}\n"
    )
    return parse_recipe(text, "r.yaml", registry)


@pytest.mark.parametrize(
    ("written", "unknowns", "equation"),
    [
        (
            "{}",
            ("base_T_camera",),
            "[base_T_camera] · camera_T_target = base_T_flange · flange_T_target",
        ),
        (
            "{place: unknown}",
            ("base_T_camera", "flange_T_target"),
            "[base_T_camera] · camera_T_target = base_T_flange · [flange_T_target]",
        ),
        (
            "{name: eye-in-hand, place: unknown}",
            ("flange_T_camera", "base_T_target"),
            "base_T_flange · [flange_T_camera] · camera_T_target = [base_T_target]",
        ),
        (
            "{name: eye-in-hand}",
            ("flange_T_camera",),
            "base_T_flange · [flange_T_camera] · camera_T_target = base_T_target",
        ),
        (
            "{name: eye-on-arm, camera: link3, place: unknown}",
            ("link3_T_camera", "flange_T_target"),
            "base_T_link3 · [link3_T_camera] · camera_T_target = base_T_flange · [flange_T_target]",
        ),
        (
            "{name: eye-on-arm, camera: link3, target: base}",
            ("link3_T_camera",),
            "base_T_link3 · [link3_T_camera] · camera_T_target = base_T_target",
        ),
        (
            "{name: two-arms}",
            ("flange_T_camera", "base_T_base2"),
            "base_T_flange · [flange_T_camera] · camera_T_target = "
            "[base_T_base2] · base2_T_flange2 · flange2_T_target",
        ),
        (
            "{name: two-arms, place: unknown}",
            ("flange_T_camera", "base_T_base2", "flange2_T_target"),
            "base_T_flange · [flange_T_camera] · camera_T_target = "
            "[base_T_base2] · base2_T_flange2 · [flange2_T_target]",
        ),
    ],
)
def test_the_unknowns_follow_from_the_frames(
    registry: Any, written: str, unknowns: tuple[Any, ...], equation: str
) -> None:
    found = recipe(registry, written).context[Configuration]
    assert found.unknowns == unknowns
    assert found.equation == equation
    assert found.describe().endswith(f"to be found: {', '.join(unknowns)}")


@pytest.mark.parametrize(
    ("written", "complaint"),
    [
        (
            "{name: eye-in-hand, camera: base}",
            "eye-in-hand: the camera is carried by flange, not by base",
        ),
        (
            "{name: eye-on-base, target: base}",
            "eye-on-base: the target is carried by flange, not by base",
        ),
        (
            "{name: eye-on-arm, camera: link3, target: flange2}",
            "eye-on-arm: the target is carried by flange or base, not by flange2",
        ),
        (
            "{name: eye-on-arm}",
            "eye-on-arm: the camera is carried by a link, link1 to link6, not by link; write for "
            "example camera: link3",
        ),
    ],
)
def test_frames_that_cannot_be_are_refused(registry: Any, written: str, complaint: str) -> None:
    with pytest.raises(RecipeError) as error:
        recipe(registry, written)
    assert str(error.value) == f"r.yaml:3: configuration: {complaint}"


def test_a_link_needs_the_robots_model(registry: Any) -> None:
    text = (
        "title: T\nconfiguration: {name: eye-on-arm, camera: link3}\nsteps:\n"
        "  - acquire.toy\n  - segment.toy\n  - fit.toy\n  - solve.toy_loop\n"
    )
    with pytest.raises(
        RecipeError,
        match="a link's pose is computed by the arm's kinematics; name the robot's model",
    ):
        parse_recipe(text, "r.yaml", registry)


def test_a_solver_that_knows_the_flange_only_is_refused_elsewhere(registry: Any) -> None:
    with pytest.raises(RecipeError) as error:
        recipe(registry, "{name: eye-in-hand}", solve="solve.svd")
    assert str(error.value) == (
        "r.yaml:8: steps.3.solve.svd: solve.svd finds base_T_camera from the flange's own circle, "
        "and the configuration asks for flange_T_camera; use solve.robust"
    )


def test_a_solver_that_takes_circles_gets_no_poses(registry: Any) -> None:
    with pytest.raises(RecipeError) as error:
        recipe(registry, "{}", solve="solve.svd", fit="fit.toy_marker")
    assert str(error.value) == (
        "r.yaml:8: steps.3.solve.svd: solve.svd takes circles, and the fit gives poses; "
        "use solve.robust"
    )


def test_a_marker_needs_no_segment_step(registry: Any, tmp_path: Path) -> None:
    text = (
        "title: T\nlog: {clouds: full}\nsteps:\n  - acquire.toy: {bad: 1, verification: 2}\n"
        "  - fit.toy_marker\n  - solve.toy_loop\n"
    )
    checked = parse_recipe(text, "r", registry)
    folder = RunFolder.create("r", tmp_path / "run")
    result = record_run(checked, registry, folder, Start(), report=False)
    assert [o.id for o in result.observations if o.used] == ["002", "003", "004", "005"]
    assert result.observations[0].radii is None
    log = read_run(folder.log)
    assert isinstance(log.observations()[0].feature, PoseFeature)
    again = restart_at(log, checked, "fit.toy_marker")
    folder = RunFolder.create("r", tmp_path / "again")
    repeated = record_run(checked, registry, folder, Start(point=again), report=False)
    assert repeated.transforms == result.transforms


def test_a_place_is_written_as_a_pose(registry: Any) -> None:
    written = (
        "{name: eye-in-hand, place: {position: [0 mm, 0 mm, 12 mm], rpy: [0 deg, 0 deg, 90 deg]}}"
    )
    place = recipe(registry, written).context[Configuration].place
    assert np.allclose(place, [[0.0, -1, 0, 0], [1.0, 0, 0, 0], [0, 0, 1, 0.012], [0.0, 0, 0, 1]])


def observation(*others, joints=None):
    pose = Transform(BASE, FLANGE, rigid(rotation_exp(np.array([0.1, 0.2, 0.3])), [0.4, 0.1, 0.3]))
    seen = Transform(CAMERA, TARGET, rigid(np.eye(3), [0.0, 0.0, 0.5]))
    return Observation("7", PoseFeature(seen, np.eye(6)), by_frame(pose, *others), joints)


def test_the_loop_closes_for_two_arms() -> None:
    x, y, z = (
        rigid(rotation_exp(np.array(v)), np.array(v)[::-1])
        for v in ([0.1, 0, 0.2], [0, 1, 0.5], [2, 0, 0])
    )
    configuration = Configuration("two-arms", FLANGE, FLANGE2, None)
    names = dict(zip(configuration.unknowns, (x, y, z), strict=True))
    ends = {name: name.split("_T_") for name in names}
    transforms = {n: Transform(ends[n][0], ends[n][1], m) for n, m in names.items()}
    first = observation()
    target = first.base_T_flange.matrix @ x @ first.feature.camera_T_target.matrix
    second = Transform(BASE2, FLANGE2, np.linalg.inv(y) @ target @ np.linalg.inv(z))
    pair = [replace(first, poses=by_frame(first.base_T_flange, second))]
    mapped, expected = mapped_and_expected(
        cell_of(configuration, None).ends(transforms, pair), pair
    )
    assert np.allclose(mapped, expected, atol=1e-12)


def test_a_missing_second_pose_is_named() -> None:
    with pytest.raises(StageError) as error:
        cell_of(Configuration("two-arms", FLANGE, FLANGE2), None).graph([observation()])
    assert str(error.value) == (
        "observation 7 has no pose of 'flange2', which moves in this cell; it has flange"
    )


def test_a_link_is_where_its_joints_put_it(registry: Any) -> None:
    robot = recipe(registry, "{}").context[RobotModel]
    configuration = Configuration("eye-on-arm", "link3", FLANGE, None)
    joints = np.linspace(-1, 1, 6)
    link = cell_of(configuration, robot).graph([observation(joints=joints)])["link3"]
    assert link.place is not None
    assert np.allclose(link.place[0], Arm(robot).frames(joints)[3])
    with pytest.raises(StageError) as error:
        cell_of(configuration, robot).graph([observation()])
    assert str(error.value) == (
        "where link3 was at observation 7 is computed from the joint angles of 'flange', which are "
        "missing: record them, and name the robot's model in the recipe"
    )


def test_a_pose_feature_has_what_every_feature_has() -> None:
    seen = observation().feature
    assert np.allclose(seen.centre, [0, 0, 0.5])
    assert np.allclose(seen.normal, [0, 0, 1])
    assert seen.centre_covariance.shape == (3, 3)
    assert not isinstance(seen, CircleFeature)
