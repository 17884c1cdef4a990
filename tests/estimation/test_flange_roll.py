"""How a plate is turned about its axis: from its holes, wherever the flange and the camera are."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from flangeye.estimation.start.sightings import roll_note, roll_of
from flangeye.types import Floats
from flangeye.types.geometry import basis_of_plane, rotation_exp

CAMERA = rotation_exp(np.array([2.0, 0.3, -0.4]))
STILL = np.zeros((3, 3))


def seen(angles: Floats) -> Any:
    """Return observations of a pattern so turned about the flange's z [rad]."""
    rng, out = np.random.default_rng(0), []
    for angle in angles:
        flange = rotation_exp(rng.uniform(-1, 1, 3))
        normal = CAMERA.T @ flange[:, 2]
        x, y = basis_of_plane(normal)[:2] @ (
            CAMERA.T @ flange @ [np.cos(angle), np.sin(angle), 0.0]
        )
        circle = SimpleNamespace(roll=float(np.arctan2(y, x)), normal=normal)
        out.append(SimpleNamespace(circle=circle, base_T_flange=SimpleNamespace(rotation=flange)))
    return out


def test_the_roll_is_the_patterns_angle_about_the_flanges_z() -> None:
    angles = np.array([0.3, -2.0, 3.1, 1.0])
    assert roll_of(seen(angles), CAMERA) == pytest.approx(angles)
    without = seen(angles)
    without[0].circle.roll = without[2].circle.normal = None
    assert roll_of(without, CAMERA) == pytest.approx(angles[[1, 3]])


@pytest.mark.parametrize("middle", [12.0, 177.5, 179.5, 180.0])
@pytest.mark.parametrize("rotation", [0.0, 2.0])
def test_the_middle_one_is_told_with_its_deviation(middle: float, rotation: float) -> None:
    """Of five that scatter by 1.4826 times 1 deg, and the last by far more."""
    said = roll_note(
        seen(np.radians(middle + np.array([-2, -1, 0, 1, 9]))),
        CAMERA,
        np.diag([0.1, 1.0, 0.2]) * np.radians(rotation) ** 2,
    )
    deviation = np.hypot(1.25 * 1.4826 / np.sqrt(5), rotation)
    assert f"frame: {middle:.2f} +- {deviation:.2f} deg (bolt pattern" in said
    assert said.endswith("in 5 poses); the camera's pose does not depend on it")


@pytest.mark.parametrize("middle", [-140.0, -20.0, 12.0, 70.0, 180.0])
def test_the_middle_one_of_a_wide_scatter_is_told(middle: float) -> None:
    """Angles a third of a turn apart, wherever the half turn lies among them."""
    said = roll_note(seen(np.radians(middle + np.array([-50, -20, 0, 30, 60]))), CAMERA, STILL)
    assert f"frame: {middle:.2f} +- " in said


def test_the_holes_of_two_poses_tell_nothing() -> None:
    every = seen(np.full(5, 0.2))
    for one in every[:3]:
        one.circle.roll = None
    told = "the bolt holes show in 2 of 5 poses"
    assert told in roll_note(every, CAMERA, STILL)
    every[2].circle.roll = every[3].circle.roll
    assert "+-" in roll_note(every, CAMERA, STILL)
