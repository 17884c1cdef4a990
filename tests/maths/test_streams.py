"""What is kept of streams about a moment: poses, and the joints that go with them."""

import numpy as np
import pytest
from pydantic import TypeAdapter

from flangeye.maths.streams import interpolated, joints_at, later, pose_at, with_joints
from flangeye.models.cell import Axis, Cell
from flangeye.types import Motion
from flangeye.types.geometry import rigid

TIMES = np.linspace(-0.2, 0.2, 21)
POSES = np.array([rigid(np.eye(3), [x, 0.0, 0.0]) for x in TIMES])
MOTION = Motion(TIMES, POSES, {"other": POSES})
STREAM = np.arange(90.0, 110.0, 0.05)


def test_joints_go_along_with_what_passed() -> None:
    values = np.stack([STREAM, 2 * STREAM], axis=1)
    motion = with_joints(MOTION, 100.0, "arm", (STREAM, values))
    assert len(motion.times) == 21
    assert joints_at(motion, 0.1, "arm") == pytest.approx([100.1, 200.2])
    moved = later(motion, 0.1)
    assert moved is not None
    assert joints_at(moved, 0.0, "arm") == pytest.approx([100.1, 200.2])
    assert joints_at(motion, 0.0, "rail") is None
    read = TypeAdapter(Motion).validate_json(TypeAdapter(Motion).dump_json(motion))
    np.testing.assert_array_equal(read.joints["arm"], motion.joints["arm"])
    both = with_joints(motion, 100.0, "rail", (STREAM, STREAM))
    assert {name: each.shape for name, each in both.joints.items()} == {
        "arm": (21, 2), "rail": (21, 1)}  # fmt: skip


def test_a_motion_is_as_long_as_the_stream_of_its_joints_tells() -> None:
    motion = with_joints(MOTION, 90.03, "rail", (STREAM, STREAM))
    assert motion.times[0] == pytest.approx(-0.02)
    assert len(motion.others["other"]) == len(motion.joints["rail"]) == len(motion.times)
    # Before the stream begins, the moment itself is all there is.
    alone = with_joints(MOTION, 89.0, "rail", (STREAM, STREAM))
    assert alone.times == pytest.approx([0.0])


def test_rails_and_positioners_pass_where_their_values_say() -> None:
    rail = Axis(np.array([0.0, 1.0, 0.0]), turns=False, travel=(-1.0, 1.0))
    cell = Cell({}, {"rail": rail, "arm": rail}, (), ())
    motion = with_joints(MOTION, 100.0, "rail", (STREAM, STREAM))
    placed = cell.passing(motion)
    assert {*placed.others} == {"other", "rail"}
    assert pose_at(placed, 0.1, "rail")[:3, 3] == pytest.approx([0.0, 100.1, 0.0])
    assert cell.passing(MOTION).others.keys() == MOTION.others.keys()


@pytest.mark.parametrize("at", [[], [-1.0], [-0.2], [0.0101], [0.2], [1.0], [0.15, -0.13, 0.02]])
def test_poses_between_samples_are_interpolated_and_held_at_the_ends(at: list[float]) -> None:
    poses = interpolated(TIMES, POSES, np.array(at))
    assert poses.shape == (len(at), 4, 4)
    np.testing.assert_allclose(poses[:, 0, 3], np.clip(at, -0.2, 0.2), atol=1e-12)
