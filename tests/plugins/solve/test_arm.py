"""solve.robust on arms that err: tool offset and joint offsets, kept only when they help."""

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flangeye.maths.arm_correction import corrected_flange, follow
from flangeye.maths.geometry import basis_of_plane, rigid, rotation_exp, rotation_log
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import chi2_quantile
from flangeye.models.loading import load_model
from flangeye.models.robots import RobotModel
from flangeye.models.standards import load_standard
from flangeye.models.targets import flange_of
from flangeye.types import (
    BASE,
    CAMERA,
    FLANGE,
    ArchivePath,
    ArmCorrection,
    CircleFeature,
    FlangeCloud,
    Floats,
    HandEye,
    Observation,
    Observations,
    Seed,
    Source,
    Transform,
    by_frame,
)
from flangeye_plugins.acquire.archive import ArchiveParams, acquire_archive
from flangeye_plugins.fit.rim import fit_rim
from flangeye_plugins.fit.rim_params import RimParams
from flangeye_plugins.reader.ancorasir import AncorasirParams
from flangeye_plugins.reader.ancorasir import ancorasir as published_layout
from flangeye_plugins.segment.flange import SegmentParams, segment_flange
from flangeye_plugins.solve.robust import RobustParams, solve_poses
from flangeye_plugins.solve.svd import SvdParams, solve_svd
from flangeye_plugins.verify.holdout import HoldoutParams, verify_holdout

MM = 1e-3
TRUTH = Transform(
    BASE, CAMERA, rigid(rotation_exp(np.array([2.9, 0.4, -0.3])), np.array([0.4, -0.7, 0.9]))
)
HOME = np.radians([-42.0, -100.0, 120.0, -110.0, -90.0, 10.0])


@pytest.fixture(scope="module")
def ur5() -> RobotModel:
    robot: RobotModel = load_model("robots", "ur5")
    return robot


def simulate(
    robot: RobotModel,
    n: int,
    *,
    offsets: Sequence[float] | Floats = (0.0,) * 6,
    tool: Sequence[float] | Floats = (0.0,) * 3,
    tilt: float = 0.3,
    with_joints: bool = False,
    seed: int = 0,
) -> list[Observation]:
    """Poses of an arm whose joints and tool are off; the report knows nothing of it."""
    rng, arm = np.random.default_rng(seed), Arm(robot)
    middle = arm.flange(HOME)
    observations = []
    for i in range(n):
        wanted = middle.copy()
        wanted[:3, :3] = middle[:3, :3] @ rotation_exp(rng.uniform(-tilt, tilt, 3))
        wanted[:3, 3] += rng.uniform(-0.5, 0.5, 3) * [0.3, 0.3, 0.2]
        joints = follow(arm, wanted, HOME)
        true = arm.flange(joints + offsets)
        seen = true[:3, 3] + true[:3, :3] @ tool
        centre = TRUTH.inverse().apply(seen) + 0.05 * MM * rng.standard_normal(3)
        normal = TRUTH.rotation.T @ rotation_exp(5e-4 * rng.standard_normal(3)) @ true[:3, 2]
        across = 25e-8 * (np.eye(3) - np.outer(normal, normal))
        circle = CircleFeature(centre, normal, {}, np.eye(3) * (0.05 * MM) ** 2, across, 1.0)
        pose = Transform(BASE, FLANGE, arm.flange(joints))
        observations.append(
            Observation(f"{i:02d}", circle, by_frame(pose), joints if with_joints else None)
        )
    return observations


def solver(
    robot: RobotModel | None, **params: object
) -> Callable[[Sequence[Observation]], HandEye]:
    return lambda observations: solve_poses(
        observations, RobustParams.model_validate(params), robot
    )


def test_a_tool_offset_is_found_when_the_flange_turns(ur5: RobotModel) -> None:
    offset = np.array([0.4, -0.3, 0.5]) * MM
    calibration = solver(ur5)(simulate(ur5, 30, tool=offset))
    assert calibration.correction is not None
    np.testing.assert_allclose(calibration.correction.tool_offset, offset, atol=0.12 * MM)
    assert "the seen circle is (0." in calibration.notes[-1]
    assert max(np.linalg.norm(p.residual) for p in calibration.pairs) < 0.3 * MM


