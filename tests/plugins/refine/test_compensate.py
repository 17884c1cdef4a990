"""refine.compensate: equation (19), its direction, and its price."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from flangeye import CalibrationRefused, StageError, part
from flangeye.models.loading import load_model
from flangeye.models.targets import flange_of, load_standard
from flangeye.plugin.stage import KINDS, Params
from flangeye.types import (
    ArmCorrection,
    CircleFeature,
    FlangeCloud,
    HandEye,
    Observation,
    Pair,
    PointCloud,
    PoseError,
    Transform,
    TransformEstimate,
    VerificationView,
    Views,
    by_frame,
)
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_plugins.error import error_icp
from flangeye_plugins.refine import (
    CompensateParams,
    compensated,
    refine_compensate,
)
from flangeye_plugins.verify.registration import surface_of

UR5 = load_model("robots", "ur5")
FLANGE = flange_of(UR5.flange, load_standard("50-4-M6"))
TRUTH = Transform("base", "camera", rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.5, 0.0, 1.0])))


def pose_at(place, turn=(0.0, 0.0, 0.0)):
    return Transform("base", "flange", rigid(rotation_exp(np.array(turn)), np.array(place)))


def off_by(turn=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0)):
    """Return an answer that is off by a turn and a shift, in base about the work."""
    about = np.array([0.5, 0.0, 0.3])
    rotation = rotation_exp(np.array(turn))
    return Transform(
        "base", "camera", rigid(rotation, about - rotation @ about + np.array(shift)) @ TRUTH.matrix
    )


def view(pose=None, id="v"):
    """Return the flange as a perfect scanner sees it."""
    pose = pose or pose_at([0.5, 0.0, 0.3], (0.1, -0.15, 0.0))
    shape = surface_of(FLANGE, 1e-3).points
    points = TRUTH.inverse().apply(pose.apply(shape))
    cloud = PointCloud("camera", points.astype(np.float32))
    return VerificationView(
        id, FlangeCloud(cloud, points.mean(axis=0), np.array([0, 0, -1.0])), pose
    )


def observations(count=12, seed=0):
    """Return poses whose centres are exact."""
    rng = np.random.default_rng(seed)
    for i in range(count):
        pose = pose_at(np.array([0.5, 0.0, 0.3]) + rng.uniform(-0.15, 0.15, 3))
        centre = TRUTH.inverse().apply(pose.translation)
        circle = CircleFeature(centre, None, {}, 1e-8 * np.eye(3), None, 1.0)
        yield Observation(f"{i:02d}", circle, by_frame(pose))


def answer(transform):
    pairs = tuple(Pair(o, transform.apply(o.circle.centre) - o.tcp_in_base) for o in observations())
    estimate = TransformEstimate(transform, 1e-10 * np.eye(6), np.array([0.5, 0.0, 0.3]))
    return HandEye(estimate, pairs, "solve.test", ("as it was",))


@part("error.exact")
def error_exact(base_T_camera, kept, views, flange) -> PoseError | None:
    """What takes the measured flange onto the predicted one, known exactly."""
    motion = base_T_camera.inverse().matrix @ TRUTH.matrix
    predicted = base_T_camera.inverse().apply(views[0].base_T_flange.translation)
    return PoseError(motion, predicted, base_T_camera.rotation)


@part("error.none")
def error_none(base_T_camera, kept, views, flange) -> PoseError | None:
    """Nothing can be measured."""
    return None


def compensate(calibration, views=None, error=error_exact, **changes):
    params = CompensateParams(error=error.bind(), **changes)
    return refine_compensate(calibration, Views(views or [view()]), params, FLANGE, UR5)


def test_it_is_a_refining_stage() -> None:
    assert refine_compensate.kind == "refine"
    assert set(refine_compensate.gives) <= set(KINDS["refine"].gives)
    assert refine_compensate.params and issubclass(refine_compensate.params, Params)


small = st.tuples(*[st.floats(-0.02, 0.02)] * 3)


@settings(max_examples=50)
@given(small, small)
def test_the_direction_is_the_one_that_is_right(turn: Any, shift: Any) -> None:
    found = compensate(answer(off_by(turn, shift))).base_T_camera.transform
    assert np.abs(found.matrix - TRUTH.matrix).max() < 1e-12


def test_icp_brings_an_answer_that_is_off_back_to_the_truth() -> None:
    wrong = answer(off_by((0.004, -0.003, 0.0), (0.8e-3, -0.5e-3, 0.4e-3)))
    found = compensate(wrong, error=error_icp).base_T_camera.transform
    work = np.array([0.5, 0.0, 0.3])
    assert np.linalg.norm(found.apply(TRUTH.inverse().apply(work)) - work) < 0.05e-3


def test_without_rotation_only_the_shift_at_the_view_is_applied() -> None:
    wrong = off_by((0.01, 0.0, 0.0), (1e-3, 0.0, 0.0))
    found = compensate(answer(wrong), rotation=False).base_T_camera.transform
    assert np.abs(found.rotation - wrong.rotation).max() < 1e-12
    place = view().base_T_flange.translation
    seen = TRUTH.inverse().apply(place)
    assert np.linalg.norm(found.apply(seen) - place) < 1e-4
    assert np.linalg.norm(wrong.apply(seen) - place) > 9e-4


def test_at_work_is_what_the_error_does_where_it_was_measured() -> None:
    motion = rigid(rotation_exp(np.array([0.0, 0.0, 0.1])), np.array([1e-3, 0.0, 0.0]))
    error = PoseError(motion, np.array([0.0, 1.0, 0.5]), np.eye(3))
    moved = motion[:3, :3] @ error.at + motion[:3, 3]
    assert error.displacement() == pytest.approx(moved - error.at)
    shifted = compensated(TRUTH, error, rotation=False)
    assert shifted.apply(error.at) == pytest.approx(TRUTH.apply(moved))


def test_residuals_notes_and_covariance_follow() -> None:
    wrong = answer(off_by((0.0, 0.0, 0.0), (0.3e-3, 0.4e-3, 0.0)))
    found = compensate(wrong)
    assert [np.linalg.norm(p.residual) for p in found.pairs] == pytest.approx([0.0] * 12, abs=1e-12)
    assert found.method == "solve.test"
    assert found.notes == (
        "as it was",
        "compensation (19): error 0.500 mm and 0.000 deg at the verification view, 0.000 mm after "
        "it; that view no longer verifies anything",
        "compensation (19) changes the residual on the 12 poses solved from 0.500 to 0.000 mm rms: "
        "better for them",
    )
    grown = found.base_T_camera.covariance - wrong.base_T_camera.covariance
    taken = np.array([0.0, 0.0, 0.0, -0.3e-3, -0.4e-3, 0.0])
    assert grown == pytest.approx(np.outer(taken, taken), abs=1e-14)
    assert found.base_T_camera.about.tolist() == wrong.base_T_camera.about.tolist()


def test_it_says_what_it_costs_the_other_poses() -> None:
    strayed = view()
    pose = strayed.base_T_flange
    shifted = rigid(pose.rotation, pose.translation + np.array([0.6e-3, 0.0, 0.0]))
    strayed = replace(strayed, base_T_flange=replace(pose, matrix=shifted))  # the arm errs there
    found = compensate(answer(TRUTH), [strayed], error=error_icp)
    assert found.notes[-1].startswith("compensation (19) changes the residual on the 12 poses")
    assert found.notes[-1].endswith("mm rms: worse for them")
    rms = np.sqrt(np.mean([p.residual @ p.residual for p in found.pairs]))
    assert rms > 0.5e-3


def test_poses_that_were_not_used_do_not_count() -> None:
    wrong = answer(off_by(shift=(0.5e-3, 0.0, 0.0)))
    aside = replace(wrong.pairs[0], residual=np.array([1.0, 0.0, 0.0]), used=False, reason="far")
    found = compensate(replace(wrong, pairs=(aside, *wrong.pairs[1:])))
    assert "on the 11 poses solved from 0.500 to 0.000 mm rms" in found.notes[-1]
    assert found.pairs[0].reason == "far"
    assert found.pairs[0].residual[0] == pytest.approx(1.0 - 0.5e-3)


def test_a_corrected_arm_is_where_the_view_is_expected() -> None:
    offset = np.array([0.0, 0.0, 2e-3])
    seen = view()
    reported = rigid(
        seen.base_T_flange.rotation,
        seen.base_T_flange.translation - seen.base_T_flange.rotation @ offset,
    )
    strayed = replace(seen, base_T_flange=replace(seen.base_T_flange, matrix=reported))
    right = replace(answer(TRUTH), correction=ArmCorrection(offset))
    found = compensate(right, [strayed], error=error_icp)
    assert np.abs(found.base_T_camera.transform.matrix - TRUTH.matrix).max() < 2e-5


def test_the_first_view_counts() -> None:
    other = view(pose_at([0.4, 0.1, 0.25]), "w")
    wrong = answer(off_by(shift=(1e-3, 0.0, 0.0)))
    one, both = compensate(wrong, [view()]), compensate(wrong, [view(), other])
    assert np.array_equal(one.base_T_camera.transform.matrix, both.base_T_camera.transform.matrix)


def test_no_view_is_said() -> None:
    with pytest.raises(StageError) as error:
        refine_compensate(answer(TRUTH), Views(), CompensateParams(error=error_none.bind()), FLANGE)
    assert str(error.value) == (
        "refine.compensate: no verification view to measure the error on; let the acquire step "
        "keep one, or leave this step out"
    )


def test_an_error_that_cannot_be_measured_is_refused() -> None:
    with pytest.raises(CalibrationRefused) as error:
        compensate(answer(TRUTH), error=error_none)
    assert str(error.value) == (
        "refine.compensate: the error on view v could not be measured, so equation (19) cannot be "
        "applied; leave the step out, or see what verify.icp says"
    )


def test_the_same_input_gives_the_same_bits() -> None:
    wrong = answer(off_by((0.002, 0.0, 0.0), (0.5e-3, 0.0, 0.0)))
    one, two = (compensate(wrong, error=error_icp).base_T_camera for _ in range(2))
    assert one.transform.matrix.tobytes() == two.transform.matrix.tobytes()
