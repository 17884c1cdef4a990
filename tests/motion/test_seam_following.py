"""The plane of the work: where a tool points, and how the tip's axes lie in it."""

import numpy as np
import pytest

from flangeye.motion.seam_following import STILL, ToolPose, turned


@pytest.mark.parametrize(
    ("degrees", "direction"), [(0.0, [1.0, 0.0]), (90.0, [0.0, 1.0]), (210.0, [-(0.75**0.5), -0.5])]
)
def test_a_tool_points_along_its_angle_and_the_tip_s_axes_turn_with_it(
    degrees: float, direction: list[float]
) -> None:
    angle = np.radians(degrees)
    along = np.array(direction)
    assert ToolPose(0.0, np.zeros(3), angle).direction == pytest.approx(along)
    left = np.array([-along[1], along[0]])
    expected = np.r_[2.0 * along + 3.0 * left, 5.0]
    assert turned(np.array([2.0, 3.0, 5.0]), angle) == pytest.approx(expected)


def test_still_is_no_motion_at_all() -> None:
    assert STILL.velocity == pytest.approx([0.0, 0.0, 0.0], abs=0.0)
    assert STILL.turn == 0.0
