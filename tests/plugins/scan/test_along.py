"""scan.along: a scanner on the flange is driven along a seam."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from flangeye import StageError
from flangeye.devices import DeviceError
from flangeye.errors import NothingMoved
from flangeye.maths.kinematics import Arm
from flangeye.types import Transform
from flangeye_emulators.scanner import MountedParams, scanner_mounted
from flangeye_emulators.world import bench
from tests.plugins.scan.flange_cell import (
    BOX,
    MOUNTED,
    PHOXI,
    UR10E,
    on_flange,
    scan_of_the_plate,
    scanned_along,
    simulated_arm,
)
from tests.plugins.seam.scenes import hand_eye


def test_each_place_looks_straight_at_the_seam_and_is_reported_as_the_arm_stood() -> None:
    scan = scan_of_the_plate()
    assert sum(place.points for place in scan.places) == len(scan.cloud.points())
    ahead = []
    for place in scan.places:
        assert Arm(UR10E).flange(place.joints) == pytest.approx(place.base_T_flange, abs=1e-9)
        ahead.append((place.base_T_flange @ MOUNTED.flange_T_camera @ [0, 0, 0.65, 1])[:3])
    assert np.array(ahead) == pytest.approx(
        np.array([[0.56, -0.05, 0.08], [0.56, 0.05, 0.08]]), abs=1e-3
    )


def test_the_truth_stays_with_the_scan_and_is_of_the_base() -> None:
    truth = scan_of_the_plate().truth["groove"]
    assert truth[:, 0] == pytest.approx([0.565, 0.565])
    assert np.sort(truth[:, 1]) == pytest.approx([-0.1, 0.1])


def test_a_real_arm_moves_only_when_that_is_asked_for() -> None:
    real = replace(simulated_arm(), simulated=False)
    with pytest.raises(NothingMoved, match="would scan from 2 places; nothing moved: add --move"):
        scanned_along(arm=real)


def test_a_scanner_beside_the_arm_is_not_driven() -> None:
    with pytest.raises(StageError, match="stands beside the arm; scan with scan.live"):
        scanned_along(hand_eye())


def test_a_place_out_of_reach_is_named() -> None:
    with pytest.raises(StageError, match="place 1 of 2, above 2560, -50, 80 mm: out of the arm's"):
        scanned_along(start=["2560 mm", "-100 mm", "80 mm"], end=["2560 mm", "100 mm", "80 mm"])


def test_a_place_outside_the_box_is_named() -> None:
    with pytest.raises(StageError, match=r"place 1 of 2.*outside the box: z is 6\d\d mm"):
        scanned_along(box={**BOX, "size": ["1400 mm", "2400 mm", "100 mm"]})


def test_a_mounted_scanner_needs_a_model_and_an_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DeviceError, match="must name the scanner to simulate: scanner.model"):
        scanner_mounted(None, MountedParams())
    monkeypatch.setattr(bench, "newest", lambda: None)
    with pytest.raises(DeviceError, match="no simulated arm carries it; give the recipe robot.dr"):
        scanner_mounted(PHOXI, MountedParams())


def test_a_calibration_turned_is_seen_in_where_the_scanner_is_sent() -> None:
    aside = Transform("camera", "camera2", np.eye(4)).matrix.copy()
    aside[0, 3] = 20e-3
    places = scanned_along(on_flange(error=aside)).places
    assert np.linalg.norm(
        places[0].base_T_flange[:3, 3] - scan_of_the_plate().places[0].base_T_flange[:3, 3]
    ) == pytest.approx(20e-3, abs=1e-3)
