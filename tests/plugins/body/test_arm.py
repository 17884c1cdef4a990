"""target: {body: robot}: an arm found by its own links, in scans of a ray caster of the tests' own."""

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from flangeye.errors import RecipeError, StageError
from flangeye.maths.kinematics import Arm
from flangeye.models.bodies import ArmBody, TargetBody, arm_body
from flangeye.models.configuration import ORIGIN, Configuration
from flangeye.models.robots import RobotModel
from flangeye.models.urdf import robot_from_urdf
from flangeye.plugin.registry import load_registry
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    Capture,
    Earlier,
    FlangeCloud,
    Floats,
    PointCloud,
    PoseFeature,
    Rejected,
    Transform,
)
from flangeye.types.geometry import invert, rigid, rotation_from_rpy, rotation_log
from flangeye.workflow.recipe.load import load_recipe, parse_recipe
from flangeye_plugins.fit.body import FitBodyParams, fit_body
from flangeye_plugins.segment.body import SegmentBodyParams, segment_body
from tests.plugins.seam.raycast import Plate

URDF = Path(__file__).parents[3] / "recipes" / "boxes-arm.urdf"
JOINTS = np.array([1.7, -1.5, 1.6, -1.7, -1.4, 0.4])
CAMERA_POSE = rigid(rotation_from_rpy(-1.92, 0.0, 1.75), np.array([1.3, 0.3, 0.8]))
NOISE = 2e-3
"""Of a time-of-flight camera at its mid range [m]."""


@cache
def robot() -> RobotModel:
    return robot_from_urdf(URDF)


@cache
def arm() -> ArmBody:
    return arm_body(robot(), {}, Path())


def plates(joints) -> Iterator[tuple[Plate, Floats]]:
    """The arm's boxes and cylinders by their half-spaces and corners, before the camera."""
    frames = invert(CAMERA_POSE) @ Arm(robot()).frames(joints)
    for k, mesh in robot().meshes():
        offsets = np.einsum("fi,fi->f", mesh.face_normals, mesh.triangles[:, 0])
        sides = np.unique(np.column_stack([mesh.face_normals, offsets]).round(9), axis=0)
        corners = mesh.vertices @ frames[k][:3, :3].T + frames[k][:3, 3]
        yield Plate(sides[:, :3], sides[:, 3]).moved(frames[k]), corners


def scan(joints=JOINTS, bodies=None, seed=0) -> Capture:
    """A scan of the arm, or of other plates with corners, before a wall; its joints as reported."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-0.7, 0.7, 320), np.linspace(-0.6, 0.6, 280))
    rays = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
    depth = np.full(len(rays), 2.6)
    for plate, corners in plates(joints) if bodies is None else bodies:
        seen = corners[:, :2] / corners[:, 2:]
        at = rays[:, :2]
        near = ((at >= seen.min(axis=0)) & (at <= seen.max(axis=0))).all(axis=1)
        depth[near] = np.minimum(depth[near], plate.meet(np.zeros(3), rays[near])[0])
    points = (depth + NOISE * rng.standard_normal(len(rays)))[:, None] * rays
    pose = Transform(BASE, FLANGE, Arm(robot()).flange(JOINTS))
    return Capture("0000", PointCloud(CAMERA, points), {FLANGE: pose}, joints=JOINTS)


BLOCK = (
    Plate(np.vstack([np.eye(3), -np.eye(3)]), np.array([0.3, 0.4, 1.7, 0.1, 0.3, -1.4])),
    np.array(list(product((-0.1, 0.3), (-0.3, 0.4), (1.4, 1.7)))),
)


def found(capture: Capture) -> FlangeCloud | Rejected:
    drawn_in_flange = Configuration(stands=ORIGIN)
    params = SegmentBodyParams(min_trust=0.95)
    return segment_body(capture, arm(), drawn_in_flange, Earlier([]), params)


def test_an_arm_is_found_by_its_links_and_its_error_is_as_stated() -> None:
    capture = scan()
    cloud = found(capture)
    assert isinstance(cloud, FlangeCloud), cloud
    exact = FitBodyParams.model_validate({"model_error": "0 mm", "scanner_error": "0 mm"})
    feature = fit_body(cloud, arm(), exact, capture=capture)
    assert isinstance(feature, PoseFeature), feature
    true = invert(CAMERA_POSE) @ capture.poses[FLANGE].matrix
    turn = feature.camera_T_target.rotation @ true[:3, :3].T
    shift = feature.camera_T_target.translation - true[:3, 3]
    error = np.r_[rotation_log(turn[None])[0], shift]
    assert np.linalg.norm(shift) < 3e-3
    assert error @ np.linalg.solve(feature.covariance, error) < 22.5  # 99.9 % of 6 freedoms


@pytest.mark.parametrize(
    "bodies",
    [
        None,
        pytest.param([BLOCK], marks=pytest.mark.slow),
    ],
    ids=["with its elbow elsewhere than reported", "that is not there"],
)
def test_an_arm_is_refused(bodies) -> None:
    elsewhere = JOINTS + np.array([0.0, 0.0, 0.5, 0.0, 0.0, 0.0])
    assert isinstance(found(scan(elsewhere, bodies)), Rejected)


def test_how_an_arm_stands_needs_its_joints() -> None:
    with pytest.raises(StageError, match="follows from its joint angles"):
        found(replace(scan(), joints=None))


RECIPE = (
    "title: T\nrobot: {}\nscanner: azure-kinect\nfeature: {{standard: ISO 9409-1-50-4-M6}}\n"
    "target: {}\nsteps: [acquire.simulated, segment.body, fit.body, solve.robust]\n"
)


@pytest.mark.parametrize(
    ("robot", "target", "message"),
    [
        ("ur10e", "robot", "body: robot needs the meshes of ur10e's links; name its URDF"),
        (f"{{urdf: {URDF}}}", "{body: robot, at: unknown}", "remove at: unknown"),
        ("ur10e", "{body: robot, links: {9: a.stl}}", "ur10e has links 0 to 6, not [9]"),
        ("ur10e", "{body: gripper, links: {0: a.stl}}", "target.links: is for body: robot only"),
    ],
)
def test_a_recipe_that_does_not_say_how_the_arm_looks_is_refused(robot, target, message) -> None:
    with pytest.raises(RecipeError, match=re.escape(message)):
        parse_recipe(RECIPE.format(robot, target), "r", load_registry())


def test_the_links_go_with_a_run(tmp_path: Path) -> None:
    path = tmp_path / "r.yaml"
    path.write_text(RECIPE.format(f"{{urdf: {URDF}}}", "robot"))
    recipe = load_recipe(path, load_registry())
    for name, text in recipe.files.items():
        (tmp_path / "run" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "run" / name).write_text(text)
    again = load_recipe(tmp_path / "run" / "recipe.resolved.yaml", load_registry())
    first, second = (each.context[TargetBody].at(JOINTS) for each in (recipe, again))
    assert np.allclose(
        first.vertices[first.triangles], second.vertices[second.triangles], atol=1e-6
    )