def test_a_tool_offset_that_cannot_be_told_apart_is_named(ur5: RobotModel) -> None:
    offset = np.array([0.4, -0.3, 0.5]) * MM
    calibration = solver(ur5)(simulate(ur5, 30, tool=offset, tilt=0.0))
    assert calibration.correction is None
    assert calibration.notes[-1] == (
        "a constant offset of the seen circle in the flange frame (tool frame, bias of the fit) "
        "does not show, for orientations differ by 0.0 deg at most: it stays in the camera's place"
    )


def test_joint_zeros_are_not_taken_for_a_tool_offset(ur5: RobotModel) -> None:
    """Zeros that are off bend the arm's space, and part of that looks like an offset."""
    loose = ur5.model_copy(update={"joint_accuracy": 5e-3})
    zeros = loose.joint_accuracy * np.random.default_rng([2, 2]).standard_normal(6)
    poses = simulate(loose, 40, offsets=[0.0, *zeros[1:]], with_joints=True, seed=2, tilt=0.8)
    assert solver(loose, joint_zeros="ignore")(poses).correction is not None
    assert solver(loose)(poses).correction is None


def test_a_tool_offset_is_found_beside_joint_zeros(ur5: RobotModel) -> None:
    offset = np.array([2.0, -1.5, 0.0]) * MM
    zeros = ur5.joint_accuracy * np.random.default_rng(5).standard_normal(6)
    poses = simulate(ur5, 30, tool=offset, offsets=[0.0, *zeros[1:]], with_joints=True)
    correction = solver(ur5)(poses).correction
    assert correction is not None
    np.testing.assert_allclose(correction.tool_offset, offset, atol=0.5 * MM)


def clocked(poses: Sequence[Observation], turn: float) -> list[Observation]:
    """The same poses, the plate's holes turned about its axis by so much [rad]."""
    seen = []
    for o in poses:
        assert o.circle.normal is not None
        wanted = o.base_T_flange.rotation @ [np.cos(turn), np.sin(turn), 0.0]
        x, y, _ = basis_of_plane(o.circle.normal) @ TRUTH.rotation.T @ wanted
        circle = replace(o.circle, roll=float(np.arctan2(y, x)))
        seen.append(replace(o, feature=circle))
    return seen


@pytest.mark.parametrize("turn", [0.84, -90.0, 180.0])
def test_a_constant_flange_roll_is_estimated_from_the_holes(ur5: RobotModel, turn: float) -> None:
    plain = simulate(ur5, 20)
    calibration = solver(ur5)(clocked(plain, np.radians(turn)))
    (note,) = [
        n for n in calibration.notes if "(flange roll, from the bolt pattern in 20 poses)" in n
    ]
    found, deviation = (float(n) for n in re.findall(r"by (\S+) \+- (\S+) deg", note)[0])
    assert abs((found - turn + 180) % 360 - 180) <= 4 * deviation
    assert deviation < 0.2
    np.testing.assert_array_equal(
        calibration.base_T_camera.transform.matrix,
        solver(ur5)(plain).base_T_camera.transform.matrix,
    )


def test_a_flange_roll_that_cannot_be_told_is_named(ur5: RobotModel) -> None:
    assert (
        "a constant turn of the plate about its own axis (flange roll) does not show, for the holes "
        "were told apart in 0 of 20 poses: the camera's pose does not depend on it"
    ) in solver(ur5)(simulate(ur5, 20)).notes


def test_of_what_has_no_face_nothing_is_said_of_its_holes(ur5: RobotModel) -> None:
    """A sphere's centre, or a point, has no normal."""
    points = [
        replace(o, feature=replace(o.circle, normal=None, normal_covariance=None))
        for o in simulate(ur5, 20)
    ]
    assert not [n for n in solver(ur5)(points).notes if "flange roll" in n]


def test_a_good_arm_is_not_corrected(ur5: RobotModel) -> None:
    calibration = solver(ur5, joint_offsets="auto")(simulate(ur5, 30))
    assert calibration.correction is None
    assert calibration.notes[-1].startswith("left out, for it does not help: the joints are off by")


