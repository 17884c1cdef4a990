"""Errors of the arm itself: what each does to its poses, and which are found of known ones."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.handeye import arm as rooms
from flangeye.handeye.arm import MovedFlange, _not_told_apart, _significant
from flangeye.handeye.candidates import Model, weighed_with
from flangeye.handeye.consensus import Consensus
from flangeye.maths.arm_correction import corrected_flange
from flangeye.maths.geometry import invert, rigid, rotation_exp, rotation_log
from flangeye.maths.kinematics import Arm
from flangeye.maths.statistics import f_quantile
from tests.handeye.cells import ROBOT, fitted, given, two_numbers
from tests.plugins.solve.test_arm import HOME, MM, TRUTH, simulate, solver

ARM = Arm(ROBOT)
JOINTS = HOME + np.random.default_rng(0).uniform(-0.3, 0.3, (8, 6))
POSES = ARM.flange(JOINTS)


@pytest.mark.parametrize("carries_camera", [True, False])
def test_a_twist_in_base_is_what_it_moves_the_flange_by_in_its_own_frame(
    carries_camera: bool,
) -> None:
    twists = np.random.default_rng(1).normal(size=(8, 6, 3))
    told = MovedFlange(POSES, None, carries_camera).nuisance(twists, 2e-3, sized=True)
    moved, still = (told.camera, told.target) if carries_camera else (told.target, told.camera)
    assert not still.any() and not told.seen.any()
    assert told.prior.tolist() == [2e-3] * 3 and told.sized.all() and not told.mean.any()
    for pose, twist, own in zip(POSES, 1e-6 * twists, 1e-6 * moved, strict=True):
        for k in range(3):
            after = rigid(rotation_exp(twist[:3, k]) @ pose[:3, :3], pose[:3, 3] + twist[3:, k])
            step = invert(pose) @ after
            assert own[:3, k] == pytest.approx(rotation_log(step[:3, :3]), abs=1e-11)
            assert own[3:, k] == pytest.approx(step[:3, 3], abs=1e-11)


def test_zeros_move_the_flange_as_the_arm_would_but_for_the_first() -> None:
    zeros = MovedFlange(POSES, JOINTS, False, ARM, 2e-4).zeros(2e-4)
    assert zeros is not None and zeros.prior.tolist() == [2e-4] * 5 and not zeros.sized.any()
    for k in range(5):
        step = invert(POSES) @ ARM.flange(JOINTS + 1e-6 * np.eye(6)[k + 1])
        assert 1e-6 * zeros.target[:, 3:, k] == pytest.approx(step[:, :3, 3], abs=1e-10)
        assert 1e-6 * zeros.target[:, :3, k] == pytest.approx(
            rotation_log(step[:, :3, :3]), abs=1e-10
        )


def test_joints_are_those_reported_where_the_catalogues_arm_stands_as_reported() -> None:
    off = POSES.copy()
    off[3, 2, 3] += 4.9 * MM
    assert [j is JOINTS for j in MovedFlange(off, JOINTS, False, ARM).branches()] == [True]
    off[3, 2, 3] += 0.2 * MM
    far = MovedFlange(off, JOINTS, False, ARM)
    assert not list(far.branches()) and far.zeros(1e-3) is None
    assert not list(MovedFlange(POSES, JOINTS, False).branches())


def test_without_joints_every_branch_leads_to_the_same_poses_or_is_left_out() -> None:
    near = ARM.flange(HOME + 0.1 * (JOINTS - HOME))
    branches = list(MovedFlange(near, None, False, ARM).branches())
    assert len(branches) > 2
    for joints in branches:
        assert ARM.flange(joints) == pytest.approx(near, abs=1e-7)
    out_of_reach = near.copy()
    out_of_reach[5:, 0, 3] += 3.0
    assert not list(MovedFlange(out_of_reach, None, False, ARM).branches())


@pytest.mark.parametrize("with_joints", [True, False])
def test_offsets_of_joints_are_found_and_named(with_joints: bool) -> None:
    """Each within a fifth of the smallest; those of the first and the last joint are none."""
    offsets = np.array([0.0, 4.0, -3.0, 5.0, -4.0, 0.0]) * 1e-3
    seen = simulate(ROBOT, 30, offsets=offsets, with_joints=with_joints, tilt=0.6)
    found = solver(ROBOT, joint_offsets="auto", tool_offset="off")(seen)
    assert found.corrected is not None
    correction, camera = found.corrected.correction, found.corrected.camera
    assert correction.joint_offsets is not None
    assert correction.joint_offsets[[0, 5]].tolist() == [0.0, 0.0]
    np.testing.assert_allclose(correction.joint_offsets, offsets, atol=6e-4)
    assert not correction.tool_offset.any()
    (note,) = [n for n in found.notes if n.startswith("the joints are off by (")]
    told = [float(n) for n in note.partition("(")[2].partition(")")[0].split(", ")]
    assert told == pytest.approx(correction.joint_offsets * 1e3, abs=0.006)
    wrong = camera.transform.apply(TRUTH.inverse().apply(POSES[:, :3, 3])) - POSES[:, :3, 3]
    assert np.linalg.norm(wrong, axis=1).max() < 0.5 * MM


def test_offsets_are_found_beside_that_of_the_tool() -> None:
    offsets, tool = np.array([0.0, 4.0, -3.0, 5.0, -4.0, 0.0]) * 1e-3, np.array([3.0, -2.0, 0]) * MM
    seen = simulate(ROBOT, 40, offsets=offsets, tool=tool, with_joints=True, tilt=0.8)
    found = solver(ROBOT, joint_offsets="auto", joint_zeros="ignore")(seen).corrected
    assert found is not None and found.correction.joint_offsets is not None
    np.testing.assert_allclose(found.correction.joint_offsets, offsets, atol=6e-4)
    np.testing.assert_allclose(found.correction.tool_offset, tool, atol=0.3 * MM)


def test_an_arm_of_another_model_keeps_its_joints() -> None:
    off = POSES.copy()
    off[:, 2, 3] += 0.1
    noted: Any = SimpleNamespace(noted=lambda note: note)
    told: Any = rooms.with_joint_offsets(noted, MovedFlange(off, JOINTS, False, ARM), 1e-3)
    assert told == "joint offsets left out: the arm's model does not reach these poses"


def test_a_field_is_found_in_what_joint_offsets_leave() -> None:
    """The offsets are as those of the arm that has only them; both together hold the arm best."""
    offsets = np.array([0.0, 4.0, -3.0, 5.0, -4.0, 0.0]) * 1e-3
    seen = simulate(ROBOT, 60, offsets=offsets, with_joints=True, tilt=0.8)
    bent = []
    for o in seen:
        x, y, z = o.base_T_flange.translation
        aside = 1.5 * MM * np.array([np.sin(4 * y), np.sin(4 * z), np.sin(4 * x)])
        centre = o.circle.centre + TRUTH.inverse().rotation @ aside
        bent.append(replace(o, feature=replace(o.circle, centre=centre)))
    found = solver(ROBOT, joint_offsets="auto", joint_zeros="ignore")(bent)
    alone = solver(ROBOT, joint_offsets="auto", joint_zeros="ignore", smooth_error="off")(bent)
    assert found.corrected is not None and alone.corrected is not None
    both, bare = found.corrected.correction, alone.corrected.correction
    assert both.field is not None and bare.field is None
    assert any("the arm is off by a smooth error" in note for note in found.notes)

    def off(correction: Any, camera: Any) -> float:
        errors = [
            camera.transform.apply(o.circle.centre[None])[0]
            - corrected_flange(o.base_T_flange.matrix, o.joints, correction, ARM)[:3, 3]
            for o in bent
        ]
        return float(np.sqrt(np.mean(np.square(errors).sum(axis=1))))

    assert off(both, found.corrected.camera) < 0.5 * off(bare, alone.corrected.camera)


def test_a_smooth_error_is_no_outlier() -> None:
    """Those that it moves most are set aside by the rest, and taken back with it."""
    seen = simulate(ROBOT, 40, with_joints=True, tilt=0.8)
    bent = []
    for o in seen:
        x, _, z = o.base_T_flange.translation - POSES[:, :3, 3].mean(axis=0)
        aside = 0.08 * np.array([0.0, x * abs(x), z * x])
        centre = o.circle.centre + TRUTH.inverse().rotation @ aside
        bent.append(replace(o, feature=replace(o.circle, centre=centre)))
    without = solver(ROBOT, smooth_error="off", normals="off")(bent)
    found = solver(ROBOT, normals="off")(bent)
    assert sum(p.used for p in without.pairs) < 38
    assert all(p.used for p in found.pairs)
    assert found.correction is not None and found.correction.field is not None


def test_an_offset_counts_beyond_what_chance_gives_once_in_ten_thousand() -> None:
    limit = np.sqrt(3 * f_quantile(0.9999, 3, 20.0)) * 1e-4
    covariance = 1e-8 * np.eye(3)
    assert not _significant(np.array([0.0, 0.999 * limit, 0.0]), covariance, 20.0)
    assert _significant(np.array([0.0, 1.001 * limit, 0.0]), covariance, 20.0)


def test_what_is_not_told_apart_is_said_with_the_largest_turn() -> None:
    turns = np.array([rotation_exp([0.0, 0.0, np.radians(a)]) for a in (0.0, 4.0, -8.0)])
    assert "would be known to 1.2 mm only, for orientations differ by 12.0 deg" in _not_told_apart(
        1.2e-3, turns
    )
    assert "(tool frame, bias of the fit) does not show, for" in _not_told_apart(0.2, turns)


def test_a_field_is_looked_for_in_a_dozen_poses(monkeypatch: pytest.MonkeyPatch) -> None:
    looked: list[Any] = []
    monkeypatch.setattr(rooms, "with_nuisance", lambda *given: looked.append(given))
    monkeypatch.setattr(rooms, "_with_all", lambda model: model)
    for inliers in (11, 12):
        found = SimpleNamespace(inliers=np.arange(40) < inliers)
        model: Any = SimpleNamespace(corrects_joints=False, found=found)
        poses = ARM.flange(HOME + np.random.default_rng(0).uniform(-0.3, 0.3, (40, 6)))
        assert rooms.with_field(model, MovedFlange(poses, None, False)) is model
        assert len(looked) == 2 * (inliers == 12)  # begun with those that agree, and with all


def test_an_offset_that_turns_about_one_axis_do_not_show_is_not_estimated() -> None:
    """Along that axis it moves all centres alike, as the camera's place does."""
    problem = given("eye-on-base, flange", "centre", 14, stated=False)
    s, turns = problem.measurements, np.linspace(-0.6, 0.6, 14)
    poses = s.b.copy()
    poses[:, :3, :3] = rotation_exp(np.outer(turns, [0.0, 0.0, 1.0])) @ s.b[0, :3, :3]
    problem = replace(problem, measurements=replace(s, b=poses))
    model = Model(Consensus(problem, fitted(problem)))
    (note,) = rooms.with_tool_offset(model, MovedFlange(poses, None, False)).notes
    assert "does not show, for orientations differ by 68.8 deg at most" in note


def test_how_well_the_last_are_known_is_a_block_of_the_inverse_of_all_information() -> None:
    problem = given("eye-on-base, flange", "centre", 14, stated=False)
    model = Model(Consensus(problem, fitted(problem)))
    told = rooms._covariance_of_last(model, two_numbers(14), 2)
    information = weighed_with(problem, model.found, two_numbers(14)).information
    assert told == pytest.approx(np.linalg.inv(information)[-2:, -2:], rel=1e-6)


def test_of_half_a_turn_the_largest_angle_between_orientations_is_told() -> None:
    turns = np.array([rotation_exp([a, 0.0, 0.0]) for a in (0.0, 0.5, np.pi)])
    assert "differ by 180.0 deg at most" in _not_told_apart(1e-3, turns)
