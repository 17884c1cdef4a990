"""What most measurements agree on: what is left out of them, and what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from flangeye.errors import CalibrationRefused
from flangeye.handeye.consensus import _require_agreement, _require_half
from flangeye.maths.geometry import hat, rotation_exp
from flangeye.types import Floats, HandEye, Observation
from flangeye_plugins.solve.robust import RobustParams, solve_poses
from tests.handeye.cells import CONFIGURATIONS, ROBOT, errors, session

FLANGE = CONFIGURATIONS["eye-on-base, flange"]
MADE = session(FLANGE, np.random.default_rng(5), n=20, feature="normal")
TURNED = "the measured normals stand {} deg from the robot's flange axis"


def solved(observations: list[Observation]) -> HandEye:
    return solve_poses(observations, RobustParams(), ROBOT, FLANGE)


def with_normals(turned: Callable[[int, Floats], Floats]) -> list[Observation]:
    """Return the session, each normal turned."""
    out = []
    for i, o in enumerate(MADE.observations):
        feature: Any = o.feature
        normal = turned(i, feature.normal)
        size = np.trace(feature.normal_covariance) / 2
        across = -size * hat(normal) @ hat(normal)
        out.append(replace(o, feature=replace(feature, normal=normal, normal_covariance=across)))
    return out


def tilted(normal: Floats, degrees: float) -> Floats:
    """Return a normal turned about an axis across it."""
    across = np.cross(normal, [1.0, 0.0, 0.0])
    axis = across / np.linalg.norm(across)
    return np.asarray(rotation_exp(np.radians(degrees) * axis) @ normal)


def off(found: HandEye) -> float:
    """Return how far the camera is from the truth, in squared standard deviations."""
    error = errors(found.camera, MADE.truth["base_T_camera"])
    return float(error @ np.linalg.solve(found.camera.covariance, error))


def test_normals_that_disagree_are_left_out_and_their_centres_are_not() -> None:
    bad = with_normals(lambda i, n: tilted(n, 6.0) if i in (3, 11) else n)
    found = solved(bad)
    assert "normals left out, for they disagree with the others: 2" in found.notes
    assert all(pair.used for pair in found.pairs)
    assert off(found) < 20.0
    assert not [n for n in solved(MADE.observations).notes if "left out, for they" in n]


def test_normals_that_all_point_inwards_are_left_out() -> None:
    found = solved(with_normals(lambda i, n: -n))
    (note,) = [n for n in found.notes if n.startswith(TURNED.format(180))]
    assert "so they are left out: check the orientation of the poses" in note
    assert off(found) < 20.0


@pytest.mark.parametrize(("degrees", "refused"), [(9.0, False), (12.0, True), (90.0, True)])
def test_normals_that_all_stand_elsewhere_are_a_mistake_of_the_poses(
    degrees: float, refused: bool
) -> None:
    turned = with_normals(lambda i, n: tilted(n, degrees))
    if not refused:
        assert not [n for n in solved(turned).notes if "flange axis" in n]
        return
    with pytest.raises(CalibrationRefused, match=TURNED.format(round(degrees))):
        solved(turned)


def test_half_of_the_poses_have_to_agree_and_three_of_them_at_least() -> None:
    for agreeing, given in ((3, 6), (3, 3), (5, 10)):
        _require_half(np.arange(given) < agreeing, 1e-3)
    for agreeing, given in ((2, 4), (3, 7), (4, 10)):
        told = f"only {agreeing} of {given} poses agree with one camera pose \\(to 1.50 mm per axis"
        with pytest.raises(CalibrationRefused, match=told):
            _require_half(np.arange(given) < agreeing, 1.5e-3)


def test_noise_is_less_than_a_fifth_of_the_poses_extent() -> None:
    """Corners of a box of 0.2 m, so far from its middle as its half diagonal is long."""
    corners = 0.1 * np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    places, extent = corners + [0.4, -0.2, 0.7], 0.1 * np.sqrt(3)
    _require_agreement(places, 0.199 * extent)
    with pytest.raises(CalibrationRefused, match=r"to 34.8 mm per axis only, and lie 173 mm from"):
        _require_agreement(places, 0.201 * extent)
