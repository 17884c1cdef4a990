"""What an arm is drawn by: its own meshes, published ones, or capsules."""

from __future__ import annotations

import io
from importlib.metadata import PackageNotFoundError, files

import numpy as np
import pytest

pytest.importorskip("nicegui", reason="nicegui is not installed")

import trimesh

from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.models.robots import RobotModel
from flangeye.workflow.report.still import ready, rods
from flangeye_ui import scene


def arm(name: str) -> RobotModel:
    robot = load_model("robots", name)
    assert isinstance(robot, RobotModel)
    return robot


def drawn(robot: RobotModel, joints: np.ndarray) -> trimesh.Trimesh:
    mesh = trimesh.load(io.BytesIO(scene._mesh(robot, joints)), file_type="stl")
    assert isinstance(mesh, trimesh.Trimesh)
    return mesh


@pytest.mark.parametrize("name", sorted(scene.PUBLISHED))
def test_published_meshes_stand_where_the_arm_does(name: str) -> None:
    """The published arm's flange is this one's at any joints, and its meshes end at the flange."""
    try:
        files("example-robot-data")
    except PackageNotFoundError:
        pytest.skip("example-robot-data is not installed: pip install 'flangeye[meshes]'")
    robot = arm(name)
    draws = np.random.default_rng(1).uniform(-1, 1, (20, len(robot.joints)))
    for joints in draws:
        published = scene._published(robot, joints)
        assert published is not None
        apart = Arm(published).flange(joints)[:3, 3] - Arm(robot).flange(joints)[:3, 3]
        assert np.linalg.norm(apart) < 1e-9
    mesh = drawn(robot, draws[0])
    assert 1_000 < len(mesh.faces) < 50_000  # a browser without a GPU draws them
    base_T_flange = Arm(robot).flange(draws[0])
    along = (mesh.vertices - base_T_flange[:3, 3]) @ base_T_flange[:3, 2]
    aside = np.linalg.norm(
        np.cross(mesh.vertices - base_T_flange[:3, 3], base_T_flange[:3, 2]), axis=1
    )
    face = along[(aside < 0.06) & (np.abs(along) < 0.05)]
    assert face.max() == pytest.approx(0.0, abs=2e-3)


def test_an_arm_that_stands_otherwise_keeps_its_capsules() -> None:
    robot = arm("ur5")
    longer = robot.joints[1].model_copy(update={"a": robot.joints[1].a - 0.02})
    other = robot.model_copy(update={"joints": (robot.joints[0], longer, *robot.joints[2:])})
    joints = ready(other)
    assert scene._published(other, joints) is None
    assert len(drawn(other, joints).split()) == len(rods(other, joints))
