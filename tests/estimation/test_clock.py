"""An arm that moved while it was seen, its poses recorded by a clock of their own."""

import re

import numpy as np
import pytest
from pydantic import TypeAdapter

from flangeye.maths.streams import later, pose_at, rates_of
from flangeye.types import FLANGE2, Motion
from tests.estimation import cells
from tests.estimation.cells import CONFIGURATIONS, OF_MOST, ROBOT, passing, squares

TOLD = re.compile(r"([\d.]+) \+- ([\d.]+) ms (after|before)")
CELLS = [("eye-on-base, marker", "pose"), ("eye-in-hand, base circle", "normal"),
         ("two arms, marker", "pose"), ("eye-on-arm 1, marker", "pose"),
         ("eye-on-arm 2, base circle", "normal")]  # fmt: skip


def solved(name, kind, delay, seed, n=24):
    """Return the squared distance of the camera's pose, of six, and the notes on the clocks."""
    made = passing(CONFIGURATIONS[name], np.random.default_rng(seed), delay, n, feature=kind)
    robot = ROBOT if made.configuration.name == "eye-on-arm" else None
    found = cells.solved(made, robot)
    square = squares(found, made.truth)[0]
    return square, [note for note in found.notes if "the arms reached the recorded poses" in note]


def told(note):
    """Return the delay and its standard deviation [ms]."""
    delay, sigma, which = TOLD.search(note).groups()
    return float(delay) * (1 if which == "after" else -1), float(sigma)


@pytest.mark.parametrize(("name", "kind"), CELLS)
def test_where_there_is_no_delay_hardly_any_is_told(name, kind) -> None:
    square, notes = solved(name, kind, 0.0, 1)
    for found, sigma in map(told, notes):
        assert abs(found) < 4 * sigma + 0.1
    assert square < 1.5 * OF_MOST


@pytest.mark.parametrize(
    ("name", "kind", "delay"), [(*cell, (0.08, -0.03)[i % 2]) for i, cell in enumerate(CELLS)]
)
def test_a_delay_is_found_with_its_deviation_and_the_pose_is_right(name, kind, delay) -> None:
    square, (note,) = solved(name, kind, delay, 0)
    found, sigma = told(note)
    assert found == pytest.approx(1e3 * delay, abs=4 * sigma + 0.1)
    assert sigma < 2
    assert square < 1.5 * OF_MOST


def test_a_motion_tells_other_moments_as_far_as_it_was_recorded() -> None:
    cell = CONFIGURATIONS["eye-on-base, marker"]
    made = passing(cell, np.random.default_rng(0), 0.0, 4)
    motion = made.observations[0].motion
    assert later(motion, 0.21) is None
    read = TypeAdapter(Motion).validate_json(TypeAdapter(Motion).dump_json(motion))
    np.testing.assert_array_equal(read.poses, motion.poses)
    moved = later(motion, 0.1)
    assert moved is not None
    np.testing.assert_array_equal(pose_at(moved, 0.0), pose_at(motion, 0.1))
    assert moved.times[-1] == pytest.approx(0.1)


def test_of_two_arms_the_motions_of_both_are_kept() -> None:
    made = passing(CONFIGURATIONS["two arms, marker"], np.random.default_rng(0), 0.0, 4)
    motion = made.observations[0].motion
    read = TypeAdapter(Motion).validate_json(TypeAdapter(Motion).dump_json(motion))
    np.testing.assert_array_equal(read.others[FLANGE2], motion.others[FLANGE2])
    moved = later(motion, 0.1)
    assert moved is not None
    np.testing.assert_array_equal(pose_at(moved, 0.0, FLANGE2), pose_at(motion, 0.1, FLANGE2))
    rates = rates_of([motion], FLANGE2)[0]
    assert 0.05 < np.linalg.norm(rates[3:]) < 1
