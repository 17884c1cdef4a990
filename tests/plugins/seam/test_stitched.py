"""Clouds from several places of the flange, put together: where the seam is, and how well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flangeye import CalibrationRefused
from flangeye.maths.seam_geometry import errors_from, tube_radii
from flangeye.types import Seam, VerifiedHandEye
from flangeye.types.geometry import rigid, rotation_exp
from flangeye_plugins.seam.cad import CadParams, seam_cad
from flangeye_plugins.seam.joint import JointParams, seam_joint
from flangeye_plugins.seam.stitched import seen_in_base
from tests.plugins.scan.flange_cell import PHOXI, UR10E, on_flange, scan_of_the_plate
from tests.plugins.seam.scenes import hand_eye, scanned

ROUGH = [["560 mm", "-100 mm", "75 mm"], ["563 mm", "98 mm", "72 mm"]]


def planned(calibration: VerifiedHandEye, **given: str) -> Seam:
    params = JointParams.model_validate({"joint": "vee", "line": ROUGH, **given})
    scan = replace(scan_of_the_plate(), truth={})
    seam: Seam = seam_joint(calibration, scan, params, None, None, PHOXI, UR10E)
    return seam


def test_the_seam_of_two_places_is_inside_its_tube() -> None:
    seam = planned(on_flange())
    errors = errors_from(seam, scan_of_the_plate().truth["groove"])
    assert seam.arc_length[-1] == pytest.approx(0.2, abs=6e-3)
    assert errors.max() < 0.4e-3
    assert (errors < tube_radii(seam)).all()
    assert seam.figures["apart"] < 0.3e-3


def test_an_uncertain_hand_eye_pose_makes_the_tube_wider() -> None:
    uncertain = planned(on_flange(sigma=(1e-3, 1e-3)))
    assert tube_radii(uncertain).min() > 1e-3


def test_the_covariance_is_that_of_drawn_calibrations() -> None:
    """A point that two places show is off by the mean of what it is off at each."""
    scan, sigma = scan_of_the_plate(), (2e-3, 1e-3)
    known = on_flange(sigma)
    at = np.array([[0.56, y, 0.08] for y in (-0.1, 0.0, 0.1)])
    stated = seen_in_base("seam.joint", scan, known, None).covariance(at)
    rng, about = np.random.default_rng(1), np.asarray(known.camera.about)
    n = 4000
    turns = rotation_exp(sigma[0] * rng.standard_normal((n, 3)))
    motions = np.tile(np.eye(4), (n, 1, 1))
    motions[:, :3, :3] = turns
    motions[:, :3, 3] = about - turns @ about + sigma[1] * rng.standard_normal((n, 3))
    stands = np.array([place.base_T_flange for place in scan.places])
    off = stands @ motions[:, None] @ np.linalg.inv(stands)
    each = at @ off[..., :3, :3].swapaxes(-1, -2) + off[..., None, :3, 3] - at
    drawn = np.cov(each.mean(axis=1)[:, 1].T)  # amid both, whose shares are equal there
    assert np.sqrt(np.diag(stated[1])) == pytest.approx(np.sqrt(np.diag(drawn)), rel=0.1)


def test_zeros_of_the_joints_are_part_of_it() -> None:
    at, scan = np.array([[0.56, 0.0, 0.08]]), scan_of_the_plate()
    with_arm = seen_in_base("seam.joint", scan, on_flange(), UR10E).covariance(at)
    without = seen_in_base("seam.joint", scan, on_flange(), None).covariance(at)
    added = np.sqrt(np.trace((with_arm - without)[0]))
    assert 0.5 * UR10E.joint_accuracy < added < 3 * UR10E.joint_accuracy  # at about a metre


def test_clouds_that_do_not_agree_are_refused() -> None:
    tilted = rigid(rotation_exp(np.array([0.0, 0.03, 0.0])), np.zeros(3))
    wrong = on_flange(error=tilted)
    with pytest.raises(CalibrationRefused, match=r"clouds are \d.\d+ mm apart where both show"):
        planned(wrong)


def test_a_scan_of_another_scanner_is_refused() -> None:
    with pytest.raises(
        CalibrationRefused, match="stands beside the arm; scan the workpiece with s"
    ):
        planned(hand_eye())
    scan, _ = scanned("v-straight")
    with pytest.raises(
        CalibrationRefused, match="rides on the flange; scan the workpiece with sca"
    ):
        params = JointParams.model_validate({"joint": "vee", "line": ROUGH})
        seam_joint(on_flange(), scan, params, None, None, PHOXI)


def test_a_cad_is_registered_to_one_place_alone() -> None:
    with pytest.raises(CalibrationRefused, match="stitched from 2 places"):
        seam_cad(on_flange(), scan_of_the_plate(), CadParams(workpiece="v-straight"), None, PHOXI)