@pytest.mark.parametrize("with_joints", [True, False])
def test_joint_offsets_are_found_and_help(ur5: RobotModel, with_joints: bool) -> None:
    offsets = np.array([0.0, 4.0, -3.0, 5.0, -4.0, 0.0]) * 1e-3
    observations = simulate(ur5, 40, offsets=offsets, with_joints=with_joints)
    solve, plain = solver(ur5, joint_offsets="auto"), solver(ur5, smooth_error="off")
    calibration = solve(observations)
    corrected = calibration.as_corrected()
    assert corrected is not None
    correction = corrected.correction
    assert correction is not None
    assert correction.joint_offsets is not None
    np.testing.assert_allclose(correction.joint_offsets, offsets, atol=1e-3)
    with_it = verify_holdout(calibration, solve, HoldoutParams(), robot=ur5).figures
    without = verify_holdout(plain(observations), plain, HoldoutParams(), robot=ur5).figures
    assert with_it["corrected_rms"] < 0.5 * without["rms"]
    assert with_it["corrected_rms"] < 0.15 * MM


def test_the_correction_moves_the_reported_pose(ur5: RobotModel) -> None:
    arm = Arm(ur5)
    offsets = np.array([0.0, 4.0, -3.0, 5.0, -4.0, 0.0]) * 1e-3
    reported = arm.flange(HOME)
    near = HOME + 0.2
    corrected = corrected_flange(reported, None, ArmCorrection(np.zeros(3), offsets, near), arm)
    np.testing.assert_allclose(corrected, arm.flange(HOME + offsets), atol=1e-9)
    tool = corrected_flange(reported, None, ArmCorrection(np.array([0, 0, 1 * MM])), None)
    np.testing.assert_allclose(tool[:3, 3], reported[:3, 3] + 1 * MM * reported[:3, 2])


def test_a_pose_out_of_reach_is_not_followed(ur5: RobotModel) -> None:
    with pytest.raises(ValueError, match="no joint angles near the given ones reach the pose"):
        follow(Arm(ur5), rigid(np.eye(3), np.array([3.0, 0, 0])), HOME)


def test_an_arm_of_another_model_is_not_corrected(ur5: RobotModel) -> None:
    observations = [
        Observation(o.id, o.circle, by_frame(o.base_T_flange), o.joints + 0.1)
        for o in simulate(ur5, 20, with_joints=True)
        if o.joints is not None
    ]
    calibration = solver(ur5, joint_offsets="auto")(observations)
    assert calibration.notes[-1] == (
        "joint offsets left out: the arm's model does not reach these poses"
    )


@pytest.fixture(scope="module")
def aubo(ancorasir: Path) -> list[Observation]:
    """The 30 published Aubo clouds, segmented and fitted."""
    flange = flange_of(load_model("robots", "aubo-i5").flange, load_standard("50-4-M6"))
    chosen = published_layout.bind(AncorasirParams(robot="aubo"))
    captures = acquire_archive(
        load_model("scanners", "phoxi-s"), ArchivePath(ancorasir), ArchiveParams(reader=chosen)
    )
    observations = []
    for capture in captures:
        found = segment_flange(capture, flange, SegmentParams())
        assert isinstance(found, FlangeCloud)
        circle = fit_rim(found, flange, RimParams())
        assert isinstance(circle, CircleFeature)
        if capture.role == "calibration":
            observations.append(Observation(capture.id, circle, by_frame(capture.base_T_flange)))
    return observations


def test_published_clouds_held_out(aubo: list[Observation]) -> None:
    """5-fold held-out rms over all poses; the arm's smooth error is part of the model."""
    robot = load_model("robots", "aubo-i5")

    def svd(observations: Sequence[Observation]) -> HandEye:
        return solve_svd(Observations(observations, Source("test")), SvdParams())

    def held_out(
        solve: Callable[[Sequence[Observation]], HandEye], figure: str, *seeds: int
    ) -> list[float]:
        """The figure [mm] for several ways to deal the folds."""
        found = solve(aubo)
        return [
            verify_holdout(found, solve, HoldoutParams(), robot=robot, seed=Seed(seed)).figures[
                figure
            ]
            / MM
            for seed in seeds
        ]

    assert len(aubo) == 30
    assert max(held_out(svd, "rms", 0, 3)) <= 0.43
    found = held_out(solver(robot), "corrected_rms", 0, 3)
    assert max(found) <= 0.20
    assert held_out(solver(robot), "rms", 0)[0] <= 0.44
    assert held_out(solver(robot, joint_offsets="auto"), "corrected_rms", 0)[0] <= 0.32


