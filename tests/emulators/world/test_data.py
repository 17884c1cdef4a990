"""Every robot and scanner in the catalogue is there, plausible, and says where it is from."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from flangeye.files.paths import bundled
from flangeye.maths.kinematics import Arm
from flangeye.models.loading import load_model
from flangeye.models.targets import plate_of

ROBOTS = sorted(path.stem for path in (bundled("data") / "robots").glob("*.yaml"))
SCANNERS = sorted(path.stem for path in (bundled("data") / "scanners").glob("*.yaml"))

# Reach as the data sheets give it [m]: from the base's axis to the wrist or the flange.
REACH = {
    "ur3e": 0.5, "ur5": 0.85, "ur5e": 0.85, "ur10e": 1.3, "aubo-i5": 0.8865, "franka-panda": 0.855,
}  # fmt: skip


def test_the_papers_robots_and_scanners_are_there() -> None:
    assert {"ur3e", "ur5", "ur5e", "ur10e", "franka-panda", "aubo-i5"} <= set(ROBOTS)
    assert {"phoxi-m", "phoxi-s", "azure-kinect"} <= set(SCANNERS)


@pytest.mark.parametrize("name", ROBOTS)
def test_robot_is_plausible(name: Any) -> None:
    robot = load_model("robots", name)
    assert robot.model == name
    assert len(robot.source) > 20
    assert robot.flange.standard is None or len(robot.flange.source) > 20
    assert 1e-5 <= robot.repeatability <= 2e-4
    assert 1e-5 <= robot.joint_accuracy <= 1e-3
    assert all(joint.lower < joint.upper for joint in robot.joints)
    assert all(0 <= volume.link <= len(robot.joints) for volume in robot.volumes)
    assert all(0.02 <= volume.radius <= 0.1 for volume in robot.volumes)


@pytest.mark.parametrize("name", sorted(REACH))
def test_robot_reaches_as_far_as_its_data_sheet_says(name: Any) -> None:
    arm = Arm(load_model("robots", name))
    joints = np.random.default_rng(0).uniform(
        np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi), (20000, arm.n)
    )
    shoulder = arm.frames(np.zeros(arm.n))[1, :3, 3]
    farthest = np.linalg.norm(arm.flange(joints)[:, :3, 3] - shoulder, axis=1).max()
    # The flange is up to a wrist's length beyond the wrist that data sheets measure to.
    assert REACH[name] - 0.03 <= farthest <= REACH[name] + 0.3


@pytest.mark.parametrize("name", ROBOTS)
def test_flange_fits_together(name: Any) -> None:
    robot = load_model("robots", name)
    if robot.flange.standard is None:
        pytest.skip("its maker's plate could not be checked; the recipe names it")
    flange = plate_of(robot)
    details = flange.details
    assert flange.rim <= flange.outer <= details.wrist / 2
    assert flange.bore is not None
    assert flange.bore < flange.pitch - flange.hole
    assert flange.pitch + max(flange.hole, flange.pin_hole) < flange.rim
    for recess in details.recesses:
        assert flange.bore < recess.radius - recess.width / 2
        assert recess.radius + recess.width / 2 < flange.rim
    assert 0 < details.thickness < details.wrist_length


@pytest.mark.parametrize("name", SCANNERS)
def test_scanner_is_plausible(name: Any) -> None:
    scanner = load_model("scanners", name)
    assert scanner.model == name
    assert len(scanner.source) > 20
    assert 0 < scanner.near < scanner.far
    assert all(np.radians(10) < angle < np.radians(130) for angle in scanner.field_of_view)
    width, height = np.tan(np.array(scanner.field_of_view) / 2)
    pixels = scanner.columns / scanner.rows
    assert width / height == pytest.approx(pixels, rel=0.12), "the pixels are square"
    assert 1e-5 < scanner.temporal_noise < 2e-2
    assert 1e-5 < scanner.calibration_error < 2e-2
    assert scanner.baseline == 0 or scanner.principle == "structured light"


def test_every_yaml_value_of_the_catalogue_has_a_source_line() -> None:
    for kind in ("robots", "scanners"):
        for path in (bundled("data") / kind).glob("*.yaml"):
            assert "source:" in Path(path).read_text()
