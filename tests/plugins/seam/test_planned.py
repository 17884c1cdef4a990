"""A seam for the arm as it reports, and for the arm corrected."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from flangeye import CalibrationRefused, RecipeError
from flangeye.maths.arm_correction import corrected_flange, reported_flange
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.plugin.registry import load_registry
from flangeye.types import ArmCorrection, CorrectedArm, Seam
from flangeye.workflow.recipe.load import load_recipe
from flangeye_plugins.seam.planned import SeamParams, answer_for, for_the_controller
from tests.plugins.seam.scenes import hand_eye

UR5 = load_model("robots", "ur5")
HOME = np.radians([0, -90, 90, -90, -90, 0])
OFFSETS = np.array([0.0, 4.0, -3.0, 5.0, -4.0, 0.0]) * 1e-3
CORRECTION = ArmCorrection(np.zeros(3), OFFSETS, HOME)
CORRECTED = SeamParams(arm="corrected", tool="150 mm")


def calibration(correction=CORRECTION):
    found = hand_eye()
    return replace(found, corrected=CorrectedArm(found.camera, correction))


def seam():
    """A seam 100 mm long, below the flange at home by the length of the tool."""
    there = Arm(UR5).flange(HOME)
    points = there[:3, 3] + 0.15 * there[:3, 2] + np.linspace(0, 0.1, 5)[:, None] * [0, 1, 0]
    openings = np.tile(-there[:3, 2], (5, 1))
    return Seam(points, openings, np.tile(1e-8 * np.eye(3), (5, 1, 1)), 0.7, 0.008, "test")


def test_what_is_told_to_the_controller_brings_the_tool_to_the_seam() -> None:
    planned, arm = seam(), Arm(UR5)
    told = for_the_controller(planned, calibration().as_corrected(), UR5, CORRECTED)
    moved = told.points_in_base - planned.points_in_base
    assert np.linalg.norm(moved, axis=1).min() > 1e-3
    wanted = np.array(arm.flange(HOME))
    commanded = reported_flange(wanted, CORRECTION, arm)
    assert corrected_flange(commanded, None, CORRECTION, arm) == pytest.approx(wanted, abs=1e-8)
    first = (commanded @ [0, 0, 0.15, 1])[:3]
    assert told.points_in_base[0] == pytest.approx(first, abs=1e-6)
    assert "the arm's estimated error subtracted" in told.notes[-1]


def test_the_arm_as_reported_needs_nothing() -> None:
    planned, params = seam(), SeamParams()
    answer = answer_for("seam.cad", calibration(), params)
    assert answer.correction is None
    assert for_the_controller(planned, answer, UR5, params) is planned


def test_an_arm_without_a_known_error_is_not_corrected() -> None:
    with pytest.raises(CalibrationRefused, match="no arm error worth correcting; write arm: as-r"):
        answer_for("seam.cad", hand_eye(), CORRECTED)


def test_a_seam_out_of_reach_is_refused() -> None:
    planned = seam()
    far = replace(planned, points_in_base=planned.points_in_base + [2.0, 0, 0])
    with pytest.raises(
        CalibrationRefused, match="cannot be corrected for the arm's error: no joint"
    ):
        for_the_controller(far, calibration().as_corrected(), UR5, CORRECTED)


RECIPE = """
title: T
description: D
robot: {model: ur10e}
scanner: {model: phoxi-m}
feature: {standard: ISO 9409-1-50-4-M6}
workspace: {centre: [600 mm, 0 mm, 300 mm], size: [300 mm, 300 mm, 200 mm]}
steps:
  - acquire.simulated
  - segment.flange
  - fit.rim
  - SOLVE
  - verify.holdout
  - scan.simulated: {workpiece: v-straight}
  - seam.joint:
      joint: vee
      line: [[510 mm, -50 mm, 260 mm], [700 mm, 20 mm, 260 mm]]
      arm: corrected
"""


def checked(tmp_path, solve):
    path = tmp_path / "r.yaml"
    path.write_text(RECIPE.replace("SOLVE", solve))
    return load_recipe(path, load_registry())


def test_a_recipe_that_mixes_the_two_arms_fails_check(tmp_path: Path) -> None:
    assert checked(tmp_path, "solve.robust")
    with pytest.raises(RecipeError, match=r"r.yaml:18: steps.6.seam.joint.arm: arm: corrected is"):
        checked(tmp_path, "solve.svd")
    mixed = "solve.robust\n  - refine.compensate"
    with pytest.raises(RecipeError, match="refine.compensate gives the pose only for the arm as"):
        checked(tmp_path, mixed)
