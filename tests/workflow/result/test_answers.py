"""Two answers, both honest: for the arm as its controller reports it, and for it corrected."""

import io

import numpy as np
import pytest
import yaml
from rich.console import Console

from flangeye.cli.details import print_details
from flangeye.types import (
    BASE,
    CAMERA,
    ArmCorrection,
    CircleFeature,
    CorrectedArm,
    ExpectedError,
    HandEye,
    Observation,
    Pair,
    Transform,
    TransformEstimate,
    by_frame,
)
from flangeye.types.geometry import rigid, rotation_exp
from flangeye.workflow.result import contract as r
from flangeye.workflow.result import sections
from flangeye.workflow.run.folder import calibration_yaml

SIGMA = 0.1e-3
OFFSETS = np.array([0.0, 4e-3, -3e-3, 5e-3, 0.0, 0.0])


def estimate(shift=0.0, unobservable=()):
    pose = Transform(BASE, CAMERA, rigid(rotation_exp(np.array([np.pi, 0, 0])), [0.6, shift, 1.0]))
    free = np.reshape(unobservable, (-1, 6))
    covariance = np.diag([1e-8] * 6)
    keep = np.eye(6) - free.T @ free
    return TransformEstimate(pose, keep @ covariance @ keep, np.array([0.6, 0, 0.3]), free)


def calibration(**changes):
    circle = CircleFeature(np.array([0, 0, 0.7]), None, {}, SIGMA**2 * np.eye(3), None, 1.0)
    flange = Transform("base", "flange", np.eye(4))
    pair = Pair(Observation("0", circle, by_frame(flange)), np.zeros(3))
    return HandEye(estimate(), (pair,), "solve.robust", **changes)


def corrected():
    correction = ArmCorrection(np.zeros(3), OFFSETS, np.ones(6))
    found = CorrectedArm(estimate(3e-3), correction, expected=ExpectedError(0.2e-3, 0.4e-3))
    return calibration(corrected=found, expected=ExpectedError(0.361e-3, 0.6e-3))


def document(calibration, figures=None):
    held = None
    if figures:
        core = {"folds": 5, "rms": 0.5e-3, "median": 0.4e-3, "p95": 0.9e-3}
        held = r.HoldoutResult(**core, figures=figures)
    return r.Result(
        title="A cell", status="verified", transforms=sections.transforms_result(calibration),
        answers=sections.answers_result(calibration, held), holdout=held, observations=[],
        verifications={}, timing={},
        provenance=r.Provenance(
            versions={}, plugins={}, recipe="", recipe_hash="", input_hash="", seed=0, notes=[]
        ),
    )  # fmt: skip


def told(result):
    out = io.StringIO()
    print_details(Console(file=out, width=200), result)
    return out.getvalue()


FIGURES = {
    "rms_all": 0.4e-3, "outliers": 2.0, "corrected_rms": 0.35e-3,
}  # fmt: skip


def test_the_pose_is_that_of_the_arm_as_reported() -> None:
    both = corrected()
    assert both.as_reported().correction is None
    assert both.as_reported().camera is both.camera
    alone = both.as_corrected()
    assert alone.camera is both.corrected.camera
    assert alone.correction is both.corrected.correction
    assert calibration().as_corrected() is None


def test_where_on_the_flange_the_circle_is_belongs_to_both() -> None:
    tool = ArmCorrection(np.array([1e-3, 0, 0]))
    assert calibration(correction=tool).as_corrected() is None
    assert calibration(correction=tool).as_reported().correction.tool_offset[0] == 1e-3


def test_both_stand_side_by_side_with_the_error_to_expect() -> None:
    answers = document(corrected(), FIGURES).answers
    assert answers.as_reported.expected_rms == pytest.approx(0.361e-3)
    assert answers.corrected.expected_rms == pytest.approx(0.2e-3)
    assert answers.as_reported.correction is None
    assert answers.corrected.correction.joint_offsets == pytest.approx(OFFSETS)
    poses = [
        np.array(a.transforms["base_T_camera"].matrix)
        for a in (answers.as_reported, answers.corrected)
    ]
    assert poses[1][1, 3] - poses[0][1, 3] == pytest.approx(3e-3)