@pytest.mark.parametrize("with_joints", [True, False])
def test_the_stated_region_allows_for_joint_zeros(ur5: RobotModel, with_joints: bool) -> None:
    """Zeros within the robot file's accuracy move all poses alike: residuals do not show it."""
    inside = []
    for seed in range(40):
        zeros = ur5.joint_accuracy * np.random.default_rng([seed, 1]).standard_normal(6)
        zeros[0] = 0.0
        poses = simulate(ur5, 14, offsets=zeros, with_joints=with_joints, seed=seed)
        inside.append(holds(solver(ur5)(poses)))
    assert np.mean(inside) >= 0.95 - 0.103  # three standard deviations of 40 runs


def test_joint_zeros_are_in_the_covariance_or_said_not_to_be(ur5: RobotModel) -> None:
    observations = simulate(ur5, 15)
    considered, ignored = (
        solver(ur5, joint_zeros=choice)(observations) for choice in ("consider", "ignore")
    )
    wider = considered.base_T_camera.covariance - ignored.base_T_camera.covariance
    assert np.linalg.eigvalsh(wider).min() > -1e-15
    assert np.trace(wider) > np.trace(ignored.base_T_camera.covariance)
    said = "what the arm does wrong alike at all poses is in the covariance, as large as"
    assert sum(note.startswith(said) for note in considered.notes) == 1
    assert not any(note.startswith(said) for note in ignored.notes)
    np.testing.assert_array_equal(
        considered.base_T_camera.transform.matrix, ignored.base_T_camera.transform.matrix
    )
    far = [
        Observation(
            o.id, o.circle, by_frame(Transform(BASE, FLANGE, _lifted(o.base_T_flange.matrix)))
        )
        for o in observations
    ]
    assert (
        "unknown joint zeros (0.2 mrad each) not considered: the arm's model misses these poses"
    ) in solver(ur5)(far).notes


def _lifted(pose: np.ndarray) -> np.ndarray:
    return rigid(pose[:3, :3], pose[:3, 3] + [0, 0, 3.0])


def holds(calibration: HandEye) -> bool:
    """Whether the stated 95 % region of the pose holds the truth."""
    estimate = calibration.base_T_camera
    found = estimate.transform
    phi = rotation_log(TRUTH.rotation @ found.rotation.T)
    tau = TRUTH.apply(found.inverse().apply(estimate.about)) - estimate.about
    error = np.concatenate([phi, tau])
    distance = error @ np.linalg.solve(estimate.covariance, error)
    return bool(distance <= chi2_quantile(0.95, 6))


def test_joint_offsets_are_found_with_a_target_off_the_flange(ur5: RobotModel) -> None:
    """A sphere on a rod: joints that turn the flange move it as well."""
    offsets, rod = np.array([0.0, 4.0, -3.0, 5.0, -4.0, 0.0]) * 1e-3, np.array([0.0, 0.05, 0.12])
    on_flange = simulate(ur5, 40, offsets=offsets, tool=rod, with_joints=True)
    observations = [
        Observation(
            o.id,
            CircleFeature(
                o.circle.centre, None, {}, o.circle.covariance, None, 1.0, centre_in_flange=rod
            ),
            by_frame(o.base_T_flange),
            o.joints,
        )
        for o in on_flange
    ]
    corrected = solver(ur5, joint_offsets="auto", tool_offset="off")(observations).corrected
    assert corrected is not None
    correction = corrected.correction
    assert correction.joint_offsets is not None
    np.testing.assert_allclose(correction.joint_offsets, offsets, atol=1e-3)


def test_without_kinematics_the_arm_is_said_not_to_be_in_the_covariance(ur5: RobotModel) -> None:
    notes = solver(None)(simulate(ur5, 15)).notes
    assert (
        "what the arm does wrong alike at all poses is not in the covariance, for its kinematics "
        "are not known: name them in the recipe (robot: model, or urdf)"
    ) in notes