def test_the_console_gives_both() -> None:
    said = told(document(corrected(), FIGURES))
    assert (
        "arm as reported    (600.00, 0.00, 1000.00) mm, (180.000, 0.000, 0.000) deg; 0.361 mm"
        in said
    )
    assert "arm corrected      (600.00, 3.00, 1000.00) mm" in said
    assert "joints 0.00, 4.00, -3.00, 5.00, 0.00, 0.00 mrad; in calibration.yaml" in said
    assert "held-out error     0.500 mm rms" in said
    assert "5 folds without 2 outliers; 0.400 mm rms with them" in said
    assert "Two camera poses" not in told(document(calibration(), FIGURES))


def test_the_calibration_file_carries_both() -> None:
    written = yaml.safe_load(calibration_yaml(document(corrected(), FIGURES)))
    assert written["base_T_camera"]["translation_m"][1] == 0.0
    other = written["corrected_arm"]
    assert other["base_T_camera"]["translation_m"][1] == pytest.approx(3e-3)
    assert other["correction"]["joint_offsets"] == pytest.approx(OFFSETS)
    assert "corrected_arm" not in calibration_yaml(document(calibration()))


def test_what_was_not_measured_has_no_sigma() -> None:
    open_turn = [0, 0, 1, 0, 0, 0]
    found = HandEye(estimate(unobservable=open_turn), (), "solve.svd")
    result = document(found)
    assert result.transforms["base_T_camera"].sigma[2] is None
    said = told(result)
    assert "0.0057, 0.0057, unknown deg about base x, y, z" in said
    assert "0.0000" not in said.split("one sigma")[1].splitlines()[0]
    assert (
        yaml.safe_load(calibration_yaml(result))["base_T_camera"]["sigma_rotation_rad"][2] is None
    )


def test_the_arms_of_a_cell_are_corrected_by_name() -> None:
    arms = {"one": ArmCorrection(np.zeros(3), OFFSETS, np.ones(6))}
    result = document(calibration(corrected=CorrectedArm(estimate(3e-3), None, arms=arms)))
    assert "  one, corrected     joints 0.00, 4.00, -3.00, 5.00, 0.00, 0.00 mrad" in told(result)
    corrected = yaml.safe_load(calibration_yaml(result))["corrected_arm"]
    assert corrected["corrections"]["one"]["joint_offsets"] == OFFSETS.tolist()
    assert "correction" not in corrected


def test_what_a_result_asks_for_whatever_its_steps_noted() -> None:
    found = document(calibration(), FIGURES)
    assert sections.standing_warnings(found) == []
    weak = found.model_copy(deep=True)
    weak.transforms["base_T_camera"].unobservable = [[0, 0, 0, 0, 0, 1.0]]
    assert "base_T_camera" in sections.standing_warnings(weak)[0].text
    unjudged = found.model_copy(update={"status": "unverified"})
    assert [w.fix for w in sections.standing_warnings(unjudged)] == [
        "add '- verify.holdout' after the solver"
    ]
    seen = [r.ObservationResult(id=str(i), used=i < 2) for i in range(5)]
    poor = found.model_copy(update={"observations": seen})
    assert sections.standing_warnings(poor)[0].text == "3 of 5 captures were rejected"


@pytest.mark.parametrize(
    ("expected", "told"),
    [((0.5e-3, 0.9e-3), None), ((0.2e-3, 0.4e-3), "significantly larger"),
     ((1.0e-3, 1.8e-3), "significantly smaller")],
)  # fmt: skip
def test_an_expected_error_that_poses_held_out_contradict_is_said(expected, told) -> None:
    stated = sections.expected_error_result(calibration(expected=ExpectedError(*expected)))
    found = document(calibration(), {"poses": 16.0}).model_copy(update={"expected_error": stated})
    warnings = [w.text for w in sections.standing_warnings(found) if "held-out" in w.text]
    assert len(warnings) == (told is not None)
    assert all(told in text and "0.50 mm" in text for text in warnings)
    fixes = [w.fix for w in sections.standing_warnings(found) if "held-out" in w.text]
    trusted = {"larger": "trust the held-out", "smaller": "trust the expected"}
    assert all(fix.startswith(trusted[str(told).split()[-1]]) for fix in fixes)
